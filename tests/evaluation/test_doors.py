"""Policies and reconstructors of the user's own, through every door: command line, Python, registration, entry points."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from baseline_assets import primitive_cache

import tslam_bench
from tslam_bench import cli
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, OCCUPANCY_THRESHOLD
from tslam_bench.episodes import episode_seed, policy_seed
from tslam_bench.errors import InvalidInputError, UserCodeError
from tslam_bench.evaluation.policies import get_baseline, list_baselines, make_baseline
from tslam_bench.evaluation.policy import CheckedPolicy
from tslam_bench.files import CACHE_VARIABLE, sha256_file
from tslam_bench.grids import world_to_object
from tslam_bench.plugins import content_sha256, identifier_of, load, parse_arguments
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.reconstruction.registry import get_reconstructor, list_reconstructors, make_reconstructor
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.measure import load_truth
from tslam_bench.scoring.metrics import iou
from tslam_bench.scoring.submission import read_submission

SALT = "d00f"
MODULE = '''
"""What a user writes: a policy with an argument and a model, and a reconstructor."""
from pathlib import Path

import numpy as np

from tslam_bench.reconstruction.volume import Volume


class MyPolicy:
    """Random targets, held."""

    control_mode = "pd_joint_pos"

    def __init__(self, hold=2, model=None):
        self.hold = hold
        self.spread = float(Path(model).read_text())

    def reset(self, num_envs, seed):
        self.generators = [np.random.default_rng(s) for s in seed]
        self.step = 0

    def act(self, observation):
        if self.step % self.hold == 0:
            self.held = np.stack([g.uniform(-self.spread, self.spread, 28) for g in self.generators])
        self.step += 1
        return self.held.astype(np.float32)


class Box:
    """The bounding box of what was touched."""

    def reconstruct(self, touched, visited):
        solid = np.zeros(touched.shape)
        if touched.any():
            where = np.argwhere(touched)
            solid[tuple(slice(a, b + 1) for a, b in zip(where.min(0), where.max(0)))] = 1
        return Volume(solid, "nearest")


def make():
    return Box()


class Sometimes(MyPolicy):
    """Fails in the fourth step of the second batch until a file is there."""

    def __init__(self):
        self.hold, self.spread, self.batches = 4, 0.9, 0

    def reset(self, num_envs, seed):
        super().reset(num_envs, seed)
        self.batches += 1

    def act(self, observation):
        if self.batches == 2 and self.step == 3 and not Path("mended").exists():
            raise KeyError("my own mistake")
        return super().act(observation)
'''


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """A user's folder."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "mymethods.py").write_text(MODULE)
    (folder / "spread.txt").write_text("0.8")
    return folder


