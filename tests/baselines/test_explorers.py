"""Registered explorers: the registry, the scripted policies, and what a learned one does with a model."""

from __future__ import annotations

import copy
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tslam_bench.baselines.frontier import FrontierBaseline
from tslam_bench.baselines.heuristic import GraspConfig, HeuristicBaseline
from tslam_bench.baselines.learned_policy import LearnedBaseline
from tslam_bench.baselines.model_files import make_network, read_model, write_model
from tslam_bench.baselines.network import NETWORKS, PolicyNetwork
from tslam_bench.baselines.random_actions import RandomBaseline, RandomTargetsBaseline
from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS, PRIVILEGED_REWARD_MODES, REWARD_MODES
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import get_baseline, list_baselines, make_baseline
from tslam_bench.evaluation.policy import Policy, episode_generators
from tslam_bench.evaluation.weights import METADATA_FILE, MODEL_FILE, WEIGHTS_VARIABLE
from tslam_bench.hand_constants import DELTA_STEP, JOINT_LIMITS, JOINT_NAMES, SKIN_LINKS, START_ARM_HIGH


def observation(qpos: np.ndarray, generator: np.random.Generator | None = None) -> dict[str, np.ndarray]:
    """An observation with the given joint positions; the rest is drawn, or zero without a generator."""
    n = len(qpos)
    draw = generator or np.random.default_rng(0)
    filled = {
        "qvel": draw.normal(size=(n, NUM_JOINTS)).astype(np.float32),
        "touch": draw.integers(0, 2, (n, len(SKIN_LINKS)), dtype=np.uint8),
        "occupancy": draw.integers(0, 2, (n, 2, GRID_SIZE, GRID_SIZE, GRID_SIZE), dtype=np.uint8),
        "time": draw.random((n, 1), dtype=np.float32),
    }
    return {"qpos": qpos.astype(np.float32), **{k: v if generator else np.zeros_like(v) for k, v in filled.items()}}


def start(n: int) -> np.ndarray:
    qpos = np.zeros((n, NUM_JOINTS))
    qpos[:, :4] = START_ARM_HIGH
    return np.clip(qpos, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])


METADATA = {"config": {"network": "fast", "control_mode": "pd_joint_pos", "action_repeat": 4}}


@pytest.fixture(scope="module")
def policy() -> PolicyNetwork:
    return make_network("fast", seed=3)


def make(kind: str, policy) -> Policy:
    makers = {
        "random": RandomBaseline,
        "random_targets": RandomTargetsBaseline,
        "heuristic": HeuristicBaseline,
        "frontier": FrontierBaseline,
        "learned": lambda: LearnedBaseline(policy, "pd_joint_pos"),
        "learned held": lambda: LearnedBaseline(policy, "pd_joint_pos", 4),
        "learned mean": lambda: LearnedBaseline(policy, "pd_joint_pos", deterministic=True),
    }
    return makers[kind]()


