"""Makes docs/viewing.webp: the viewer's two views, photographed in Chromium (needs playwright and a Chromium).

python docs/build_viewing.py --object stanfordbunny
"""

from __future__ import annotations

import io
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from PIL import Image
from playwright.sync_api import sync_playwright

from tslam_bench.cli import main as tslam_bench
from tslam_bench.files import atomic_file

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
VIEWS = ("#view=episode&pose=5&step=130", "#view=shape&count=8&colour=error")


@dataclass(frozen=True)
class Config:
    """Explores, writes the page, and photographs it."""

    object: str = "stanfordbunny"
    policy: str = "heuristic"
    reconstructor: str = "carve"
    policy_salt: str = "2021"
    output: Path = Path(__file__).parent / "viewing.webp"


def build(config: Config) -> None:
    """Writes the picture."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        poses = [str(pose) for pose in range(8)]
        chosen = ["--object", config.object, "--policy", config.policy, "--reconstructor", config.reconstructor]
        tslam_bench(
            ["view", *chosen, "--policy-salt", config.policy_salt, "--pose", *poses, "--output", folder, "--no-browser"]
        )
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1200, "height": 640})
        shots = []
        for view in VIEWS:
            page.goto("about:blank")
            page.goto((Path(folder) / "index.html").as_uri() + view)
            page.wait_for_selector("main[aria-busy=false]")
            page.wait_for_timeout(2000)
            shots.append(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")))
        browser.close()
    with atomic_file(config.output) as temporary:
        Image.fromarray(np.concatenate(shots)).save(temporary, format="WEBP", quality=82, method=6)
    print(f"{config.output}: {config.output.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    build(tyro.cli(Config))
