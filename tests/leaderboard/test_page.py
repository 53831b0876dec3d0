"""Ranking, page and commands: from submissions on disk to HTML, with a small asset cache made of primitives."""

from __future__ import annotations

import json
import re
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import trimesh
from prepared_shapes import surface_grid

from tslam_bench import __version__, grids
from tslam_bench.cli import main
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.leaderboard.charts import Axis, Line, line_chart
from tslam_bench.leaderboard.commands import find_inputs, page_main, score_main
from tslam_bench.leaderboard.page import build_page, group_explorers
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.objects import store
from tslam_bench.objects.store import PreparedObject
from tslam_bench.reconstruction.grid import GridReconstructor
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.scoring.aggregate import Estimate, interval, resampled_means
from tslam_bench.scoring.info import SubmissionInfo, Training
from tslam_bench.scoring.scoring import ObjectScore, SubmissionScore, score_submission, worker_pool
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, SubmissionWriter

NAMES = ("mug", "toruslarge")


def info(explorer: str, reconstructor: str, **changes) -> SubmissionInfo:
    values = {
        "method": f"{explorer} + {reconstructor}",
        "explorer": explorer,
        "reconstructor": reconstructor,
        "authors": ("A. Author",),
        "asset_manifest_sha256": "0" * 64,
        "seeds": (0,),
        "object_set": "quick",
        "privileged": False,
        "package_version": __version__,
    }
    return SubmissionInfo(**(values | changes))


