"""The ``tslam-bench`` command: dispatch, help, and one line for bad input."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tslam_bench import __version__
from tslam_bench.cli import main

COMMANDS = ("assets", "baselines", "reconstruct", "score", "leaderboard", "env")


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


def test_version():
    command = [sys.executable, "-m", "tslam_bench.cli", "--version"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fly",), "unknown command 'fly'; choose one of assets"),
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
