"""The page's folder: its figures are those of scoring, its texts are harmless, and nothing is made twice."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tslam_bench import grids
from tslam_bench.constants import HORIZON
from tslam_bench.errors import InvalidInputError
from tslam_bench.leaderboard.viewer import write_entries_viewer
from tslam_bench.objects.store import load_object
from tslam_bench.scoring import metrics
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import EXPLORATION_ORDER, Submission, read_submission
from tslam_bench.viewing.entries import members_of, submission_entry
from tslam_bench.viewing.packing import unpack
from tslam_bench.viewing.site import Written, link, write_viewer
from tslam_bench.viewing.surface import ERROR_STEP


@pytest.fixture(scope="module")
def submissions(run: Path) -> dict[str, Submission]:
    return {path.name: read_submission(path) for path in sorted((run / "submissions").iterdir()) if path.is_dir()}


@pytest.fixture(scope="module")
def written(submissions: dict[str, Submission], primitive_cache: Path, tmp_path_factory) -> Written:
    folder = tmp_path_factory.mktemp("viewer")
    chosen = [submissions[name] for name in ("heuristic-hull", "random-grid", "mine-hull")]
    return write_viewer(folder, [submission_entry(s) for s in chosen], title="<Test>", cache=primitive_cache)


def catalogue(written: Written) -> dict:
    text = (written.page.parent / "catalogue.js").read_text(encoding="utf-8")
    return json.loads(text.removeprefix("tslam.catalogue=").rstrip(";\n"))


def data(written: Written, explorer: str, kind: str, name: str = "mug") -> tuple[dict, dict]:
    entry = next(e for e in catalogue(written)["entries"] if e["explorer"] == explorer)
    file = entry["objects"][name][kind]
    found, header, arrays = unpack((written.page.parent / file).read_text(encoding="ascii"))
    assert found == file
    return header, arrays


def test_everything_lies_in_the_folder_and_is_named(written: Written) -> None:
    folder = written.page.parent
    lying = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert lying == set(written.sizes)
    page = written.page.read_text(encoding="utf-8")
    for name in re.findall(r'(?:src|href)="([^"#]+)"', page):
        assert name == "data:," or (folder / name).is_file(), name
    assert "://" not in page
    assert catalogue(written)["hand"] is None  # the cache of primitives has none, and the page says so


def test_figures_are_those_of_scoring(
    written: Written, submissions: dict[str, Submission], run: Path, primitive_cache: Path
) -> None:
    for name, explorer in (("heuristic-hull", "heuristic"), ("random-grid", "random")):
        score = score_submission(run / "submissions" / name, ["mug"], cache=primitive_cache)
        (result,) = score.results
        header, _ = data(written, explorer, "shape")
        assert [entry["count"] for entry in header["counts"]] == [1, 2, 4, 8]
        for entry in header["counts"]:
            stated = result.poses[str(entry["count"])]
            assert entry["iou"] == pytest.approx(stated["iou"], abs=1e-5)
            assert entry["recall"] == pytest.approx(stated["touched_surface_recall"], abs=1e-5)


def test_touches_and_recall_of_every_step(
    written: Written, submissions: dict[str, Submission], primitive_cache: Path
) -> None:
    header, arrays = data(written, "heuristic", "episodes")
    coverage = metrics.TouchCoverage(load_object("mug", cache=primitive_cache).surface_points)
    assert [entry["pose"] for entry in header["poses"]] == list(EXPLORATION_ORDER)
    earlier = np.zeros((32, 32, 32), dtype=bool)
    for entry in header["poses"]:
        pose = entry["pose"]
        rollout = submissions["heuristic-hull"].rollout("mug", pose, 0)
        assert rollout is not None and entry["touched"] == rollout.touched.sum() and entry["source"] == "interpolated"
        own = grids.world_to_object(rollout.touched_step, pose)
        assert np.array_equal(own.reshape(-1)[arrays[f"x{pose}"]], arrays[f"s{pose}"])
        assert (np.diff(arrays[f"s{pose}"].astype(int)) >= 0).all() and len(arrays[f"x{pose}"]) == (own >= 0).sum()
        for step in (0, 57, HORIZON):  # after so many steps
            felt = (own >= 0) & (own < step)
            assert arrays[f"r{pose}"][step] == pytest.approx(10_000 * coverage.recall(felt), abs=0.51)
            assert arrays[f"m{pose}"][step] == pytest.approx(10_000 * coverage.recall(felt | earlier), abs=0.51)
        earlier |= own >= 0
        middle = 65535 * (0.1 + 0.25) / 0.7  # joint 0 at 0, of a range of -0.25 to 0.25 and 0.1 on either side
        assert np.abs(arrays[f"q{pose}"][:, 0] - middle).max() <= 0.5


def test_errors_of_a_hull_of_a_box_are_small_and_inside(written: Written) -> None:
    """The hull of voxel centres on a box lies within it, up to half a voxel, or beyond by as much."""
    _, arrays = data(written, "mine", "shape")
    errors = arrays["e8"].astype(float) * ERROR_STEP
    assert len(errors) == len(arrays["p8"]) and np.abs(errors).max() < 12e-3 and np.median(np.abs(errors)) < 4e-3


def test_texts_of_strangers_are_no_markup(written: Written) -> None:
    listed = catalogue(written)
    assert listed["title"] == "<Test>"
    assert listed["entries"][2]["remark"].startswith('"><script>')
    for path in written.page.parent.rglob("catalogue.js"):
        assert "<" not in path.read_text(encoding="utf-8")


def test_what_is_there_is_kept_and_what_is_not_named_goes(
    submissions: dict[str, Submission], primitive_cache: Path, tmp_path: Path
) -> None:
    entries = [submission_entry(submissions[name], ["mug"]) for name in ("heuristic-hull", "random-grid")]
    first = write_viewer(tmp_path / "a", entries, cache=primitive_cache)
    kept = next(path for path in (tmp_path / "a/data/mug").glob("shape-*.js"))
    stamp = {path: path.stat().st_mtime_ns for path in (tmp_path / "a/data/mug").glob("*-*.js")}
    again = write_viewer(tmp_path / "a", entries, cache=primitive_cache)
    assert again.sizes == first.sizes and {path: path.stat().st_mtime_ns for path in stamp} == stamp
    fewer = write_viewer(tmp_path / "a", entries[:1], cache=primitive_cache)
    assert len(fewer.sizes) == len(first.sizes) - 2 and kept.parent.is_dir()
    assert set(fewer.links) == {(entries[0].key, "mug")}


def test_other_folders_stay(submissions: dict[str, Submission], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InvalidInputError, match="holds something else"):
        write_viewer(tmp_path, [submission_entry(submissions["random-grid"])])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_objects_that_are_not_prepared_are_named(submissions: dict[str, Submission], tmp_path: Path) -> None:
    found = write_viewer(tmp_path / "a", [submission_entry(submissions["random-grid"])], cache=tmp_path / "empty")
    assert found.links == {} and catalogue(found)["missing"] == ["mug", "toruslarge"]


def test_entries_know_what_they_hold(submissions: dict[str, Submission]) -> None:
    submission = submissions["random-grid"]
    assert submission_entry(submission).objects == ("mug", "toruslarge")
    with pytest.raises(InvalidInputError, match="holds nothing of hammer; it has mug, toruslarge"):
        submission_entry(submission, ["hammer"])
    with pytest.raises(InvalidInputError, match="has no seed 3"):
        submission_entry(submission, seed=3)
    assert submission_entry(submission, poses=[5, 2]).read("mug").played == (2, 5)


def test_merged_poses_follow_the_order_of_exploration() -> None:
    assert members_of([3]) == {1: (3,)}
    assert members_of([0, 5, 7]) == {1: (0,), 2: (0, 5), 3: (0, 5, 7)}
    assert members_of(range(8)) == {n: EXPLORATION_ORDER[:n] for n in (1, 2, 4, 8)}
    assert members_of([]) == {}


def test_a_leaderboard_can_link_to_it(
    submissions: dict[str, Submission], primitive_cache: Path, tmp_path: Path
) -> None:
    chosen = {s.content_hash: s for s in (submissions["random-grid"], submissions["tslam_chamfer-hull"])}
    links = write_entries_viewer(tmp_path, chosen, ["mug", "hammer"], replay=False, cache=primitive_cache)
    assert {key for key, _ in links} == set(chosen) and {name for _, name in links} == {"mug"}
    for address in links.values():
        assert (tmp_path / address.partition("#")[0]).is_file() and address.startswith("viewer/index.html#object=mug&")


def test_addresses_are_quoted() -> None:
    assert link("a&b", "mug", view="shape", count=8) == "index.html#object=mug&entry=a%26b&view=shape&count=8"


def test_pages_need_neither_simulator_nor_torch() -> None:
    code = """
        import sys
        import tslam_bench.viewing.site, tslam_bench.leaderboard.viewer
        print(sorted({"sapien", "torch", "mani_skill"} & set(sys.modules)))
    """
    code = "\n".join(line.strip() for line in code.splitlines())
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
