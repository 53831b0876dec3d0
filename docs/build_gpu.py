"""Writes the list of lines that only a GPU reaches into docs/gpu.md, from the comments ``# GPU only`` in the code.

python docs/build_gpu.py           # write
python docs/build_gpu.py --check   # fail if the list is out of date
"""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from tslam_bench.files import atomic_file

ROOT = Path(__file__).parent.parent
TARGET = ROOT / "docs" / "gpu.md"
MARK = "# GPU only"
BEGIN, END = "<!-- list: begin (docs/build_gpu.py) -->", "<!-- list: end -->"


@dataclass(frozen=True)
class Config:
    """Writes or checks the list in docs/gpu.md."""

    check: bool = False
    """Only compare; exit with status 1 if the list is out of date."""


def rows() -> list[str]:
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
            found.append(f"| `{path.relative_to(ROOT)}` | `{name}` | {shown.replace('|', chr(92) + '|')} |")
    return ["| file | function | line |", "|---|---|---|", *found]


def main(config: Config) -> None:
    """Writes the list, or compares it."""
    old = TARGET.read_text(encoding="utf-8")
    block = "\n".join([BEGIN, *rows(), END])
    new = re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: block, old, flags=re.DOTALL)
    if config.check:
        if new != old:
            sys.exit("docs/gpu.md is out of date; run 'python docs/build_gpu.py'")
        return
    with atomic_file(TARGET) as temporary:
        temporary.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main(tyro.cli(Config))
