"""The results that are kept, and the pages made of them: what the pages show is what the score files say."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tslam_bench.scoring.score_file import aggregate
from tslam_bench.scoring.untrusted_scores import read_score

ROOT = Path(__file__).parents[2]
SCORES = sorted((ROOT / "leaderboard" / "results" / "scores").glob("*.json"))
SITE = ROOT / "docs" / "leaderboard"


class Rows(HTMLParser):
    """Cells (text, data-value) of every ranking's rows, and the addresses of all pictures."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.rows: list[list[list[Any]]] = []
        self.pictures: set[str] = set()
        self._inside = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        about = dict(attrs)
        if tag == "img":
            self.pictures.add(about["src"] or "")
        elif tag == "tr" and "data-tier" in about:
            self._inside = True
            self.rows.append([])
        elif tag in ("td", "th") and self._inside:
            self.rows[-1].append(["", about["data-value"]])

    def handle_endtag(self, tag: str) -> None:
        self._inside = self._inside and tag != "tr"

    def handle_data(self, data: str) -> None:
        if self._inside and data.strip():
            self.rows[-1][-1][0] += data.strip() + "\n"


@pytest.fixture(scope="module")
def shown() -> Rows:
    return Rows((SITE / "index.html").read_text(encoding="utf-8"))


def test_figures_of_the_page_are_those_of_the_files(shown: Rows) -> None:
    """Means over objects and seeds, computed here from the results of every file."""
    expected, found = [], []
    for path in SCORES:
        score = json.loads(path.read_text(encoding="utf-8"))
        results, info = score["results"], score["submission"]

        def mean(group: str, metric: str, results: Any = results) -> float | None:
            values = [r["areas"][metric] if group == "areas" else r["poses"][group][metric] for r in results]
            return None if None in values else float(np.mean(values))

        figures = [
            mean("areas", "iou_area"),
            *(mean(count, "iou") for count in "1248"),
            mean("areas", "exploration_area"),
        ]
        expected.append((info["explorer"], info["reconstructor"], figures, len(info["seeds"])))
    for row in shown.rows:
        cells = [row[k] for k in range(3, 9)]
        figures = [float(value) if value else None for _, value in cells]
        for (text, _), figure in zip(cells, figures, strict=True):
            assert text.split("\n")[0] == ("\u2013" if figure is None else f"{figure:.3f}")
        found.append((row[1][1], row[2][1], figures, int(row[-1][1])))
    assert len(expected) == len(found) > 0
    for wanted, there in zip(sorted(expected, key=lambda e: e[:2]), sorted(found, key=lambda e: e[:2]), strict=True):
        assert wanted[:2] + wanted[3:] == there[:2] + there[3:]
        assert there[2] == [
            None if figure is None else pytest.approx(figure, rel=1e-6, abs=1e-8) for figure in wanted[2]
        ]


@pytest.mark.parametrize("path", SCORES[:3], ids=lambda path: path.stem)
def test_aggregates_of_a_kept_file_are_those_of_its_results(path: Path) -> None:
    score = read_score(path, vouched=True)
    for group, estimates in aggregate(score.results, len(score.objects)).items():
        for metric, estimate in estimates.items():
            assert vars(estimate) == pytest.approx(vars(score.aggregate[group][metric]), rel=1e-9)


def test_who_vouches_for_a_file_decides_whose_figures_they_are() -> None:
    """The same file sent by a stranger: its figures are shown as somebody's, and its explorer only claims its name."""
    mine, theirs = (read_score(SCORES[0], vouched=vouched) for vouched in (True, False))
    assert mine.made_here and mine.own_run and "scored elsewhere" not in " ".join(mine.notes)
    assert not theirs.made_here and not theirs.own_run and "scored elsewhere" in theirs.notes[0]


def test_the_folder_of_the_page_is_complete_and_holds_nothing_else(shown: Rows) -> None:
    files = {path.relative_to(SITE).as_posix() for path in SITE.rglob("*") if path.is_file()}
    assert shown.pictures and shown.pictures <= files
    own = {"index.html", "leaderboard.json", "pictures/pictures.json"}
    assert files - own == shown.pictures
    text = (SITE / "index.html").read_text(encoding="utf-8") + (SITE / "leaderboard.json").read_text(encoding="utf-8")
    assert not re.search(r"/(?:root|home|tmp|work)/", text)
    assert sum(path.stat().st_size for path in SITE.rglob("*.webp")) + len(text) < 12 * 2**20