def command(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """The installed ``tslam-bench``, in ``folder``."""
    program = Path(sys.executable).with_name("tslam-bench")
    return subprocess.run([program, *map(str, arguments)], cwd=folder, capture_output=True, text=True, env=os.environ)


@pytest.fixture(scope="module")
def evaluated(home: Path) -> Path:
    done = command(
        home,
        *("evaluate", "--policy", "mymethods:MyPolicy", "--policy-arguments", "hold=8", "--model", "spread.txt"),
        *("--reconstructor", "hull", "mymethods:make", "--objects", "phone", "--policy-salt", SALT, "--output", "out"),
        *("--processes", "1"),
    )
    assert done.returncode == 0, done.stderr
    names = [Path(line).name for line in done.stdout.splitlines()]
    assert names == ["mymethods.mypolicy-hull", "mymethods.mypolicy-mymethods.make"]
    return home / "out"


@pytest.fixture(scope="module")
def by_hand() -> dict[str, np.ndarray]:
    """The same eight episodes without anything of the evaluation: one environment, a loop, and the turned grids."""
    env = gym.make(ENVIRONMENT_ID, split="test", control_mode="pd_joint_pos", render_backend="none")
    merged = {"touched": np.zeros((32, 32, 32), bool), "visited": np.zeros((32, 32, 32), bool)}
    actions = []
    try:
        for pose in range(8):
            generator = np.random.default_rng(policy_seed(SALT, ("phone", pose, 0)))
            env.reset(seed=episode_seed(pose, 0), options={"object": "phone", "pose": pose})
            for step in range(HORIZON):
                if step % 8 == 0:
                    action = generator.uniform(-0.8, 0.8, NUM_JOINTS).astype(np.float32)
                actions.append(action)
                observation, *_ = env.step(action)
            occupancy = observation["occupancy"][0].numpy().astype(bool)
            merged["touched"] |= world_to_object(occupancy[0], pose)
            merged["visited"] |= world_to_object(occupancy[1], pose)
    finally:
        env.close()
    return {**merged, "actions": np.array(actions).reshape(8, HORIZON, NUM_JOINTS)}


def box_of(touched: np.ndarray) -> Volume:
    solid = np.zeros(touched.shape)
    low, high = np.argwhere(touched).min(axis=0), np.argwhere(touched).max(axis=0) + 1
    solid[low[0] : high[0], low[1] : high[1], low[2] : high[2]] = 1
    return Volume(solid, "nearest")


# -- the whole way ------------------------------------------------------------------------------------------------------
def test_scores_of_a_policy_and_a_reconstructor_are_those_of_the_same_work_by_hand(evaluated, by_hand) -> None:
    truth = load_truth("phone")
    volumes = {
        "hull": HullReconstructor().reconstruct(by_hand["touched"], by_hand["visited"]),
        "mymethods.make": box_of(by_hand["touched"]),
    }
    touched, surface = by_hand["touched"], truth.prepared.surface
    overlap = (touched & surface).sum() / (touched | surface).sum()
    assert touched.sum() > 30
    for name, volume in volumes.items():
        submission = evaluated / "submissions" / f"mymethods.mypolicy-{name}"
        score = evaluated / f"{name}.json"
        done = command(evaluated, "score", submission, "--objects", "phone", "--output", score)
        assert done.returncode == 0, done.stderr
        found = json.loads(score.read_text())["results"][0]["poses"]["8"]
        solid = volume.query(truth.iou_points.points) >= OCCUPANCY_THRESHOLD
        expected = iou(solid, truth.prepared.solid_at_iou_points, truth.iou_points.weights)
        assert found["iou"] == pytest.approx(expected, abs=1e-6) and 0.1 < expected < 1
        assert found["surface_iou"] == pytest.approx(overlap, abs=1e-6)
        stored = read_submission(submission)
        for pose in range(8):
            assert np.array_equal(stored.rollout("phone", pose, 0).actions, by_hand["actions"][pose])


def test_what_was_evaluated_is_recorded(evaluated: Path, home: Path) -> None:
    source = json.loads((evaluated / "rollouts" / "mymethods.mypolicy" / "source.json").read_text())
    assert source["policy"] == "mymethods:MyPolicy" and source["arguments"] == {"hold": 8}
    assert source["model_sha256"] == sha256_file(home / "spread.txt")
    assert source["code_sha256"] == sha256_file(home / "mymethods.py")
    info = read_submission(evaluated / "submissions" / "mymethods.mypolicy-mymethods.make").info
    assert info.method == "mymethods.mypolicy(hold=8) + mymethods.make" and info.authors == ("unnamed",)
    assert (info.explorer, info.reconstructor) == ("mymethods.mypolicy", "mymethods.make")
    assert info.control_mode == "pd_joint_pos" and not info.privileged and info.reward_mode is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--policy-arguments", "hold=4"), "another arguments"),
        (("--model", "other.txt"), "another model_sha256"),
    ],
)
def test_results_of_other_settings_are_not_mixed(evaluated: Path, home: Path, change, message: str) -> None:
    (home / "other.txt").write_text("0.7")
    flags = {"--policy-arguments": "hold=8", "--model": "spread.txt", **dict([change])}
    words = [word for pair in flags.items() for word in pair]
    done = command(
        home, "evaluate", "--policy", "mymethods:MyPolicy", *words, "--objects", "phone", "--output", evaluated
    )
    assert done.returncode == 2 and message in done.stderr.splitlines()[-1]


