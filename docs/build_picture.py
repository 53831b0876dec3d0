"""Makes docs/picture.webp for the README: the hand on an object, what it touched, what was rebuilt, and the truth.

    python docs/build_picture.py --object mug

The heuristic explorer feels the object in all 8 poses; everything shown comes from those episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import trimesh
import tyro
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

import tslam_bench  # noqa: F401  (registers the environment)
from tslam_bench import grids
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_POSES
from tslam_bench.episodes import episode_seed
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.files import atomic_file
from tslam_bench.geometry.render import Camera, render, voxels_to_mesh
from tslam_bench.objects.hand import load_hand, visual_meshes
from tslam_bench.objects.store import load_object
from tslam_bench.reconstruction.registry import make_reconstructor

HAND, OBJECT, TOUCHED, REBUILT = (0.72, 0.74, 0.78), (0.93, 0.62, 0.28), (0.20, 0.55, 0.85), (0.35, 0.70, 0.50)
CAPTIONS = ("a blind hand explores", "what it touched (8 poses)", "rebuilt", "truth")
PANEL = 420


@dataclass(frozen=True)
class Config:
    """Explores, rebuilds and draws."""

    object: str = "mug"
    """Test object."""
    baseline: str = "heuristic"
    """Scripted explorer."""
    reconstructor: str = "hull"
    """Reconstructor."""
    model: Path | None = None
    """Model of a learned reconstructor."""
    seed: int = 0
    """Seed of the episodes."""
    output: Path = Path(__file__).parent / "picture.webp"
    """File to write."""


def hand_mesh(environment: Any) -> trimesh.Trimesh:
    """The hand's visual meshes where its links are now, in the world frame."""
    links = environment.unwrapped.agent.robot.links_map
    parts = []
    for link, file, pose, scale in visual_meshes(load_hand().urdf):
        part = trimesh.load(file, force="mesh")
        part.apply_scale(scale)
        part.apply_transform(links[link]._objs[0].entity_pose.to_transformation_matrix() @ pose)
        parts.append(part)
    return trimesh.util.concatenate(parts)


def explore(config: Config) -> tuple[trimesh.Trimesh, np.ndarray, np.ndarray]:
    """The hand at the moment of pose 0 when most links touch; merged touched and visited grids (object frame)."""
    explorer = make_baseline(config.baseline)
    environment = gym.make(ENVIRONMENT_ID, object=config.object, control_mode=explorer.control_mode)
    touched, visited, best, moment = [], [], -1, None
    for pose in tqdm(range(NUM_POSES), desc="poses"):
        seed = episode_seed(pose, config.seed)
        observation, _ = environment.reset(seed=seed, options={"pose": pose})
        explorer.reset(1, seed)
        for _ in range(HORIZON):
            action = explorer.act({key: value.numpy() for key, value in observation.items()})
            observation, *_ = environment.step(action)
            links = int(observation["touch"].sum())
            if pose == 0 and links > best:
                best, moment = links, hand_mesh(environment)
        touched.append(grids.world_to_object(environment.unwrapped.touched[0], pose))
        visited.append(grids.world_to_object(environment.unwrapped.visited[0], pose))
    environment.close()
    assert moment is not None
    return moment, grids.merge(touched), grids.merge(visited)


def main(config: Config) -> None:
    """Writes the picture."""
    truth = load_object(config.object)
    mesh = trimesh.Trimesh(truth.vertices, truth.faces, process=False)
    hand, touched, visited = explore(config)
    rebuilt = make_reconstructor(config.reconstructor, config.model).reconstruct(touched, visited).to_mesh()
    near = Camera((0.0, 0.0, 0.0), azimuth=-50, elevation=28, height=0.19)
    far = Camera((0.0, -0.05, 0.02), azimuth=-50, elevation=28, height=0.30)
    ground = float(mesh.bounds[0, 2])
    panels = [
        render([(mesh, OBJECT), (hand, HAND)], far, PANEL, ground=ground, supersampling=3),
        render([(voxels_to_mesh(touched), TOUCHED)], near, PANEL, ground=ground, supersampling=3),
        render([(rebuilt, REBUILT)], near, PANEL, ground=ground, supersampling=3),
        render([(mesh, OBJECT)], near, PANEL, ground=ground, supersampling=3),
    ]
    canvas = Image.new("RGB", (len(panels) * PANEL, PANEL + 44), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=22)
    captions = (CAPTIONS[0], CAPTIONS[1], f"{CAPTIONS[2]} ({config.reconstructor})", CAPTIONS[3])
    for column, (panel, caption) in enumerate(zip(panels, captions, strict=True)):
        canvas.paste(Image.fromarray(panel), (column * PANEL, 0))
        draw.text((column * PANEL + PANEL / 2, PANEL + 16), caption, fill=(40, 40, 40), font=font, anchor="mm")
    with atomic_file(config.output) as temporary:
        canvas.save(temporary, quality=88)


if __name__ == "__main__":
    main(tyro.cli(Config))
