"""Writes the list of lines that only a GPU reaches into docs/gpu.md, from the comments ``# GPU only`` in the code.

python docs/build_gpu.py           # write
python docs/build_gpu.py --check   # fail if the list is out of date
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

import tyro
from sections import filled, table, write_or_check

ROOT = Path(__file__).parent.parent
TARGET = ROOT / "docs" / "gpu.md"
MARK = "# GPU only"


@dataclass(frozen=True)
class Config:
    """Writes or checks the list in docs/gpu.md."""

    check: bool = False
    """Only compare; exit with status 1 if the list is out of date."""


def rows() -> list[tuple[str, str, str]]:
    """One row per marked line: file, function, the line. A marked docstring stands for its whole function."""
    found = []
    for path in sorted([*ROOT.glob("tasks/*.py"), *ROOT.glob("tslam_bench/**/*.py"), *ROOT.glob("baselines/*.py")]):
        text = path.read_text(encoding="utf-8")
        functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
        for number, line in enumerate(text.splitlines(), start=1):
            if MARK not in line:
                continue
            inside = [f for f in functions if f.lineno <= number <= (f.end_lineno or 0)]
            name = max(inside, key=lambda f: f.lineno).name if inside else "module"
            code = line.split(MARK)[0].strip()
            shown = "the whole function" if code.endswith('"""') else f"`{code}`"
            found.append((f"`{path.relative_to(ROOT)}`", f"`{name}`", shown.replace("|", "\\|")))
    return found


def main(config: Config) -> None:
    """Writes the list, or compares it."""
    text = table(("file", "function", "line"), rows())
    write_or_check({TARGET: filled(TARGET, {"list": text})}, config.check)


if __name__ == "__main__":
    main(tyro.cli(Config))
