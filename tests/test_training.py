"""PPO training in the real environment on two boxes: it resumes exactly, learns, and refuses bad settings."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from baseline_assets import primitive_cache
from counting_environment import Counter
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tslam_bench.baselines import training
from tslam_bench.baselines.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.baselines.learned import read_policy
from tslam_bench.baselines.registry import make_baseline
from tslam_bench.baselines.training import train
from tslam_bench.baselines.training_config import MODEL_FILE, TrainingConfig
from tslam_bench.baselines.vector import TactileVecEnv
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.leaderboard.submission import read_submission

CONFIG = TrainingConfig(
    baseline="tslam",
    steps=120,
    num_envs=2,
    rollout_steps=20,
    batch_size=20,
    epochs=2,
    network="small",
    checkpoint_every=40,
    processes=1,
)


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


def weights(output: Path) -> list[torch.Tensor]:
    return list(read_policy(output).state_dict().values())


def test_finished_run_holds_what_it_promises(straight: Path) -> None:
    metadata = json.loads((straight / "model.json").read_text())
    assert metadata["steps"] == 120 and metadata["baseline"] == "tslam" and metadata["reward_mode"] == "tslam"
    assert metadata["assets"]["objects"] == 2 and len(metadata["assets"]["sha256"]) == 64
    assert metadata["command"] == "the command" and metadata["seconds"] > 0 and metadata["machine"]["cores"] >= 1
    assert not (straight / "checkpoints").exists()
    events = EventAccumulator(str(straight / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("time/fps")] == [40, 80, 120]
    baseline = make_baseline("tslam", straight)
    baseline.reset(1, 0)


def test_submission_of_a_trained_model_states_its_budget(straight: Path, tmp_path: Path) -> None:
    config = EvaluationConfig("tslam", ("phone",), object_set="quick", model=straight)
    (path,) = evaluate(config, make_reconstructors(("grid",)), tmp_path)
    info = read_submission(path).info
    assert info.training.steps == 120 and info.training.wall_time_hours > 0 and "cores" in info.training.hardware
    assert (info.explorer, info.reward_mode, info.privileged) == ("tslam", "tslam", False)
    other = tmp_path / "other"
    shutil.copytree(straight, other)
    (other / MODEL_FILE).write_bytes((straight / MODEL_FILE).read_bytes() + b" ")
    with pytest.raises(InvalidInputError, match="episodes of another model"):
        evaluate(replace(config, model=other), make_reconstructors(("grid",)), tmp_path)


def test_policy_read_without_pickle_is_the_saved_one(straight: Path) -> None:
    model = PPO.load(straight / MODEL_FILE, device="cpu")
    for ours, theirs in zip(weights(straight), model.policy.state_dict().values(), strict=True):
        assert torch.equal(ours, theirs)


def test_killed_and_resumed_run_ends_with_the_same_weights(straight: Path, tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill_at(limit: int):
        def report(done: int) -> None:
            if done >= limit:
                raise Killed

        return report

    for limit in (10, 60, 110):  # before the first checkpoint, and twice between checkpoints
        with pytest.raises(Killed):
            train(CONFIG, tmp_path, on_progress=kill_at(limit))
        assert not (tmp_path / "model.json").exists()
        with pytest.raises(InvalidInputError, match="no finished model"):
            make_baseline("tslam", tmp_path)
    # A write that was cut off leaves a hidden folder, which must not be taken for a checkpoint.
    (tmp_path / "checkpoints" / ".0000000120-cut").mkdir()
    metadata = train(CONFIG, tmp_path)
    assert metadata["steps"] == 120
    for straight_weight, resumed_weight in zip(weights(straight), weights(tmp_path), strict=True):
        assert torch.equal(straight_weight, resumed_weight)


def test_checkpoint_of_other_objects_is_refused(tmp_path: Path, cache: Path) -> None:
    class Killed(Exception):
        pass

    def kill(done: int) -> None:
        if done > 40:
            raise Killed

    with pytest.raises(Killed):
        train(CONFIG, tmp_path, on_progress=kill)
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
    assert train(CONFIG, straight)["steps"] == 120
    assert (straight / MODEL_FILE).read_bytes() == before


def test_other_settings_in_the_same_folder_are_refused(straight: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"steps 120 there, 160 here.*choose another output"):
        train(replace(CONFIG, steps=160), straight)


def test_every_parameter_is_trained(straight: Path, tmp_path: Path) -> None:
    train(replace(CONFIG, steps=40), tmp_path)
    for (name, early), late in zip(read_policy(tmp_path).state_dict().items(), weights(straight), strict=True):
        if "joint_" not in name:  # the joint limits are constants
            assert not torch.equal(early, late), name


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
        ({"gamma": 1.5}, "gamma"),
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
    for one, other in zip(weights(straight), weights(tmp_path), strict=True):
        assert torch.equal(one, other)
    assert train(replace(CONFIG, processes=1), tmp_path)["steps"] == 120  # no other settings: nothing to refuse


def test_torch_threads_are_one_unless_asked_for(tmp_path: Path) -> None:
    before = torch.get_num_threads()
    try:
        for asked, expected in ((None, 1), (2, 2)):
            torch.set_num_threads(3)
            config = replace(CONFIG, steps=40) if asked is None else replace(CONFIG, steps=40, torch_threads=asked)
            train(config, tmp_path / str(asked))
            assert torch.get_num_threads() == expected
    finally:
        torch.set_num_threads(before)


def test_rounding_of_budgets() -> None:
    config = replace(CONFIG, steps=81, checkpoint_every=41)
    assert (config.iteration_steps, config.total_steps, config.chunk_steps) == (40, 120, 80)


def test_learner_improves_where_improving_is_easy(tmp_path: Path) -> None:
    """The whole learner on a hand-made task with the real observation space: it finds out what pays."""

    class PaysForClosing(Counter):
        """Pays the mean of the action: the best policy saturates at 1."""

        def __init__(self) -> None:
            super().__init__((20,) * 8)
            shapes = {"qpos": (28,), "qvel": (28,), "touch": (18,), "time": (1,)}
            entries = {key: spaces.Box(-np.inf, np.inf, shape, np.float32) for key, shape in shapes.items()}
            entries["occupancy"] = spaces.Box(0, 1, (2, 32, 32, 32), np.uint8)
            self.set_spaces(entries, 28)
            self.zeros = {
                key: torch.zeros(8, *space.shape, dtype=torch.uint8 if space.dtype == np.uint8 else torch.float32)
                for key, space in entries.items()
            }

        def _observe(self):
            return self.zeros

        def pay(self):
            assert self.last_actions is not None
            return self.last_actions.mean(dim=1)

    torch.set_num_threads(1)
    environments = VecNormalize(VecMonitor(TactileVecEnv(PaysForClosing())), norm_obs=False)
    config = replace(CONFIG, num_envs=8, rollout_steps=20, batch_size=40, epochs=5, learning_rate=1e-3)
    model = training._new_model(config, environments)
    returns = []
    for _ in range(12):
        model.ep_info_buffer = None
        model.learn(160, reset_num_timesteps=False)
        returns.append(np.mean([episode["r"] for episode in model.ep_info_buffer]))
    assert returns[-1] > returns[0] + 2.0  # of 20 at most; the first is about 0