def moving_hand(baseline: Policy, seeds: list[int], steps: int, floor: float = -1.0) -> list[np.ndarray]:
    """Actions on a hand that does what it is told, but cannot sink below ``floor``: (steps,) of (n, 28)."""
    baseline.reset(len(seeds), seeds)
    qpos, actions = start(len(seeds)), []
    height = JOINT_NAMES.index("ARTy")
    for _ in range(steps):
        actions.append(baseline.act(observation(qpos)))
        qpos = np.clip(qpos + actions[-1] * DELTA_STEP * 0.5, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        qpos[:, height] = np.maximum(qpos[:, height], floor)
    return actions


# -- registry ---------------------------------------------------------------------------------------------------------
def test_baselines_cover_every_reward_mode_once() -> None:
    baselines = [spec for spec in list_baselines() if spec.kind != "reference"]
    assert len(baselines) == 12
    learned = [spec for spec in baselines if spec.kind == "learned"]
    assert sorted(str(spec.reward_mode) for spec in learned) == sorted(REWARD_MODES)
    assert [spec.id for spec in learned if spec.privileged] == [f"tslam_{mode}" for mode in PRIVILEGED_REWARD_MODES]
    assert all(spec.reward_mode is None for spec in list_baselines() if spec.kind != "learned")


def test_unknown_id_lists_the_known_ones() -> None:
    with pytest.raises(InvalidInputError) as caught:
        get_baseline("randm")
    message = str(caught.value)
    assert "'randm'" in message and "\n" not in message
    assert all(spec.id in message for spec in list_baselines())


def test_make_baseline_refuses_what_has_no_policy_or_no_model(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(InvalidInputError, match="no policy"):
        make_baseline("oracle")
    with pytest.raises(InvalidInputError, match="tslam-bench baselines train tslam_knn"):
        make_baseline("tslam_knn")
    with pytest.raises(InvalidInputError, match=f"{tmp_path}.*no finished model.*baselines train tslam"):
        make_baseline("tslam", tmp_path)
    with pytest.raises(InvalidInputError, match="takes no model"):
        make_baseline("random", tmp_path)


class Bomb:
    """Unpickled, it writes a file: what a stranger's model could do if anything read it as a pickle."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "boom")


def spoil(kind: str, folder: Path) -> None:
    """Damages the model in ``folder``, or makes it a stranger's."""
    model, metadata = folder / MODEL_FILE, folder / METADATA_FILE
    record = json.loads(metadata.read_text())
    if kind == "no archive":
        model.write_bytes(b"not an archive")
    elif kind == "cut off":
        model.write_bytes(model.read_bytes()[:-9])
    elif kind == "pickle":
        model.write_bytes(pickle.dumps(Bomb(folder / "boom")))
    elif kind == "torch archive":
        torch.save({"weights": Bomb(folder / "boom")}, model)
    elif kind == "header of 2^60 bytes":
        model.write_bytes((1 << 60).to_bytes(8, "little") + model.read_bytes()[8:])
    elif kind == "other network":
        record["config"]["network"] = "paper"
    elif kind == "unknown network":
        record["config"]["network"] = "__import__('os')"
    elif kind == "not finite":
        network, _ = read_model(folder)
        with torch.no_grad():
            network.log_std[3] = float("nan")
        write_model(folder, network, record)
    elif kind == "no recipe":
        record = ["nothing"]
    elif kind == "other mode":
        record["config"]["control_mode"] = "torque"
    elif kind == "endless":
        record["config"]["action_repeat"] = 0
    elif kind == "other noise":
        record["config"]["noise_correlation"] = 1.5
    metadata.write_text(json.dumps(record) if kind != "no json" else "{")


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("no archive", "cannot be read"),
        ("cut off", "cannot be read"),
        ("pickle", "cannot be read"),
        ("torch archive", "cannot be read"),
        ("header of 2^60 bytes", "cannot be read"),
        ("other network", "cannot be read"),
        ("unknown network", "unknown; choose one of fast, hand, paper"),
        ("not finite", "not finite"),
        ("no recipe", "cannot be read"),
        ("no json", "cannot be read"),
        ("other mode", "control_mode 'torque'"),
        ("endless", "action_repeat 0"),
        ("other noise", "noise_correlation 1.5"),
    ],
)
def test_damaged_or_hostile_model_is_one_line_and_runs_no_code(kind: str, message: str, policy, tmp_path) -> None:
    write_model(tmp_path, policy, METADATA)
    make_baseline("tslam", tmp_path)
    spoil(kind, tmp_path)
    with pytest.raises(InvalidInputError, match="train it: tslam-bench baselines train tslam") as caught:
        make_baseline("tslam", tmp_path)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "boom").exists()


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_a_model_that_was_written_is_read_as_it_was(name: str, tmp_path) -> None:
    network = make_network(name, 0.3, seed=4)
    write_model(tmp_path, network, {"config": {**METADATA["config"], "network": name}})
    again, _ = read_model(tmp_path)
    for (key, one), other in zip(network.state_dict().items(), again.state_dict().values(), strict=True):
        assert torch.equal(one, other), key


def test_a_model_in_half_precision_acts_in_single(policy, tmp_path) -> None:
    write_model(tmp_path, copy.deepcopy(policy).half(), METADATA)
    again, _ = read_model(tmp_path)
    assert again.log_std.dtype == torch.float32 and (tmp_path / MODEL_FILE).stat().st_size < 1e6
    assert torch.allclose(again.log_std, policy.log_std, atol=1e-3)
    make_baseline("tslam", tmp_path).reset(1, 0)


def test_scripted_baselines_need_no_torch() -> None:
    code = (
        "import sys; from tslam_bench.evaluation.policies import make_baseline, list_baselines\n"
        "make_baseline('random'); make_baseline('heuristic'); list_baselines()\n"
        "assert not {'torch', 'sapien', 'stable_baselines3'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


# -- every policy -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "kind", ["random", "random_targets", "heuristic", "frontier", "learned", "learned held", "learned mean"]
)
def test_actions_are_in_range_and_repeat_with_the_seed(kind: str, policy) -> None:
    first = moving_hand(make(kind, policy), [5, 6], 40)
    again = moving_hand(make(kind, policy), [5, 6], 40)
    for a, b in zip(first, again, strict=True):
        assert a.shape == (2, NUM_JOINTS) and a.dtype == np.float32
        assert np.abs(a).max() <= 1 and np.isfinite(a).all()
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    "kind", ["random", "random_targets", "heuristic", "frontier", "learned", "learned held", "learned mean"]
)
def test_an_episode_does_not_depend_on_its_batch(kind: str, policy) -> None:
    together = moving_hand(make(kind, policy), [11, 12, 13], 60)
    alone = moving_hand(make(kind, policy), [12], 60)
    assert np.array_equal(np.stack(together)[:, 1], np.stack(alone)[:, 0])