def test_reconstructions_of_changed_code_are_not_mixed(evaluated: Path, tmp_path: Path, monkeypatch) -> None:
    """The user edits the reconstructor and evaluates again into the same folder."""
    (tmp_path / "box.py").write_text(MODULE)
    arguments = ("oracle", (f"{tmp_path}/box.py:make",), ("phone",), tmp_path / "out")
    tslam_bench.evaluate(*arguments)
    tslam_bench.evaluate(*arguments)
    (tmp_path / "box.py").write_text(MODULE + "\n# changed\n")
    with pytest.raises(
        InvalidInputError, match=r"oracle-box.make: holds other reconstructions \(another code_sha256\)"
    ):
        tslam_bench.evaluate(*arguments)


def test_python_door_takes_objects_and_gives_the_same_episodes(evaluated: Path, home: Path, tmp_path: Path) -> None:
    module: dict[str, object] = {"__name__": "in_a_notebook"}
    exec(MODULE, module)
    policy, box = module["MyPolicy"](8, home / "spread.txt"), module["Box"]  # type: ignore[operator]
    (path,) = tslam_bench.evaluate(policy, (box,), ("phone",), tmp_path, policy_salt=SALT, processes=1)
    again = read_submission(path)
    stored = read_submission(evaluated / "submissions" / "mymethods.mypolicy-mymethods.make")
    assert path.name == "in_a_notebook.mypolicy-in_a_notebook.box"
    for pose in range(8):
        one, other = again.rollout("phone", pose, 0), stored.rollout("phone", pose, 0)
        assert np.array_equal(one.touched_step, other.touched_step) and np.array_equal(one.actions, other.actions)
    assert np.array_equal(
        again.reconstruction("phone", 8, 0).probability, stored.reconstruction("phone", 8, 0).probability
    )


def test_a_policy_that_raises_keeps_what_is_finished_and_shows_its_traceback(home: Path) -> None:
    words = ("evaluate", "--policy", "mymethods.py:Sometimes", "--objects", "phone", "--seeds", 0, 1)
    words += ("--reconstructor", "grid", "--output", "some", "--processes", 1)
    failed = command(home, *words)
    assert failed.returncode == 1
    assert 'raise KeyError("my own mistake")' in failed.stderr and "tslam_bench/evaluation" not in failed.stderr
    last = failed.stderr.splitlines()[-1]
    assert last.startswith("tslam-bench: policy 'mymethods.py:Sometimes': act, step 3 of phone, pose ")
    assert last.endswith("and 7 beside it, raised KeyError: 'my own mistake'")
    kept = {path: path.stat().st_mtime_ns for path in (home / "some").rglob("*.npz")}
    assert len(kept) == 8
    (home / "mended").touch()
    done = command(home, *words)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list((home / "some" / "rollouts").rglob("*.npz"))) == 16


# -- mistakes -----------------------------------------------------------------------------------------------------------
WRONG = """
import numpy as np

class Good:
    control_mode = "pd_joint_delta_pos"
    def reset(self, num_envs, seed): self.n = num_envs
    def act(self, observation): return np.zeros((self.n, 28), np.float32)
    def reconstruct(self, touched, visited): return touched

class NoAct:
    control_mode = "pd_joint_delta_pos"
    def reset(self, num_envs, seed): pass

class NoReset:
    control_mode = "pd_joint_delta_pos"
    def act(self, observation): pass

class NoMode(Good): control_mode = None
class OtherMode(Good): control_mode = "torque"
class Needs(Good):
    def __init__(self, size): pass
class Fails(Good):
    def __init__(self): raise OSError("no weights\\nhere")
class Bad(Good):
    def reconstruct(self, touched, visited): return 1 / 0

number = 5
def gives_class(): return Good
"""


