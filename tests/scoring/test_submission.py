"""Submissions: what is written is read back; what lies, escapes or explodes is refused in one line."""

from __future__ import annotations

import copy
import io
import json
import os
import pickle
import shutil
import stat
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tslam_bench import __version__, grids
from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import untrusted_files
from tslam_bench.scoring.info import SubmissionInfo, Training, parse_info
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import (
    EXPLORATION_ORDER,
    RECONSTRUCTED_POSES,
    SubmissionWriter,
    read_submission,
    reconstruction_name,
    rollout_name,
)

INFO = SubmissionInfo(
    method="Test method",
    explorer="random",
    reconstructor="hull",
    authors=("A. Author", "B. Author"),
    asset_manifest_sha256="0" * 64,
    seeds=(0, 7),
    object_set="quick",
    privileged=False,
    package_version=__version__,
    training=Training(4000, 0.5, "2 cores"),
    label="quick run",
    policy_salt="0123456789abcdef",
)
ROLLOUT = "rollouts/mug/pose3_seed7.npz"
VOLUME = "reconstructions/mug_8_seed0.npz"


def rollout_arrays(seed: int = 0) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(seed)
    touched_step = np.where(generator.random((32, 32, 32)) < 0.02, generator.integers(0, 200, (32, 32, 32)), -1).astype(
        np.int16
    )
    return {
        "actions": generator.uniform(-1, 1, (200, 28)).astype(np.float32),
        "touched": touched_step >= 0,
        "visited": generator.random((32, 32, 32)) < 0.1,
        "touched_step": touched_step,
        "joint_checkpoints": generator.uniform(-1, 1, (21, 28)).astype(np.float32),
    }


def mug(seed: int = 0) -> Rollout:
    """The rollout of ``ROLLOUT``."""
    return Rollout("mug", 3, 7, **rollout_arrays(seed))  # type: ignore[arg-type]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with SubmissionWriter(tmp_path / "sub", INFO) as writer:
        writer.add_rollout(mug())
        writer.add_reconstruction("mug", 8, 0, Volume(np.random.default_rng(0).random((16, 16, 16))))
        writer.add_reconstruction("mug", 4, 0, trimesh.creation.icosphere(radius=0.05))
    return tmp_path / "sub"


def zipped(folder: Path, prefix: str = "") -> Path:
    path = folder.parent / "sub.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                archive.write(file, prefix + file.relative_to(folder).as_posix())
    return path


def refused(path: Path, *fragments: str) -> None:
    """Refused with one line that holds every fragment."""
    with pytest.raises(InvalidInputError) as caught:
        read_submission(path)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 700, message
    for fragment in (str(path), *fragments):
        assert fragment in message, message


def packed_rollout(**changes: np.ndarray) -> dict[str, np.ndarray]:
    arrays = rollout_arrays()
    arrays["touched"], arrays["visited"] = grids.pack(arrays["touched"]), grids.pack(arrays["visited"])
    return {"format": np.array(2, np.int16), **arrays, **changes}


# --- Round trips -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "zip", "zip with a folder"])
def test_what_is_written_is_read(folder: Path, kind: str) -> None:
    path = folder if kind == "folder" else zipped(folder, "" if kind == "zip" else "sub/")
    submission = read_submission(path)
    assert submission.info == INFO
    rollout, arrays = submission.rollout("mug", 3, 7), rollout_arrays()
    assert rollout is not None
    for name, expected in arrays.items():
        np.testing.assert_array_equal(getattr(rollout, name), expected)
    volume = submission.reconstruction("mug", 8, 0)
    assert isinstance(volume, Volume)
    np.testing.assert_allclose(volume.probability, np.random.default_rng(0).random((16, 16, 16)), atol=5e-4)
    mesh = submission.reconstruction("mug", 4, 0)
    assert isinstance(mesh, trimesh.Trimesh) and mesh.is_watertight
    assert mesh.volume == pytest.approx(trimesh.creation.icosphere(radius=0.05).volume, rel=1e-5)
    assert submission.rollout("mug", 0, 0) is None
    assert submission.reconstruction("hammer", 8, 0) is None
    assert submission.content_hash == read_submission(folder).content_hash


