"""Shipped weights: exported, read back, explored with and recorded; with none, some and all seeds there."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tslam_bench import cli
from tslam_bench.baselines.export import MOST_CHANGE, drawn_observations, export, half_precision_change, training_curve
from tslam_bench.baselines.model_files import make_network, read_model, write_model
from tslam_bench.baselines.run import PRESETS, Arguments, plan, settings_of
from tslam_bench.baselines.training import train
from tslam_bench.baselines.training_config import TrainingConfig
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.evaluation.policies import get_baseline, list_baselines, make_baseline
from tslam_bench.evaluation.weights import WEIGHTS_VARIABLE, shipped_seeds, shipped_weights, training_record
from tslam_bench.files import sha256_file
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import read_submission

CONFIG = TrainingConfig(
    "tslam",
    steps=800,
    objects=("bowl-000", "mug-000"),
    num_envs=2,
    batch_size=10,
    epochs=2,
    action_repeat=20,
    processes=0,
    torch_threads=1,
)


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> Iterator[list[Path]]:
    """A trained model of seed 0, and its untrained like of seed 1."""
    folder = tmp_path_factory.mktemp("models")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(WEIGHTS_VARIABLE, str(folder / "nowhere"))
        metadata = train(CONFIG, folder / "zero", command=f"train --output {folder}")
        network = make_network("fast", seed=1, clock=CONFIG.clock)
        write_model(folder / "one", network, {**metadata, "seed": 1, "steps": 400, "commit": None})
        yield [folder / "zero", folder / "one"]


@pytest.fixture
def shipped(models, tmp_path, monkeypatch) -> Path:
    """A folder of weights of both seeds, taken as the shipped one."""
    for model in models:
        export(model, tmp_path / "shipped", "abc")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "shipped"))
    return tmp_path / "shipped"


def actions(policy, seeds: list[int]) -> np.ndarray:
    """(3, n, 28) of three decisions on drawn observations."""
    policy.reset(len(seeds), seeds)
    decided = []
    for step in range(3):
        seen = drawn_observations(8, np.random.default_rng(step))
        rows = {name: value[: len(seeds)].numpy() for name, value in seen.items()}
        held = [policy.act(rows) for _ in range(CONFIG.action_repeat)]
        assert all(np.array_equal(action, held[0]) for action in held)
        decided.append(held[0])
    return np.stack(decided)


# -- files ------------------------------------------------------------------------------------------------------------
def test_numbers_are_those_of_the_model_rounded_once(models, shipped: Path) -> None:
    for seed, model in enumerate(models):
        path = shipped / f"tslam-{seed}.safetensors"
        assert path.stat().st_size < 1_000_000
        stored, original = load_file(path), load_file(model / "model.safetensors")
        read = dict(read_model(path)[0].state_dict())
        assert stored.keys() == original.keys() == read.keys()
        for name, value in original.items():
            rounded = value.numpy().astype(np.float16)  # numpy's rounding, not torch's
            assert stored[name].dtype == torch.float16 and np.array_equal(stored[name].numpy(), rounded)
            assert read[name].dtype == torch.float32 and np.array_equal(read[name].numpy(), rounded.astype(np.float32))


def test_equal_models_give_equal_bytes(models, shipped: Path, tmp_path: Path) -> None:
    again = export(models[0], tmp_path / "again", "abc")
    for suffix in (".safetensors", ".json"):
        assert again.with_suffix(suffix).read_bytes() == (shipped / f"tslam-0{suffix}").read_bytes()


def test_record_says_how_it_was_trained(models, shipped: Path) -> None:
    record, metadata = (
        training_record(shipped / "tslam-0.safetensors"),
        json.loads((models[0] / "model.json").read_text()),
    )
    for name in ("baseline", "seed", "steps", "seconds", "machine", "versions", "assets", "reward_mode", "mean_return"):
        assert record[name] == metadata[name]
    assert (
        record["assets"]["objects"] == 2 and record["config"]["learning_rate"] == 3e-4 and record["dtype"] == "float16"
    )
    assert record["curve"]["steps"][-1] == 800 and len(record["curve"]["touched_voxels"]) == 2
    assert record["model_sha256"] == sha256_file(models[0] / "model.safetensors")
    assert record["weights_sha256"] == sha256_file(shipped / "tslam-0.safetensors")
    assert str(models[0].parent) not in (shipped / "tslam-0.json").read_text()  # no paths of the machine
    assert training_record(shipped / "tslam-1.safetensors")["commit"] == "abc"  # what the model does not say


def test_curve_is_thinned_by_means(tmp_path: Path) -> None:
    lines = [{"steps": 10 * (i + 1), "episode/return": i, "episode/touched_voxels": 2 * i} for i in range(205)]
    (tmp_path / "curve").write_text("\n".join(map(json.dumps, [{"steps": 1}, *lines])))
    curve = training_curve(tmp_path / "curve")
    assert len(curve["steps"]) == 20 and curve["steps"][0] == 110 and curve["steps"][-1] == 2050
    assert curve["return"][0] == 5.0 and curve["touched_voxels"][0] == 10.0  # of the first eleven
    assert training_curve(tmp_path / "none")["steps"] == []


def test_half_precision_changes_actions_little(models, shipped: Path) -> None:
    network, halved = read_model(models[0])[0], read_model(shipped / "tslam-0.safetensors")[0]
    changes = half_precision_change(network, halved)
    record = training_record(shipped / "tslam-0.safetensors")
    assert 0 < changes["mean"] < MOST_CHANGE and 0 <= changes["std"] < MOST_CHANGE
    assert record["half_precision_change"] == {name: round(value, 5) for name, value in changes.items()}
    whole = actions(make_baseline("tslam", models[0]), [3, 4, 5])
    half = actions(make_baseline("tslam"), [3, 4, 5])
    assert 0 < np.abs(whole - half).max() < 5 * MOST_CHANGE  # the noise, up to four deviations, is scaled by the latter


# -- loading ----------------------------------------------------------------------------------------------------------
def test_explores_at_once_and_the_same_every_time(shipped: Path) -> None:
    first = actions(make_baseline("tslam"), [7, 8])
    for policy in (
        make_baseline("tslam@0"),
        make_baseline("tslam", seed=0),
        make_baseline("tslam", shipped / "tslam-0.safetensors"),
    ):
        assert np.array_equal(first, actions(policy, [7, 8]))
    assert np.array_equal(first[:, :1], actions(make_baseline("tslam"), [7]))
    other = actions(make_baseline("tslam@1"), [7, 8])
    assert not np.array_equal(first, other) and np.array_equal(other, actions(make_baseline("tslam", seed=1), [7, 8]))
    mean = actions(make_baseline("tslam@1", deterministic=True), [7, 8])
    assert np.array_equal(mean, actions(make_baseline("tslam@1", deterministic=True), [1, 2]))


@pytest.mark.parametrize(
    ("policy", "arguments", "message"),
    [
        ("tslam@2", {}, "seed 2 are not shipped; choose tslam@0, tslam@1, or train"),
        ("tslam", {"seed": 7}, "seed 7 are not shipped"),
        ("tslam_knn", {}, "none is shipped; train it .tslam-bench baselines train tslam_knn"),
        ("tslam@x", {}, "a training seed follows '@'"),
        ("heuristic@0", {}, "only a learned explorer has one"),
        ("nope@0", {}, "'nope': unknown"),
    ],
)
def test_what_is_not_shipped_is_one_line(shipped: Path, policy: str, arguments: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message) as caught:
        make_baseline(policy, **arguments)
    assert "\n" not in str(caught.value)


def test_nothing_shipped(models, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nowhere"))
    assert shipped_seeds("tslam") == ()
    with pytest.raises(InvalidInputError, match="baselines train tslam --seed 0"):
        make_baseline("tslam")
    with pytest.raises(InvalidInputError, match="seed 1 names shipped weights"):
        make_baseline("tslam", models[0], seed=1)


def test_what_lies_in_the_folder_of_the_package_can_be_used(monkeypatch) -> None:
    """Whatever is shipped today: every file has its record, is of a learned explorer and loads."""
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    for spec in list_baselines():
        for seed in shipped_seeds(spec.id):
            path = shipped_weights(spec.id, seed)
            record = training_record(path)
            assert spec.kind == "learned" and path.stat().st_size < 1_000_000
            assert (record["baseline"], record["seed"], record["privileged"]) == (spec.id, seed, spec.privileged)
            assert max(record["half_precision_change"].values()) <= MOST_CHANGE and record["commit"]
            make_baseline(f"{spec.id}@{seed}")


def test_damaged_and_foreign_files_are_one_line(models, shipped: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="its header names no network"):
        make_baseline("tslam", models[0] / "model.safetensors")
    shutil.copy(shipped / "tslam-1.json", shipped / "tslam-0.json")
    with pytest.raises(
        InvalidInputError, match=r"tslam-0.json: is the record of other weights than tslam-0.safetensors"
    ):
        training_record(shipped / "tslam-0.safetensors")
    (shipped / "tslam-0.json").write_text("{}")
    with pytest.raises(InvalidInputError, match="holds no training record"):
        training_record(shipped / "tslam-0.safetensors")
    (shipped / "tslam-1.safetensors").write_bytes((shipped / "tslam-1.safetensors").read_bytes()[:-5])
    with pytest.raises(InvalidInputError, match=r"tslam-1.safetensors: cannot be read.*install the package again"):
        make_baseline("tslam@1")
    (shipped / "tslam-01.safetensors").touch()
    (shipped / "tslam-2.safetensors.part").touch()
    assert shipped_seeds("tslam") == (0, 1)


def test_models_of_earlier_recipes_can_be_exported(models, tmp_path: Path) -> None:
    """They lack settings that came later."""
    shutil.copytree(models[1], tmp_path / "model")
    metadata = json.loads((tmp_path / "model" / "model.json").read_text())
    for name in ("noise_correlation", "state_std", "coverage_bonus", "reconfigure_every"):
        del metadata["config"][name]
    del metadata["commit"]
    (tmp_path / "model" / "model.json").write_text(json.dumps(metadata))
    path = export(tmp_path / "model", tmp_path / "out", "1234567")
    assert read_model(path)[1]["noise_correlation"] == 0.0 and training_record(path)["commit"] == "1234567"


def test_what_cannot_be_shipped_is_refused_and_leaves_nothing(models, tmp_path: Path, capsys) -> None:
    network, _ = read_model(models[0])
    metadata = json.loads((models[0] / "model.json").read_text())
    with torch.no_grad():
        network.value[0].weight[0, 0] = 1e6
    write_model(tmp_path / "large", network, metadata)
    recipe = {**metadata["config"], "network": "paper"}
    write_model(tmp_path / "paper", make_network("paper", seed=0, clock=5), {**metadata, "config": recipe})
    with torch.no_grad():
        network.value[0].weight[0, 0] = 0
        network.policy[-1].weight.mul_(3e4)
    write_model(tmp_path / "steep", network, metadata)
    for name, message in (
        ("large", "too large for half precision"),
        ("paper", "bytes in half precision, less than 1,000,000"),
        ("steep", "half precision changes its actions by"),
        ("absent", "is no directory of a trained model"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main(["baselines", "export", str(tmp_path / name), "--output", str(tmp_path / "out")])
        errors = capsys.readouterr().err
        assert ended.value.code == 2 and message in errors and errors.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_exports_several_and_refuses_two_of_a_kind(models, tmp_path: Path, capsys) -> None:
    words = ["baselines", "export", *map(str, models), "--output", str(tmp_path / "out"), "--commit", "abc"]
    cli.main(words)
    assert "tslam-0.safetensors: 65" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        f"tslam-{seed}{suffix}" for seed in (0, 1) for suffix in (".json", ".safetensors")
    }
    with pytest.raises(SystemExit):
        cli.main(["baselines", "export", str(models[0]), str(models[0]), "--output", str(tmp_path / "twice")])
    assert "of the same id and seed" in capsys.readouterr().err and not (tmp_path / "twice").exists()


# -- evaluation -------------------------------------------------------------------------------------------------------
def test_each_repetition_is_explored_by_its_own_training_seed(shipped: Path, tmp_path: Path) -> None:
    config = EvaluationConfig("tslam", ("mug",), (0, 1), "quick", policy_salt="5", processes=0)
    (path,) = evaluate(config, make_reconstructors(("grid",)), tmp_path / "each")
    source = json.loads((tmp_path / "each" / "rollouts" / "tslam" / "source.json").read_text())
    assert source["model_sha256"] == {str(s): sha256_file(shipped / f"tslam-{s}.safetensors") for s in (0, 1)}
    info = read_submission(path).info
    assert (info.method, info.explorer, info.training.steps) == ("tslam + grid", "tslam", 800)  # the longer one
    assert info.label == "shipped weights: 800 training steps"

    one = EvaluationConfig("tslam@1", ("mug",), (1,), "quick", policy_salt="5", processes=0)
    (path,) = evaluate(one, make_reconstructors(("grid",)), tmp_path / "one")
    assert read_submission(path).info.method == "tslam@1 + grid"
    source = json.loads((tmp_path / "one" / "rollouts" / "tslam" / "source.json").read_text())
    assert source["policy"] == "tslam@1" and source["model_sha256"] == sha256_file(shipped / "tslam-1.safetensors")
    folder = Path("rollouts") / "tslam" / "mug"
    each, other = (Rollout.load(tmp_path / "each" / folder / f"pose3_seed{seed}.npz") for seed in (1, 0))
    fixed = Rollout.load(tmp_path / "one" / folder / "pose3_seed1.npz")
    assert np.array_equal(each.actions, fixed.actions) and np.array_equal(each.touched, fixed.touched)
    assert not np.array_equal(other.actions, fixed.actions)

    with pytest.raises(InvalidInputError, match=r"holds other episodes \(another policy, model_sha256"):
        evaluate(one, make_reconstructors(("grid",)), tmp_path / "each")
    shutil.copy(shipped / "tslam-0.safetensors", shipped / "tslam-1.safetensors")
    with pytest.raises(InvalidInputError, match=r"holds other episodes \(another model_sha256"):
        evaluate(config, make_reconstructors(("grid",)), tmp_path / "each")


def test_a_repetition_without_weights_is_refused_before_anything_is_explored(shipped: Path, tmp_path: Path) -> None:
    config = EvaluationConfig("tslam", ("mug",), (0, 2), "quick", processes=0)
    with pytest.raises(InvalidInputError, match="training seed 2 are not shipped; choose tslam@0, tslam@1"):
        evaluate(config, make_reconstructors(("grid",)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# -- the run ----------------------------------------------------------------------------------------------------------
def commands(settings, output: Path) -> dict[str, str]:
    return {job.name: " ".join(job.command) for job in plan(settings, output, 2)}


def test_the_run_plans_what_is_shipped(shipped: Path, monkeypatch, tmp_path: Path) -> None:
    learned = {spec.id for spec in list_baselines() if spec.kind == "learned"}
    (shipped / "tslam_knn-0.safetensors").touch()  # some seeds of some
    jobs = commands(settings_of(Arguments(shipped=True)), tmp_path)
    assert "--seeds 0 1 " in jobs["evaluate-shipped-tslam"] and "--model" not in jobs["evaluate-shipped-tslam"]
    assert "--seeds 0 --" in jobs["evaluate-shipped-tslam_knn"] and "--seeds 0 1 2" in jobs["evaluate-heuristic"]
    assert not {f"train-{name}" for name in learned} & set(jobs)
    assert {name for name in learned if f"evaluate-shipped-{name}" in jobs} == {"tslam", "tslam_knn"}

    jobs = commands(settings_of(Arguments(quick=True)), tmp_path)
    assert {f"train-{name}" for name in learned} <= set(jobs)
    assert f"--output {tmp_path}/shipped" in jobs["evaluate-shipped-tslam"] and "evaluate-tslam" in jobs
    assert f"{tmp_path}/shipped/submissions/tslam-grid" in jobs["score-shipped-tslam"]
    assert f"leaderboard {tmp_path}/shipped --scores" in jobs["leaderboard"]

    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nowhere"))
    jobs = commands(PRESETS["quick"], tmp_path)
    assert not any("shipped" in name for name in jobs) and "leaderboard --scores" in jobs["leaderboard"]
    assert not any("tslam_" in name for name in commands(PRESETS["shipped"], tmp_path))
    assert get_baseline("heuristic").kind == "scripted"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (Arguments(shipped=True, baselines=("tslam_knn",)), "none is shipped"),
        (Arguments(shipped=True, baselines=("tslam",), seeds=(5,)), None),
        (Arguments(scripted=True, baselines=("tslam",)), "--scripted trains nothing; give --steps too"),
        (Arguments(shipped=True, baselines=("tslam@1",)), "give the id alone"),
    ],
)
def test_runs_that_cannot_be_planned(shipped: Path, arguments: Arguments, message: str | None) -> None:
    with pytest.raises(InvalidInputError, match=message or "seed 5 are not shipped"):
        settings_of(arguments)