@pytest.fixture
def wrong(tmp_path: Path, monkeypatch) -> Path:
    (tmp_path / "wrong.py").write_text(WRONG)
    (tmp_path / "broken.py").write_text("import numpy\nraise RuntimeError('at import')\n")
    (tmp_path / "lacking.py").write_text("import nowhere_to_be_found\n")
    (tmp_path / "syntax.py").write_text("def f(:\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in ("wrong", "broken", "lacking"):
        sys.modules.pop(name, None)


def run(capsys, *arguments: str) -> tuple[int, list[str]]:
    """Exit status and lines of standard error of the command line, in this process."""
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    return int(ended.value.code or 0), capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        ("nothing_here:Policy", "there is no module nothing_here; install it, or run in the folder that holds it"),
        ("wrong.inner:Policy", "there is no module wrong.inner"),
        ("no/such/file.py:Policy", "there is no file no/such/file.py"),
        ("wrong:Goood", "wrong.py has no Goood; did you mean Good?"),
        ("wrong.py:Goood", "wrong.py has no Goood; did you mean Good?"),
        ("wrong:", "give module:Class, or path/to/file.py:Class"),
        (":Good", "give module:Class"),
        ("wrong:number", "is neither a class nor a function"),
        ("wrong:gives_class", "returned the class Good, expected an instance"),
        ("wrong:NoAct", "NoAct has no method act"),
        ("wrong:NoReset", "NoReset has no method reset"),
        ("wrong:NoMode", "its control_mode is None; choose one of pd_joint_delta_pos, pd_joint_pos"),
        ("wrong:OtherMode", "its control_mode is 'torque'"),
        ("wrong:Needs", "missing a required argument: 'size'; its arguments are (size)"),
    ],
)
def test_a_mistake_is_one_line(wrong: Path, capsys, policy: str, message: str) -> None:
    words = ("evaluate", "--policy", policy, "--objects", "phone", "--reconstructor", "none", "--output", "out")
    status, lines = run(capsys, *words)
    assert status == 2 and len(lines) == 1, lines
    assert lines[0].startswith(f"tslam-bench: policy '{policy}': ") and message in lines[0]
    assert not (wrong / "out").exists() or not any((wrong / "out").rglob("*.npz"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policy", "wrong:Good", "--model", "m.pt"), "takes no model; leave m.pt out"),
        (("--policy", "wrong:Good", "--policy-arguments", "size=3"), "unexpected keyword argument 'size'"),
        (("--policy", "random", "--policy-arguments", "size=3"), "unexpected keyword argument 'size'"),
        (("--policy", "wrong:Good", "--policy-arguments", "size"), "argument 'size': give key=value"),
        (("--policy", "wrong:Good", "--policy-arguments", "{size"), "not a JSON object"),
        (("--policy", "wrong:Good", "--policy-arguments", "model=m.pt"), "give it as the model"),
        (("--policy", "oracle", "--policy-arguments", "size=3"), "a reference takes no arguments"),
        (("--policy", "heuristic", "--reconstructor", "wrong:NoAct"), "NoAct has no method reconstruct"),
        (("--policy", "heuristic", "--reconstructor", "wrong:Good=m.pt"), "takes no model; leave m.pt out"),
        (("--policy", "heuristic", "--reconstructor", "wrong:Good", "wrong:Goood"), "wrong.py has no Goood"),
        (("--policy", "heuristic", "--reconstructor", "wrong:Good", "wrong.py:Good"), "'wrong.good': given twice"),
        (("--policy", "oracle", "--reconstructor", "wrong:Good"), "returned a ndarray, expected a Volume"),
    ],
)
def test_a_wrong_argument_is_one_line(wrong: Path, capsys, words, message: str) -> None:
    status, lines = run(capsys, "evaluate", *words, "--objects", "phone", "--output", "out")
    lines = [line for line in lines if "%|" not in line]
    assert status == 2 and len(lines) == 1 and message in lines[0], lines


@pytest.mark.parametrize(
    ("words", "traceback", "message"),
    [
        (
            ("--policy", "broken:Policy"),
            "raise RuntimeError('at import')",
            "importing broken raised RuntimeError: at import",
        ),
        (("--policy", "lacking:Policy"), "import nowhere_to_be_found", "importing lacking raised ModuleNotFoundError"),
        (("--policy", "syntax.py:Policy"), "def f(:", "importing syntax.py raised SyntaxError"),
        (("--policy", "wrong:Fails"), 'raise OSError("no weights', "making it raised OSError: no weights"),
        (
            ("--policy", "oracle", "--reconstructor", "wrong:Bad"),
            "1 / 0",
            "reconstruct raised ZeroDivisionError: division",
        ),
    ],
)
def test_what_the_users_code_raises_is_shown(wrong: Path, capsys, words, traceback: str, message: str) -> None:
    status, lines = run(capsys, "evaluate", *words, "--objects", "phone", "--output", "out")
    assert status == 1 and any(traceback in line for line in lines), lines
    assert message in lines[-1] and lines[-1].startswith("tslam-bench: ")


