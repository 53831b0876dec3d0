"""setup.sh on other people's machines, with interpreters and systems that write down what they are asked to do."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
INTERPRETER = """#!/bin/bash
case "$1 $2" in
    "-c "*) exit {unfit} ;;
    "--version "*) echo Python {version} ;;
    "-I -") exec {python} "$@" ;;
    "-m venv") mkdir -p "$3/bin" && cp "$0" "$3/bin/python"
        printf 'VIRTUAL_ENV="%s"\\n' "$3" >"$3/bin/activate"
        printf '#!%s/bin/python\\n' "$3" >"$3/bin/tool" && chmod +x "$3/bin/tool" && echo "home" >"$3/pyvenv.cfg" ;;
    "-m pip") echo "pip $0" >>"{log}" ;;
esac
"""


def interpreter(folder: Path, version: str = "3.11.9") -> Path:
    """Stands in for Python: makes an environment that holds itself, and notes where pip installs to."""
    path = folder / f"python-{version}"
    unfit = 0 if version.startswith(("3.11", "3.12")) else 1
    path.write_text(INTERPRETER.format(unfit=unfit, version=version, python=sys.executable, log=folder / "log"))
    path.chmod(0o755)
    return path


def set_up(clone: Path, python: Path, **variables: str) -> tuple[int, str]:
    """Exit status and output of a set-up; what was installed is in ``log`` beside the clones."""
    environment = {**os.environ, "PYTHON_FOR_VENV": str(python), **variables}
    command = ["bash", "-c", "set -euo pipefail; source ./setup.sh; set_up_environment"]  # as run_all.sh and run.sh do
    done = subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def installed(clone: Path) -> list[str]:
    log = clone.parent / "log"
    lines = log.read_text().splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return lines


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    folder = tmp_path / "first clone"
    folder.mkdir()
    for name in ("setup.sh", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, folder)
    assert set_up(folder, interpreter(tmp_path))[0] == 0
    assert installed(folder) == [f"pip {folder}/.venv/bin/python"]
    assert set_up(folder, interpreter(tmp_path)) == (0, "") and installed(folder) == []
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("copy", [["cp", "-a"], ["cp", "-al"]])
@pytest.mark.parametrize("stamped", [True, False])
def test_a_copied_clone_leaves_the_original_alone(clone: Path, copy: list[str], stamped: bool) -> None:
    """Scripts of a copied environment run the original's interpreter; a copy of hard links shares its files."""
    other = clone.parent / "copy"
    subprocess.run([*copy, clone, other], check=True)
    if not stamped:  # a set-up that was stopped
        (other / ".venv/tslam-bench.stamp").unlink()
    before = contents(clone)
    code, output = set_up(other, interpreter(clone.parent))
    assert code == 0 and f"setup: .venv was made in {clone}; its scripts are rewritten" in output
    assert installed(clone) == [f"pip {other}/.venv/bin/python"]
    assert contents(clone) == before
    assert not [name for name, data in contents(other).items() if os.fsencode(clone) in data]
    assert os.access(other / ".venv/bin/tool", os.X_OK)
    assert set_up(other, interpreter(clone.parent)) == (0, "")


def test_an_environment_that_is_a_link_to_the_original_s_is_not_installed_into(clone: Path) -> None:
    other = clone.parent / "copy"
    shutil.copytree(clone, other, ignore=shutil.ignore_patterns(".venv"))
    (other / ".venv").symlink_to("../first clone/.venv")
    before = contents(clone)
    code, output = set_up(other, interpreter(clone.parent))
    assert code == 0 and f"setup: .venv is that of {clone}; making another one here" in output
    assert installed(clone) == [f"pip {other}/.venv/bin/python"]
    assert contents(clone) == before and not (other / ".venv").is_symlink()


def test_a_clone_that_is_reached_by_another_name_keeps_its_environment(clone: Path) -> None:
    (clone.parent / "link").symlink_to(clone)
    code, output = set_up(clone.parent / "link", interpreter(clone.parent))
    assert code == 0 and ".venv was made in" not in output and ".venv is that of" not in output


@pytest.mark.parametrize("version", ["3.10.13", "3.13.0"])
def test_other_versions_of_python_are_refused_before_anything_is_installed(clone: Path, version: str) -> None:
    python = interpreter(clone.parent, version)
    shutil.rmtree(clone / ".venv")
    code, output = set_up(clone, python)
    assert code == 2 and output.strip().count("\n") == 0
    assert output.startswith(
        f"setup: {python} is Python {version}; delete .venv if there is one, and set PYTHON_FOR_VENV"
    )
    assert not (clone / ".venv").exists() and installed(clone) == []
    subprocess.run([python, "-m", "venv", clone / ".venv"], check=True)  # made by hand
    code, output = set_up(clone, interpreter(clone.parent))
    assert code == 2 and f".venv/bin/python is Python {version}; delete .venv" in output and installed(clone) == []


def test_a_system_without_wheels_of_the_simulator_is_told_before_anything_is_installed(clone: Path) -> None:
    shutil.rmtree(clone / ".venv")
    programs = clone.parent / "programs"
    programs.mkdir()
    (programs / "uname").write_text('#!/bin/bash\n[ "$1" = -s ] && echo Linux || echo aarch64\n')
    (programs / "uname").chmod(0o755)
    code, output = set_up(clone, interpreter(clone.parent), PATH=f"{programs}:{os.environ['PATH']}")
    assert code == 2 and not (clone / ".venv").exists() and installed(clone) == []
    assert output == (
        "setup: the simulator has no wheels for Linux on aarch64; take another machine, "
        "or 'pip install .' for scoring and pages alone\n"
    )


def test_what_is_promised_is_what_is_installed() -> None:
    """One range of versions in the package, in the set-up and in what people read first."""
    project = (ROOT / "pyproject.toml").read_text()
    assert 'requires-python = ">=3.11,<3.13"' in project
    assert "(3, 11) <= sys.version_info < (3, 13)" in (ROOT / "setup.sh").read_text()
    for name in ("README.md", "CONTRIBUTING.md"):
        assert "Linux on x86-64, Python 3.11 or 3.12" in (ROOT / name).read_text(), name
