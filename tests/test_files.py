"""Files: what stands in the way is never destroyed, a race loses nothing, and what the system refuses is one line."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest

from tslam_bench.cli import main
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import (
    CACHE_VARIABLE,
    atomic_directory,
    cache_directory,
    ensure_writable_directory,
    place_to_write,
    read_plain_file,
    write_json,
)


def make(kind: str, path: Path) -> None:
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/null")
    elif kind == "file":
        path.write_text("mine")


@pytest.mark.parametrize("kind", ["folder", "pipe", "device"])
def test_what_is_no_file_stays(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    make(kind, path)
    before = os.lstat(path)
    with pytest.raises(InvalidInputError, match=f"out.json: is a {kind}, no file, and stays; name another file"):
        write_json(path, {})
    assert os.lstat(path).st_ino == before.st_ino and os.lstat(path).st_mode == before.st_mode
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.json"]


@pytest.mark.parametrize("kind", ["file", "pipe"])
def test_what_is_no_directory_stays(kind: str, tmp_path: Path) -> None:
    make(kind, tmp_path / "out")
    with (
        pytest.raises(InvalidInputError, match=f"out: is a {kind}, no folder, and stays"),
        atomic_directory(tmp_path / "out"),
    ):
        pytest.fail("there is no place to write to")
    assert [entry.name for entry in tmp_path.iterdir()] == ["out"]


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there/real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("there/real.json")
    (tmp_path / "dangling.json").symlink_to("there/new.json")
    (tmp_path / "folder").symlink_to("there")
    for name in ("link.json", "dangling.json"):
        write_json(tmp_path / name, [name])
        assert (tmp_path / name).is_symlink()
    assert json.loads((tmp_path / "there/real.json").read_text()) == ["link.json"]
    assert json.loads((tmp_path / "there/new.json").read_text()) == ["dangling.json"]
    with atomic_directory(tmp_path / "folder") as directory:
        (directory / "a").write_text("a")
    assert (tmp_path / "folder").is_symlink() and [p.name for p in (tmp_path / "there").iterdir()] == ["a"]
    assert len(list(tmp_path.iterdir())) == 4


def test_links_that_lead_round_in_a_circle_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(AssetError, match="a: cannot be written"):
        place_to_write(tmp_path / "a")


def test_nobody_loses_a_race_for_a_directory(tmp_path: Path) -> None:
    """Every writer succeeds, and what stays is one writer's whole directory."""
    errors: list[BaseException] = []

    def write(name: str) -> None:
        for turn in range(150):
            try:
                with atomic_directory(tmp_path / "object") as directory:
                    for part in "ab":
                        (directory / part).write_text(f"{name} {turn}")
            except BaseException as error:
                errors.append(error)

    threads = [threading.Thread(target=write, args=(name,)) for name in "xyz"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert len({path.read_text() for path in (tmp_path / "object").iterdir()}) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["object"]


def test_an_old_directory_comes_back_if_the_new_one_cannot_take_its_place(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "object").mkdir()
    (tmp_path / "object/a").write_text("old")
    replace = Path.replace

    def refuse(self: Path, target: Path) -> Path:
        if self.name.startswith(".object-") and Path(target).name == "object":
            raise OSError(errno.EIO, "Input/output error")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(AssetError, match="Input/output error"), atomic_directory(tmp_path / "object") as directory:
        (directory / "a").write_text("new")
    assert (tmp_path / "object/a").read_text() == "old" and len(list(tmp_path.iterdir())) == 1


LONG = 200 * "x" + "/" + 300 * "y"


@pytest.mark.parametrize("write", [ensure_writable_directory, lambda path: write_json(path, {})])
def test_names_that_no_system_takes_are_one_line(write, tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="File name too long") as caught:
        write(tmp_path / LONG)
    assert "\n" not in str(caught.value)


def test_names_as_long_as_a_name_can_be_are_written(tmp_path: Path) -> None:
    write_json(tmp_path / (250 * "x" + ".json"), [1])
    with atomic_directory(tmp_path / (255 * "y")) as directory:
        (directory / "a").write_text("a")
    assert sorted(len(path.name) for path in tmp_path.iterdir()) == [255, 255]


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "out.json").write_text("old")
    code = """
        import resource, sys
        from pathlib import Path
        from tslam_bench.errors import AssetError
        from tslam_bench.files import write_json
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
        try:
            write_json(Path(sys.argv[1]), list(range(10_000)))
        except AssetError as error:
            print(error)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "out.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "out.json: cannot be written (File too large); make room" in done.stdout and done.stderr == ""
    assert (tmp_path / "out.json").read_text() == "old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("command", [["score"], ["leaderboard"], ["assets", "show", "mug", "--output", "x.png"]])
def test_no_command_meets_a_long_path_with_a_traceback(command: list[str], tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(tmp_path / (300 * "y")))
    arguments = command if command[0] == "assets" else [*command, str(tmp_path / (300 * "y"))]
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert caught.value.code == 2 and len(lines) == 1 and "File name too long" in lines[0]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become somebody else")
@pytest.mark.parametrize("command", ["score", "leaderboard"])
def test_a_folder_that_may_not_be_entered_is_one_line(command: str, tmp_path: Path, capsys) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o700)
    for user, reason in ((0, "no such"), (65534, "Permission denied")):  # first as root, who imports what it takes
        os.seteuid(user)
        try:
            with pytest.raises(SystemExit) as caught:
                main([command, str(closed / "submission")])
        finally:
            os.seteuid(0)
        error = capsys.readouterr().err
        assert caught.value.code == 2 and reason in error and "Traceback" not in error, error


def test_a_user_without_a_home_is_told_what_to_set(monkeypatch) -> None:
    """A container runs programs as a user who is in no list of users."""
    if not hasattr(os, "setresuid") or os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    for name in ("HOME", "XDG_CACHE_HOME", CACHE_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    os.setresuid(123_456, 0, 0)
    try:
        with pytest.raises(AssetError, match="this user has no home directory; set TSLAM_BENCH_CACHE"):
            cache_directory()
    finally:
        os.setresuid(0, 0, 0)


def test_a_full_disk_behind_standard_output_is_one_line() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("the system has no /dev/full")
    code = "from tslam_bench.cli import main; main(['env', 'list'])"
    with full.open("w") as stream:
        done = subprocess.run([sys.executable, "-c", code], stdout=stream, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines() == ["tslam-bench: No space left on device"]


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_may_never_end_is_not_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "in.json"
    make(kind, path) if kind != "device" else path.symlink_to("/dev/zero")
    with pytest.raises(InvalidInputError, match=r"in.json: (is a (pipe|device), no file|cannot be read)"):
        read_plain_file(path, 1000)


def test_files_are_read_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(10))
    assert read_plain_file(tmp_path / "a", 10) == bytes(10)
    with pytest.raises(InvalidInputError, match="more than 9 bytes"):
        read_plain_file(tmp_path / "a", 9)
    with pytest.raises(InvalidInputError, match="no such file"):
        read_plain_file(tmp_path / "b", 9)


@pytest.mark.parametrize(
    "read",
    [
        lambda path: main(["reconstruct", "run", "--touched", str(path), "--output", f"{path}.ply"]),
        lambda path: main(["score", str(path)]),
        lambda path: main(["leaderboard", str(path), "--output", str(path.parent / "page")]),
        lambda path: main(["assets", "import", str(path), "--output", "mine"]),
    ],
)
def test_no_command_waits_for_a_pipe(read, tmp_path: Path, capsys) -> None:
    for name in ("in.npz", "in.json", "in.zip", "in.obj"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(SystemExit) as caught:
            read(tmp_path / name)
        assert caught.value.code == 2
