"""Attestation: an honest entry's code is recognised, lies of code are found, and the code reaches nothing but its answers."""

from __future__ import annotations

import json
import os
import shutil
import socket
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from baseline_assets import primitive_cache

from tslam_bench.cli import main
from tslam_bench.errors import InvalidInputError, UserCodeError
from tslam_bench.evaluation.attest import SubmittedCode, attest
from tslam_bench.evaluation.confinement import Code, ConfinedCode, ConfinedReconstructor, Limits
from tslam_bench.evaluation.evaluate import EvaluationConfig, evaluate, make_reconstructors
from tslam_bench.evaluation.messages import Garbled, decode, encode
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.scoring.attestation import Attestation
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.verification import VerificationRecord, record_path

NAMES = ("cubelarge", "phone")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        folder = primitive_cache(tmp_path_factory.mktemp("cache"))
        patch.setenv(CACHE_VARIABLE, str(folder))
        yield folder


@pytest.fixture(scope="module")
def submission(cache, tmp_path_factory) -> Path:
    config = EvaluationConfig("heuristic", NAMES, (0,), object_set="quick", policy_salt="5a17", processes=0)
    (made,) = evaluate(config, make_reconstructors(("hull",)), tmp_path_factory.mktemp("heuristic"))
    return made


def code(folder: Path, text: str) -> str:
    """A stranger's file."""
    path = folder / "code.py"
    path.write_text(textwrap.dedent(text))
    return str(path)


# --- Entries ---------------------------------------------------------------------------------------------------


def test_an_honest_entry_is_attested_by_the_command_of_the_docs(submission: Path, cache: Path, capsys) -> None:
    main(["verify", str(submission), "--attest"])
    assert "attested: the code gives all 16 episodes' actions and all 8 reconstructions" in capsys.readouterr().out
    record = VerificationRecord.read(record_path(submission))
    attestation = record.attestation
    assert record.tier == "attested" and attestation is not None and attestation.failures() == []
    assert attestation.fresh.keys() == attestation.swapped.keys() == set(NAMES)
    assert attestation.turned == pytest.approx(attestation.own, abs=0.02), "a hull turns with its touches"
    score = score_submission(submission, NAMES, cache=cache)
    assert score.tier == "attested" and score.verified and score.to_json()["tier"] == "attested"
    assert any(note.startswith("attested: ") for note in score.notes)
    # The claim is what scoring measures.
    areas = {result.object: result.areas["iou_area"] for result in score.results}
    assert attestation.claimed == pytest.approx(areas, abs=1e-9)

    forged = json.loads(record_path(submission).read_text())
    forged["attestation"]["fresh"] = dict.fromkeys(NAMES, 1.0)
    record_path(submission).write_text(json.dumps(forged))
    score = score_submission(submission, NAMES, cache=cache)
    assert score.tier == "reported" and "not made here, or changed since" in score.notes[0]
    record_path(submission).unlink()


def test_code_that_did_not_make_the_entry_is_found(submission: Path, cache: Path, tmp_path: Path) -> None:
    """Another policy, and shapes from a table that asks for no touches."""
    file = code(
        tmp_path,
        """
        import numpy as np
        from tslam_bench.reconstruction.volume import Volume

        class Policy:
            control_mode = "pd_joint_delta_pos"
            def reset(self, num_envs, seed):
                self.num_envs = num_envs
            def act(self, observation):
                return np.zeros((self.num_envs, 28), np.float32)

        class Table:
            name = "table"
            def reconstruct(self, touched, visited):
                shape = np.zeros((32, 32, 32), np.float32)
                shape[9:23, 9:23, 9:23] = 1
                return Volume(shape)
        """,
    )
    entry = shutil.copytree(submission, tmp_path / "entry")
    record = attest(entry, SubmittedCode(f"{file}:Policy", f"{file}:Table"))
    attestation = record.attestation
    assert record.tier == "replayed" and attestation is not None
    assert len(attestation.departed_actions) == 16 and len(attestation.departed_shapes) == 8
    failures = "; ".join(attestation.failures())
    assert "actions are not those" in failures and "reconstructions are not those" in failures
    assert "the shapes do not come from the touches" in failures
    score = score_submission(entry, NAMES, cache=cache)
    assert score.tier == "replayed" and any(note.startswith("not attested: ") for note in score.notes)


