"""The parts of a page that scripts write, between its lines ``<!-- begin NAME -->`` and ``<!-- end NAME -->``."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def filled(page: Path, texts: Mapping[str, str]) -> str:
    """The page's text with its sections ``texts`` (name -> text) replaced.

    Raises:
        InvalidInputError: the page lacks the lines of a section, or has them twice.
    """
    content = page.read_text(encoding="utf-8")
    for name, text in texts.items():
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        if content.count(begin) != 1 or content.count(end) != 1:
            raise InvalidInputError(f"{page}: needs exactly one line {begin!r} and one {end!r}")
        before, rest = content.split(begin)
        content = f"{before}{begin}\n{text.strip()}\n{end}{rest.split(end)[1]}"
    return content


def write_or_check(pages: Mapping[Path, str], check: bool) -> None:
    """Writes the text of every page, or, to ``check``, exits with status 1 where one is out of date."""
    stale = [page for page, text in pages.items() if not page.exists() or page.read_text(encoding="utf-8") != text]
    if check and stale:
        sys.exit(f"{', '.join(map(str, stale))}: out of date; run python docs/{Path(sys.argv[0]).name}")
    for page in () if check else stale:
        with atomic_file(page) as temporary:
            temporary.write_text(pages[page], encoding="utf-8")