def test_files_are_bit_identical_from_run_to_run(folder: Path, tmp_path: Path) -> None:
    with SubmissionWriter(tmp_path / "again", INFO) as writer:
        writer.add_rollout(mug())
    for name in (ROLLOUT, "submission.json"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()


def test_names_of_the_protocol() -> None:
    assert rollout_name("mug", 3, 7) == ROLLOUT
    assert reconstruction_name("mug", 8, 0, "npz") == VOLUME
    assert EXPLORATION_ORDER[:4] == (0, 2, 5, 7)
    assert sorted(EXPLORATION_ORDER) == list(range(8))
    assert set(RECONSTRUCTED_POSES) == {1, 2, 4, 8}


@pytest.mark.parametrize("changes", [{}, {"control_mode": "pd_joint_pos", "policy_salt": None}])
def test_json_round_trip(changes: dict) -> None:
    info = replace(INFO, **changes)
    assert parse_info(json.dumps(info.to_json()).encode()) == info


# --- Writing ---------------------------------------------------------------------------------------------------


def test_unfinished_is_refused_and_resumed(tmp_path: Path) -> None:
    writer = SubmissionWriter(tmp_path / "sub", INFO)
    writer.add_rollout(mug())
    refused(tmp_path / "sub", "submission.json is missing", "resume")
    resumed = SubmissionWriter(tmp_path / "sub", replace(INFO, training=Training(4000, 0.7, "2 cores")))
    assert resumed.has_rollout("mug", 3, 7)
    assert not resumed.has_rollout("mug", 3, 0)
    assert not resumed.has_reconstruction("mug", 4, 0)
    resumed.close()
    assert read_submission(tmp_path / "sub").info.training.wall_time_hours == 0.7


def test_a_failing_block_leaves_no_submission(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), SubmissionWriter(tmp_path / "sub", INFO):
        raise RuntimeError
    assert not (tmp_path / "sub" / "submission.json").exists()


@pytest.mark.parametrize(
    "change",
    [{"explorer": "heuristic"}, {"control_mode": "pd_joint_pos"}, {"policy_salt": "00"}, {"policy_salt": None}],
)
def test_another_submission_is_not_overwritten(folder: Path, change: dict) -> None:
    with pytest.raises(InvalidInputError, match="holds another submission"):
        SubmissionWriter(folder, replace(INFO, **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"actions": np.zeros((100, 28), np.float32)}, "expected \\(200, 28\\) float32"),
        ({"actions": np.zeros((200, 28))}, "float64"),
        ({"actions": np.full((200, 28), np.nan, np.float32)}, "NaN"),
        ({"actions": np.full((200, 28), 1.01, np.float32)}, "leave \\[-1, 1\\]"),
        ({"touched": np.zeros((32, 32, 32), bool)}, "disagree"),
        ({"joint_checkpoints": np.zeros((20, 28), np.float32)}, "expected \\(21, 28\\) float32"),
        ({"joint_checkpoints": np.full((21, 28), np.inf, np.float32)}, "joint_checkpoints hold NaN"),
        ({"touched_step": np.full((32, 32, 32), 200, np.int16)}, "outside"),
        ({"visited": np.zeros((32, 32), bool)}, "visited"),
        ({"object": "../mug"}, "not the name of a rollout"),
        ({"pose": 8}, "not the name of a rollout"),
        ({"seed": -1}, "not the name of a rollout"),
    ],
)
def test_bad_rollouts_are_not_made(change: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        Rollout(**({"object": "mug", "pose": 3, "seed": 7} | rollout_arrays() | change))


def test_bad_places_are_not_written(tmp_path: Path) -> None:
    writer = SubmissionWriter(tmp_path / "sub", INFO)
    volume = Volume(np.zeros((4, 4, 4)))
    with pytest.raises(InvalidInputError, match="seed 1 is not among"):
        writer.add_rollout(Rollout("mug", 3, 1, **rollout_arrays()))  # type: ignore[arg-type]
    for arguments, message in [
        (("../mug", 8, 0, volume), "check object"),
        (("mug", 3, 0, volume), "check object"),
        (("mug", 8, 1, volume), "seed 1 is not among"),
        (("mug", 8, 0, "mesh"), "give a Volume"),
        (("mug", 8, 0, Volume(np.zeros((257, 257, 257)))), "at most 256"),
    ]:
        with pytest.raises(InvalidInputError, match=message):
            writer.add_reconstruction(*arguments)
    assert [p.name for p in (tmp_path / "sub").iterdir()] == [".submission.json.unfinished"]


def test_a_stored_rollout_is_linked_and_the_link_can_be_moved(tmp_path: Path) -> None:
    stored = mug().save(tmp_path / "run")
    with SubmissionWriter(tmp_path / "linked", INFO) as writer:
        writer.add_rollout(mug(), stored)
    assert (tmp_path / "linked" / ROLLOUT).samefile(stored)
    with SubmissionWriter(tmp_path / "written", INFO) as writer:
        writer.add_rollout(mug())
    linked, written = (read_submission(tmp_path / name) for name in ("linked", "written"))
    assert linked.content_hash == written.content_hash == read_submission(zipped(tmp_path / "linked")).content_hash
    assert linked.rollouts_hash("mug", 7) == written.rollouts_hash("mug", 7) != linked.rollouts_hash("mug", 0) == ""
    mug(1).save(tmp_path / "run")  # replaces the file: the submission keeps what it has
    stored.unlink()
    (tmp_path / "linked").rename(tmp_path / "moved")
    assert read_submission(tmp_path / "moved").content_hash == written.content_hash


def test_a_rollout_is_copied_where_links_are_not_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise OSError

    monkeypatch.setattr(os, "link", no_links)
    stored = mug().save(tmp_path / "run")
    with SubmissionWriter(tmp_path / "sub", INFO) as writer:
        writer.add_rollout(mug(), stored)
    assert (tmp_path / "sub" / ROLLOUT).read_bytes() == stored.read_bytes()
    assert not (tmp_path / "sub" / ROLLOUT).samefile(stored)


# --- submission.json -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"schema_version": 1}, ["schema_version is 1", "SubmissionWriter"]),
        ({"protocol_version": 99}, ["protocol_version is 99"]),
        ({"protocol_version": "1"}, ["protocol_version is '1'"]),
        ({"environment_id": "TactileSLAM-Tabletop-v0"}, ["environment_id"]),
        ({"method": ""}, ["method is empty"]),
        ({"method": 3}, ["method is 3", "text"]),
        ({"method": "two\nlines"}, ["one line"]),
        ({"method": "clear\x1b[2J"}, ["one line"]),
        ({"method": " \u3000"}, ["method is empty"]),
        ({"authors": ["A", " "]}, ["one name is empty"]),
        ({"training": {"steps": 10**400, "wall_time_hours": 1, "hardware": ""}}, ["training.steps is 1000"]),
        (
            {"training": {"steps": 4, "wall_time_hours": 10**400, "hardware": ""}},
            ["wall_time_hours is 1000", "from 0 to"],
        ),
        ({"method": "x" * 1000}, ["at most 300"]),
        ({"explorer": "My Method"}, ["explorer 'My Method'"]),
        ({"authors": []}, ["authors"]),
        ({"authors": "me"}, ["authors", "list"]),
        ({"authors": [1]}, ["authors is 1"]),
        ({"seeds": []}, ["seeds"]),
        ({"seeds": [0, 0]}, ["twice"]),
        ({"seeds": [-1]}, ["seeds is -1"]),
        ({"seeds": [True]}, ["seeds is True"]),
        ({"seeds": [0, 7.0]}, ["seeds is 7.0"]),
        ({"object_set": "train"}, ["object_set 'train'", "quick"]),
        ({"object_set": ["quick"]}, ["object_set"]),
        ({"privileged": "no"}, ["privileged is 'no'"]),
        ({"reward_mode": "tslamm"}, ["reward_mode 'tslamm'"]),
        ({"reward_mode": ["tslam"]}, ["reward_mode"]),
        ({"control_mode": "pd_joint_vel"}, ["control_mode 'pd_joint_vel'", "pd_joint_delta_pos, pd_joint_pos"]),
        ({"control_mode": None}, ["control_mode None"]),
        ({"control_mode": ["pd_joint_pos"]}, ["control_mode"]),
        ({"policy_salt": ""}, ["policy_salt", "hexadecimal"]),
        ({"policy_salt": "pepper"}, ["policy_salt", "hexadecimal"]),
        ({"policy_salt": "0" * 65}, ["policy_salt", "1 to 64"]),
        ({"policy_salt": 7}, ["policy_salt is 7", "text"]),
        ({"link": "javascript:alert(1)"}, ["link", "http(s)"]),
        ({"asset_manifest_sha256": "abc"}, ["asset_manifest_sha256"]),
        ({"training": []}, ["training"]),
        ({"training": {"steps": -4, "wall_time_hours": 1, "hardware": ""}}, ["training.steps is -4"]),
        ({"training": {"steps": 4, "wall_time_hours": 1e999, "hardware": ""}}, ["JSON"]),
        ({"training": {"steps": 4, "wall_time_hours": "1", "hardware": ""}}, ["wall_time_hours"]),
        ({"training": {"step": 4}}, ["unknown field training.'step'", "did you mean 'steps'?"]),
        ({"reward_mode": "chamfer"}, ["privileged is false", "reward mode 'chamfer'", "set privileged to true"]),
        ({"explorer": "oracle"}, ["privileged is false", "explorer 'oracle'"]),
        ({"metod": "x"}, ["unknown field 'metod'", "did you mean 'method'?"]),
        ({"zzzzzz": 1}, ["unknown field 'zzzzzz'", "remove it"]),
    ],
)
def test_bad_info_is_refused(folder: Path, changes: dict, fragments: list[str]) -> None:
    (folder / "submission.json").write_text(json.dumps(INFO.to_json() | changes))
    refused(folder, "submission.json", *fragments)


