"""Page and command: from submissions on disk to HTML, with a small asset cache made of primitives."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import re
import shutil
import time
import zipfile
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scored_run import NAMES, fake_score

from tslam_bench.cli import main
from tslam_bench.cli.score import score_main
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.leaderboard.commands import find_inputs, page_main, write_page
from tslam_bench.leaderboard.page import build_page, row_names
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.leaderboard.shown import Shown, read_links, read_pictures, write_links, write_pictures
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.origin import beside, has_origin, write_origin
from tslam_bench.scoring.submission import read_submission
from tslam_bench.scoring.verification import Verdict, VerificationRecord, pack_steps, record_path


@pytest.fixture(autouse=True)
def use_cache(primitive_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(primitive_cache))


class Page(HTMLParser):
    """Collects tags, checks nesting, finds what a browser would fetch."""

    VOID = ("meta", "link", "img", "br", "input", "wbr")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        assert self.stack == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag, (tag, self.getpos())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def page(run: Path, primitive_cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TSLAM_BENCH_CACHE", str(primitive_cache))
        page_main(["--scores", str(run / "scores"), "--output", str(output)])
    return output


def markup(page: Path) -> str:
    """The page without what its script reads: figures stand there as well."""
    text = (page / "index.html").read_text(encoding="utf-8")
    return re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.DOTALL)


def test_page_is_well_formed_and_complete_in_its_folder(page: Path) -> None:
    text = markup(page)
    parsed = Page(text)
    images = parsed.all("img")
    # Truth, touched and reconstruction of two objects; random + grid shows touched voxels only; three in the header.
    assert len(images) == 3 + 2 * (1 + 4 + 3)
    assert all(image["alt"] and image["loading"] == "lazy" for image in images)
    for image in images:
        with Image.open(page / (image["src"] or "")) as picture:
            assert picture.format == "WEBP" and picture.size == (int(image["width"] or 0), int(image["height"] or 0))
    pictures = {path.name for path in (page / "pictures").glob("*.webp")}
    assert pictures == {(image["src"] or "").removeprefix("pictures/") for image in images}
    for attributes in [*parsed.all("link"), *parsed.all("script"), *parsed.all("img")]:
        address = attributes.get("href") or attributes.get("src") or ""
        assert not address.startswith(("http", "//"))
    own = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "@import" not in own and "url(" not in own
    headers = parsed.all("th")
    assert headers and all(attributes.get("scope") in ("row", "col") for attributes in headers)
    identifiers = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    targets = [a["href"] for a in parsed.all("a") if (a.get("href") or "").startswith("#")]
    assert targets and all(target[1:] in identifiers for target in targets if target)


def test_page_escapes_what_submissions_say(page: Path) -> None:
    text = (page / "index.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text and "<b>Mine</b>" not in text
    assert "&lt;script&gt;alert(1)" in text and "&lt;b&gt;Mine&lt;/b&gt;" in text
    assert 'href="https://example.org/a?b=1&amp;c"' in text


HOSTILE = """\"'><script>alert(1)</script><img src=x onerror=alert(1)> {{ 7 * 7 }} {% raw %} &lt; ]]> --> javascript:alert(1)"""


def page_with(text: str, link: str) -> str:
    """A page on which every text of a submission is ``text``; the board is changed after all checks of submissions."""
    scores = [fake_score("a", [0.2, 0.3]), fake_score("heuristic", [0.2, 0.3]), fake_score("b", [0.4, 0.3])]
    board = rank(scores)
    table = board["tables"][0]
    table["objects"] = [name + text for name in table["objects"]]
    images = {("truth", "", name): Shown("a.webp", 2, 1) for name in table["objects"]}
    viewer = {
        (e["content_hash"], name): f"viewer/index.html#{text}" for e in table["entries"] for name in table["objects"]
    }
    for number, entry in enumerate(table["entries"]):
        names = {"explorer": f"{number}{text}", "reconstructor": text, "method": text, "label": text, "link": link}
        entry["submission"] |= {**names, "authors": [text, text], "contact": text, "package_version": text}
        entry["submission"]["training"] |= {"hardware": text, "steps": 1}
        entry["notes"] = [text]
        entry["per_object"] = {name + text: value for name, value in entry["per_object"].items()}
        for name in table["objects"]:
            for kind in ("touched", "reconstruction"):
                images[kind, entry["content_hash"], name] = Shown("b.webp", 2, 1)
    board["training"] = [{"explorer": text, "runs": 1, "steps": [1], "mean": [1.0], "low": [1.0], "high": [1.0]}]
    return build_page(board, images, viewer)


