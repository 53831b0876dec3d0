"""The page in a real browser: Chromium, driven by Playwright. Skipped where there is none."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scored_run import fake_score

from tslam_bench.leaderboard.commands import write_page
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.leaderboard.shown import Shown
from tslam_bench.scoring.score_file import SubmissionScore

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")
HOSTILE = "\"'><img src=x onerror=alert(1)><script>alert(1)</script>"


def scores() -> list[SubmissionScore]:
    """Two rankings; entries of three reconstructors, two tiers, with and without privilege, one with hostile texts."""
    generator = np.random.default_rng(0)
    found = []
    for k, explorer in enumerate(("heuristic", "random", "oracle", "mine")):
        for reconstructor in ("hull", "grid", "carve")[: 3 - k % 2]:
            changes: dict[str, Any] = {"reconstructor": reconstructor, "privileged": explorer == "oracle"}
            if explorer == "mine":
                changes |= {"method": HOSTILE, "label": HOSTILE, "authors": (HOSTILE,)}
            score = fake_score(explorer, generator.uniform(0.1, 0.9, (6, 3)), area=0.2 + k / 10, **changes)
            score = replace(score, tier="replayed" if explorer == "random" else "reported")
            for result in score.results:  # as long as a real one's
                result.recall_curve[:] = np.linspace(0, 0.2 + k / 10, 161).tolist()
            found.append(score)
    return [*found, fake_score("small", [0.5, 0.2])]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with pictures, of which one is far down, and training curves."""
    from PIL import Image

    folder = tmp_path_factory.mktemp("site")
    steps = list(range(1000, 9000, 1000))
    figures = {"mean": [20.0 + k for k in range(8)], "low": [10.0] * 8, "high": [40.0] * 8}
    board = rank(scores(), [{"explorer": name, "runs": 1, "steps": steps, **figures} for name in ("a", HOSTILE)])
    pictures = {}
    (folder / "pictures").mkdir()
    for k, name in enumerate(board["tables"][0]["objects"]):
        pictures["truth", "", name] = Shown(f"{k:024d}.webp", 120, 90)
        Image.new("RGB", (120, 90), (40 * k, 90, 90)).save(folder / "pictures" / f"{k:024d}.webp")
    write_page(board, pictures, folder)
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture
def visit(browser: Any, site: Path) -> Iterator[Any]:
    """Opens the page from its folder at a width; whatever the browser complains about fails the test."""
    complaints: list[str] = []
    contexts = []

    def opened(width: int = 1440, **options: Any) -> Any:
        contexts.append(browser.new_context(viewport={"width": width, "height": 900}, offline=True, **options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("dialog", lambda dialog: (complaints.append(dialog.message), dialog.dismiss()))
        page.on("requestfailed", lambda request: complaints.append(f"not loaded: {request.url}"))
        page.goto((site / "index.html").as_uri())
        page.wait_for_selector("[data-chart] svg[role=img]")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []


def column(page: Any, title: str, table: str = "#entries-1") -> list[str]:
    """Texts of the visible cells below a head that holds ``title``; the first line of each."""
    return page.evaluate(
        """([table, title]) => {
            const grid = document.querySelector(table);
            const heads = Array.from(grid.tHead.rows[0].cells);
            const column = heads.findIndex((head) => head.textContent.includes(title));
            return Array.from(grid.tBodies[0].rows).filter((row) => !row.hidden)
                .map((row) => row.cells[column].innerText.split("\\n")[0].trim());
        }""",
        [table, title],
    )


def wait_for(page: Any, condition: str) -> None:
    """Until a JavaScript expression is true. Playwright's own wait evaluates text inside the page, which its policy forbids."""
    for _ in range(100):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never true: {condition}")


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (820, "dark"), (1440, "light")])
def test_the_page_fits_and_its_charts_are_drawn(visit: Any, width: int, scheme: str) -> None:
    page = visit(width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == width  # tables scroll, the page does not
    charts = page.locator("[data-chart]")
    assert charts.count() == 2 + 3 + 1  # touch of two rankings, IoU of three reconstructors, training
    for k in range(charts.count()):
        box, frame = charts.nth(k).locator("svg").first.bounding_box(), charts.nth(k).bounding_box()
        assert box["x"] >= frame["x"] - 1 and box["x"] + box["width"] <= frame["x"] + frame["width"] + 1
        assert charts.nth(k).locator("[aria-label=line] path").count() >= 1
        assert charts.nth(k).locator("[aria-label=area] path").count() >= 1
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", background))) < 200) == (scheme == "dark")


def test_the_ranking_sorts(visit: Any) -> None:
    page = visit()
    ranked = column(page, "IoU area")
    assert ranked == sorted(ranked, reverse=True) and len(ranked) == 10
    head = page.locator("#entries-1 th", has_text="4 poses")
    for order, reverse in (("descending", True), ("ascending", False)):
        head.get_by_role("button").click()
        values = page.evaluate(
            "Array.from(document.querySelectorAll('#entries-1 tbody tr')).map((row) => Number(row.cells[6].dataset.value))"
        )
        assert head.get_attribute("aria-sort") == order and values == sorted(values, reverse=reverse)
    page.locator("#entries-1 th", has_text="Entry").get_by_role("button").press("Enter")
    assert column(page, "Entry") == sorted(column(page, "Entry"), key=str.lower)
    page.locator("#entries-1 th.rank").get_by_role("button").click()
    ranks = [int(text.strip("=")) for text in column(page, "Rank") if text != "\u2013"]
    assert ranks == sorted(ranks) and column(page, "Rank")[-3:] == ["\u2013"] * 3  # unranked ones stay below


def test_filters_hold_for_table_map_and_charts(visit: Any) -> None:
    page = visit()
    form = page.locator("form[data-for='1']")
    lines = "[data-chart=touch] >> nth=0 >> [aria-label=line] path"
    assert page.locator(lines).count() == 4
    form.get_by_label("Reconstructor").select_option("grid")
    assert column(page, "Reconstructor") == ["grid"] * 4
    assert len(column(page, "Entry", "#heat-1")) == 4 and form.locator("output").inner_text() == "4 of 10 entries"
    form.get_by_label("Tier").select_option("replayed")
    assert column(page, "Entry") == ["random"] and page.locator(lines).count() == 1
    form.get_by_role("button", name="Reset").click()
    playwright.expect(form.locator("output")).to_have_text("10 of 10 entries")
    form.get_by_label("True shape").select_option("no")
    assert "oracle" not in column(page, "Entry") and page.locator(lines).count() == 3
    form.get_by_label("Find").fill("HEUR")
    assert set(column(page, "Entry")) == {"heuristic"}
    assert len(column(page, "Entry", "#entries-2")) == 1  # the other ranking is not touched


def test_columns_can_be_changed(visit: Any) -> None:
    page = visit()
    head = "#entries-1 th >> text=Chamfer-L2"
    assert not page.locator(head).is_visible()
    page.locator("form[data-for='1']").get_by_label("Columns").select_option("surface")
    assert page.locator(head).is_visible() and not page.locator("#entries-1 th >> text=P(better)").is_visible()


def test_the_map_shows_any_figure(visit: Any, site: Path) -> None:
    page = visit()
    entries = json.loads((site / "leaderboard.json").read_text())["tables"][0]["entries"]
    for choice, group, metric in (("IoU, 8 poses", "8", "iou"), ("Exploration", "areas", "exploration_area")):
        option = page.locator("select[data-heat='0'] option", has_text=choice)
        page.locator("select[data-heat='0']").select_option(option.get_attribute("value"))
        expected = [f"{entry['per_object']['object3'][group][metric]:.2f}" for entry in entries]
        assert column(page, "object3", "#heat-1") == expected


def test_charts_answer_to_pointer_and_keys(visit: Any) -> None:
    page = visit()
    chart = page.locator("[data-chart=touch]").first
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tip = chart.locator("[aria-label=tip] text")
    tip.wait_for()
    assert re.search(r"step 8\d\d: 0\.\d{3}\W*95 %: 0\.\d{3} to 0\.\d{3}", tip.text_content())
    page.mouse.move(0, 0)
    chart.focus()
    page.keyboard.press("ArrowLeft")
    first = chart.locator("[aria-live]").text_content()
    page.keyboard.press("ArrowDown")
    second = chart.locator("[aria-live]").text_content()
    assert first.startswith("mine, step 1,540: 0.481") and second.startswith("oracle, step 1,540: 0.385")
    assert tip.count() == 1
    chart = page.locator("[data-chart=training]")
    chart.focus()
    page.keyboard.press("ArrowDown")
    assert chart.locator("[aria-live]").text_content() == f"{HOSTILE}, step 8,000: 27.0, 10 to 90 %: 10.0 to 40.0"


def test_the_legend_switches_lines(visit: Any) -> None:
    page = visit()
    button = page.locator("[data-legend='1'] button", has_text="heuristic")
    counted = "document.querySelectorAll('[data-chart=iou] [aria-label=line] path').length"
    before = page.evaluate(counted)
    button.click()
    assert button.get_attribute("aria-pressed") == "false" and page.evaluate(counted) == before - 3
    button.press("Enter")
    assert button.get_attribute("aria-pressed") == "true" and page.evaluate(counted) == before
    every = page.locator("[data-legend='1'] button.every")
    for lines in (0, before):
        every.click()
        assert page.evaluate(counted) == lines


def test_pictures_are_loaded_when_they_are_seen(visit: Any) -> None:
    page = visit(390)
    loaded = "Array.from(document.images).map((image) => image.complete && image.naturalWidth === 120)"
    assert not any(page.evaluate(loaded))
    page.locator("details.object").first.scroll_into_view_if_needed()
    wait_for(page, f"({loaded})[0]")
    folded = page.locator("details.object").nth(4)
    assert not page.evaluate(loaded)[4]
    folded.locator("summary").click()
    wait_for(page, f"({loaded})[4]")


def test_everything_is_there_without_scripts(visit: Any, browser: Any, site: Path) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto((site / "index.html").as_uri())
    assert page.locator("#entries-1 th", has_text="Chamfer-L2").is_visible()
    assert page.locator("#entries-1 tbody tr").count() == 10 and not page.locator(".controls").first.is_visible()
    assert page.locator("noscript").inner_text().startswith("Charts, filters and sorting need scripts")
    context.close()


def test_the_first_load_is_small(site: Path) -> None:
    assert (site / "index.html").stat().st_size < 2 * 2**20
