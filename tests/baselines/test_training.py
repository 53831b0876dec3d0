"""Training runs in the real environment on two boxes: they resume exactly, log, and refuse bad settings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from baseline_assets import primitive_cache
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tslam_bench.baselines import training
from tslam_bench.baselines.model_files import read_model
from tslam_bench.baselines.training import train
from tslam_bench.baselines.training_config import TrainingConfig
from tslam_bench.constants import HORIZON
from tslam_bench.engine.rewards import COVERAGE_WEIGHT
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.weights import MODEL_FILE
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.scoring.submission import read_submission

CONFIG = TrainingConfig(
    baseline="tslam",
    steps=2400,
    num_envs=2,
    rollout_steps=200,
    action_repeat=20,
    batch_size=5,
    epochs=2,
    checkpoint_every=800,
    processes=1,
    torch_threads=1,
)
"""Six iterations of one episode of both hands, with a checkpoint after every second."""
Report = Callable[[int, dict[str, float]], None]


class Killed(Exception):
    pass


def kill_at(limit: int) -> Report:
    def report(done: int, figures: dict[str, float]) -> None:
        if done >= limit:
            raise Killed

    return report


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def straight(cache, tmp_path_factory) -> Path:
    """A run that was never interrupted."""
    output = tmp_path_factory.mktemp("models") / "straight"
    train(CONFIG, output, command="the command")
    return output


def weights(output: Path) -> dict[str, torch.Tensor]:
    return dict(read_model(output)[0].state_dict())


def same(one: Path, other: Path) -> bool:
    pairs = zip(weights(one).values(), weights(other).values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def test_finished_run_holds_what_it_promises(straight: Path) -> None:
    metadata = json.loads((straight / "model.json").read_text())
    assert metadata["steps"] == 2400 and metadata["baseline"] == "tslam" and metadata["reward_mode"] == "tslam"
    assert metadata["assets"]["objects"] == 2 and len(metadata["assets"]["sha256"]) == 64
    assert metadata["command"] == "the command" and metadata["seconds"] > 0 and metadata["machine"]["cores"] >= 1
    assert metadata["control_mode"] == "pd_joint_pos" and metadata["action_repeat"] == 20 and metadata["seed"] == 0
    assert not (straight / "checkpoints").exists()
    baseline = make_baseline("tslam", straight)
    assert baseline.control_mode == "pd_joint_pos"


def test_curves_add_up(straight: Path) -> None:
    curve = [json.loads(line) for line in (straight / "curve.jsonl").read_text().splitlines()]
    assert [line["steps"] for line in curve] == [400, 800, 1200, 1600, 2000, 2400]
    for line in curve:
        terms = line["episode/reward_discovery"] + line["episode/reward_coverage"]
        assert line["episode/return"] == pytest.approx(terms, rel=1e-4)
        assert line["episode/reward_coverage"] == pytest.approx(
            COVERAGE_WEIGHT * line["episode/visited_voxels"], rel=1e-4
        )
        assert line["episode/reward_discovery"] == pytest.approx(line["episode/touched_voxels"], abs=1e-3)
        assert line["episode/visited_voxels"] > 1000 and line["time/steps_per_second"] > 0
    events = EventAccumulator(str(straight / "tensorboard"))
    events.Reload()
    promised = {"episode/return", "episode/touched_voxels", "episode/reward_discovery", "episode/reward_coverage"}
    promised |= {f"train/{name}" for name in ("entropy", "approximate_kl", "clip_fraction", "explained_variance")}
    assert promised | {"time/steps_per_second"} <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("episode/return")] == [line["steps"] for line in curve]


def test_submission_of_a_trained_model_states_its_budget(straight: Path, tmp_path: Path) -> None:
    config = EvaluationConfig("tslam", ("phone",), object_set="quick", model=straight)
    (path,) = evaluate(config, make_reconstructors(("grid",)), tmp_path)
    info = read_submission(path).info
    assert info.training.steps == 2400 and info.training.wall_time_hours > 0 and "cores" in info.training.hardware
    assert (info.explorer, info.reward_mode, info.privileged) == ("tslam", "tslam", False)
    assert info.control_mode == "pd_joint_pos"
    actions = np.load(next((tmp_path / "rollouts" / "tslam" / "phone").glob("*.npz")))["actions"]
    held = actions.reshape(HORIZON // 20, 20, -1)
    assert (held == held[:, :1]).all()
    assert (held[1:, 0] != held[:-1, 0]).any(axis=1).all()  # a joint may well be at its limit twice
    other = tmp_path / "other"
    shutil.copytree(straight, other)
    train(replace(CONFIG, seed=5, steps=400), tmp_path / "second")
    (other / MODEL_FILE).write_bytes((tmp_path / "second" / MODEL_FILE).read_bytes())
    with pytest.raises(InvalidInputError, match="holds other episodes"):
        evaluate(replace(config, model=other), make_reconstructors(("grid",)), tmp_path)


def test_killed_and_resumed_run_ends_with_the_same_weights(straight: Path, tmp_path: Path) -> None:
    for limit in (40, 1000, 2200):  # before the first checkpoint, and twice between checkpoints
        with pytest.raises(Killed):
            train(CONFIG, tmp_path, on_progress=kill_at(limit))
        assert not (tmp_path / "model.json").exists()
        with pytest.raises(InvalidInputError, match="no finished model"):
            make_baseline("tslam", tmp_path)
    # A write that was cut off leaves a hidden folder, which must not be taken for a checkpoint.
    (tmp_path / "checkpoints" / ".0000002400-cut").mkdir()
    with (tmp_path / "curve.jsonl").open("a") as file:
        file.write('{"steps": 2000, "episode/ret')
    metadata = train(CONFIG, tmp_path)
    assert metadata["steps"] == 2400 and same(straight, tmp_path)
    curves = [
        [{k: v for k, v in json.loads(line).items() if "time/" not in k} for line in text.splitlines()]
        for text in ((folder / "curve.jsonl").read_text() for folder in (straight, tmp_path))
    ]
    assert curves[0] == curves[1]


def test_rollouts_shorter_than_an_episode_resume_as_well(tmp_path: Path) -> None:
    config = replace(CONFIG, rollout_steps=60, steps=480, checkpoint_every=240)
    train(config, tmp_path / "straight")
    with pytest.raises(Killed):
        train(config, tmp_path / "killed", on_progress=kill_at(400))
    train(config, tmp_path / "killed")
    assert same(tmp_path / "straight", tmp_path / "killed")
    (first, *_) = (tmp_path / "straight" / "curve.jsonl").read_text().splitlines()
    assert "episode/return" not in json.loads(first)  # no episode has ended yet


def test_checkpoint_of_other_objects_is_refused(tmp_path: Path, cache: Path) -> None:
    with pytest.raises(Killed):
        train(CONFIG, tmp_path, on_progress=kill_at(1000))
    moved = cache / "objects" / "plate"
    (cache / "objects" / "train" / "plate").rename(moved)
    try:
        with pytest.raises(InvalidInputError, match="begun with other objects"):
            train(CONFIG, tmp_path)
    finally:
        moved.rename(cache / "objects" / "train" / "plate")


def test_split_that_is_not_prepared(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"no object is prepared; run 'tslam-bench assets prepare --split val'"):
        train(replace(CONFIG, split="val"), tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_finished_model_is_not_trained_again(straight: Path, monkeypatch) -> None:
    monkeypatch.setattr(training, "make_training_environments", lambda config: pytest.fail("environments were made"))
    before = (straight / MODEL_FILE).read_bytes()
    assert train(CONFIG, straight)["steps"] == 2400
    assert (straight / MODEL_FILE).read_bytes() == before


def test_other_settings_in_the_same_folder_are_refused(straight: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"steps 2400 there, 2800 here.*choose another output"):
        train(replace(CONFIG, steps=2800), straight)


def test_every_parameter_is_trained(straight: Path, tmp_path: Path) -> None:
    train(replace(CONFIG, steps=400), tmp_path)
    late = weights(straight)
    for name, early in weights(tmp_path).items():
        assert not torch.equal(early, late[name]), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": "heuristic"}, "nothing to train"),
        ({"baseline": "nope"}, "unknown"),
        ({"split": "test"}, "train split only"),
        ({"steps": 0}, "steps 0"),
        ({"num_envs": -1}, "num_envs -1"),
        ({"seed": -1}, "seed -1"),
        ({"network": "huge"}, "network 'huge'"),
        ({"control_mode": "torque"}, "control_mode 'torque'"),
        ({"gamma": 1.5}, "gamma"),
        ({"learning_rate": float("nan")}, "learning_rate nan"),
        ({"initial_std": 0.0}, "initial_std 0.0"),
        ({"initial_arm_std": -0.3}, "initial_arm_std -0.3"),
        ({"initial_aim": (0.0, -1.4, 0.0)}, r"initial_aim \(0.0, -1.4, 0.0\)"),
        ({"clock": 7}, "clock 7"),
        ({"noise_correlation": -0.1}, "noise_correlation -0.1"),
        ({"final_learning_rate": 1.1}, "final_learning_rate 1.1"),
        ({"entropy_coefficient": -1.0}, "entropy_coefficient -1.0"),
        ({"rollout_steps": 30}, "rollout_steps 30: must be a multiple of action_repeat 20"),
        ({"action_repeat": 3, "rollout_steps": 201}, "action_repeat 3: must divide the 200 steps"),
    ],
)
def test_bad_settings_are_one_line_and_write_nothing(change, message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=message) as caught:
        train(replace(CONFIG, **change), tmp_path / "model")
    assert "\n" not in str(caught.value) and not (tmp_path / "model").exists()


def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(AssetError, match="cannot be written"):
        train(CONFIG, tmp_path / "file" / "model")


def test_objects_restrict_the_draw(cache) -> None:
    environments = training.make_training_environments(replace(CONFIG, objects=("plate",), num_envs=4))
    try:
        environments.reset(seed=0)
        assert environments.state()["object_name"] == ["plate"] * 4
    finally:
        environments.close()


def test_the_number_of_processes_changes_nothing(straight: Path, tmp_path: Path) -> None:
    train(replace(CONFIG, processes=2), tmp_path)
    assert same(straight, tmp_path)
    assert train(replace(CONFIG, processes=1), tmp_path)["steps"] == 2400  # no other settings: nothing to refuse


def test_threads_are_given_back(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        train(replace(CONFIG, steps=400), tmp_path)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_the_paper_network_trains_in_the_other_control_mode(tmp_path: Path) -> None:
    config = replace(CONFIG, network="paper", control_mode="pd_joint_delta_pos", steps=400)
    assert train(config, tmp_path)["control_mode"] == "pd_joint_delta_pos"
    assert make_baseline("tslam", tmp_path).control_mode == "pd_joint_delta_pos"


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_joint_delta_pos"])
def test_an_untrained_policy_aims_and_scatters_as_it_is_told(mode: str) -> None:
    """Absolute targets of the arm are drawn around the aim; differences around standing still."""
    config = replace(
        CONFIG, control_mode=mode, initial_std=0.9, initial_arm_std=0.2, initial_aim=(0.1, -0.4, 0.3), clock=3
    )
    network = training.untrained_network(config)
    seen = {
        "qpos": torch.zeros(4, 28),
        "qvel": torch.zeros(4, 28),
        "touch": torch.zeros(4, len(SKIN_LINKS), dtype=torch.uint8),
        "occupancy": torch.zeros(4, 2, 32, 32, 32, dtype=torch.uint8),
        "time": torch.linspace(0, 1, 4)[:, None],
    }
    with torch.no_grad():
        mean, log_std = network.distribution(network.encode(seen))
    aim = [0.1, -0.4, 0.3] if mode == "pd_joint_pos" else [0.0, 0.0, 0.0]
    expected = torch.tensor([*aim, *[0.0] * 25])
    assert torch.allclose(mean, expected.expand_as(mean), atol=0.1)
    assert torch.allclose(log_std.exp(), torch.tensor([*[0.2] * 3, *[0.9] * 25]).expand_as(mean))


def test_the_clock_turns_twice_as_often_with_each_pair() -> None:
    network = training.untrained_network(replace(CONFIG, clock=3))
    time = np.array([0.0, 0.1, 0.7], dtype=np.float32)
    empty = {
        "qpos": torch.zeros(3, 28),
        "qvel": torch.zeros(3, 28),
        "touch": torch.zeros(3, len(SKIN_LINKS), dtype=torch.uint8),
        "occupancy": torch.zeros(3, 2, 32, 32, 32, dtype=torch.uint8),
        "time": torch.from_numpy(time)[:, None],
    }
    flat = network.encode(empty).flat.numpy()[:, -6:]
    angles = 2 * np.pi * time[:, None] * [1, 2, 4]
    np.testing.assert_allclose(flat, np.concatenate([np.sin(angles), np.cos(angles)], axis=1), atol=1e-5)


def test_rounding_of_budgets() -> None:
    config = replace(CONFIG, steps=801, checkpoint_every=401)
    assert (config.iteration_steps, config.total_steps, config.chunk_steps, config.decisions) == (400, 1200, 800, 10)
