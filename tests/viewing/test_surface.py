"""Nets and errors against spheres and boxes, whose surfaces are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tslam_bench.constants import WORKSPACE_EDGE
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.viewing import surface

RADIUS = 0.07


def ball(resolution: int, centre: float = 0.0) -> Volume:
    """A ball whose probability passes one half on its surface, with a slope of one in 16 mm."""
    distance = np.linalg.norm(voxel_centres(resolution) - centre, axis=-1) - RADIUS
    return Volume(np.clip(0.5 - distance / 0.016, 0, 1), "linear")


@pytest.mark.parametrize("resolution", [32, 64, 96])
def test_a_ball_is_a_ball(resolution: int) -> None:
    found = surface.net(ball(resolution))
    vertices, faces = found.mesh()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)  # positive: faces look outwards
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 0.5e-3
    assert len(vertices) == surface.crossed_cells(found.solid).sum()


def test_a_solid_that_meets_the_wall_of_the_workspace_is_closed() -> None:
    vertices, faces = surface.net(ball(32, centre=0.1)).mesh()
    assert trimesh.Trimesh(vertices, faces, process=False).is_watertight
    assert np.abs(vertices).max() <= WORKSPACE_EDGE / 2 + WORKSPACE_EDGE / surface.NODES


def test_voxels_stay_voxels() -> None:
    solid = np.zeros((32, 32, 32))
    solid[10:12, 10:13, 10] = 1
    found = surface.net(Volume(solid, "nearest"))
    vertices, faces = found.mesh()
    edge = WORKSPACE_EDGE / 32
    assert found.places is None
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(6 * edge**3)


def test_a_submitted_mesh_keeps_its_surface() -> None:
    sphere = trimesh.creation.icosphere(4, RADIUS)
    vertices, faces = surface.net(sphere).mesh()
    error = np.abs(np.linalg.norm(vertices, axis=1) - RADIUS)
    assert (
        np.median(error) < 0.2e-3 and error.max() < 1e-3
    )  # a vertex stays in its cell, also where the surface leaves it
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(sphere.volume, rel=0.02)


def test_what_is_no_solid_is_empty() -> None:
    open_box = trimesh.creation.box((0.1, 0.1, 0.1))
    open_box = trimesh.Trimesh(open_box.vertices, open_box.faces[:-1])
    for nothing in (open_box, Volume(np.zeros((32, 32, 32)), "linear"), Volume(np.zeros((32, 32, 32)), "nearest")):
        assert len(surface.net(nothing).mesh()[1]) == 0


def test_distances_to_a_box_are_exact_and_signed() -> None:
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    points = np.random.default_rng(0).uniform(-0.12, 0.12, (2000, 3))
    beyond = np.abs(points) - box.extents / 2
    outside, inside = np.linalg.norm(np.maximum(beyond, 0), axis=1), np.minimum(beyond.max(axis=1), 0)
    found = surface.signed_distances(points, box.vertices, box.faces)
    np.testing.assert_allclose(found, outside + inside, atol=1e-7)
    stored = surface.stored_errors(found) * surface.ERROR_STEP
    near = np.abs(found) < surface.MOST_STEPS * surface.ERROR_STEP
    assert np.abs(stored - found)[near].max() <= surface.ERROR_STEP / 2 + 1e-9 and near.sum() > 100


def test_fine_meshes_are_the_same_surface() -> None:
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    vertices, faces = surface.fine_mesh(box.vertices, box.faces, 0.02)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and len(faces) > len(box.faces)
    assert (mesh.area, mesh.volume) == pytest.approx((box.area, box.volume))
    assert mesh.edges_unique_length.max() <= 0.02 + 1e-9
    assert set(np.unique(faces)) == set(range(len(vertices)))