def test_no_text_of_a_submission_becomes_markup() -> None:
    """A page of hostile texts has exactly the elements and attributes of one of harmless texts, and the same script."""
    harmless, hostile = page_with("text", ""), page_with(HOSTILE, "javascript:alert(1)")
    shapes = [[(tag, sorted(attributes)) for tag, attributes in Page(text).tags] for text in (harmless, hostile)]
    assert shapes[0] == shapes[1]
    scripts = [re.findall(r"<script>(.*?)</script>", text, re.DOTALL) for text in (harmless, hostile)]
    assert scripts[0] == scripts[1] and len(scripts[0]) == 4
    assert all(
        (a["href"] or "").startswith(("#", "viewer/index.html#", "leaderboard.json")) for a in Page(hostile).all("a")
    )
    (data,) = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', hostile, re.DOTALL)
    assert not set("<>&'") & set(data)
    assert {line["label"] for line in json.loads(data)["tables"][0]["iou"]} == {f"{k}{HOSTILE}" for k in range(3)}
    names = [
        attributes["data-reconstructor"] for attributes in Page(hostile).all("tr") if "data-reconstructor" in attributes
    ]
    assert names == 3 * [HOSTILE]  # what the browser reads is the text itself, no more and no less


def test_text_that_turns_or_hides_its_surroundings_is_shown_as_an_escape() -> None:
    text = re.sub(r"<script>.*?</script>", "", page_with("a\u202eb\u200bc\x1bd", ""), flags=re.DOTALL)
    assert not set("\u202e\u200b\x1b") & set(text) and r"a\u202eb\u200bc\x1bd" in text
    (data,) = re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL)
    assert json.loads(data)["training"][0]["label"] == r"a\u202eb\u200bc\x1bd"


@pytest.mark.parametrize(
    "link", ["javascript:alert(1)", "data:text/html,x", " https://example.org", "//example.org", ""]
)
def test_only_web_addresses_become_links(link: str) -> None:
    assert all("rel" not in attributes for attributes in Page(page_with("text", link)).all("a"))


def test_a_web_address_becomes_a_link() -> None:
    links = [a["href"] for a in Page(page_with("text", "https://example.org/?a=1&b=2")).all("a") if "rel" in a]
    assert links == 3 * ["https://example.org/?a=1&b=2"]