@pytest.mark.parametrize(
    "field",
    [
        *("method", "authors", "seeds", "privileged", "schema_version", "environment_id"),
        *("control_mode", "policy_salt"),
    ],
)
def test_missing_fields_are_refused(folder: Path, field: str) -> None:
    (folder / "submission.json").write_text(json.dumps({k: v for k, v in INFO.to_json().items() if k != field}))
    refused(folder, f"field {field} is missing")


@pytest.mark.parametrize(
    "text",
    [
        b'{"method": "honest", "method": "other"}',
        b'{"method": "half \\ud83d"}',
        *[b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 60_000, b'{"method": NaN}', b'{"a": 1' + b"0" * 5000 + b"}"],
    ],
)
def test_malformed_json_is_refused(folder: Path, text: bytes) -> None:
    (folder / "submission.json").write_bytes(text)
    refused(folder, "submission.json")


def test_large_json_is_refused(folder: Path) -> None:
    (folder / "submission.json").write_text(json.dumps(INFO.to_json()) + " " * 70_000)
    refused(folder, "more than 65536 bytes")


@pytest.mark.parametrize(
    "text",
    ["Größe 力 [/w noise]", "می\u200cخواهم", "東京\u3000大学", "👩\u200d🔬", "a\u202eb", "<b>", "{{ x }}", "\\"],  # noqa: RUF001
)
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_text_of_every_script_is_read(folder: Path, text: str, mark: bytes) -> None:
    info = replace(INFO, method=text, authors=(text,), label=text, contact=text)
    for ascii_only in (True, False):
        (folder / "submission.json").write_bytes(mark + json.dumps(info.to_json(), ensure_ascii=ascii_only).encode())
        assert read_submission(folder).info == info


