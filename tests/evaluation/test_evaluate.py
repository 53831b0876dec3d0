"""Episodes, merged grids and submissions in the real environment, on boxes."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from baseline_assets import SHAPES, primitive_cache

import tslam_bench
from tslam_bench.baselines.learned_policy import LearnedBaseline
from tslam_bench.baselines.model_files import make_network
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, VOXEL_EDGE
from tslam_bench.episodes import check_salt, episode_seed, new_salt, policy_seed, shuffled
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation import evaluate as evaluation
from tslam_bench.evaluation.evaluate import (
    EvaluationConfig,
    evaluate,
    make_reconstructors,
    merged_grids,
    reference_grids,
)
from tslam_bench.evaluation.observations import observation_to_numpy, to_numpy
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.policy import Policy
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.grids import voxel_centres, world_to_object
from tslam_bench.scoring.origin import has_origin
from tslam_bench.scoring.rollout import Rollout, rollout_file
from tslam_bench.scoring.submission import read_submission

SALT = "5a17"
PHONE = np.array(SHAPES["test"]["phone"]) / 2


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


def play(env: gym.Env, policy: Policy, name: str, pose: int, seed: int, salt: str) -> Rollout:
    """One episode in an environment of ``gymnasium.make``."""
    policy.reset(1, [policy_seed(salt, (name, pose, seed))])
    observation, _ = env.reset(seed=episode_seed(pose, seed), options={"object": name, "pose": pose})
    actions, joints, ended = [], [to_numpy(observation["qpos"])[0]], False
    while not ended:
        actions.append(policy.act(observation_to_numpy(observation))[0])
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        ended = bool(terminated) or bool(truncated)
        if len(actions) % 10 == 0:
            joints.append(to_numpy(observation["qpos"])[0])
    base = env.unwrapped
    touched, visited, touched_step = (to_numpy(grid)[0] for grid in (base.touched, base.visited, base.touched_step))
    steps = touched_step.astype(np.int16)
    grids = touched.astype(bool), visited.astype(bool), steps
    return Rollout(name, pose, seed, np.stack(actions), *grids, np.stack(joints).astype(np.float32))


@pytest.fixture(scope="module")
def rollouts(cache) -> list[Rollout]:
    """The heuristic on the phone in every pose."""
    env = gym.make(ENVIRONMENT_ID, render_backend="none")
    try:
        return [play(env, make_baseline("heuristic"), "phone", pose, 0, SALT) for pose in range(8)]
    finally:
        env.close()


def distance_to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Unsigned distance (m) of points (M, 3) to the surface of a box centred on the origin."""
    excess = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(excess, 0), axis=1)
    return np.where((excess < 0).all(axis=1), -excess.max(axis=1), outside)


def test_episode_seeds_are_fixed_and_differ() -> None:
    seeds = {episode_seed(pose, seed) for pose in range(8) for seed in range(6)}
    assert len(seeds) == 48 and all(0 <= seed < 2**31 for seed in seeds)
    assert episode_seed(3, 1) == int(hashlib.sha256(b"pose3/seed1").hexdigest()[:8], 16) >> 1
    with pytest.raises(InvalidInputError, match="pose 8"):
        episode_seed(8, 0)


def test_policy_seeds_and_order_follow_from_the_salt() -> None:
    episodes = [(name, pose, seed) for name in ("mug", "hammer") for pose in range(8) for seed in range(3)]
    seeds = {salt: [policy_seed(salt, episode) for episode in episodes] for salt in ("0", "1")}
    assert len({*seeds["0"], *seeds["1"]}) == 2 * len(episodes)
    orders = {salt: shuffled(salt, episodes) for salt in ("0", "1")}
    assert orders["0"] != orders["1"] != episodes and sorted(orders["0"]) == sorted(episodes)
    some = episodes[::3]
    assert shuffled("0", some) == [episode for episode in orders["0"] if episode in some]
    assert len(check_salt(new_salt())) == 32 and new_salt() != new_salt()
    for wrong in ("", "xyz", "A", "0" * 65, None):
        with pytest.raises(InvalidInputError, match="hexadecimal"):
            check_salt(wrong)