class Answers:
    """A policy that answers what it is told to."""

    control_mode = "pd_joint_pos"

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def reset(self, num_envs: int, seed) -> None:
        self.began = True

    def act(self, observation) -> object:
        return self.answer


def changed(place: tuple[int, int], value: float) -> np.ndarray:
    actions = np.zeros((3, NUM_JOINTS), np.float32)
    actions[place] = value
    return actions


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "act returned a NoneType in step 2 of mug, pose 1, seed 0 and 1 beside it, expected a numpy array"),
        (np.zeros((3, 27), np.float32), r"shape \(3, 27\) in step 2 of mug.*expected \(3, 28\)"),
        (np.zeros(28, np.float32), r"shape \(28,\) in step 2"),
        (np.zeros((3, NUM_JOINTS)), r"float64 in step 2 .*expected float32; use .astype\(np.float32\)"),
        (
            changed((1, 3), np.nan),
            r"nan for \w+ \(action 3\) in step 2 of hammer, pose 4, seed 1; actions have to be in",
        ),
        (changed((0, 27), -1.5), r"-1.5 for \w+ \(action 27\) in step 2 of mug, pose 1, seed 0"),
        (changed((2, 0), np.inf), r"inf for \w+ \(action 0\) in step 2 of hammer, pose 4"),  # an idle one
    ],
)
def test_every_action_is_checked(answer, message: str) -> None:
    policy = Answers(np.ones((3, NUM_JOINTS), np.float32))
    checked = CheckedPolicy(policy, "policy 'mine'")
    checked.playing = [("mug", 1, 0), ("hammer", 4, 1)]
    checked.reset(3, [1, 2, 3])
    for _ in range(2):
        assert checked.act({}) is policy.answer
    policy.answer = answer
    with pytest.raises(InvalidInputError, match=f"policy 'mine': .*{message}") as caught:
        checked.act({})
    assert "\n" not in str(caught.value)


# -- registries ---------------------------------------------------------------------------------------------------------
def test_registered_ids_are_listed_made_and_replaced(monkeypatch) -> None:
    monkeypatch.setattr("tslam_bench.evaluation.policies._POLICIES._registered", {})
    monkeypatch.setattr("tslam_bench.reconstruction.registry._RECONSTRUCTORS._registered", {})
    tslam_bench.register_policy("mine", lambda answer: Answers(answer), summary="answers", privileged=True)
    spec = list_baselines()[-1]
    assert (spec.id, spec.summary, spec.kind, spec.privileged) == ("mine", "answers", "own", True)
    assert make_baseline("mine", answer=3).act({}) == 3  # type: ignore[comparison-overlap]
    tslam_bench.register_policy("mine", "tslam_bench.baselines.heuristic:HeuristicBaseline")
    assert type(make_baseline("mine")).__name__ == "HeuristicBaseline"
    tslam_bench.register_reconstructor("grown", "tslam_bench.reconstruction.hull:HullReconstructor", summary="a hull")
    assert list_reconstructors()[-1].summary == "a hull"
    assert make_reconstructor("grown").reconstruct(*np.zeros((2, 32, 32, 32), bool)).probability.max() == 0
    for name, message in (("oracle", "the benchmark's own"), ("My Policy", "at most 64"), ("", "at most 64")):
        with pytest.raises(InvalidInputError, match=message):
            tslam_bench.register_policy(name, Answers)
    with pytest.raises(InvalidInputError, match="the benchmark's own"):
        tslam_bench.register_reconstructor("hull", HullReconstructor)


