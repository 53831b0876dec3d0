"""A table of lies: what is refused when read, what departs in a replay, what is flagged, and what has no effect.

One honest submission of two boxes serves all. Lies about episodes are told in one copy, each in an episode of its own, and
replayed once.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from baseline_assets import SHAPES, primitive_cache

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.evaluation.verify import verify
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.scoring.origin import SUFFIX, beside
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.score_file import SubmissionScore
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import ROLLOUTS, read_submission, rollout_name
from tslam_bench.scoring.untrusted_scores import parse_score, sealed_json
from tslam_bench.scoring.verification import VerificationRecord, record_path

NAMES = ("cubelarge", "phone")
Rollouts = dict[tuple[str, int], Rollout]
INFO = "submission.json"
VOLUME = "reconstructions/phone_8_seed0.npz"
ROLLOUT = rollout_name("phone", 3, 0)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def honest(cache, tmp_path_factory) -> Path:
    config = EvaluationConfig("heuristic", NAMES, (0,), object_set="quick", policy_salt="5a17", processes=0)
    (made,) = evaluate(config, make_reconstructors(("hull",)), tmp_path_factory.mktemp("honest"))
    return made


@pytest.fixture(scope="module")
def episodes(honest: Path) -> Rollouts:
    submission = read_submission(honest)
    found = {(name, pose): submission.rollout(name, pose, seed) for name, pose, seed in submission.episodes()}
    return {key: rollout for key, rollout in found.items() if rollout is not None}


@pytest.fixture(scope="module")
def record(honest: Path, tmp_path_factory) -> VerificationRecord:
    return verify(honest, tmp_path_factory.mktemp("record") / "record.json")


@pytest.fixture(scope="module")
def score(honest: Path, cache: Path) -> SubmissionScore:
    return score_submission(honest, NAMES, cache=cache)


@pytest.fixture
def entry(honest: Path, tmp_path: Path) -> Path:
    """A copy that may be changed; its files are not those of the other."""
    return shutil.copytree(honest, tmp_path / "entry")


def test_the_honest_submission_is_beyond_doubt(record: VerificationRecord, score: SubmissionScore) -> None:
    assert record.departed == () and len(record.verdicts) == 16
    assert not any("flag" in note for note in score.notes) and score.tier == "reported"


# --- Episodes: replayed once, together -------------------------------------------------------------------------

Tell = Callable[[Rollouts, Rollout], Rollout]


def steps(rollout: Rollout, touched_step: np.ndarray) -> Rollout:
    return replace(rollout, touched=touched_step >= 0, touched_step=touched_step.astype(np.int16))


def far_away(all_of_them: Rollouts, own: Rollout) -> Rollout:
    invented = own.touched_step.copy()
    invented[2, 2, 2] = 50
    return steps(own, invented)


def one_voxel_earlier(all_of_them: Rollouts, own: Rollout) -> Rollout:
    voxel = np.unravel_index(own.touched_step.argmax(), own.touched_step.shape)
    earlier = own.touched_step.copy()
    earlier[voxel] -= 1
    return steps(own, earlier)


def one_bit(all_of_them: Rollouts, own: Rollout) -> Rollout:
    actions = own.actions.copy()
    actions[60, 4] = np.nextafter(actions[60, 4], np.float32(0) if actions[60, 4] else np.float32(1))
    return replace(own, actions=actions)


def moved(row: int, joint: int, by: float) -> Tell:
    def tell(all_of_them: Rollouts, own: Rollout) -> Rollout:
        joints = own.joint_checkpoints.copy()
        joints[row, joint] += np.float32(by)
        return replace(own, joint_checkpoints=joints)

    return tell


def whole(name: str, pose: int) -> Tell:
    """Another episode under this one's name."""
    return lambda all_of_them, own: replace(all_of_them[name, pose], object=own.object, pose=own.pose)