class Recogniser:
    """A policy that looks for its object's name in all that it is told before it moves: start, seed, place and order."""

    control_mode = "pd_joint_delta_pos"

    def __init__(self) -> None:
        self.clues: list[dict[str, object]] = []
        self.began = 0

    def reset(self, num_envs: int, seed) -> None:
        self.seeds = list(seed)
        self.first = True

    def act(self, observation):
        count = len(observation["qpos"])
        if self.first:
            for env in range(count):
                start = hashlib.sha256(b"".join(observation[key][env].tobytes() for key in sorted(observation)))
                self.clues.append(
                    {
                        "start": start.hexdigest(),
                        "seed": self.seeds[env],
                        "low bits": self.seeds[env] % 64,
                        "turn": self.began + env,
                        "place": env,
                        "start and turn": (start.hexdigest(), self.began + env),
                    }
                )
            self.began += count
            self.first = False
        return np.zeros((count, NUM_JOINTS), dtype=np.float32)


def test_a_policy_cannot_tell_which_object_it_holds(tmp_path) -> None:
    """It studies one evaluation with the answers, then guesses in another: no clue beats chance, which is one half."""
    episodes = [(name, pose, seed) for name in ("phone", "cubelarge") for seed in (0, 1) for pose in range(8)]
    runs = []
    for salt in ("1", "2"):
        recogniser = Recogniser()
        config = EvaluationConfig(recogniser, ("phone", "cubelarge"), seeds=(0, 1), policy_salt=salt)
        evaluation.explore(config, tmp_path / salt, lambda *_: None)
        runs.append([(c, name) for c, (name, _, _) in zip(recogniser.clues, shuffled(salt, episodes), strict=True)])
    studied, played = runs
    for clue in studied[0][0]:
        seen: dict[object, list[str]] = {}
        for clues, name in studied:
            seen.setdefault(clues[clue], []).append(name)
        guesses = [
            max(sorted(set(known)), key=known.count) if (known := seen.get(c[clue])) else "phone" for c, _ in played
        ]
        right = np.mean([guess == name for guess, (_, name) in zip(guesses, played, strict=True)])
        assert right <= 0.5 + 2 * np.sqrt(0.25 / 32), f"{clue} tells the object: {right:.2f} right"
    starts = {clues["start"] for clues, _ in [*studied, *played]}
    assert len(starts) == 16  # one per pose and repetition, whatever the object


def test_episode_is_complete_and_consistent(rollouts) -> None:
    for pose, rollout in enumerate(rollouts):
        assert (rollout.object, rollout.pose, rollout.seed) == ("phone", pose, 0)
        assert rollout.actions.shape == (HORIZON, NUM_JOINTS) and rollout.actions.dtype == np.float32
        assert np.array_equal(rollout.touched_step >= 0, rollout.touched)
        assert rollout.touched_step.max() < HORIZON
        assert rollout.touched.any() and rollout.visited.sum() > rollout.touched.sum()


def test_replayed_actions_reproduce_the_grids_step_by_step(rollouts) -> None:
    rollout = rollouts[6]
    env = gym.make(ENVIRONMENT_ID, render_backend="none")
    try:
        observation, _ = env.reset(seed=episode_seed(6, 0), options={"object": "phone", "pose": 6})
        first = np.full(rollout.touched.shape, -1)
        for step, action in enumerate(rollout.actions):
            observation, *_ = env.step(action)
            touched = observation["occupancy"][0, 0].numpy().astype(bool)
            first[touched & (first < 0)] = step
    finally:
        env.close()
    assert np.array_equal(first, rollout.touched_step)
    assert np.array_equal(observation["occupancy"][0, 1].numpy().astype(bool), rollout.visited)


def test_touched_voxels_lie_on_the_surface_once_in_the_object_frame(rollouts) -> None:
    reach = VOXEL_EDGE * np.sqrt(3) / 2 + 2e-3
    centres = voxel_centres().reshape(-1, 3)
    wrong_frame = []
    for rollout in rollouts:
        touched = world_to_object(rollout.touched, rollout.pose).reshape(-1)
        assert distance_to_box(centres[touched], PHONE).max() < reach
        wrong_frame.append(distance_to_box(centres[rollout.touched.reshape(-1)], PHONE).max())
    # The same voxels without the turn are off the surface where the pose is a quarter turn: the check can fail.
    assert min(wrong_frame[pose] for pose in (1, 3, 5, 7)) > reach