@pytest.fixture(scope="module")
def cache(box: PreparedObject, torus: PreparedObject, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset cache in which a box passes for the mug and a torus for the large torus."""
    folder = tmp_path_factory.mktemp("cache")
    for name, prepared in zip(NAMES, (box, torus), strict=True):
        mesh = trimesh.Trimesh(prepared.vertices, prepared.faces, process=False)
        _, _, faces = trimesh.proximity.closest_point(mesh, prepared.surface_points[:1])
        store.write(replace(prepared, name=name), np.full(100_000, faces[0]), folder)
    return folder


@pytest.fixture(autouse=True)
def use_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache))


def write_submission(
    folder: Path, about: SubmissionInfo, reconstructor: Reconstructor, share: float, objects: dict[str, PreparedObject]
) -> Path:
    """Real reconstructions of a random share of the surface voxels."""
    with SubmissionWriter(folder, about) as writer:
        for name, prepared in objects.items():
            touched = {}
            for pose in range(8):
                generator = np.random.default_rng([pose, len(name)])
                world = grids.object_to_world(surface_grid(prepared), pose)
                found = world & (generator.random(world.shape) < share)
                steps = np.where(found, generator.integers(0, 200, world.shape), -1).astype(np.int16)
                actions = generator.uniform(-1, 1, (200, 28)).astype(np.float32)
                writer.add_rollout(name, pose, 0, actions, found, ~world, steps)
                touched[pose] = grids.world_to_object(found, pose)
            for count, poses in RECONSTRUCTED_POSES.items():
                merged = grids.merge(touched[pose] for pose in poses)
                writer.add_reconstruction(name, count, 0, reconstructor.reconstruct(merged, ~merged))
    return folder


@pytest.fixture(scope="module")
def run(box: PreparedObject, torus: PreparedObject, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder: four submissions, one of them with a hostile label, scored."""
    folder = tmp_path_factory.mktemp("run")
    objects = dict(zip(NAMES, (box, torus), strict=True))
    hostile = info(
        "mine", "hull", method="<b>Mine</b>", label='"><script>alert(1)</script>', link="https://example.org/a?b=1&c"
    )
    cases: list[tuple[str, SubmissionInfo, Reconstructor, float]] = [
        ("heuristic-hull", info("heuristic", "hull"), HullReconstructor(32), 0.01),
        ("random-grid", info("random", "grid"), GridReconstructor(), 0.005),
        ("mine-hull", replace(hostile, training=Training(12_345, 0.5, "a toaster")), HullReconstructor(32), 0.1),
        ("tslam_chamfer-hull", info("tslam_chamfer", "hull", privileged=True), HullReconstructor(32), 0.3),
    ]
    for name, about, reconstructor, share in cases:
        path = write_submission(folder / "submissions" / name, about, reconstructor, share, objects)
        score = score_submission(path, NAMES, cache=cache)
        (folder / "scores").mkdir(exist_ok=True)
        (folder / "scores" / f"{name}.json").write_text(json.dumps(score.to_json()))
    return folder


# --- Ranking ---------------------------------------------------------------------------------------------------


def fake_score(
    explorer: str, iou: list[float] | np.ndarray, chamfer: float = 0.1, area: float = 0.3, iou_8=None, **changes
) -> SubmissionScore:
    """A score with chosen figures: ranking reads nothing else.

    Args:
        iou: IoU area of each object, or (objects, seeds).
        iou_8: mean IoU at 8 poses; by default that of ``iou``.
    """
    matrix = np.array(iou, dtype=float).reshape(len(iou), -1)
    objects = tuple(f"object{k}" for k in range(len(matrix)))
    seeds = tuple(range(matrix.shape[1]))
    values: dict[str, float | None] = {"chamfer_l2": chamfer, "touched_surface_recall": 0.5, "surface_iou": 0.5}
    results = tuple(
        ObjectScore(
            object=name,
            seed=seed,
            poses={n: {**values, "iou": float(matrix[k, seed])} for n in ("1", "2", "4", "8")},
            reasons=dict.fromkeys(("1", "2", "4", "8")),
            areas={"iou_area": float(matrix[k, seed]), "exploration_area": area},
            recall_curve=[0.0, area],
            surface_iou_curve=[0.0, area],
            implausible_touches=0.0,
            missing=[],
        )
        for k, name in enumerate(objects)
        for seed in seeds
    )

    def same(value: float) -> Estimate:
        return Estimate(value, value, value, value, value, value)

    mean = float(matrix.mean())
    at = {"iou": same(mean if iou_8 is None else iou_8), "chamfer_l2": same(chamfer)}
    aggregate = {"areas": {"iou_area": same(mean), "exploration_area": same(area)}, **dict.fromkeys("1248", at)}
    reconstructor = changes.pop("reconstructor", "hull")
    about = info(explorer, reconstructor, **({"seeds": seeds} | changes))
    return SubmissionScore(about, f"{explorer}-{reconstructor}", objects, "0" * 64, results, aggregate, ())


def order(scores: list[SubmissionScore]) -> list[tuple[int | None, str]]:
    return [(e["rank"], e["submission"]["explorer"]) for e in rank(scores)["tables"][0]["entries"]]


def test_order_is_by_area_then_iou_at_8_then_chamfer() -> None:
    scores = [
        fake_score("worst", [0.1, 0.1]),
        fake_score("best", [0.6, 0.4], chamfer=0.9),
        fake_score("tie_far", [0.3, 0.3], chamfer=0.2, iou_8=0.4),
        fake_score("tie_near", [0.2, 0.4], chamfer=0.1, iou_8=0.4),
        fake_score("tie_high", [0.4, 0.2], chamfer=0.5, iou_8=0.5),
    ]
    expected = ["best", "tie_high", "tie_near", "tie_far", "worst"]
    assert [name for _, name in order(scores)] == expected
    assert order(scores[::-1]) == order(scores)


def test_entries_whose_paired_difference_may_be_0_share_a_rank() -> None:
    """Objects differ far more than entries: only the paired difference tells them apart."""
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 3))
    wobble = np.random.default_rng(1).normal(0, 0.02, (4, 20, 3))
    wobble -= wobble.mean(axis=(1, 2), keepdims=True)
    scores = [
        fake_score("first", base),
        fake_score("near", base + wobble[0] - 0.002),
        fake_score("steady", base - 0.003),  # nearer to the first than "far" but surely behind it
        fake_score("with_steady", base + wobble[1] - 0.004),
        fake_score("last", base + wobble[2] - 0.05),
        fake_score("also_last", base + wobble[3] - 0.051),
    ]
    ranks = [(1, "first"), (1, "near"), (3, "steady"), (3, "with_steady"), (5, "last"), (5, "also_last")]
    assert order(scores) == order(scores[::-1]) == ranks
    entries = rank(scores)["tables"][0]["entries"]
    assert entries[0]["behind_leader"] is None
    near, steady, with_steady = (entry["behind_leader"] for entry in entries[1:4])
    assert near["low"] < 0 < near["high"] and near["mean"] == pytest.approx(0.002)
    assert steady["low"] == pytest.approx(steady["high"]) == pytest.approx(0.003)
    assert with_steady["mean"] == pytest.approx(0.001)  # behind the leader of its own group
    # Without the pairing nothing could be told apart.
    low, high = interval(resampled_means(base))
    assert high - low > 0.1


