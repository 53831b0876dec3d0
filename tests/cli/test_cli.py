"""The ``tslam-bench`` command: dispatch, help, and one line for bad input."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tslam_bench import __version__, cli
from tslam_bench.cli import main

COMMANDS = tuple(cli._COMMANDS)


def run(capsys: pytest.CaptureFixture, *arguments: str) -> tuple[int, str, str]:
    status = 0
    try:
        main(arguments)
    except SystemExit as stop:
        status = int(stop.code or 0)
    out, err = capsys.readouterr()
    return status, out, err


def test_help_names_every_command_and_each_has_help(capsys):
    status, out, _ = run(capsys, "--help")
    assert status == 0 and all(command in out for command in COMMANDS)
    for command in COMMANDS:
        status, out, err = run(capsys, command, "--help")
        assert status == 0 and "usage" in (out + err).lower(), command


def leaves() -> list[tuple[str, ...]]:
    """Every command that has flags."""
    found: list[tuple[str, ...]] = []
    for command in COMMANDS:
        shown = subprocess.run(
            [sys.executable, "-m", "tslam_bench.cli", command, "--help"], capture_output=True, text=True, check=True
        )
        words = re.findall(r"^  ([a-z-]+)  ", shown.stdout.partition("commands:")[2], re.MULTILINE)
        found += [(command, word) for word in words] or [(command,)]
    return found


@pytest.mark.parametrize("words", leaves(), ids=" ".join)
def test_help_describes_every_flag(capsys, words: tuple[str, ...]) -> None:
    status, text, _ = run(capsys, *words, "--help")
    assert status == 0
    flags = re.split(r"^[ |]+(?=--[a-z]|-h)", re.sub(r"[│╭╮╰╯─|]|--+(?![a-z])", " ", text), flags=re.MULTILINE)[1:]
    assert flags
    for flag in flags:
        described = re.sub(r"\(default:.*|\(required\)", "", flag, flags=re.DOTALL).split("  ", 1)[-1]
        assert described.strip(), flag


def test_help_needs_neither_simulator_nor_torch_nor_settings() -> None:
    code = (
        "import sys\nfrom tslam_bench.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit: pass\n"
        "assert not {'torch', 'sapien', 'tyro', 'trimesh', 'scipy', 'numba', 'tslam_bench.scoring.scoring'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_errors_become_exit_statuses_in_one_place() -> None:
    """Elsewhere errors are caught to go on, not to end the program."""
    root = Path(__file__).parents[2]
    folders = ("tslam_bench", "baselines", "leaderboard", "tasks", "benchmarks", "docs", "examples")
    sources = [p for folder in folders for p in (root / folder).rglob("*.py")]
    ending = [
        p.name
        for p in sources
        if re.search(r"except BenchmarkError[^\n]*\n(?:[^\n]*\n)?[^\n]*sys\.exit", p.read_text())
    ]
    assert ending == ["ending.py"]


def test_version():
    command = [sys.executable, "-m", "tslam_bench.cli", "--version"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fly",), "'fly': unknown command; choose one of assets, env"),
        (("assets", "fly"), "assets 'fly': unknown command; choose one of prepare, import"),
        (("baselines", "train", "tslamm"), "tslamm"),
        (("assets", "show", "mugg"), "mugg"),
        (("env", "describe", "TactileSLAM-v7"), "TactileSLAM-v7"),
        (("score", "no/such/folder"), "no/such/folder"),
    ],
)
def test_bad_input_gets_one_line_and_status_2(capsys, arguments, message):
    status, _, err = run(capsys, *arguments)
    assert status == 2
    lines = [line for line in err.splitlines() if line.strip() and "/s]" not in line]  # progress bars aside
    assert len(lines) == 1 and message in lines[0] and lines[0].startswith("tslam-bench"), err


@pytest.mark.parametrize(
    "arguments", [("assets", "list"), ("baselines", "list"), ("reconstruct", "list"), ("env", "list")]
)
def test_every_listing_command_prints_json(capsys, arguments):
    status, out, _ = run(capsys, *arguments, "--json")
    rows = json.loads(out)
    assert status == 0 and len(rows) >= 1 and all(isinstance(row, dict) for row in rows)