def test_merged_poses_cover_both_sides(rollouts) -> None:
    touched, visited = merged_grids(rollouts)
    assert touched.sum() > max(rollout.touched.sum() for rollout in rollouts)
    heights = voxel_centres()[touched][:, 2]
    assert heights.max() > 0.5 * PHONE[2] and heights.min() < -0.5 * PHONE[2]  # upright and upside-down poses
    upright, _ = merged_grids(rollouts[:4])
    assert (upright <= touched).all() and (merged_grids(rollouts[:4])[1] <= visited).all()


def test_equal_arguments_give_equal_episodes_in_a_new_environment(rollouts) -> None:
    env = gym.make(ENVIRONMENT_ID, render_backend="none")
    try:
        baseline = make_baseline("heuristic")
        play(env, baseline, "cubelarge", 1, 5, SALT)  # leaves no trace
        again = play(env, baseline, "phone", 3, 0, SALT)
        other = play(env, baseline, "phone", 3, 1, SALT)
        salted = play(env, baseline, "phone", 3, 0, "beef")
    finally:
        env.close()
    assert np.array_equal(again.actions, rollouts[3].actions)
    assert np.array_equal(again.touched_step, rollouts[3].touched_step)
    assert not np.array_equal(other.actions, again.actions)
    assert not np.array_equal(salted.actions, again.actions)


@pytest.mark.parametrize("identifier", ["heuristic", "random", "random_targets", "learned"])
def test_batches_of_episodes_are_bit_for_bit_those_of_gym_make(identifier: str) -> None:
    """The CPU vector environment that evaluation uses, against one ManiSkill environment; five episodes in threes."""
    torch.manual_seed(1)
    torch.set_num_threads(1)
    explorer = (
        LearnedBaseline(make_network("fast", seed=0), "pd_joint_delta_pos", 4)
        if identifier == "learned"
        else make_baseline(identifier)
    )
    episodes = [("phone", 0, 0), ("cubelarge", 5, 0), ("phone", 3, 1), ("cubelarge", 2, 4), ("phone", 6, 0)]
    mode = explorer.control_mode
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 3, "cpu", split="test", control_mode=mode, processes=2)
    batched = [r for first in (0, 3) for r in roll_out_batch(envs, explorer, episodes[first : first + 3], SALT)]
    with pytest.raises(InvalidInputError, match="4 given for 3 environments"):
        roll_out_batch(envs, explorer, episodes[:4], SALT)
    envs.close()
    env = gym.make(ENVIRONMENT_ID, control_mode=mode, render_backend="none")
    if identifier != "random":  # which hardly ever gets down to the object
        assert sum(rollout.touched.sum() for rollout in batched) > 0
    for rollout, episode in zip(batched, episodes, strict=True):
        single = play(env, explorer, *episode, SALT)
        for name, value in vars(single).items():
            assert np.array_equal(getattr(rollout, name), value), (episode, name)
    env.close()


def test_heuristic_touches_more_than_random_targets_and_those_more_than_random(rollouts) -> None:
    means = {}
    for name in ("random", "random_targets"):
        explorer = make_baseline(name)
        env = gym.make(ENVIRONMENT_ID, control_mode=explorer.control_mode, render_backend="none")
        means[name] = np.mean([play(env, explorer, "phone", pose, 0, SALT).touched.sum() for pose in range(8)])
        env.close()
    assert means["random_targets"] > 3 * means["random"]
    assert np.mean([rollout.touched.sum() for rollout in rollouts]) > 1.3 * means["random_targets"]


def test_stored_episode_comes_back(rollouts, tmp_path: Path) -> None:
    path = rollouts[2].save(tmp_path)
    assert path == tmp_path / "phone" / "pose2_seed0.npz"
    loaded = Rollout.load(path)
    for name, value in vars(rollouts[2]).items():
        assert np.array_equal(getattr(loaded, name), value), name
    path.with_name("pose3_seed0.npz").write_bytes(path.read_bytes()[:500])
    for name, reason in (
        ("pose3_seed0.npz", "truncated"),
        ("pose4_seed0.npz", "no such file"),
        ("a.npz", "the name"),
    ):
        with pytest.raises(InvalidInputError, match=f"{name}: .*{reason}"):
            Rollout.load(path.with_name(name))


def test_oracle_grids_are_the_true_surface() -> None:
    touched, visited = reference_grids("oracle", "phone")
    centres = voxel_centres()
    assert distance_to_box(centres[touched], PHONE).max() <= VOXEL_EDGE * np.sqrt(3) / 2
    inside = (np.abs(centres) < PHONE).all(axis=-1)
    assert not visited[inside].any() and visited[~inside].all()
    assert not np.any(reference_grids("nothing", "phone"))