def test_a_privileged_entry_neither_leads_nor_counts() -> None:
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 1))
    wobble = np.random.default_rng(1).normal(0, 0.02, (20, 1))
    scores = [
        fake_score("oracle", base + 0.1, privileged=True),
        fake_score("a", base),
        fake_score("tslam_chamfer", base - 0.0005, privileged=True),
        fake_score("b", base + wobble - wobble.mean() - 0.001),
        fake_score("c", base - 0.1),
    ]
    assert order(scores) == [(None, "oracle"), (1, "a"), (None, "tslam_chamfer"), (1, "b"), (3, "c")]


def test_entries_with_other_numbers_of_seeds_are_paired_by_object() -> None:
    base = np.random.default_rng(0).uniform(0.2, 0.8, (20, 1))
    scores = [fake_score("a", base.repeat(3, axis=1)), fake_score("b", base - 0.01)]
    assert order(scores) == [(1, "a"), (2, "b")]
    difference = rank(scores)["tables"][0]["entries"][1]["behind_leader"]
    assert difference["low"] == pytest.approx(0.01) == pytest.approx(difference["high"])


def test_privileged_entries_hold_no_rank() -> None:
    scores = [
        fake_score("a", [0.2], 0.1, 0.1),
        fake_score("oracle", [0.9], 0.1, 0.1, privileged=True),
        fake_score("b", [0.1], 0.1, 0.1),
    ]
    assert order(scores) == [(None, "oracle"), (1, "a"), (2, "b")]


def test_sets_of_objects_are_not_mixed_and_files_count_once() -> None:
    scores = [fake_score("a", [0.2], 0.1, 0.1), fake_score("b", [0.1, 0.9], 0.1, 0.1), fake_score("a", [0.2], 0.1, 0.1)]
    tables = rank(scores)["tables"]
    assert [len(table["objects"]) for table in tables] == [2, 1]
    assert [len(table["entries"]) for table in tables] == [1, 1]
    assert all(table["object_set"] == "custom" for table in tables)


def test_improvement_is_over_the_heuristic_of_the_same_reconstructor() -> None:
    scores = [
        fake_score("heuristic", [0.2, 0.4], 0.1, 0.1),
        fake_score("heuristic", [0.9, 0.9], 0.1, 0.1, reconstructor="grid"),
        fake_score("a", [0.3, 0.3], 0.1, 0.1),
        fake_score("b", [0.3, 0.5], 0.1, 0.1),
        fake_score("c", [0.3, 0.5], 0.1, 0.1, reconstructor="other"),
    ]
    found = {e["submission"]["method"]: e["improvement"] for e in rank(scores)["tables"][0]["entries"]}
    assert found == {
        "heuristic + hull": None,
        "heuristic + grid": None,
        "a + hull": 0.5,
        "b + hull": 1.0,
        "c + other": None,
    }


def test_explorers_are_grouped_by_their_rollouts() -> None:
    entries = rank([fake_score("a", [0.2], 0.1, 0.3), fake_score("a", [0.1], 0.1, 0.3, reconstructor="grid")])
    other = rank([fake_score("a", [0.2], 0.1, 0.4, method="Other")])
    groups = group_explorers([*entries["tables"][0]["entries"], *other["tables"][0]["entries"]])
    assert [(g.label, len(g.entries)) for g in groups] == [("a", 2), ("a (Other)", 1)]


# --- Charts ----------------------------------------------------------------------------------------------------