def test_a_registered_policy_is_marked_in_its_submission(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tslam_bench.evaluation.policies._POLICIES._registered", {})
    tslam_bench.register_policy("peeks", lambda: Answers(np.zeros((8, 28), np.float32)), privileged=True)
    (path,) = tslam_bench.evaluate("peeks", ("grid",), ("phone",), tmp_path, processes=1, authors=("A. Author",))
    info = read_submission(path).info
    assert info.privileged and info.explorer == "peeks" and info.authors == ("A. Author",)


def test_installed_packages_name_theirs_as_entry_points(tmp_path: Path, monkeypatch, capsys) -> None:
    (tmp_path / "elsewhere.py").write_text(WRONG)
    record = tmp_path / "elsewhere-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n")
    (record / "entry_points.txt").write_text(
        textwrap.dedent("""
            [tslam_bench.policies]
            still = elsewhere:Good
            random = elsewhere:NoAct
            Not_An_Id = elsewhere:Good
            [tslam_bench.reconstructors]
            wrongly = elsewhere:Good
        """)
    )
    assert "still" not in [spec.id for spec in list_baselines()]
    monkeypatch.syspath_prepend(tmp_path)
    assert [spec.id for spec in list_baselines()][-1] == "still" and list_reconstructors()[-1].id == "wrongly"
    assert get_baseline("still").summary == "entry point elsewhere:Good" and get_reconstructor("wrongly").needs == "own"
    assert type(make_baseline("still")).__module__ == "elsewhere"
    assert type(make_baseline("random")).__name__ == "RandomBaseline", "a built-in id stays what it is"
    with pytest.raises(InvalidInputError, match="'Not_An_Id': use at most 64"):
        get_baseline("Not_An_Id")
    cli.main(["baselines", "list", "--json"])
    assert json.loads(capsys.readouterr().out)[-1]["id"] == "still"


def test_arguments_and_ids() -> None:
    assert parse_arguments(["a=2", "b=text", 'c="2"', "d=[1, 2]", '{"e": null}']) == {
        **{"a": 2, "b": "text", "c": "2", "d": [1, 2], "e": None}
    }
    assert identifier_of("my_pkg.sub:My.Policy") == "my_pkg.sub.my.policy"
    assert identifier_of("/some/where/Mine.py:make") == "mine.make"
    assert len(identifier_of(f"{'p' * 80}:make")) == 64
    assert get_baseline("a:B").reference == "a:B" and get_baseline(Answers).id.endswith("test_doors.answers")


def test_a_file_is_executed_once_and_again_after_a_change(tmp_path: Path) -> None:
    file = tmp_path / "counted.py"
    file.write_text("class A: value = 1\n")
    first = load(f"{file}:A", "policy")
    assert load(f"{file}:A", "policy") is first
    file.write_text("class A: value = 2\n")
    assert (first.value, load(f"{file}:A", "policy").value) == (1, 2)


def test_a_models_hash_is_that_of_names_and_contents(tmp_path: Path) -> None:
    for name, text in (("a/x", "1"), ("a/y/z", "2"), ("b/x", "1"), ("b/y/z", "2"), ("c/x", "1"), ("c/z", "2")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    hashes = [content_sha256(tmp_path / name) for name in "abc"]
    assert hashes[0] == hashes[1] != hashes[2]
    with pytest.raises(InvalidInputError, match="no such file"):
        content_sha256(tmp_path / "d")


def test_arguments_have_to_be_recordable(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"arguments cannot be recorded as JSON .*ndarray"):
        tslam_bench.evaluate(Answers, ("none",), ("phone",), tmp_path, arguments={"answer": np.zeros(3)})
    with pytest.raises(UserCodeError, match="making it raised"):
        make_baseline(lambda: 1 / 0)


def test_importing_the_package_stays_light() -> None:
    code = (
        "import sys, tslam_bench; tslam_bench.evaluate, tslam_bench.register_policy('a', 'b:C')\n"
        "assert not {'torch', 'sapien', 'mani_skill', 'trimesh', 'scipy', 'numba', 'tyro'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_specs_are_data() -> None:
    """Built-in ones name their classes: nothing is imported before it is made."""
    for spec in (*list_baselines(), *list_reconstructors()):
        assert spec.factory is None or isinstance(spec.factory, str)
        assert set(spec.row()) == {f.name for f in dataclasses.fields(spec)} - {"factory", "kwargs", "reference"}