TOLD: dict[str, tuple[str, int, Tell, str]] = {
    "touches: one is invented": ("cubelarge", 1, far_away, "touches"),
    "touches: one is a step too early": ("cubelarge", 2, one_voxel_earlier, "touches"),
    "touches: all are earlier": (
        "cubelarge",
        3,
        lambda _, own: steps(own, np.where(own.touched, own.touched_step // 2, -1)),
        "touches",
    ),
    "touches: everything at once": ("cubelarge", 4, lambda _, own: steps(own, np.zeros((32, 32, 32))), "touches"),
    "touches: the half is left out": (
        "cubelarge",
        5,
        lambda _, own: steps(own, np.where(np.arange(32) < 16, own.touched_step, -1)),
        "touches",
    ),
    "touches: those of another object": (
        "cubelarge",
        6,
        lambda all_of_them, own: steps(own, all_of_them["phone", 6].touched_step),
        "touches",
    ),
    "visited: more than was": (
        "cubelarge",
        7,
        lambda _, own: replace(own, visited=np.ones_like(own.visited)),
        "visited",
    ),
    "actions: those of another pose": (
        "phone",
        1,
        lambda all_of_them, own: replace(own, actions=all_of_them["phone", 2].actions),
        "joints|touches",
    ),
    "actions: backwards": ("phone", 2, lambda _, own: replace(own, actions=own.actions[::-1].copy()), "joints|touches"),
    "actions: none": ("phone", 3, lambda _, own: replace(own, actions=np.zeros_like(own.actions)), "joints|touches"),
    "actions: one bit": ("phone", 4, one_bit, "joints|touches"),
    "poses: another pose's episode": ("phone", 5, whole("phone", 6), "start"),
    "poses: another object's episode": ("phone", 6, whole("cubelarge", 6), "joints|touches"),
    "joints: a checkpoint is a millimetre off": ("phone", 7, moved(7, 1, 1e-3), "joints"),
    "joints: a start of one's own": ("phone", 0, moved(0, 0, 1e-6), "start"),
}


@pytest.fixture(scope="module")
def told(honest: Path, episodes: Rollouts, tmp_path_factory) -> tuple[Path, VerificationRecord]:
    folder = shutil.copytree(honest, tmp_path_factory.mktemp("told") / "entry")
    for name, pose, tell, _ in TOLD.values():
        tell(episodes, episodes[name, pose]).save(folder / ROLLOUTS)
    return folder, verify(folder)


@pytest.mark.parametrize("lie", TOLD)
def test_lies_about_episodes_depart(lie: str, told: tuple[Path, VerificationRecord]) -> None:
    name, pose, _, expected = TOLD[lie]
    (verdict,) = [v for v in told[1].verdicts if (v.object, v.pose) == (name, pose)]
    assert verdict.departed in expected.split("|"), str(verdict)


def test_what_departs_counts_as_untouched_and_what_does_not_stays(told, score: SubmissionScore, cache: Path) -> None:
    assert [(v.object, v.pose) for v in told[1].verdicts if not v.departed] == [("cubelarge", 0)]
    replayed = score_submission(told[0], NAMES, cache=cache)
    assert replayed.verified and "15 of 16 episodes do not reproduce" in replayed.notes[0]
    cube, phone = replayed.results
    assert cube.poses["1"] == score.results[0].poses["1"], "made of the one honest episode"
    assert cube.poses["8"]["iou"] == 0 and phone.areas["iou_area"] == 0 and max(phone.recall_curve) == 0


# --- Files: refused when read ----------------------------------------------------------------------------------

Change = Callable[[Path], None]


def info(**changes: Any) -> Change:
    def change(folder: Path) -> None:
        content = json.loads((folder / INFO).read_text())
        (folder / INFO).write_text(json.dumps(content | changes))

    return change


def arrays(file: str, **changes: Callable[[np.ndarray], Any]) -> Change:
    def change(folder: Path) -> None:
        stored = dict(np.load(folder / file))
        (folder / file).unlink()  # not into what others share
        np.savez_compressed(folder / file, **(stored | {name: make(stored[name]) for name, make in changes.items()}))

    return change


def put(index: tuple, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def make(array: np.ndarray) -> np.ndarray:
        changed = array.copy()
        changed[index] = value
        return changed

    return make


def named(old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        (folder / new).parent.mkdir(parents=True, exist_ok=True)
        (folder / old).rename(folder / new)

    return change


def text(file: str, content: str) -> Change:
    return lambda folder: (folder / file).write_text(content) and None


def link(folder: Path) -> None:
    (folder / ROLLOUT).unlink()
    (folder / ROLLOUT).symlink_to("/etc/passwd")


def huge(folder: Path) -> None:
    """An array that says it is larger than it is."""
    with zipfile.ZipFile(folder / VOLUME, "a") as archive:
        names = [name for name in archive.namelist() if name != "probability.npy"]
        kept = {name: archive.read(name) for name in names}
    (folder / VOLUME).unlink()
    header = b"{'descr': '<f2', 'fortran_order': False, 'shape': (100000, 100000, 100000), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(folder / VOLUME, "w") as archive:
        for name, data in kept.items():
            archive.writestr(name, data)
        archive.writestr("probability.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)


REFUSED: dict[str, tuple[Change, str]] = {
    "actions: not a number": (arrays(ROLLOUT, actions=put((3, 4), np.nan)), "NaN"),
    "actions: beyond one": (arrays(ROLLOUT, actions=put((3, 4), 1.001)), "leave"),
    "actions: infinite": (arrays(ROLLOUT, actions=put((3, 4), -np.inf)), "actions"),
    "actions: of another type": (arrays(ROLLOUT, actions=lambda a: a.astype(np.float64)), "actions"),
    "actions: more steps than an episode has": (arrays(ROLLOUT, actions=lambda a: np.concatenate([a, a])), "actions"),
    "actions: objects that run code": (arrays(ROLLOUT, actions=lambda a: np.array([print], dtype=object)), "actions"),
    "actions: a truncated file": (
        lambda folder: (folder / ROLLOUT).write_bytes((folder / ROLLOUT).read_bytes()[:-200]) and None,
        "truncated",
    ),
    "touches: after the episode's end": (
        arrays(ROLLOUT, touched_step=lambda a: np.where(a >= 0, np.int16(200), a).astype(np.int16)),
        "touched_step",
    ),
    "touches: without a step": (arrays(ROLLOUT, touched=lambda a: np.full_like(a, 255)), "touched"),
    "joints: not a number": (arrays(ROLLOUT, joint_checkpoints=put((3, 4), np.nan)), "joint_checkpoints"),
    "clocks: an older format of rollouts": (arrays(ROLLOUT, format=lambda a: np.int16(1)), "format"),
    "clocks: negative hours of training": (info(training={"steps": 0, "wall_time_hours": -1}), "wall_time_hours"),
    "clocks: hours that are no number": (info(training={"steps": 0, "wall_time_hours": "fast"}), "wall_time_hours"),
    "clocks: longer than a lifetime": (info(training={"steps": 0, "wall_time_hours": 1e8}), "wall_time_hours"),
    "clocks: steps below none": (info(training={"steps": -5}), "training.steps"),
    "seeds: one that is not declared": (named(ROLLOUT, rollout_name("phone", 3, 9)), "seed 9 is not among"),
    "seeds: the same twice": (info(seeds=[0, 0]), "listed twice"),
    "seeds: negative": (info(seeds=[0, -1]), "seeds"),
    "seeds: true": (info(seeds=[True]), "seeds"),
    "seeds: a hundred and one": (info(seeds=list(range(101))), "1 to 100"),
    "seeds: a leading zero": (named(ROLLOUT, "rollouts/phone/pose3_seed00.npz"), "not a file of a submission"),
    "poses: a ninth": (named(ROLLOUT, "rollouts/phone/pose8_seed0.npz"), "not a file of a submission"),
    "poses: of nine merged": (
        named(VOLUME, "reconstructions/phone_9_seed0.npz"),
        "not a file of a submission",
    ),
    "names: an unknown object": (named(ROLLOUT, "rollouts/teapod/pose3_seed0.npz"), "did you mean"),
    "names: a file beside the others": (text("run_me.py", "print()"), "not a file of a submission"),
    "names: a link to another file": (link, "pose3_seed0"),
    "names: a method on two lines": (info(method="mine\nand yours"), "method"),
    "names: a method that talks to the terminal": (info(method="\x1b[2J"), "method"),
    "names: an empty author": (info(authors=["A", " "]), "authors"),
    "names: an explorer with blanks": (info(explorer="my best"), "explorer"),
    "names: a link that is a script": (info(link="javascript:alert(1)"), "link"),
    "names: a field nobody knows": (info(tier="hidden"), "unknown field 'tier'"),
    "names: verified, says the submitter": (info(verified=True), "unknown field 'verified'"),
    "names: two kinds of one shape": (
        text(VOLUME.replace(".npz", ".ply"), "ply\n"),
        "keep one",
    ),
    "privilege: an oracle that knows nothing": (info(explorer="oracle"), "counts as privileged"),
    "privilege: rewarded with the truth": (info(reward_mode="chamfer"), "counts as privileged"),
    "protocol: another version": (info(protocol_version=2), "protocol_version"),
    "protocol: an easier environment": (info(environment_id="TactileSLAM-Tabletop-v0"), "environment_id"),
    "protocol: a split of one's own": (info(object_set="mine"), "object_set"),
    "protocol: another control mode": (info(control_mode="teleport"), "control_mode"),
    "protocol: a salt that is none": (info(policy_salt="xyz"), "policy_salt"),
    "shapes: a probability above one": (arrays(VOLUME, probability=put((1, 1, 1), 2)), "outside"),
    "shapes: not a number": (arrays(VOLUME, probability=put((1, 1, 1), np.nan)), "phone_8_seed0"),
    "shapes: not a cube": (arrays(VOLUME, probability=lambda a: a[:-1]), "phone_8_seed0"),
    "shapes: an interpolation of one's own": (
        arrays(VOLUME, interpolation=lambda _: np.array("best")),
        "interpolation",
    ),
    "shapes: a bomb": (huge, "phone_8_seed0"),
    "shapes: a mesh that is none": (
        named(VOLUME, "reconstructions/phone_8_seed0.ply"),
        "phone_8_seed0.ply",
    ),
}


@pytest.mark.parametrize("lie", REFUSED)
def test_lies_in_files_are_refused_in_one_line(lie: str, entry: Path) -> None:
    change, message = REFUSED[lie]
    change(entry)
    with pytest.raises(InvalidInputError) as caught:
        read_submission(entry)
    assert "\n" not in str(caught.value) and message in str(caught.value), str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../evil.npz", "evil"),
        ("/etc/evil.npz", "evil"),
        ("C:/evil.npz", "evil"),
        ("submission.json", "twice|doubled|more than once"),
    ],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archives_that_escape_are_refused(name: str, message: str, entry: Path, tmp_path: Path) -> None:
    archive = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", entry))
    with zipfile.ZipFile(archive, "a") as stream:
        stream.writestr(name, b"{}")
    with pytest.raises(InvalidInputError) as caught:
        read_submission(archive)
    assert any(part in str(caught.value) for part in message.split("|")), str(caught.value)


# --- Shapes: empty, or flagged ---------------------------------------------------------------------------------


def solid(scale: float = 1.0) -> trimesh.Trimesh:
    """The true phone."""
    return trimesh.creation.box(extents=scale * np.array(SHAPES["test"]["phone"]))


def inside_out() -> trimesh.Trimesh:
    mesh = solid()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def with_a_hole() -> trimesh.Trimesh:
    mesh = solid()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False)


SHAPES_TOLD: dict[str, tuple[str, Callable[[], trimesh.Trimesh], str]] = {
    "shapes: in millimetres": ("1", lambda: solid(1000), "outside the workspace"),
    "shapes: inside out": ("2", inside_out, "faces point inwards"),
    "shapes: open": ("4", with_a_hole, "not watertight"),
}


@pytest.fixture(scope="module")
def remarked(honest: Path, episodes: Rollouts, cache: Path, tmp_path_factory) -> SubmissionScore:
    """Lies that are shown: shapes that are none, the truth itself, copies, touches in the air. Scored once, nothing replayed."""
    folder = shutil.copytree(honest, tmp_path_factory.mktemp("remarked") / "entry")
    for count, make, _ in SHAPES_TOLD.values():
        (folder / f"reconstructions/phone_{count}_seed0.npz").unlink()
        make().export(folder / f"reconstructions/phone_{count}_seed0.ply")
    truth = trimesh.creation.box(extents=SHAPES["test"]["cubelarge"])
    for count in (1, 2, 4, 8):
        (folder / f"reconstructions/cubelarge_{count}_seed0.npz").unlink()
        truth.export(folder / f"reconstructions/cubelarge_{count}_seed0.ply")
    retouched = np.clip(episodes["cubelarge", 2].actions + np.float32(1e-4), -1, 1)
    replace(episodes["cubelarge", 2], pose=3, actions=retouched).save(folder / ROLLOUTS)
    air = np.full((32, 32, 32), -1)
    air[:3] = 10
    for pose in range(1, 8):
        steps(episodes["phone", pose], air).save(folder / ROLLOUTS)
    info(label="verified by the organisers", authors=["The organisers"])(folder)
    return score_submission(folder, NAMES, cache=cache)


@pytest.mark.parametrize("lie", SHAPES_TOLD)
def test_shapes_that_are_none_count_as_empty(lie: str, remarked: SubmissionScore) -> None:
    count, _, message = SHAPES_TOLD[lie]
    phone = remarked.results[1]
    assert phone.poses[count]["iou"] == 0 and message in str(phone.reasons[count])


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        ("shapes: the truth from one pose's touches", "of the surface that nothing had felt is right"),
        (
            "seeds: one episode twice, retouched",
            "the same actions in several episodes: cubelarge, seed 0, pose 2; cubelarge",
        ),
        ("seeds: the same touches twice", "the same touches in several episodes"),
        ("touches: in the air", "too far from the object to hold a contact"),
        ("names: chosen objects for the whole set", "scored on chosen objects (2), not on the object set 'quick'"),
    ],
)
def test_lies_that_are_shown(lie: str, message: str, remarked: SubmissionScore) -> None:
    assert any(message in note for note in remarked.notes), (lie, remarked.notes)


def test_a_label_makes_nothing_true(remarked: SubmissionScore) -> None:
    (table,) = rank([remarked])["tables"]
    assert table["entries"][0]["tier"] == "reported" and table["entries"][0]["claimed"]


# --- Scores, records, clocks, names: without effect, or refused -------------------------------------------------


def deep(value: Any, *keys: Any) -> Any:
    """Changes one field of a copy: the last of ``keys`` is its new value."""
    changed = json.loads(json.dumps(value))
    inner = changed
    for key in keys[:-2]:
        inner = inner[key]
    inner[keys[-2]] = keys[-1]
    return changed


WITHOUT_EFFECT: dict[str, Callable[[Any], Any]] = {
    "score: tier hidden": lambda v: v | {"tier": "hidden", "verified": True},
    "score: verified": lambda v: v | {"verified": True},
    "score: another's name on it": lambda v: deep(v, "submission", "authors", ["Me"]),
    "score: a better mean": lambda v: deep(v, "aggregate", "areas", "iou_area", "mean", 0.99),
    "score: a better area": lambda v: deep(v, "results", 0, "areas", "iou_area", 0.99),
    "score: a seal of one's own": lambda v: v | {"verified": True, "seal": "0" * 64},
    "score: no seal": lambda v: {k: x for k, x in v.items() if k != "seal"} | {"verified": True},
}


@pytest.mark.parametrize("lie", WITHOUT_EFFECT)
def test_lies_in_score_files_have_no_effect(lie: str, score: SubmissionScore) -> None:
    value = sealed_json(score)
    read = parse_score(WITHOUT_EFFECT[lie](value), "file")
    assert not read.made_here and read.tier == "reported" and not read.own_run
    assert read.aggregate["areas"]["iou_area"] == score.aggregate["areas"]["iou_area"]


SCORES_REFUSED: dict[str, Callable[[Any], Any]] = {
    "score: more than everything": lambda v: deep(v, "results", 0, "poses", "8", "iou", 1.5),
    "score: not a number": lambda v: deep(v, "results", 0, "poses", "8", "iou", float("nan")),
    "score: a result is left out": lambda v: v | {"results": v["results"][:1]},
    "score: one object twice": lambda v: v | {"objects": [NAMES[0]] * 2},
    "score: an object of one's own": lambda v: v | {"objects": [NAMES[0], "sphere_of_mine"]},
    "score: the result of another object": lambda v: v | {"results": v["results"][::-1]},
    "score: a tier above all": lambda v: v | {"tier": "perfect"},
    "score: another version": lambda v: v | {"score_version": 99},
    "score: a curve that is too long": lambda v: deep(v, "results", 0, "recall_curve", [1.0] * 500),
    "score: a submission that is refused": lambda v: deep(v, "submission", "explorer", "oracle"),
}


@pytest.mark.parametrize("lie", SCORES_REFUSED)
def test_lies_in_score_files_are_refused(lie: str, score: SubmissionScore) -> None:
    with pytest.raises(InvalidInputError, match="not a score file"):
        parse_score(SCORES_REFUSED[lie](sealed_json(score)), "file")


def verdict(**changes: Any) -> Callable[[Any], Any]:
    return lambda v: v | {"verdicts": [v["verdicts"][0] | changes, *v["verdicts"][1:]]}


RECORDS: dict[str, Callable[[Any], Any]] = {
    "record: what departed reproduces": lambda v: v | {"verdicts": [x | {"departed": None} for x in v["verdicts"]]},
    "record: an episode less": lambda v: v | {"verdicts": v["verdicts"][:-1]},
    "record: more touches": verdict(touched="eJwDAAAAAAE="),
    "record: of other files": lambda v: v | {"content_hash": "0" * 64},
    "record: of another split": lambda v: v | {"split": "hidden"},
    "record: attested": lambda v: v | {"attestation": {"policy": {}}},
    "record: another way": lambda v: v | {"mode": "segments"},
    "record: on other assets": lambda v: v | {"assets": dict.fromkeys(v["assets"], "0" * 64)},
    "record: no seal": lambda v: {k: x for k, x in v.items() if k != "seal"},
}


@pytest.mark.parametrize("lie", RECORDS)
def test_lies_in_records_have_no_effect(lie: str, told: tuple[Path, VerificationRecord], tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    told[1].write(path)
    path.write_text(json.dumps(RECORDS[lie](json.loads(path.read_text()))))
    with pytest.raises(InvalidInputError, match=r"not made here|not a verification record"):
        VerificationRecord.read(path)


def test_a_record_of_another_submission_has_no_effect(
    told: tuple[Path, VerificationRecord], record: VerificationRecord, cache: Path, tmp_path: Path
) -> None:
    """The honest record beside the lies."""
    folder = shutil.copytree(told[0], tmp_path / "entry")
    record.write(record_path(folder))
    score = score_submission(folder, NAMES[:1], cache=cache)
    assert score.tier == "reported" and "made for other files" in score.notes[0]


def test_clocks_of_files_have_no_effect(entry: Path, tmp_path: Path) -> None:
    before = read_submission(entry).content_hash
    for path in entry.rglob("*"):
        os.utime(path, (0, 4_000_000_000))
    assert read_submission(entry).content_hash == before
    packed = tmp_path / "old.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for path in sorted(entry.rglob("*"), reverse=True):
            if path.is_file():
                archive.writestr(
                    zipfile.ZipInfo(path.relative_to(entry).as_posix(), (1980, 1, 1, 0, 0, 0)), path.read_bytes()
                )
    assert read_submission(packed).content_hash == before


@pytest.mark.parametrize("note", ["none", "forged", "another's"])
def test_a_baseline_s_name_is_claimed_without_its_note(
    note: str, score: SubmissionScore, honest: Path, entry: Path
) -> None:
    from tslam_bench.scoring.origin import has_origin

    info(method="The real heuristic")(entry)
    if note == "forged":
        content = {"content_hash": read_submission(entry).content_hash, "explorer": "heuristic", "seal": "0" * 64}
        beside(entry, SUFFIX).write_text(json.dumps(content))
    elif note == "another's":
        shutil.copy(beside(honest, SUFFIX), beside(entry, SUFFIX))
    assert has_origin(read_submission(honest)) and not has_origin(read_submission(entry))
    claimed = replace(score, own_run=False, content_hash="1" * 64)
    (table,) = rank([score, claimed])["tables"]
    assert sorted(e["claimed"] for e in table["entries"]) == [False, True]