def test_lines_are_drawn_where_the_data_are() -> None:
    lines = [Line("up", 0, [(0, 0), (10, 1)]), Line("flat & low", 1, [(0, 0.5), (10, 0.5)])]
    svg = line_chart(
        "t", lines, Axis("x", 0, 10, [(0, "0")]), Axis("y", 0, 1, [(0, "0")]), (400, 200), end_labels=False
    )
    found = re.findall(r'class="line[^"]*" points="([\d., ]+)"', svg)
    (x0, y0), (x1, y1) = ([float(v) for v in point.split(",")] for point in found[0].split())
    (a0, b0), (_, b1) = ([float(v) for v in point.split(",")] for point in found[1].split())
    assert x0 == a0 < x1 <= 400 and 0 <= y1 < y0 <= 200
    assert b0 == b1 == pytest.approx((y0 + y1) / 2)
    assert "flat &amp; low" in svg


def test_end_labels_do_not_overlap() -> None:
    lines = [Line(f"line{k}", k, [(0, 0), (1, 0.5 + 0.001 * k)]) for k in range(12)]
    svg = line_chart("t", lines, Axis("x", 0, 1, []), Axis("y", 0, 1, []))
    rows = sorted(float(y) for y in re.findall(r'class="end[^"]*" x="[\d.]+" y="([\d.]+)"', svg))
    assert len(rows) == 12 and min(np.diff(rows)) >= 13.9
    assert rows[0] > 0 and rows[-1] < 360


# --- The page --------------------------------------------------------------------------------------------------


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
def page(run: Path, cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TSLAM_BENCH_CACHE", str(cache))
        page_main(["--scores", str(run / "scores"), "--output", str(output)])
    return output


def test_page_is_well_formed_and_self_contained(page: Path) -> None:
    text = (page / "index.html").read_text(encoding="utf-8")
    parsed = Page(text)
    images = parsed.all("img")
    # Truth, touched and reconstruction of two objects; random + grid shows touched voxels only; three in the header.
    assert len(images) == 3 + 2 * (1 + 4 + 3)
    assert all(image["src"].startswith("data:image/webp;base64,") and image["alt"] for image in images)  # type: ignore[union-attr]
    for attributes in [*parsed.all("link"), *parsed.all("script"), *parsed.all("img")]:
        address = attributes.get("href") or attributes.get("src") or ""
        assert not address.startswith(("http", "//"))
    assert "@import" not in text and "url(" not in text
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


def test_page_shows_the_scores(page: Path, run: Path) -> None:
    text = (page / "index.html").read_text(encoding="utf-8")
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
    assert "12,345" in text and "a toaster" in text and "not replayed" in text and "privileged" in text


def test_page_is_deterministic_and_reuses_pictures(page: Path, run: Path, tmp_path: Path) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in (page / ".pictures").iterdir()}
    text = (page / "index.html").read_bytes()
    time.sleep(0.02)
    page_main([str(run), "--output", str(page)])
    assert (page / "index.html").read_bytes() == text
    assert {path.name: path.stat().st_mtime_ns for path in (page / ".pictures").iterdir()} == before
    page_main(["--scores", str(run / "scores"), "--output", str(tmp_path)])
    assert (tmp_path / "index.html").read_bytes() == text


def test_page_without_submissions_has_no_pictures(run: Path, tmp_path: Path) -> None:
    paths = sorted((run / "scores").glob("*.json"))
    page_main([*map(str, paths), "--output", str(tmp_path)])
    assert Page((tmp_path / "index.html").read_text(encoding="utf-8")).all("img") == []


def test_page_of_fake_scores_with_missing_figures() -> None:
    scores = [fake_score("a", [0.2], 0.1, 0.3), fake_score("b", [0.2, 0.3], 0.1, 0.3)]
    oracle = fake_score("oracle", [0.9], 0.1, 0.3, privileged=True)
    areas = {"iou_area": oracle.aggregate["areas"]["iou_area"]}
    results = tuple(replace(r, recall_curve=[], surface_iou_curve=[]) for r in oracle.results)
    oracle = replace(oracle, results=results, aggregate=oracle.aggregate | {"areas": areas})
    Page(build_page(rank([*scores, oracle]), {}))


# --- Commands --------------------------------------------------------------------------------------------------