@pytest.mark.parametrize("kind", ["random", "random_targets", "heuristic", "learned"])
def test_seeds_matter(kind: str, policy) -> None:
    one, other = (np.stack(moving_hand(make(kind, policy), [seed], 30)) for seed in (1, 2))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("kind", ["random", "random_targets", "heuristic", "learned"])
def test_wrong_batch_is_refused(kind: str, policy) -> None:
    baseline = make(kind, policy)
    baseline.reset(2, 0)
    with pytest.raises(InvalidInputError, match="qpos has shape"):
        baseline.act(observation(start(3)))


def test_generators() -> None:
    with pytest.raises(InvalidInputError, match="at least 1"):
        episode_generators(0, 1)
    with pytest.raises(InvalidInputError, match="negative"):
        episode_generators(2, [1, -1])
    with pytest.raises(InvalidInputError, match="one per episode"):
        episode_generators(3, [1, 2])
    draws = [generator.random() for generator in episode_generators(4, 9)]
    assert len(set(draws)) == 4


# -- random -----------------------------------------------------------------------------------------------------------
def test_random_is_uniform_and_never_repeats() -> None:
    baseline = RandomBaseline()
    baseline.reset(8, 4)
    steps = 2 * HORIZON + 50  # goes on past the horizon
    actions = np.stack([baseline.act(observation(start(8))) for _ in range(steps)])
    assert len(np.unique(actions[:, 0, 0])) == steps
    # 126,000 draws: standard error 0.0016 of the mean and 0.0008 of the variance
    assert abs(actions.mean()) < 0.008 and abs(actions.var() - 1 / 3) < 0.004
    counts, _ = np.histogram(actions, bins=10, range=(-1, 1))
    assert np.abs(counts / actions.size - 0.1).max() < 0.005