def test_submissions_are_readable_and_resumed(tmp_path: Path) -> None:
    config = EvaluationConfig("heuristic", ("phone",), object_set="quick", label="a label")
    reconstructors = make_reconstructors(("grid", "hull"))

    class Killed(Exception):
        pass

    def kill(stage: str, done: int, total: int) -> None:
        if done == 3:
            raise Killed

    with pytest.raises(Killed):
        evaluate(config, reconstructors, tmp_path, kill)
    folder = tmp_path / "rollouts" / "heuristic"
    kept = sorted(folder.rglob("*.npz"))[0]  # which three were played depends on the salt
    stamp = kept.stat().st_mtime_ns
    stages: list[tuple[str, int, int]] = []
    submissions = evaluate(config, reconstructors, tmp_path, lambda *event: stages.append(event))
    assert kept.stat().st_mtime_ns == stamp and stages[0] == ("explore", 3, 8)
    assert [path.name for path in submissions] == ["heuristic-grid", "heuristic-hull"]

    grid, hull = (read_submission(path) for path in submissions)
    assert has_origin(grid) and has_origin(hull), "heuristic is what it calls itself"
    source = json.loads((folder / "source.json").read_text())
    assert grid.info.policy_salt == source["policy_salt"] and grid.info.control_mode == "pd_joint_delta_pos"
    assert grid.info.label == "a label" and grid.info.explorer == "heuristic" and not grid.info.privileged
    rollouts = {pose: Rollout.load(folder / rollout_file("phone", pose, 0)) for pose in range(8)}
    for pose, rollout in rollouts.items():
        assert np.array_equal(grid.rollout("phone", pose, 0).actions, rollout.actions)
        stored = folder / rollout_file("phone", pose, 0)
        assert all((path / "rollouts" / rollout_file("phone", pose, 0)).samefile(stored) for path in submissions)
    for protocol, poses in ((4, (0, 2, 5, 7)), (8, range(8))):
        touched, _ = merged_grids([rollouts[pose] for pose in poses])
        assert np.array_equal(grid.reconstruction("phone", protocol, 0).probability >= 0.5, touched)
        solid = hull.reconstruction("phone", protocol, 0).query(voxel_centres()[touched]) >= 0.49
        assert solid.all()  # a hull holds the points it was made from

    again: list[tuple[str, int, int]] = []
    evaluate(config, reconstructors, tmp_path, lambda *event: again.append(event))
    assert again[0] == ("explore", 8, 8)


def test_references_write_submissions_without_rollouts(tmp_path: Path) -> None:
    reconstructors = make_reconstructors(("grid",))
    for name, solid in (("oracle", True), ("nothing", False)):
        (path,) = evaluate(EvaluationConfig(name, ("cubelarge",)), reconstructors, tmp_path)
        submission = read_submission(path)
        assert submission.rollout("cubelarge", 0, 0) is None
        assert bool((submission.reconstruction("cubelarge", 8, 0).probability >= 0.5).any()) is solid


def test_episodes_of_other_assets_are_not_mixed(tmp_path: Path) -> None:
    config = EvaluationConfig("random", ("phone",))
    folder = tmp_path / "rollouts" / "random"
    folder.mkdir(parents=True)
    (folder / "source.json").write_text(json.dumps({"policy": "random", "asset_manifest_sha256": "another"}))
    with pytest.raises(InvalidInputError, match=r"holds other episodes \(another .*asset_manifest_sha256"):
        evaluate(config, {}, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objects": ("telephone",)}, "telephone"),
        ({"objects": ()}, "at least one object"),
        ({"seeds": ()}, "one seed"),
        ({"seeds": (1, 1)}, "different"),
        ({"policy": "nope"}, "unknown"),
    ],
)
def test_bad_evaluations(change, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(EvaluationConfig("random", ("phone",)), **change)


def test_bad_reconstructors() -> None:
    with pytest.raises(InvalidInputError, match="'hulk'"):
        make_reconstructors(("hulk",))
    with pytest.raises(InvalidInputError, match="twice"):
        make_reconstructors(("grid", "grid"))
    with pytest.raises(InvalidInputError, match=r"/nowhere/model\.pt"):
        make_reconstructors(("ifnet=/nowhere/model.pt",))
    with pytest.raises(InvalidInputError, match="model"):
        make_reconstructors(("ifnet",))
    assert make_reconstructors(("none",)) == {}
