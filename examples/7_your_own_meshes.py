"""Your own meshes: a folder of files becomes a split, and the hand explores one of its objects.

Without --folder a mesh is made first: a mug-like cup, drawn with trimesh.

python examples/7_your_own_meshes.py --folder my_meshes --license CC0-1.0 --source "my scanner"
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium as gym
import trimesh
import tyro

import tslam_bench  # noqa: F401  (registers the environments)
from tslam_bench.objects.store import load_object, prepared_names


def make_meshes(folder: Path) -> None:
    """Writes `cups/cup.stl`: the folder's name is the category."""
    outside = trimesh.creation.cylinder(radius=0.04, height=0.1)
    inside = trimesh.creation.cylinder(radius=0.033, height=0.1)
    inside.apply_translation([0, 0, 0.008])
    (folder / "cups").mkdir(parents=True)
    trimesh.boolean.difference([outside, inside]).export(folder / "cups" / "cup.stl")


def main(
    folder: Path | None = None, split: str = "mine", license: str = "CC0-1.0", source: str = "drawn here", up: str = "z"
) -> None:
    """Imports a folder of meshes and steps an environment with the first of them.

    Args:
        folder: meshes, in one subfolder per category; default: one is made.
        split: name of the new split.
        license: licence of the meshes.
        source: where they come from.
        up: axis that points up in the files.
    """
    with tempfile.TemporaryDirectory() as scratch:
        if folder is None:
            folder = Path(scratch) / "meshes"
            make_meshes(folder)
        command = [sys.executable, "-m", "tslam_bench.cli", "assets", "import", folder, "--split", split]
        command += ["--license", license, "--source", source, "--up", up]
        subprocess.run([str(part) for part in command], check=True)
    name = prepared_names(split)[0]
    prepared = load_object(name, split)
    print(f"{name}: {len(prepared.hulls)} collision hulls, {int(prepared.surface.sum())} surface voxels")
    env = gym.make("TactileSLAM-v0", object=name, split=split)
    observation, info = env.reset(seed=0)
    print({key: tuple(value.shape) for key, value in observation.items()})
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