def test_privileged_declared_is_accepted(folder: Path) -> None:
    info = replace(INFO, privileged=True, reward_mode="chamfer", explorer="tslam_chamfer")
    (folder / "submission.json").write_text(json.dumps(info.to_json()))
    assert read_submission(folder).info.privileged


# --- Files -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"actions": np.full((200, 28), np.nan, np.float32)}, ["NaN"]),
        ({"actions": np.full((200, 28), -1.5, np.float32)}, ["leave [-1, 1]"]),
        ({"actions": np.zeros((200, 28))}, ["actions is (200, 28) float64"]),
        ({"actions": np.zeros((201, 28), np.float32)}, ["actions is (201, 28)"]),
        ({"actions": np.zeros((200, 28), ">f4")}, ["actions"]),
        ({"touched": np.zeros((32, 32, 32), bool)}, ["touched is (32, 32, 32) bool", "(4096) uint8"]),
        ({"touched": np.zeros(4096, np.uint8)}, ["disagree"]),
        ({"touched_step": np.zeros((32, 32, 32), np.int32)}, ["touched_step"]),
        ({"actions": np.array([{"a": 1}], dtype=object)}, ["pickled"]),
        ({"more": np.zeros(3)}, ["expected the arrays"]),
        ({"format": np.array(3, np.int16)}, ["rollout format 3, this version reads 2"]),
        ({"joint_checkpoints": np.full((21, 28), np.nan, np.float32)}, ["joint_checkpoints hold NaN"]),
    ],
)
def test_bad_rollout_files_are_refused(folder: Path, changes: dict, fragments: list[str]) -> None:
    np.savez_compressed(folder / ROLLOUT, **packed_rollout(**changes))  # type: ignore[arg-type]
    refused(folder, ROLLOUT, *fragments)


def test_rollout_without_an_array_is_refused(folder: Path) -> None:
    arrays = packed_rollout()
    del arrays["visited"]
    np.savez_compressed(folder / ROLLOUT, **arrays)  # type: ignore[arg-type]
    refused(folder, ROLLOUT, "expected the arrays")


def test_rollouts_of_format_1_are_told_apart(folder: Path) -> None:
    arrays = packed_rollout()
    del arrays["format"], arrays["joint_checkpoints"]
    np.savez_compressed(folder / ROLLOUT, **arrays)  # type: ignore[arg-type]
    refused(folder, ROLLOUT, "rollout format 1, which has no joint checkpoints", "explore again")


@pytest.mark.parametrize(
    ("probability", "interpolation", "fragments"),
    [
        (np.full((8, 8, 8), np.nan, np.float16), "linear", ["NaN"]),
        (np.full((8, 8, 8), 1.5, np.float16), "linear", ["outside [0, 1]"]),
        (np.zeros((8, 8, 9), np.float16), "linear", ["(8, 8, 9)"]),
        (np.zeros((8, 8, 8), np.float32), "linear", ["float32"]),
        (np.zeros((300, 300, 300), np.float16), "linear", ["R at most 256"]),
        (np.zeros((8, 8, 8), np.float16), "cubic", ["cubic"]),
        (np.zeros((8, 8, 8), np.float16), "x" * 1000, ["interpolation"]),
        (np.zeros((8, 8, 8), np.float16), 3, ["interpolation"]),
    ],
)
def test_bad_volumes_are_refused(folder: Path, probability, interpolation, fragments: list[str]) -> None:
    np.savez_compressed(folder / VOLUME, probability=probability, interpolation=np.array(interpolation))
    refused(folder, VOLUME, *fragments)