# -- random targets ----------------------------------------------------------------------------------------------------
def test_random_targets_are_held_and_normal() -> None:
    baseline = RandomTargetsBaseline()
    baseline.reset(8, 4)
    assert baseline.control_mode == "pd_joint_pos"
    steps = 2 * HORIZON + 48
    actions = np.stack([baseline.act(observation(start(8))) for _ in range(steps)])
    held = actions.reshape(steps // 4, 4, 8, NUM_JOINTS)
    assert (held == held[:, :1]).all() and len(np.unique(held[:, 0, 0, 0])) > 100
    drawn = held[:, 0].reshape(-1)
    inside = np.abs(drawn) < 1
    # 25,088 draws: P(|x| < 1) = 0.9044 and P(|x| < 0.6) = 0.6827 for a normal of deviation 0.6; standard errors .002, .003
    assert abs(inside.mean() - 0.9044) < 0.008 and abs((np.abs(drawn) < 0.6).mean() - 0.6827) < 0.012
    assert abs(drawn.mean()) < 0.015 and np.abs(drawn).max() == 1


# -- heuristic --------------------------------------------------------------------------------------------------------
def phases_of(floor: float, seeds: list[int], steps: int = HORIZON) -> tuple[np.ndarray, np.ndarray]:
    """Arm heights (steps, n) and mean finger flexion (steps, n) under the heuristic, above a floor."""
    baseline = HeuristicBaseline()
    baseline.reset(len(seeds), seeds)
    qpos = start(len(seeds))
    height = JOINT_NAMES.index("ARTy")
    flexion = [JOINT_NAMES.index(f"{finger}J2") for finger in ("FF", "MF", "RF", "LF")]
    heights, flexions = [], []
    for _ in range(steps):
        action = baseline.act(observation(qpos))
        qpos = np.clip(qpos + action * DELTA_STEP * 0.5, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        qpos[:, height] = np.maximum(qpos[:, height], floor)
        heights.append(qpos[:, height].copy())
        flexions.append(qpos[:, flexion].mean(axis=1))
    return np.stack(heights), np.stack(flexions)


def test_heuristic_closes_where_it_meets_an_obstacle_and_comes_back() -> None:
    floor = 0.06
    heights, flexions = phases_of(floor, [0, 1, 2, 3])
    closed = flexions > 1.0
    closing = closed[1:] & ~closed[:-1]
    assert (heights[1:][closing] < floor + 0.01).all()  # the hand closes on the obstacle, not in the air
    closings = closing.sum(axis=0)
    openings = (~closed[1:] & closed[:-1]).sum(axis=0)
    assert (closings >= 2).all() and (openings >= 1).all()  # reopened and repeated
    assert (heights.max(axis=0) > floor + 0.03).all()


def test_heuristic_stops_at_its_depth_when_nothing_is_there() -> None:
    config = GraspConfig()
    heights, flexions = phases_of(-1.0, [0, 1, 2, 3])
    assert heights.min() > config.depth[0] - config.press - 0.01  # the closing hand presses on
    assert heights.min() < config.depth[1]
    assert (flexions.max(axis=0) > 1.0).all()


def test_heuristic_visits_different_spots() -> None:
    baseline = HeuristicBaseline()
    baseline.reset(1, 3)
    qpos, spots = start(1), []
    side, flexion = JOINT_NAMES.index("ARTx"), JOINT_NAMES.index("FFJ2")
    for _ in range(HORIZON):
        action = baseline.act(observation(qpos))
        qpos = np.clip(qpos + action * DELTA_STEP * 0.5, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])
        if qpos[0, flexion] > 1.2:
            spots.append(round(float(qpos[0, side]), 2))
    assert len(set(spots)) >= 3


# -- learned ----------------------------------------------------------------------------------------------------------
def test_learned_samples_around_its_mean(policy) -> None:
    qpos = np.repeat(start(1), 400, axis=0)
    drawn, mean = make("learned", policy), make("learned mean", policy)
    drawn.reset(400, list(range(400)))
    mean.reset(400, 0)
    centre, actions = mean.act(observation(qpos)), drawn.act(observation(qpos))
    assert np.allclose(centre, centre[:1], atol=1e-5)
    deviation = float(policy.log_std.detach().exp()[0])
    inside = np.abs(actions) < 1
    standard = (actions - centre)[np.abs(centre) < 0.2] / deviation
    assert abs(np.median(standard)) < 0.05  # clipping at +-1 does not move the median
    assert 0.7 < inside.mean() < 1.0


def test_learned_agrees_with_the_network_it_was_made_from(policy) -> None:
    generator = np.random.default_rng(8)
    seen = observation(np.repeat(start(1), 3, axis=0) + generator.normal(size=(3, NUM_JOINTS)) * 0.1, generator)
    baseline = make("learned mean", policy)
    baseline.reset(3, 0)
    with torch.no_grad():
        mean, *_ = policy(policy.encode({key: torch.from_numpy(value) for key, value in seen.items()}))
    assert np.allclose(baseline.act(seen), mean.clamp(-1, 1), atol=1e-5)


def test_learned_holds_each_action_and_then_looks_again(policy) -> None:
    baseline = LearnedBaseline(policy, "pd_joint_pos", 4)
    every = LearnedBaseline(policy, "pd_joint_pos", 1)
    for each in (baseline, every):
        each.reset(2, [3, 4])
    qpos = [start(2) + 0.01 * step for step in range(12)]
    actions = np.stack([baseline.act(observation(q)) for q in qpos])
    for first in (0, 4, 8):
        assert (actions[first : first + 4] == actions[first]).all()
        assert np.array_equal(actions[first], every.act(observation(qpos[first])))  # the same noise per decision
    assert not np.array_equal(actions[0], actions[4])
    assert baseline.control_mode == "pd_joint_pos"


def test_learned_noise_is_as_broad_and_as_correlated_as_it_says(policy) -> None:
    """By signs and medians, which the clip at +-1 leaves alone."""
    count, steps, correlation = 50, 40, 0.7
    drawn = LearnedBaseline(policy, "pd_joint_pos", 1, noise_correlation=correlation)
    still = observation(np.repeat(start(1), count, axis=0))
    centre = LearnedBaseline(policy, "pd_joint_pos", deterministic=True)
    centre.reset(count, 0)
    mean = centre.act(still)
    assert np.abs(mean).max() < 0.5
    drawn.reset(count, 0)
    noise = np.stack([drawn.act(still) for _ in range(steps)]) - mean
    pairs = np.stack([noise[:-1], noise[1:]]).reshape(2, -1)
    deviation = float(policy.log_std.detach().exp()[0])
    quadrants = (np.sign(pairs[0]) == np.sign(pairs[1])).mean()
    assert quadrants == pytest.approx(0.5 + np.arcsin(correlation) / np.pi, abs=0.01)  # of two such normals
    assert np.median(np.abs(noise)) / deviation == pytest.approx(0.6745, abs=0.02)
    drawn.reset(count, 0)
    assert np.array_equal(drawn.act(still) - mean, noise[0])  # an episode begins with fresh noise