HONEST = Attestation(
    policy={},
    reconstructor={},
    confinement={"policy": {"network": "namespace"}},
    limits={},
    salt="ab",
    fresh_seed=1,
    episodes=2,
    departed_actions=(),
    shapes=2,
    departed_shapes=(),
    claimed={"a": 0.5, "b": 0.7, "c": 0.6},
    fresh={"a": 0.52, "b": 0.66, "c": 0.6},
    own={"a": 0.6, "b": 0.8},
    swapped={"a": 0.1, "b": 0.2},
    turned={"a": 0.6, "b": 0.79},
)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"departed_actions": ("a, pose 0, seed 0",)}, "actions are not those that the code computes: 1 of 2"),
        ({"departed_shapes": tuple("abcdefg")}, "and 2 more"),
        ({"fresh": {"a": 0.42, "b": 0.62, "c": 0.52}}, "0.080 more, where chance explains 0.000"),  # seeds were chosen
        ({"fresh": {"a": 0.2, "b": 0.7, "c": 0.7}}, None),  # one object went badly: chance
        ({"swapped": {"a": 0.5, "b": 0.6}}, "the shapes do not come from the touches"),
        ({"swapped": {}}, "no touches to swap"),
    ],
)
def test_what_an_organiser_concludes(changes: dict, message: str | None) -> None:
    attestation = replace(HONEST, **changes)
    failures = attestation.failures()
    assert (failures == []) if message is None else (len(failures) == 1 and message in failures[0]), failures
    assert attestation.summary().startswith("attested" if message is None else "not attested")
    assert Attestation(**json.loads(json.dumps(attestation.to_json()))).failures() == failures


def test_what_is_remarked_on() -> None:
    assert HONEST.flags() == []
    (turned,) = replace(HONEST, turned={"a": 0.3, "b": 0.3}).flags()
    assert turned.startswith("flag: with turned touches")
    (weak,) = replace(HONEST, confinement={"policy": {"network": "audit hook"}}).flags()
    assert "stops mistakes, not attackers" in weak


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--attest", "--segments"), "leave out --segments"),
        (("--policy", "heuristic"), "only --attest runs code"),
        (("--attest", "--policy", "heuristicc"), "heuristicc"),
        (("--attest", "--reconstructor", "nowhere.py:Hull"), "there is no file"),
        (("--attest", "--policy", "random_targets"), "acts by pd_joint_pos"),
    ],
)
def test_what_cannot_be_attested_is_one_line(arguments, message: str, submission: Path, capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["verify", str(submission), *arguments])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert caught.value.code == 2 and len(lines) == 1 and message in lines[0]


# --- Confinement -----------------------------------------------------------------------------------------------

ATTACKS = """
    import os, socket, subprocess, sys, time
    from pathlib import Path
    import numpy as np
    from tslam_bench.files import cache_directory
    from tslam_bench.reconstruction.volume import Volume

    def network():
        with socket.create_server(("127.0.0.1", 0)) as server:  # not even here: a path to another process
            socket.create_connection((os.environ["LANG"], int(os.environ["LC_ALL"])), 2).close()

    def truth():
        np.load(cache_directory() / "objects" / "test" / "phone" / "vertices.npy")

    def key():
        assert (cache_directory() / "verification.key").read_bytes()

    def submission():
        assert (Path(os.environ["LD_LIBRARY_PATH"]) / "submission.json").read_bytes()

    def write():
        Path(os.environ["LD_LIBRARY_PATH"]).with_name("written").write_text("here")

    def kill():
        os.kill(int(os.environ["VIRTUAL_ENV"]), 0)

    ATTACKS = (network, truth, key, submission, write, kill)

    class Attacker:
        name = "attacker"
        def reconstruct(self, touched, visited):
            shape = np.zeros((8, 8, 8), np.float32)
            print("noise", flush=True)
            for index, attack in enumerate(ATTACKS):
                try:
                    attack()
                    shape[0, 0, index] = 1
                except (OSError, AssertionError):
                    pass
            scratch = Path("own").write_text("allowed")
            shape[1, 0, 0] = scratch == 7
            shape[1, 0, 1] = len(list((cache_directory() / "objects" / "train").iterdir())) == 2
            return Volume(shape)

    class Slow(Attacker):
        def reconstruct(self, touched, visited):
            time.sleep(60)

    class Greedy(Attacker):
        def reconstruct(self, touched, visited):
            return Volume(np.ones((900, 900, 900), np.float32))

    class Crash(Attacker):
        def reconstruct(self, touched, visited):
            print("so long", file=sys.stderr, flush=True)
            os._exit(3)

    class Forger(Attacker):
        def reconstruct(self, touched, visited):
            for descriptor in range(3, 30):
                try:
                    os.write(descriptor, b"\\xff" * 64)
                except OSError:
                    pass
            return Volume(np.zeros((8, 8, 8), np.float32))
"""
FORGED_HELLO = """
    import json, os, struct

    text = json.dumps({"control_mode": "", "confinement": {"network": "perfect", "files": "perfect"}, "arrays": []}).encode()
    for descriptor in range(3, 30):
        try:
            os.write(descriptor, struct.pack("<I", len(text)) + text)
        except OSError:
            pass
"""
EMPTY = np.zeros((32, 32, 32), dtype=bool)