def test_pickle_is_not_executed(folder: Path, tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    (folder / ROLLOUT).write_bytes(pickle.dumps(Bomb()))
    refused(folder, ROLLOUT)
    array = np.empty(1, dtype=object)
    array[0] = Bomb()
    np.savez(folder / ROLLOUT, **packed_rollout(actions=array))  # type: ignore[arg-type]
    refused(folder, ROLLOUT, "pickled")
    assert not (tmp_path / "executed").exists()


def test_a_small_file_that_claims_a_large_array_is_refused_before_it_is_unpacked(folder: Path) -> None:
    """The header says (200, 28); the deflated body would be 4 GiB of zeros."""
    arrays = packed_rollout()
    header = io.BytesIO()
    np.lib.format.write_array(header, arrays.pop("actions")[:0])
    zeros = b"\0" * (64 * 2**20)
    with zipfile.ZipFile(folder / ROLLOUT, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array)
            archive.writestr(f"{name}.npy", member.getvalue())
        with archive.open("actions.npy", "w") as stream:
            np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (200, 28)})
            stream.write(zeros)
    refused(folder, ROLLOUT, "actions is truncated or too long")


def peak_of_reading(path: Path, *fragments: str) -> float:
    """Peak of allocated memory (bytes) while ``path`` is refused."""
    tracemalloc.start()
    try:
        refused(path, *fragments)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_header_that_claims_to_be_long_is_not_read(folder: Path, version: int) -> None:
    """A header of 60 kB, or of 1 GiB that the file deflates to 1 MB."""
    with zipfile.ZipFile(folder / VOLUME, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        with archive.open("probability.npy", "w") as stream:
            claimed = 60_000 if version == 1 else 2**30
            stream.write(b"\x93NUMPY" + bytes([version, 0]) + claimed.to_bytes(2 if version == 1 else 4, "little"))
            for _ in range(1 if version == 1 else 1024):
                stream.write(b" " * min(claimed, 2**20))
        with archive.open("interpolation.npy", "w") as stream:
            np.lib.format.write_array(stream, np.array("linear"))
    assert (folder / VOLUME).stat().st_size < 2e6
    assert peak_of_reading(folder, VOLUME, "damaged header") < 20e6


def bare_zip(entries: int) -> bytes:
    """An archive that lists very many entries, all the same empty file."""
    local = b"PK\3\4" + bytes(26)
    entry = b"PK\1\2" + bytes(24) + (1).to_bytes(2, "little") + bytes(16) + b"x"
    listed = entry * entries
    end = b"PK\5\6" + bytes(4) + 2 * min(entries, 65535).to_bytes(2, "little")
    return local + listed + end + len(listed).to_bytes(4, "little") + len(local).to_bytes(4, "little") + bytes(2)


@pytest.mark.parametrize("kind", ["npz", "zip"])
def test_an_archive_of_very_many_entries_is_not_opened(folder: Path, kind: str) -> None:
    """1,200,000 entries in 56 MB: an object of each would take 700 MB."""
    data = bare_zip(1_200_000)
    with zipfile.ZipFile(io.BytesIO(bare_zip(1000))) as archive:
        assert len(archive.infolist()) == 1000
    if kind == "npz":
        (folder / VOLUME).write_bytes(data)
        peak = peak_of_reading(folder, VOLUME, "its list of entries has 56400000 bytes; at most 16384 are read")
    else:
        (folder.parent / "many.zip").write_bytes(data)
        peak = peak_of_reading(folder.parent / "many.zip", "its list of entries has 56400000 bytes")
    assert peak < 150e6


@pytest.mark.parametrize("compression", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_arrays_in_an_unusual_compression_are_refused(folder: Path, compression: int) -> None:
    """Such unpackers take what memory the file asks for."""
    with zipfile.ZipFile(folder / VOLUME, "w", compression) as archive:
        for name, array in {
            "probability": np.zeros((8, 8, 8), np.float16),
            "interpolation": np.array("linear"),
        }.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array)
            archive.writestr(f"{name}.npy", member.getvalue())
    refused(folder, VOLUME, "unusual compression", "numpy.savez_compressed")


@pytest.mark.parametrize("name", [ROLLOUT, VOLUME, "reconstructions/mug_4_seed0.ply"])
def test_truncated_files_are_refused(folder: Path, name: str) -> None:
    whole = (folder / name).read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 5):
        (folder / name).write_bytes(whole[:length])
        refused(folder, name)


@pytest.mark.parametrize(
    "text",
    [
        b"not a mesh",
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 999999999\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n",
    ],
)
def test_bad_meshes_are_refused(folder: Path, text: bytes) -> None:
    (folder / "reconstructions/mug_4_seed0.ply").write_bytes(text)
    refused(folder, "mug_4_seed0.ply")


