"""Winding numbers by counted crossings: against closed forms, libigl's, and where many faces meet."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh
from hostile_shapes import slivers

from tslam_bench.geometry.crossings import crossing_numbers

ENOUGH = 10**9


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.icosphere(3, 0.08),
        trimesh.creation.box([0.1, 0.2, 0.05]),
        trimesh.creation.cylinder(0.05, 0.2, sections=256),
        trimesh.creation.torus(0.08, 0.03),
        slivers(300),
    ],
)
def test_numbers_are_those_of_solid_angles(mesh: trimesh.Trimesh) -> None:
    """libigl adds up the solid angle of every face: another definition of the same number."""
    vertices, faces = arrays(mesh)
    points = np.random.default_rng(1).uniform(*(mesh.bounds * 1.1), (4000, 3))
    if len(faces) > 1000:
        points = np.concatenate([points, mesh.triangles_center[:1000] + 1e-4 * mesh.face_normals[:1000]])
    expected = igl.winding_number(vertices, faces, points)
    np.testing.assert_array_equal(crossing_numbers(vertices, faces, points, ENOUGH), expected.round())
    assert {0, 1} <= set(expected.round().astype(int))


def test_nothing_is_counted_twice_or_left_out_at_edges_and_corners() -> None:
    """Points straight below corners, edges and upright faces of a box that is cut along its diagonals."""
    mesh = trimesh.creation.box([2, 2, 2]).subdivide().subdivide()
    vertices, faces = arrays(mesh)
    lattice = np.stack(np.meshgrid(*[np.linspace(-1.25, 1.25, 21)] * 2, [-0.3, 0.1], indexing="ij"), axis=-1)
    points = lattice.reshape(-1, 3)
    numbers = crossing_numbers(vertices, faces, points, ENOUGH)
    assert numbers is not None and set(numbers) <= {0, 1}
    inside, outside = (np.abs(points) < 1).all(axis=1), (np.abs(points) > 1).any(axis=1)
    assert (numbers[inside] == 1).all() and (numbers[outside] == 0).all()


def test_the_same_solid_twice_is_counted_twice() -> None:
    mesh = trimesh.creation.icosphere(2, 1)
    vertices, faces = arrays(trimesh.util.concatenate([mesh, mesh]))
    np.testing.assert_array_equal(crossing_numbers(vertices, faces, np.array([[0, 0, 0], [0, 0, 2.0]]), ENOUGH), [2, 0])


def test_too_much_work_is_given_up() -> None:
    vertices, faces = arrays(slivers(2000))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20_000, 3))
    assert crossing_numbers(vertices, faces, points, 1000) is None
    assert crossing_numbers(vertices, faces, points, ENOUGH) is not None
