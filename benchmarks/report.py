"""What the benchmarks say in the end: tables in the docs and on the terminal, a JSON file, and the machine they ran on."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from tslam_bench.files import atomic_file
from tslam_bench.machine import processor_name

sys.path.insert(0, str(Path(__file__).parent.parent / "docs"))
from sections import filled
from sections import table as markdown_table

__all__ = ["machine", "markdown_table", "print_table", "replace_section", "write_json"]


def print_table(header: Sequence[str], rows: Iterable[Sequence[Any]], title: str | None = None) -> None:
    """Prints a table."""
    table = Table(*header, title=title)
    for row in rows:
        table.add_row(*(str(cell) for cell in row))
    Console(width=130).print(table)


def replace_section(page: Path, name: str, text: str) -> None:
    """Puts ``text`` between a page's lines ``<!-- begin NAME -->`` and ``<!-- end NAME -->``.

    Raises:
        InvalidInputError: the page lacks these lines.
    """
    with atomic_file(page) as temporary:
        temporary.write_text(filled(page, {name: text}), encoding="utf-8")


def write_json(path: Path | None, result: Any) -> None:
    """Writes ``result`` if a file is asked for."""
    if path is not None:
        path.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def machine() -> str:
    """Cores, processor and its load by others, in a few words."""
    cores = len(os.sched_getaffinity(0))
    return f"{cores} cores, {processor_name()}, load {os.getloadavg()[0]:.1f} at the start"