@pytest.mark.parametrize(
    ("name", "fragments"),
    [
        ("rollouts/mugg/pose3_seed7.npz", ["unknown object 'mugg'", "did you mean 'mug'?"]),
        ("rollouts/coffeemug/pose3_seed7.npz", ["another name of 'mug'"]),
        ("rollouts/qqq/pose3_seed7.npz", ["unknown object 'qqq'", "assets list"]),
        ("rollouts/mug/pose8_seed7.npz", ["not a file of a submission"]),
        ("rollouts/mug/pose3_seed07.npz", ["not a file of a submission"]),
        ("rollouts/mug/pose3_seed1.npz", ["seed 1 is not among the seeds"]),
        ("reconstructions/mug_3_seed0.npz", ["not a file of a submission"]),
        ("reconstructions/mug_4_seed0.npz", ["keep one"]),
        ("notes.txt", ["not a file of a submission"]),
    ],
)
def test_bad_names_are_refused(folder: Path, name: str, fragments: list[str]) -> None:
    source = VOLUME if name.startswith("reconstructions") else ROLLOUT
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes((folder / source).read_bytes())
    refused(folder, *fragments)


def test_harmless_extras_are_ignored(folder: Path) -> None:
    before = read_submission(folder).content_hash
    (folder / "README.md").write_text("hello")
    (folder / ".DS_Store").write_bytes(b"x")
    (folder / "rollouts" / "mug" / ".pose1_seed0-half.npz").write_bytes(b"x")
    assert read_submission(folder).content_hash == before
    path = zipped(folder, "sub/")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("__MACOSX/sub/._submission.json", b"x")
    assert read_submission(path).content_hash == before


# --- Files that change after they were checked ------------------------------------------------------------------


def other_content(file: Path) -> None:
    """Puts a valid file of the same kind in its place."""
    if file.suffix == ".ply":
        file.write_bytes(bytes(trimesh.creation.icosphere(radius=0.06).export(file_type="ply")))  # type: ignore[arg-type]
    elif file.parts[-3] == "rollouts":
        file.write_bytes(mug(1).to_bytes())
    else:
        np.savez_compressed(file, probability=np.zeros((16, 16, 16), np.float16), interpolation=np.array("linear"))


@pytest.mark.parametrize("kind", ["folder", "zip"])
@pytest.mark.parametrize("name", [ROLLOUT, VOLUME, "reconstructions/mug_4_seed0.ply"])
@pytest.mark.parametrize("sent", [False, True])
def test_what_was_hashed_is_what_is_read(folder: Path, kind: str, name: str, sent: bool) -> None:
    path = folder if kind == "folder" else zipped(folder)
    submission = read_submission(path)
    hashed = submission.content_hash
    if sent:  # to another process, as scoring and pictures do
        submission = pickle.loads(pickle.dumps(submission.of_object("mug")))
        assert submission.content_hash == hashed and submission.rollout("mug", 3, 7) is not None
        submission = pickle.loads(pickle.dumps(submission))
    other_content(folder / name)
    if kind == "zip":
        path.unlink()
        zipped(folder)
    assert read_submission(path).content_hash != hashed
    read = {
        ROLLOUT: lambda: submission.rollout("mug", 3, 7),
        VOLUME: lambda: submission.reconstruction("mug", 8, 0),
    }.get(name, lambda: submission.reconstruction("mug", 4, 0))
    if (
        kind == "zip" and not sent
    ):  # the archive is still open: its own bytes are read, and they are those that were hashed
        assert read() is not None
        return
    with pytest.raises(InvalidInputError, match=r"changed while it was read|is damaged") as caught:
        read()
    assert str(path) in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.skipif(os.name == "nt", reason="symbolic links need rights on Windows")
@pytest.mark.parametrize("kind", ["gone", "link", "pipe", "longer"])
def test_a_file_that_was_checked_and_is_no_file_any_more_is_refused(folder: Path, tmp_path: Path, kind: str) -> None:
    submission = read_submission(folder)
    file, same = folder / ROLLOUT, tmp_path / "same.npz"
    same.write_bytes(file.read_bytes())
    if kind == "longer":
        file.write_bytes(file.read_bytes() + b"\0")
    else:
        file.unlink()
    if kind == "link":
        file.symlink_to(same)
    elif kind == "pipe":
        os.mkfifo(file)
    with pytest.raises(InvalidInputError, match=r"cannot be read|changed while it was read"):
        submission.rollout("mug", 3, 7)