@pytest.mark.parametrize("namespaces", [True, False])
def test_code_that_is_shut_in_reaches_nothing(namespaces: bool, tmp_path: Path, monkeypatch) -> None:
    submission = tmp_path / "submission"
    submission.mkdir()
    (submission / "submission.json").write_text("{}")
    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = server.getsockname()
        for name, value in (
            ("LANG", host),
            ("LC_ALL", port),
            ("LD_LIBRARY_PATH", submission),
            ("VIRTUAL_ENV", os.getpid()),
        ):
            monkeypatch.setenv(name, str(value))  # some that the child is given
        attacker = Code("reconstructor", f"{code(tmp_path, ATTACKS)}:Attacker")
        with ConfinedCode(attacker, Limits(namespaces=namespaces), [submission]) as confined:
            held = confined.confinement["network"]
            assert held == ("namespace" if namespaces and held == "namespace" else "audit hook")
            shape = ConfinedReconstructor(confined, "attacker").reconstruct(EMPTY, EMPTY).probability
    assert not shape[0].any(), f"attacks that worked: {np.flatnonzero(shape[0, 0])}"
    assert shape[1, 0, 0] == 1, "a scratch folder is there to be written"
    assert shape[1, 0, 1] == 1, "train objects are there to learn from"
    assert not submission.with_name("written").exists() and (submission / "submission.json").is_file()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Slow", "no answer within 1 s"),
        ("Greedy", "MemoryError"),
        ("Crash", "its process ended .so long."),
        ("Forger", "answered with|its process ended"),
        ("Nobody", "has no Nobody"),
    ],
)
def test_code_that_does_not_answer_is_named(name: str, message: str, tmp_path: Path) -> None:
    limits = Limits(answer=1, memory=3)
    given = Code("reconstructor", f"{code(tmp_path, ATTACKS)}:{name}")
    with pytest.raises((UserCodeError, InvalidInputError), match=message), ConfinedCode(given, limits) as confined:
        ConfinedReconstructor(confined, name).reconstruct(EMPTY, EMPTY)


def test_how_it_is_shut_in_is_told_before_the_code_is_there(tmp_path: Path) -> None:
    given = Code("reconstructor", f"{code(tmp_path, FORGED_HELLO)}:Nobody")
    with ConfinedCode(given) as confined:
        assert confined.confinement["network"] in ("namespace", "audit hook")


def test_messages_are_read_as_they_were_written_and_nothing_else_is() -> None:
    arrays = {"a": np.arange(6, dtype="<f4").reshape(2, 3), "b": np.ones((0, 4), "|u1")}

    def reader(data: bytes):
        rest = bytearray(data)

        def read(count: int) -> bytes:
            taken, rest[:] = bytes(rest[:count]), rest[count:]
            assert len(taken) == count, "read beyond the end"
            return taken

        return read

    header, found = decode(reader(encode({"do": "act"}, arrays)))
    assert header == {"do": "act"} and all(np.array_equal(found[name], arrays[name]) for name in arrays)
    good = encode({"do": "act"}, arrays)
    for bad in (
        b"\xff" * 64,
        b"\x02\x00\x00\x00[]",
        good.replace(b"<f4", b"|O8"),
        good.replace(b"[2, 3]", b"[9, -3]"[:6] + b""),
        encode({}, {"a": np.zeros(3, "<f4")}).replace(b"[3]", b"[" + b"9" * 1 + b"]").replace(b'"<f4"', b'"<f8"'),
    ):
        with pytest.raises((Garbled, AssertionError)):
            decode(reader(bad))
    big = json.dumps({"arrays": [["a", "<f4", [2**40]]]}).encode()
    with pytest.raises(Garbled, match="arrays of"):
        decode(reader(len(big).to_bytes(4, "little") + big))