def test_score_prints_a_table_and_writes_json(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run / "submissions" / "mine-hull"
    score_main([str(path), "--objects", *NAMES, "--output", str(tmp_path / "score.json")])
    printed = capsys.readouterr().out
    value = json.loads((tmp_path / "score.json").read_text())
    assert SubmissionScore.from_json(value, "file").objects == NAMES
    assert value == json.loads((run / "scores" / "mine-hull.json").read_text())
    for name in NAMES:
        assert name in printed
    for group, metric in (("areas", "iou_area"), ("1", "iou"), ("8", "iou"), ("8", "calibration_error")):
        assert f"{value['aggregate'][group][metric]['mean']:.3f}" in printed


def test_score_prints_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    score_main([str(run / "submissions" / "random-grid"), "--objects", "mug", "--json"])
    assert json.loads(capsys.readouterr().out)["objects"] == ["mug"]


@pytest.mark.parametrize(
    ("object_set", "seeds", "full"), [("test", (0,), False), ("test", (0, 1, 2), True), ("quick", (0,), True)]
)
def test_an_entry_of_few_seeds_says_so(object_set, seeds, full: bool, tmp_path: Path, cache: Path) -> None:
    with SubmissionWriter(tmp_path / "s", info("mine", "hull", object_set=object_set, seeds=seeds)):
        pass
    notes = score_submission(tmp_path / "s", ["mug"], cache=cache).notes
    assert any("not a full entry" in note for note in notes) is not full
    assert any(
        "missing, counted as empty: rollout of pose 0" in note for note in notes
    )  # all pieces are, and are named
    assert any("reconstruction of 1 pose, reconstruction of 2 poses" in note for note in notes)


def test_each_score_is_written_as_soon_as_it_is_there(run: Path, tmp_path: Path) -> None:
    """The second submission is refused; the first one's score is there all the same."""
    (tmp_path / "broken").mkdir()
    with pytest.raises(InvalidInputError, match="broken"):
        paths = [str(run / "submissions" / "random-grid"), str(tmp_path / "broken")]
        score_main([*paths, "--objects", "mug", "--output", str(tmp_path / "scores")])
    assert [p.name for p in (tmp_path / "scores").iterdir()] == ["random-grid.json"]


def test_several_scores_go_to_a_folder(run: Path, tmp_path: Path) -> None:
    paths = [str(run / "submissions" / name) for name in ("random-grid", "mine-hull")]
    score_main([*paths, "--objects", "mug", "--output", str(tmp_path / "scores")])
    assert sorted(p.name for p in (tmp_path / "scores").iterdir()) == ["mine-hull.json", "random-grid.json"]


@pytest.mark.slow
def test_processes_do_not_change_the_score(run: Path, cache: Path) -> None:
    path = run / "submissions" / "mine-hull"
    with worker_pool(2) as pool:
        assert isinstance(pool, ProcessPoolExecutor)
        in_processes = [score_submission(path, NAMES, pool, cache=cache).to_json() for _ in range(2)]
    assert in_processes == 2 * [score_submission(path, NAMES, cache=cache).to_json()]


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
        (["score"], "name at least one submission"),
        (["score", "nothing-here"], "no such folder"),
        (["score", "SUBMISSION", "--objects", "mugg"], "mugg"),
        (["score", "SUBMISSION", "--objects", "hammer"], "tslam-bench assets prepare"),
        (["score", "SUBMISSION", "--objects", "mug", "--workers", "0"], "--workers 0"),
        (["leaderboard"], "name submissions"),
        (["leaderboard", "nothing-here"], "no such file or folder"),
        (["leaderboard", "EMPTY"], "neither submissions nor score files"),
        (["leaderboard", "BROKEN"], "not a score file"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken.json").write_text("{}")
    places = {
        "SUBMISSION": run / "submissions/mine-hull",
        "EMPTY": tmp_path / "empty",
        "BROKEN": tmp_path / "broken.json",
    }
    with pytest.raises(SystemExit) as caught:
        main([str(places.get(argument, argument)) for argument in arguments])
    assert caught.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("tslam-bench:")]
    assert len(lines) == 1 and message in lines[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.json", "empty"]


def test_commands_explain_themselves(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("score", "leaderboard"):
        with pytest.raises(SystemExit) as caught:
            main([command, "--help"])
        assert caught.value.code == 0
        assert "--output" in capsys.readouterr().out


def test_same_names_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="same name"):
        path = str(run / "submissions" / "random-grid")
        score_main([path, path, "--objects", "mug", "--output", str(tmp_path)])