def test_a_file_that_changes_while_the_submission_is_opened_is_hashed_as_it_was_checked(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file is replaced right after it was read: opening reads none of them a second time."""
    before = read_submission(folder).content_hash
    read = untrusted_files.FileSource.read
    seen: list[str] = []

    def read_and_replace(source: untrusted_files.FileSource, name: str) -> bytes:
        seen.append(name)
        data = read(source, name)
        (folder / name).write_bytes(b"replaced")
        return data

    monkeypatch.setattr(untrusted_files.FileSource, "read", read_and_replace)
    assert read_submission(folder).content_hash == before
    assert len(seen) == len(set(seen)) == 4


# --- Paths, links, bombs ---------------------------------------------------------------------------------------


def test_missing_path_and_plain_file(tmp_path: Path) -> None:
    refused(tmp_path / "nothing", "no such folder")
    (tmp_path / "file.txt").write_text("x")
    refused(tmp_path / "file.txt", "neither a folder nor a zip")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "submission.json is missing")


@pytest.mark.skipif(os.name == "nt", reason="symbolic links need rights on Windows")
def test_links_and_special_files_in_a_folder_are_refused(folder: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.npz"
    secret.write_bytes((folder / ROLLOUT).read_bytes())
    link = folder / "rollouts/mug/pose0_seed0.npz"
    link.symlink_to(secret)
    refused(folder, "symbolic link")
    link.unlink()
    (folder / "rollouts/linked").symlink_to(tmp_path, target_is_directory=True)
    refused(folder, "symbolic link")
    (folder / "rollouts/linked").unlink()
    os.mkfifo(link)
    refused(folder, "not a regular file")


@pytest.mark.parametrize(
    "name",
    [
        "../evil.npz",
        "/etc/evil.npz",
        "rollouts/../../evil.npz",
        "rollouts/./../../x.npz",
        "..\\evil.npz",
        "rollouts\\..\\..\\x.npz",
        "\\evil.npz",
        "C:/evil.npz",
        "C:evil.npz",
    ],
)
def test_entries_that_escape_are_refused(folder: Path, name: str) -> None:
    path = zipped(folder)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(name, b"x")
    refused(path, "leaves the archive")


def test_links_in_a_zip_are_refused(folder: Path) -> None:
    path = zipped(folder)
    entry = zipfile.ZipInfo("rollouts/mug/pose0_seed0.npz")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(entry, "/etc/passwd")
    refused(path, "link")


def test_doubled_entries_are_refused(folder: Path) -> None:
    path = zipped(folder)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr(ROLLOUT, b"x")
    refused(path, "twice")


def test_an_archive_of_mostly_empty_volumes_is_no_bomb(folder: Path) -> None:
    """Stored without compression, as numpy.savez does; the archive makes 32 MiB of 40 kB. A folder of it is read, too."""
    probability = np.zeros((256, 256, 256), np.float16)
    probability[100:140, 100:140, 100:140] = 1
    np.savez(folder / VOLUME, probability=probability, interpolation=np.array("linear"))
    path = zipped(folder)
    assert path.stat().st_size < (folder / VOLUME).stat().st_size / 100
    assert read_submission(path).content_hash == read_submission(folder).content_hash


def test_what_unpacks_to_more_than_the_limits_is_refused_before_it_is_unpacked(folder: Path) -> None:
    """Declared sizes are counted, and nothing is unpacked beyond what is declared."""
    path = zipped(folder)
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
        archive.open("rollouts/mug/pose0_seed0.npz", "w") as stream,
    ):
        for _ in range(65):
            stream.write(bytes(2**20))
    assert peak_of_reading(path, "at most 67108864 are read") < 20e6
    # The same with a lie in the list of entries: reading stops at the declared size.
    data = path.read_bytes()
    for size in (65 * 2**20, 1000):
        data = data.replace((65 * 2**20).to_bytes(4, "little"), size.to_bytes(4, "little"))
    path.write_bytes(data)
    assert peak_of_reading(path, "pose0_seed0.npz") < 20e6


def test_entries_that_share_their_bytes_count_each(folder: Path) -> None:
    """A thousand entries that all point to one of 60 MiB: 60 GB from 60 kB."""
    path = folder.parent / "sub.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x", bytes(60 * 2**20))
        entry = archive.filelist[0]
        for number in range(1000):
            other = copy.copy(entry)
            other.filename = f"rollouts/mug/pose0_seed{number}.npz"
            archive.filelist.append(other)
    assert path.stat().st_size < 300_000
    assert peak_of_reading(path, "bytes uncompressed; at most 8589934592 are read") < 20e6


@pytest.mark.parametrize("style", ["backslashes", "dots", "backslashes and dots", "doubled slashes"])
def test_archives_as_other_systems_pack_them_are_read(folder: Path, style: str) -> None:
    path = folder.parent / "sub.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*")):
            name = file.relative_to(folder.parent).as_posix()
            name = f"./{name}" if "dots" in style else name
            name = name.replace("/", "\\") if "backslashes" in style else name
            name = name.replace("/", "//") if style == "doubled slashes" else name
            if file.is_dir():
                archive.writestr(zipfile.ZipInfo(name + ("\\" if "backslashes" in style else "/")), b"")
            else:
                archive.writestr(zipfile.ZipInfo(name), file.read_bytes())
    submission = read_submission(path)
    assert submission.content_hash == read_submission(folder).content_hash
    submission = pickle.loads(pickle.dumps(submission.of_object("mug")))
    assert submission.rollout("mug", 3, 7) is not None


LITTER = [
    *("desktop.ini", "Desktop.ini", "Thumbs.db", "Icon\r", "Icon", ".DS_Store", "._submission.json"),
    *(
        "rollouts/desktop.ini",
        "rollouts/mug/Thumbs.db",
        "__MACOSX/._x",
        "@eaDir/x",
        "$RECYCLE.BIN/y",
        ".git/objects/pack",
    ),
    *("README.md", "LICENSE", "readme"),
]


@pytest.mark.parametrize("name", LITTER)
def test_what_file_managers_leave_is_no_part_of_a_submission(folder: Path, name: str) -> None:
    before = read_submission(folder).content_hash
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(b"x")
    assert read_submission(folder).content_hash == before
    assert read_submission(zipped(folder)).content_hash == before
    assert read_submission(zipped(folder, "sub/")).content_hash == before
    path = zipped(folder, "sub/")
    with zipfile.ZipFile(path, "a") as archive:  # beside the one folder
        archive.writestr(name, b"x")
    assert read_submission(path).content_hash == before


def test_litter_may_be_large_and_may_be_links(folder: Path, monkeypatch) -> None:
    before = read_submission(folder).content_hash
    (folder / ".git").mkdir()
    (folder / ".git" / "pack").write_bytes(bytes(300_000))
    (folder / ".git" / "HEAD").symlink_to("pack")
    os.mkfifo(folder / ".pipe")
    monkeypatch.setattr(untrusted_files, "MAX_FILE_SIZE", 200_000)
    assert read_submission(folder).content_hash == before


def test_a_submission_in_the_wrong_place_is_found(folder: Path, tmp_path: Path) -> None:
    outer = tmp_path / "outer"
    shutil.copytree(folder, outer / "deep" / "one")
    refused(outer, "submission.json is missing; it is in the folder deep/one")
    with zipfile.ZipFile(tmp_path / "deep.zip", "w") as archive:
        for file in sorted((outer / "deep").rglob("*")):
            archive.write(
                file, "a/b/" + file.relative_to(outer / "deep" / "one").as_posix()
            ) if file.is_file() else None
    refused(tmp_path / "deep.zip", "it is in the folder a/b, so give (or pack) that folder alone")
    shutil.copytree(folder, outer / "deep" / "two")
    refused(outer, "deep/one and deep/two hold one each")
    with zipfile.ZipFile(tmp_path / "empty.zip", "w"):
        pass
    refused(tmp_path / "empty.zip", "submission.json is missing")


def test_limits_on_files_and_sizes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for limit, value, fragment in [
        ("MAX_FILES", 3, "at most 3 are read"),
        ("MAX_FILE_SIZE", 1000, "at most 1000 are read"),
        ("MAX_TOTAL_SIZE", 5000, "bytes uncompressed"),
    ]:
        with monkeypatch.context() as patch:
            patch.setattr(untrusted_files, limit, value)
            refused(folder, fragment)
            refused(zipped(folder), fragment)
    read_submission(folder)


def test_damaged_zip_archives_are_refused_or_read(folder: Path) -> None:
    """Random bytes flipped: either the change was harmless or there is one clear line, never another exception."""
    path = zipped(folder)
    whole = bytearray(path.read_bytes())
    generator = np.random.default_rng(0)
    refusals = 0
    for _ in range(150):
        damaged = bytearray(whole)
        for position in generator.integers(0, len(whole), size=8):
            damaged[position] = generator.integers(0, 256)
        if generator.random() < 0.3:
            damaged = damaged[: generator.integers(0, len(whole))]
        path.write_bytes(damaged)
        try:
            read_submission(path)
        except InvalidInputError as error:
            assert "\n" not in str(error)
            refusals += 1
    assert refusals > 100


@pytest.mark.parametrize("name", [ROLLOUT, VOLUME, "reconstructions/mug_4_seed0.ply", "submission.json"])
def test_damaged_files_are_refused_or_read(folder: Path, name: str) -> None:
    whole = (folder / name).read_bytes()
    generator = np.random.default_rng(1)
    for _ in range(60):
        damaged = bytearray(whole)
        # The start of a file holds its structure: half of the damage goes there.
        reach = len(whole) if generator.random() < 0.5 else min(400, len(whole))
        for position in generator.integers(0, reach, size=4):
            damaged[position] = generator.integers(0, 256)
        (folder / name).write_bytes(damaged)
        try:
            read_submission(folder)
        except InvalidInputError as error:
            assert "\n" not in str(error)
