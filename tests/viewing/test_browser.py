"""The page in Chromium, opened from the disk: models turn, episodes play, the hand is where the simulator has it."""

from __future__ import annotations

import base64
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import chromium, watched

from tslam_bench.cli import main
from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.episodes import episode_seed
from tslam_bench.evaluation.playback import play
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.grids import world_to_object
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.objects.store import load_object
from tslam_bench.reconstruction.carve import CarveReconstructor
from tslam_bench.scoring.submission import read_submission
from tslam_bench.viewing.entries import submission_entry
from tslam_bench.viewing.site import write_viewer
from tslam_bench.viewing.surface import net

READY = "main[aria-busy=false]"
SMALL = (640, 400)
"""Window of most tests: software draws it quickly."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def page_file(browser: Any, tmp_path_factory) -> Path:
    """Live episodes of the mug in two poses, completed twice."""
    folder = tmp_path_factory.mktemp("view")
    arguments = ["--object", "mug", "--pose", "0", "5", "--reconstructor", "carve", "grid", "--policy-salt", "ab"]
    main(["view", *arguments, "--output", str(folder), "--no-browser"])
    return folder / "index.html"


@pytest.fixture
def opened(browser: Any, page_file: Path) -> Iterator[Any]:
    """Opens the page with an address; afterwards nothing may have gone wrong or left the disk."""
    contexts: list[Any] = []
    troubles: list[list[str]] = []

    def at(address: str = "", size: tuple[int, int] = SMALL) -> Any:
        contexts.append(browser.new_context(viewport={"width": size[0], "height": size[1]}))
        page, trouble = watched(contexts[-1])
        troubles.append(trouble)
        page.goto(page_file.as_uri() + address)
        page.wait_for_selector(READY)
        return page

    yield at
    for context in contexts:
        context.close()
    assert [line for trouble in troubles for line in trouble] == []


def camera(page: Any) -> list[float]:
    return page.evaluate("tslam.stage.camera.position.toArray()")


def shown(page: Any) -> np.ndarray:
    """Pixels of the canvas as drawn now: (height, width, 4)."""
    code = """() => new Promise((done) => requestAnimationFrame(() => {
        tslam.stage._render();
        const gl = tslam.stage.renderer.getContext(), w = gl.drawingBufferWidth, h = gl.drawingBufferHeight;
        const pixels = new Uint8Array(4 * w * h);
        gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        let text = "";
        for (let k = 0; k < pixels.length; k += 8192) text += String.fromCharCode(...pixels.subarray(k, k + 8192));
        done([w, h, btoa(text)]);
    }))"""
    width, height, data = page.evaluate(code)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)


def test_nothing_sticks_out_and_something_is_drawn(opened: Any) -> None:
    page = opened("#view=episode&pose=0&step=100")
    for width, height in ((1400, 480), (900, 440), (390, 480)):
        page.set_viewport_size({"width": width, "height": height})
        for view in ("episode", "shape"):
            page.click(f"button[data-view={view}]")
            page.wait_for_selector(f"main[data-view={view}][aria-busy=false]")
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            pixels = shown(page)
            assert (pixels[..., 3] > 0).mean() > 0.02
            shades = np.unique(pixels[pixels[..., 3] == 255][::7, :3], axis=0)
            assert len(shades) > 50


def test_models_turn_together(opened: Any) -> None:
    page = opened("#view=shape&count=2")
    before, drawn = camera(page), shown(page)
    box = page.locator("#rebuilt").bounding_box()
    page.mouse.move(box["x"] + 50, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 100, steps=3)
    page.mouse.up()
    after = camera(page)
    assert math.dist(before, after) > 0.02
    turned = shown(page)
    third = drawn.shape[1] // 3
    for panel in range(3):  # one camera for all three
        part = slice(panel * third, (panel + 1) * third)
        assert (drawn[:, part] != turned[:, part]).any(axis=-1).mean() > 0.02
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    distance = [math.dist(p, page.evaluate("tslam.stage.controls.target.toArray()")) for p in (after, camera(page))]
    assert distance[1] < distance[0]
    page.keyboard.press("r")
    assert camera(page) == pytest.approx(before)


def test_an_episode_plays_and_obeys_the_keys(opened: Any) -> None:
    page = opened("#view=episode&pose=0&step=0")
    page.focus("#stage")
    page.select_option("#speed", "0.5")
    assert page.get_attribute("#play", "aria-label") == "Play"
    page.click("#play")
    page.wait_for_selector("#step:not([aria-valuetext^='step 0 '])")
    page.click("#play")
    time = page.evaluate("tslam.state.time")
    assert 0 < time < HORIZON
    page.wait_for_timeout(100)
    assert page.evaluate("tslam.state.time") == time
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press(".")
    assert page.evaluate("tslam.state.time") == math.floor(time) + 1
    page.keyboard.press(" ")
    assert page.get_attribute("#play", "aria-label") == "Stop"
    page.keyboard.press(" ")
    page.keyboard.press("5")
    assert page.evaluate("[tslam.state.pose, tslam.state.time]") == [5, 0]
    assert page.locator("#poses button:not([disabled])").all_inner_texts() == ["0", "5"]
    page.fill("#step", "200")
    assert (
        page.inner_text("#f-step") == "200 of 200" and page.inner_text("#source") == "Simulated just now, step by step."
    )
    assert "pose=5" in page.evaluate("location.hash")


def test_it_goes_on_with_the_next_pose_and_then_stops(opened: Any) -> None:
    page = opened("#view=episode&pose=0&step=198")
    page.select_option("#speed", "4")
    page.click("#play")
    page.wait_for_selector("#poses button:nth-child(6)[aria-pressed=true]")
    page.evaluate("tslam.state.time = 197")
    page.wait_for_selector("#play[aria-label=Play]")
    assert page.evaluate("[tslam.state.pose, tslam.state.time]") == [5, 200]


def test_hand_touches_and_shapes_are_the_simulators(opened: Any) -> None:
    """What JavaScript makes of the files against the engine, asked anew, and against the arrays of Python."""
    policy = make_baseline("heuristic")
    (rollout, _), (second, _) = play(policy, [("mug", 0, 0), ("mug", 5, 0)], "ab", "test")
    page = opened("#view=episode&pose=5&step=0")
    hands = HandBatch(1, BatchSettings(object="mug", split="test", control_mode=policy.control_mode), autoreset=False)
    hands.reset([episode_seed(5, 0)], [0], ["mug"], [5])
    for step in range(1, 61):
        hands.arrays["action"][:] = second.actions[step - 1]
        hands.step()
        if step % 30 == 0:
            page.fill("#step", str(step))
            links = page.evaluate(
                """(names) => { tslam.player().scene.updateMatrixWorld(true);
                return names.map((name) => tslam.player().hand.links[name].matrixWorld.toArray()); }""",
                list(SKIN_LINKS),
            )
            found = np.array(links).reshape(-1, 4, 4).transpose(0, 2, 1)[:, :3]
            assert np.abs(found - hands._links[0]).max() < 2e-4  # m, and cosines
            touched = page.evaluate("Array.from(tslam.player().voxels.slice(0, tslam.player().now.count))")
            own = world_to_object(second.touched_step, 5).reshape(-1)
            assert sorted(touched) == np.flatnonzero((own >= 0) & (own < step)).tolist()
            assert page.inner_text("#f-touched") == str(len(touched))
    # The voxel that is drawn first stands where the pose put it.
    matrix = page.evaluate(
        """() => { const { now, scene } = tslam.player(); scene.updateMatrixWorld(true);
        const place = new THREE.Matrix4(); now.getMatrixAt(0, place); return place.premultiply(now.matrixWorld).toArray(); }"""
    )
    index = np.floor((np.array(matrix[12:15]) + 0.125) / 0.25 * 32).astype(int)
    assert second.touched[tuple(index)]

    page.keyboard.press("s")
    page.wait_for_selector("main[data-view=shape][aria-busy=false]")
    touched = [world_to_object(r.touched, r.pose) for r in (rollout, second)]
    visited = [world_to_object(r.visited, r.pose) for r in (rollout, second)]
    found = net(CarveReconstructor().reconstruct(touched[0] | touched[1], visited[0] | visited[1]))
    vertices, faces = found.mesh()
    drawn = page.evaluate(
        """() => { const mesh = tslam.stage.panels[1].scene.userData.shown[0].geometry;
        return [Array.from(mesh.getAttribute("position").array), Array.from(mesh.index.array)]; }"""
    )
    np.testing.assert_allclose(np.array(drawn[0]).reshape(-1, 3), vertices, atol=1e-6)
    assert _turned(np.array(drawn[1]).reshape(-1, 3)) == _turned(faces)
    truth = page.evaluate("tslam.stage.panels[2].scene.userData.shown[0].geometry.getAttribute('position').count / 3")
    assert truth >= len(load_object("mug").faces)


def _turned(faces: np.ndarray) -> set[tuple[int, ...]]:
    """Triangles, turned so that the smallest corner comes first."""
    order = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return set(map(tuple, np.take_along_axis(faces, order, axis=1).tolist()))


def test_colours_counts_and_entries_change_what_is_drawn(opened: Any) -> None:
    page = opened("#view=shape&count=2&colour=error")
    coloured = shown(page)
    page.click("[data-colour=plain]")
    plain = shown(page)
    assert (coloured != plain).any() and page.is_hidden("#legend")
    figure = page.inner_text("#f-iou")
    page.click("#counts button:has-text('1')")
    assert page.inner_text("#f-iou") != figure and page.inner_text("#counts-unit") == "pose"
    page.select_option("#entry", label="heuristic · grid")
    page.wait_for_selector(READY)
    page.click("[data-colour=error]")
    blocks = page.evaluate("tslam.stage.panels[1].scene.userData.shown[0].geometry.getAttribute('color').count")
    assert blocks > 0 and (shown(page) != plain).any()


def test_texts_of_strangers_are_text_and_a_missing_hand_is_said(
    browser: Any, run: Path, primitive_cache: Path, tmp_path: Path
) -> None:
    entry = submission_entry(read_submission(run / "submissions" / "mine-hull"), ["mug"], [0])
    written = write_viewer(tmp_path / "out", [entry], title="<img src=x onerror=alert(1)>", cache=primitive_cache)
    context = browser.new_context(viewport={"width": SMALL[0], "height": SMALL[1]})
    page, trouble = watched(context)
    page.on("dialog", lambda dialog: trouble.append(dialog.message))
    page.goto(written.page.as_uri() + "#view=episode&step=10")
    page.wait_for_selector(READY)
    assert page.inner_text("#message").startswith("The hand is not drawn")
    assert "interpolated between the joint positions" in page.inner_text("#source")
    assert page.inner_text("#title") == "<img src=x onerror=alert(1)>"
    assert '"><script>alert(1)</script>' in page.inner_text("#entry")
    assert trouble == []
    context.close()


def test_a_damaged_folder_says_so(browser: Any, page_file: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(page_file.parent, tmp_path / "copy")
    for path in copy.rglob("episodes-*.js"):
        path.unlink()
    context = browser.new_context()
    page = context.new_page()
    page.goto((copy / "index.html").as_uri() + "#view=episode")
    page.wait_for_selector("#message:has-text('is missing; copy the whole folder')")
    context.close()
