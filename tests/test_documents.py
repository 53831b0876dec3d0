"""README, CONTRIBUTING and docs/: files and links that they name exist, tables have headers, every page is in the site's menu."""

from __future__ import annotations

import re
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

import tslam_bench

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
FOLDERS = "tslam_bench|tasks|baselines|leaderboard|assets|tests|docs|benchmarks"
PATH = re.compile(rf"(?<![\w/.<>-])((?:{FOLDERS})/[\w/.-]*\.(?:py|sh|md|json|yml|png))\b")


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, made as GitHub makes them; a page may be another file, included."""
    text = page.read_text(encoding="utf-8")
    if included := re.fullmatch(r'--8<-- "([\w.]+)"\n', text):
        text = text_of(included.group(1))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(name)):
        if re.match(r"https?://", target):
            continue
        path, _, anchor = target.partition("#")
        there = page.parent / path if path else page
        assert there.exists(), f"{name} links to {target}"
        assert not anchor or anchor in anchors(there), f"{name} links to {target}: no such heading"


@pytest.mark.parametrize("name", NAMES)
def test_files_that_are_named_exist(name: str) -> None:
    missing = {path for path in PATH.findall(text_of(name)) if not (ROOT / path).exists()}
    assert not missing, f"{name} names files that are not there: {sorted(missing)}"


@pytest.mark.parametrize("name", NAMES)
def test_tables_have_headers(name: str) -> None:
    lines = ["", *text_of(name).splitlines()]
    for above, line in pairwise(lines):
        if re.fullmatch(r"\|(?:\s*:?-+:?\s*\|)+", line):
            cells = [cell.strip() for cell in above.strip("|").split("|")]
            assert any(cells), f"{name}: a table without headers"


def test_every_page_is_in_the_menu_once() -> None:
    class Loader(yaml.SafeLoader):
        """Reads tags that only the site knows as None."""

    Loader.add_multi_constructor("!", lambda loader, suffix, node: None)
    menu = yaml.load(text_of("mkdocs.yml"), Loader)["nav"]
    listed = [page for section in menu for pages in section.values() for page in pages]
    assert sorted(listed) == [name.removeprefix("docs/") for name in NAMES if name.startswith("docs/")]


def test_every_example_is_shown() -> None:
    shown = re.findall(r'^--8<-- "(examples/.*)"$', text_of("docs/examples.md"), re.MULTILINE)
    assert {path.relative_to(ROOT).as_posix() for path in (ROOT / "examples").glob("*.py")} <= set(shown)


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load(text_of("CITATION.cff"))
    assert citation["version"] == tslam_bench.__version__
    assert citation["license"] == tomllib.loads(text_of("pyproject.toml"))["project"]["license"]