def test_only_the_scripts_of_the_package_may_run(page: Path) -> None:
    text = (page / "index.html").read_text(encoding="utf-8")
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    folder = Path(build_page.__code__.co_filename).parent
    names = ("vendor/d3.min.js", "vendor/plot.umd.min.js", "templates/tables.js", "templates/charts.js")
    assert scripts == [(folder / name).read_text(encoding="utf-8") for name in names]
    (policy,) = [m["content"] or "" for m in Page(text).all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    (allowed,) = re.findall(r"script-src ([^;]*)", policy)
    assert allowed.split() == [f"'sha256-{digest}'" for digest in digests]
    assert {"default-src 'none'", "base-uri 'none'", "form-action 'none'"} <= {
        part.strip() for part in policy.split(";")
    }


def test_libraries_are_those_of_their_packages_and_carry_their_licences() -> None:
    """SHA-256 of dist/ in d3 7.9.0 and @observablehq/plot 0.6.17 as npm has them."""
    folder = Path(build_page.__code__.co_filename).parent / "vendor"
    for name, digest in (
        ("d3.min.js", "f2094bbf6141b359722c4fe454eb6c4b0f0e42cc10cc7af921fc158fceb86539"),
        ("plot.umd.min.js", "4358086467740777dd788d6b27a95cebdbaefdd50c730a3060117073bd7134cb"),
    ):
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    for name in ("d3", "plot"):
        assert "Permission to use, copy, modify" in (folder / f"{name}.LICENSE").read_text(encoding="utf-8")


def test_figures_are_written_alike_everywhere(run: Path, page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The terminal and the page show the same text for the same figure."""
    text = markup(page)
    value = json.loads((run / "scores" / "heuristic-hull.json").read_text())["aggregate"]
    score_main([str(run / "submissions" / "heuristic-hull"), "--objects", *NAMES])
    printed = capsys.readouterr().out
    area = value["areas"]["iou_area"]
    for shown in (
        f"{area['mean']:.3f}",
        f"{area['low']:.3f} to {area['high']:.3f}",
        f"{100 * value['8']['chamfer_l2']['mean']:.4f}",
        f"{value['8']['normal_consistency']['mean']:.3f}",
    ):
        assert f">{shown}<" in text and f" {shown} " in printed


def test_page_shows_the_scores(page: Path, run: Path) -> None:
    text = markup(page)
    table = json.loads((page / "leaderboard.json").read_text())["tables"][0]
    assert {e["submission"]["explorer"] for e in table["entries"]} == {"heuristic", "random", "mine", "tslam_chamfer"}
    for entry in table["entries"]:
        score = json.loads(
            (
                run / "scores" / f"{entry['submission']['explorer']}-{entry['submission']['reconstructor']}.json"
            ).read_text()
        )
        mean = np.mean([result["areas"]["iou_area"] for result in score["results"]])
        assert entry["aggregate"]["areas"]["iou_area"]["mean"] == pytest.approx(mean)
        assert f">{mean:.3f}<" in text
    assert "12,345" in text and "a toaster" in text and ">reported</span>" in text and "privileged" in text


def test_a_record_beside_a_submission_makes_it_a_replayed_one(run: Path, tmp_path: Path) -> None:
    """The older score is not kept. A stranger's record, which has another seal, changes nothing."""
    folder = shutil.copytree(run / "submissions" / "random-grid", tmp_path / "submissions" / "random-grid")
    submission = read_submission(folder)
    verdicts = []
    for name, pose, seed in submission.episodes():
        rollout = submission.rollout(name, pose, seed)
        assert rollout is not None
        lied = (name, pose) == ("mug", 3)
        verdicts.append(
            Verdict(name, pose, seed, *(("joints", 9) if lied else (None, None)), pack_steps(rollout.touched_step))
        )
    assets = {name: asset_sha256([name]) for name in NAMES}
    how = {"mode": "bits", "tolerances": {}, "package_version": "1", "processor": "a", "simulator": "b"}
    record = VerificationRecord(submission.content_hash, assets, verdicts=tuple(verdicts), **how)  # type: ignore[arg-type]
    record.write(record_path(folder))
    sealed = record_path(folder).read_text()
    record_path(folder).write_text(sealed.replace('"step": 9', '"step": 19'))
    scores = str(run / "scores" / "random-grid.json")
    for expected in (False, True):
        page_main([scores, str(folder), "--output", str(tmp_path / "page"), "--pictured", "0"])
        (entry,) = json.loads((tmp_path / "page" / "leaderboard.json").read_text())["tables"][0]["entries"]
        text = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
        assert entry["verified"] is expected and (">replayed</span>" in text) is expected
        assert entry["tier"] == ("replayed" if expected else "reported")
        assert ("mug, pose 3, seed 0: joints depart by step 9" in text) is expected
        record_path(folder).write_text(sealed)


def test_page_is_deterministic_and_reuses_pictures(page: Path, run: Path, tmp_path: Path) -> None:
    def pictures() -> dict[str, int]:
        found = [*(page / ".pictures").iterdir(), *(page / "pictures").glob("*.webp")]
        return {path.name: path.stat().st_mtime_ns for path in found}

    before = pictures()
    text = (page / "index.html").read_bytes()
    time.sleep(0.02)
    page_main([str(run), "--output", str(page)])
    assert (page / "index.html").read_bytes() == text
    assert pictures() == before
    page_main(["--scores", str(run / "scores"), "--output", str(tmp_path)])
    assert (tmp_path / "index.html").read_bytes() == text


def test_page_without_submissions_has_no_pictures(run: Path, tmp_path: Path) -> None:
    paths = sorted((run / "scores").glob("*.json"))
    page_main([*map(str, paths), "--output", str(tmp_path)])
    assert Page((tmp_path / "index.html").read_text(encoding="utf-8")).all("img") == []


def test_pictures_of_an_earlier_page_go_and_the_list_says_what_is_shown(tmp_path: Path) -> None:
    def webp(grey: int) -> bytes:
        stream = io.BytesIO()
        Image.new("L", (3, 2), grey).save(stream, format="WEBP")
        return stream.getvalue()

    keys = [("truth", "", "mug"), ("touched", "ab", "mug"), ("touched", "cd", "mug")]
    first = write_pictures(dict(zip(keys, map(webp, (0, 99, 99)), strict=True)), tmp_path / "pictures")
    assert read_pictures(tmp_path / "pictures") == first
    assert first[keys[1]] == first[keys[2]] != first[keys[0]] and (first[keys[0]].width, first[keys[0]].height) == (
        3,
        2,
    )
    (tmp_path / "pictures" / "mine.webp").write_bytes(b"")
    second = write_pictures({keys[0]: webp(200)}, tmp_path / "pictures")
    names = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert names == {"mine.webp", "pictures.json", second[keys[0]].file}
    (tmp_path / "pictures" / second[keys[0]].file).unlink()
    with pytest.raises(InvalidInputError, match="is not there"):
        read_pictures(tmp_path / "pictures")
    assert read_pictures(tmp_path / "nothing") == {} == write_pictures({}, tmp_path / "nothing")


def test_the_viewer_is_linked_where_it_is(page: Path, run: Path, tmp_path: Path) -> None:
    """Shapes of every reconstruction that is pictured, and the episodes of every explorer."""
    assert "viewer" not in markup(page)
    board, pictures = json.loads((page / "leaderboard.json").read_text()), read_pictures(page / "pictures")
    hashes = [entry["content_hash"] for entry in board["tables"][0]["entries"]]
    links = {(h, name): f"viewer/index.html#object={name}&entry={h}&view=shape" for h in hashes for name in NAMES}
    write_links(links, tmp_path)
    assert read_links(tmp_path) == {}  # the viewer is not there
    (tmp_path / "viewer").mkdir()
    (tmp_path / "viewer" / "index.html").touch()
    assert read_links(tmp_path) == links
    write_page(board, pictures, tmp_path)
    found = [a["href"] or "" for a in Page(markup(tmp_path)).all("a") if "viewer" in (a["href"] or "")]
    grid = {e["content_hash"] for e in board["tables"][0]["entries"] if e["submission"]["reconstructor"] == "grid"}
    assert {a for a in found if "view=shape" in a} == {link for (h, _), link in links.items() if h not in grid}
    assert len([a for a in found if "view=episode" in a]) == len(hashes) * len(NAMES)
    for address in (
        "javascript:alert(1)",
        "../viewer/index.html#",
        "viewer/../x.html#",
        "https://example.org/viewer/index.html#",
    ):
        write_links({("a", "mug"): address}, tmp_path)
        with pytest.raises(InvalidInputError, match="does not lead into the viewer"):
            read_links(tmp_path)


def test_a_page_with_its_viewer(run: Path, primitive_cache: Path, tmp_path: Path, monkeypatch) -> None:
    """The command writes both; nothing is simulated where the hand is not prepared."""
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(primitive_cache))
    page_main([str(run), "--output", str(tmp_path), "--pictured", "0", "--viewer", "1"])
    links = read_links(tmp_path)
    assert {name for _, name in links} == {"mug"} and len(links) == 4
    assert all((tmp_path / link.partition("#")[0]).is_file() for link in links.values())
    text = markup(tmp_path)
    assert "turn in 3D" in text and ">play<" in text and "no picture" in text


def test_rows_that_would_read_alike_are_told_apart() -> None:
    scores = [fake_score(name, [0.2 + k / 10], method="Mine") for k, name in enumerate(("a", "b"))]
    scores += [fake_score("c", [0.5], method="Mine", reconstructor="grid"), fake_score("d", [0.6])]
    entries = rank(scores)["tables"][0]["entries"]
    assert row_names(entries) == ["d", "Mine", f"Mine ({entries[2]['content_hash'][:6]})", "Mine (a-hull)"]


def test_page_of_fake_scores_with_missing_figures() -> None:
    scores = [fake_score("a", [0.2], 0.1, 0.3), fake_score("b", [0.2, 0.3], 0.1, 0.3)]
    oracle = fake_score("oracle", [0.9], 0.1, 0.3, privileged=True)
    areas = {"iou_area": oracle.aggregate["areas"]["iou_area"]}
    results = tuple(replace(r, recall_curve=[], surface_iou_curve=[]) for r in oracle.results)
    oracle = replace(oracle, results=results, aggregate=oracle.aggregate | {"areas": areas})
    Page(build_page(rank([*scores, oracle]), {}))


# --- The command -------------------------------------------------------------------------------------------------


def test_a_page_destroys_no_submission_and_no_other_page(run: Path, tmp_path: Path) -> None:
    submission = run / "submissions" / "random-grid"
    before = sorted(path.name for path in submission.iterdir())
    (tmp_path / "index.html").write_text("my home page")
    for output, reason in ((submission, "is a submission"), (tmp_path, "is not a leaderboard's page and stays")):
        with pytest.raises(InvalidInputError, match=reason):
            page_main([str(run / "scores"), "--output", str(output)])
    assert sorted(path.name for path in submission.iterdir()) == before
    assert (tmp_path / "index.html").read_text() == "my home page"


def test_the_page_says_whose_each_entry_is_and_what_is_only_claimed(page: Path, run: Path, tmp_path: Path) -> None:
    entries = json.loads((page / "leaderboard.json").read_text())["tables"][0]["entries"]
    text = (page / "index.html").read_text(encoding="utf-8")
    assert text.count("<small>A. Author</small>") == len(entries) == 4
    claimed = {entry["submission"]["explorer"] for entry in entries if entry["claimed"]}
    assert claimed == {"heuristic", "random", "tslam_chamfer"} and text.count(">claimed</span>") == 3
    assert all(entry["improvement"] is None for entry in entries)

    submission = read_submission(shutil.copytree(run / "submissions/heuristic-hull", tmp_path / "heuristic-hull"))
    assert not has_origin(submission)
    write_origin(submission)  # as evaluate does
    assert has_origin(submission)
    shutil.copytree(run / "submissions/mine-hull", tmp_path / "mine-hull")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tslam_bench.objects.splits.QUICK_OBJECTS", NAMES)
        page_main([str(tmp_path), "--output", str(tmp_path / "page"), "--pictured", "0"])
    found = {
        entry["submission"]["explorer"]: (entry["claimed"], entry["improvement"])
        for entry in json.loads((tmp_path / "page" / "leaderboard.json").read_text())["tables"][0]["entries"]
    }
    assert found["heuristic"] == (False, None) and found["mine"][0] is False and found["mine"][1] is not None

    # Beside other files, or with another seal, the note says nothing.
    other = read_submission(run / "submissions/random-grid")
    note = beside(submission.location, ".origin.json")
    shutil.copytree(run / "submissions/random-grid", tmp_path / "copy" / "random-grid")
    copied = read_submission(tmp_path / "copy" / "random-grid")
    shutil.copy(note, beside(copied.location, ".origin.json"))
    assert other.content_hash == copied.content_hash and not has_origin(copied)
    sealed = json.loads(note.read_text())
    for change in ({"seal": "0" * 64}, {"seal": None}, {"explorer": "random"}, {"more": 1}):
        note.write_text(json.dumps(sealed | change))
        assert not has_origin(submission)
    note.write_text("[" * 1000)
    assert not has_origin(submission)


def test_many_authors_are_counted() -> None:
    board = rank([fake_score("a", [0.2], authors=tuple(f"Author {k}" for k in range(100)))])
    assert "Author 0, Author 1, Author 2, Author 3 and 96 more<" in build_page(board, {})


def forged(run: Path, name: str) -> dict:
    """A stranger's score file of a submission: everything right everywhere, and verified."""
    value = json.loads((run / "scores" / f"{name}.json").read_text())
    for result in value["results"]:
        for figures in result["poses"].values():
            figures["iou"] = 1.0
    for estimate in value["aggregate"]["areas"].values():
        estimate["mean"] = 2.0
    return {**value, "verified": True}


def test_a_forged_score_file_beside_its_submission_counts_nothing(run: Path, tmp_path: Path) -> None:
    """The submission is scored; and where it is not at hand, what was sent is shown as that."""
    (tmp_path / "forged.json").write_text(json.dumps(forged(run, "random-grid")))
    shutil.copytree(run / "submissions" / "random-grid", tmp_path / "random-grid")
    true = json.loads((run / "scores" / "random-grid.json").read_text())["aggregate"]["areas"]["iou_area"]["mean"]
    for arguments, mean, remark in (
        (["forged.json", "random-grid"], true, False),
        (["forged.json"], 1.0, True),
        (["forged.json", "random-grid", "--trust-scores"], 1.0, True),
    ):
        paths = [str(tmp_path / argument) if argument[0] != "-" else argument for argument in arguments]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("tslam_bench.objects.splits.QUICK_OBJECTS", NAMES)
            page_main([*paths, "--output", str(tmp_path / "page"), "--pictured", "0"])
        (entry,) = json.loads((tmp_path / "page" / "leaderboard.json").read_text())["tables"][0]["entries"]
        text = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
        assert entry["aggregate"]["areas"]["iou_area"]["mean"] == pytest.approx(mean)
        assert entry["verified"] is False and ">replayed</span>" not in text
        assert ("scored elsewhere" in text) is remark


def test_of_two_scores_of_one_submission_the_one_made_here_stays_in_any_order(run: Path, tmp_path: Path) -> None:
    honest, lies = run / "scores" / "random-grid.json", tmp_path / "lies.json"
    lies.write_text(json.dumps(forged(run, "random-grid")))
    (tmp_path / "other.json").write_text(json.dumps(forged(run, "random-grid") | {"notes": ["another"]}))
    boards = []
    for paths in ([honest, lies], [lies, honest], [lies, tmp_path / "other.json"], [tmp_path / "other.json", lies]):
        page_main([*map(str, paths), "--output", str(tmp_path / "page")])
        boards.append((tmp_path / "page" / "leaderboard.json").read_bytes())
    assert boards[0] == boards[1] != boards[2] == boards[3]
    (entry,) = json.loads(boards[0])["tables"][0]["entries"]
    assert (
        entry["aggregate"]["areas"]["iou_area"]["mean"] < 1 and len(json.loads(boards[2])["tables"][0]["entries"]) == 1
    )


def test_bad_items_are_left_out_of_the_page_and_named(run: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "entries"
    shutil.copytree(run / "scores", folder)
    (folder / "broken").mkdir()
    (folder / "broken" / "submission.json").write_text("{}")
    with zipfile.ZipFile(folder / "empty.zip", "w"):
        pass
    (folder / "lies.json").write_text('{"score_version": 3}')
    (folder / "notes.json").write_text("[1]")  # no score file: not looked at
    (folder / "nested.json").write_text("[" * 100_000)
    for name in ("pipe.json", "pipe.zip"):
        os.mkfifo(folder / name)
    with pytest.raises(InvalidInputError, match=r"3 of 7 failed, see above: .*; the page shows the others"):
        page_main([str(folder), "--output", str(tmp_path / "page")])
    assert len(json.loads((tmp_path / "page" / "leaderboard.json").read_text())["tables"][0]["entries"]) == 4
    Page((tmp_path / "page" / "index.html").read_text(encoding="utf-8"))
    printed, error = capsys.readouterr()
    lines = [line for line in error.splitlines() if line.startswith("tslam-bench leaderboard: ")]
    assert "4 entries" in printed and len(lines) == 3
    assert all(any(name in line for line in lines) for name in ("lies.json", "broken", "empty.zip"))
    for path in folder.glob("*-*.json"):
        path.unlink()
    with pytest.raises(InvalidInputError, match=r"3 of 3 failed, .*; there is nothing to show"):
        page_main([str(folder), "--output", str(tmp_path / "other")])
    assert not (tmp_path / "other" / "index.html").exists()


def test_a_page_is_built_where_no_object_is_prepared(run: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(tmp_path / "empty"))
    page_main([str(run), "--output", str(tmp_path / "page"), "--trust-scores"])
    parsed = Page((tmp_path / "page" / "index.html").read_text(encoding="utf-8"))
    assert parsed.all("img") == [] and len(parsed.all("tr")) > 4


def test_unscored_submissions_are_scored_by_the_leaderboard(run: Path, tmp_path: Path, monkeypatch) -> None:
    """A submission of the quick set needs all its objects: the message names the command that prepares them."""
    with pytest.raises(AssetError, match="assets prepare"):
        page_main([str(run / "submissions" / "mine-hull"), "--output", str(tmp_path)])
    assert not (tmp_path / "index.html").exists()
    monkeypatch.setattr("tslam_bench.objects.splits.QUICK_OBJECTS", NAMES)
    page_main([str(run / "submissions" / "mine-hull"), "--output", str(tmp_path), "--pictured", "0"])
    assert json.loads((tmp_path / "leaderboard.json").read_text())["tables"][0]["object_set"] == "quick"


def test_inputs_are_found(run: Path) -> None:
    scores, submissions = find_inputs([run])
    assert len(scores) == len(submissions) == 4
    assert find_inputs([run / "scores"]) == (scores, submissions)
    assert find_inputs([run / "submissions"]) == ([], submissions)
    assert find_inputs([submissions[0], scores[0]]) == ([scores[0]], [submissions[0]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name submissions"),
        (["nothing-here"], "no such file or folder"),
        (["EMPTY"], "neither submissions nor score files"),
        (["BROKEN"], "not a score file"),
        (["EMPTY", "--workers", "0"], "--workers 0"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.json").write_text("{}")
    places = {"EMPTY": tmp_path / "empty", "BROKEN": tmp_path / "broken.json"}
    with pytest.raises(SystemExit) as caught:
        main(["leaderboard", *(str(places.get(argument, argument)) for argument in arguments)])
    assert caught.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert len(lines) == 1 and message in lines[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.json", "empty"]
