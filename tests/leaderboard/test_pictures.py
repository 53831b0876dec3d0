"""Pictures: of what would take too long to draw, the voxels are drawn."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hostile_shapes import slivers
from PIL import Image
from scored_run import info

from tslam_bench.geometry.render import voxels_to_mesh
from tslam_bench.grids import voxel_centres
from tslam_bench.leaderboard import pictures
from tslam_bench.leaderboard.pictures import MAX_OVERLAP, Picture, draw, overlap
from tslam_bench.objects.store import PreparedObject
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.submission import Reconstruction, SubmissionWriter, read_submission


def drawn(reconstruction: Reconstruction, folder: Path, box: PreparedObject) -> bytes:
    """The picture of a reconstruction of the box."""
    with SubmissionWriter(folder, info("mine", "own", privileged=True)) as writer:
        writer.add_reconstruction("mug", 8, 0, reconstruction)
    return draw(Picture("reconstruction", "mug", read_submission(folder), "x", 0), box)


def test_overlap_is_what_a_line_meets() -> None:
    """Random lines through the box of a mesh, and the boxes of its faces, one by one."""
    mesh = trimesh.creation.icosphere(1, 1)
    generator = np.random.default_rng(0)
    direction = generator.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # Uniform lines: a point on a plane at right angles, in a disc that holds the box.
    across = np.cross(direction, generator.normal(size=(4000, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    start = across * np.sqrt(generator.random((4000, 1)) * 3.1) - 5 * direction

    def hits(low: np.ndarray, high: np.ndarray) -> int:
        near, far = (low - start) / direction, (high - start) / direction
        return int((np.minimum(near, far).max(axis=1) <= np.maximum(near, far).min(axis=1)).sum())

    boxes = sum(hits(t.min(axis=0), t.max(axis=0)) for t in mesh.triangles)
    assert overlap(mesh) == pytest.approx(boxes / hits(*mesh.bounds), rel=0.05)
    assert overlap(trimesh.Trimesh()) == 0


@pytest.mark.parametrize("kind", ["slivers", "noise"])
def test_what_would_take_too_long_is_drawn_in_voxels(kind: str, tmp_path: Path, box: PreparedObject) -> None:
    if kind == "slivers":
        hostile: Reconstruction = slivers(5000)
        assert overlap(hostile) > 3 * MAX_OVERLAP
    else:
        hostile = Volume(np.random.default_rng(0).random((96, 96, 96)))
    picture = drawn(hostile, tmp_path / "hostile", box)
    if isinstance(hostile, Volume):
        solid = hostile.query(voxel_centres().reshape(-1, 3)) >= 0.5
        same = Volume(solid.reshape(32, 32, 32), "nearest")
        assert picture == drawn(same, tmp_path / "same", box)
    assert Image.open(io.BytesIO(picture)).size[0] == pictures.PICTURE_SIZE


def test_ordinary_meshes_and_volumes_are_drawn_as_they_are(tmp_path: Path, box: PreparedObject) -> None:
    ball = trimesh.creation.icosphere(5, 0.06)
    voxels = voxels_to_mesh(np.linalg.norm(voxel_centres(), axis=-1) < 0.06)
    assert overlap(ball) < 10
    as_it_is = drawn(ball, tmp_path / "ball", box)
    assert as_it_is != drawn(Volume(np.linalg.norm(voxel_centres(), axis=-1) < 0.06, "nearest"), tmp_path / "v", box)
    assert len(voxels.faces) > 0
