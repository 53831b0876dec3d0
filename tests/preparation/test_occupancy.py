"""Occupancy products against closed forms and dense sampling."""

import numpy as np
import pytest
from manifold3d import Manifold

from tslam_bench.constants import IOU_INSIDE_POINTS, VOXEL_EDGE
from tslam_bench.geometry.meshes import from_manifold, to_manifold
from tslam_bench.geometry.sampling import iou_cells, iou_points, sample_surface
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.preparation import occupancy
from tslam_bench.sources.generator import generate


@pytest.fixture(scope="module")
def mug():
    return generate.draw("mug", 1)[0]


def test_solid_grid_of_a_box():
    half = np.array([0.051, 0.033, 0.022])
    mesh = from_manifold(Manifold.cube(2 * half, center=True))
    np.testing.assert_array_equal(occupancy.solid_grid(mesh), (np.abs(voxel_centres()) < half).all(axis=-1))


def test_surface_grid_of_a_box():
    half = np.array([0.051, 0.033, 0.022])
    mesh = from_manifold(Manifold.cube(2 * half, center=True))
    distance = np.abs(voxel_centres())
    meets = (distance <= half + VOXEL_EDGE / 2).all(axis=-1)
    within = (distance < half - VOXEL_EDGE / 2).all(axis=-1)
    np.testing.assert_array_equal(occupancy.surface_grid(mesh), meets & ~within)


def test_surface_grid_holds_every_voxel_with_a_sample_and_hardly_more(mug):
    points, _ = sample_surface(mug, 2_000_000, np.random.default_rng(0))
    sampled = points_to_grid(points)
    exact = occupancy.surface_grid(mug)
    assert not (sampled & ~exact).any()
    assert (exact & ~sampled).sum() <= 0.01 * exact.sum()


def test_solid_share_of_the_iou_points_is_the_volume(mug):
    volume = to_manifold(mug).volume()
    compared = iou_points(*mug.bounds, iou_cells(*mug.bounds, volume))
    solid = occupancy.solid_at(compared.points, mug)
    assert solid.sum() == pytest.approx(IOU_INSIDE_POINTS, rel=0.1)
    # One point per cell: better than the binomial deviation of as many uniform points, 1 / sqrt(8000) = 1.1 %.
    assert compared.weights[solid].sum() == pytest.approx(volume, rel=0.03)


def test_solid_at_points_of_a_ball():
    mesh = from_manifold(Manifold.sphere(0.06, 256))
    points = iou_points(*mesh.bounds, (50, 50, 50)).points
    radius = np.linalg.norm(points, axis=1)
    decided = np.abs(radius - 0.06) > 2e-5  # the mesh is a polyhedron
    np.testing.assert_array_equal(occupancy.solid_at(points, mesh)[decided], (radius < 0.06)[decided])


def test_surface_samples_are_seeded(mug):
    first, faces = occupancy.surface_samples(mug)
    second, _ = occupancy.surface_samples(mug)
    assert first.shape == (100_000, 3)
    assert faces.max() < len(mug.faces)
    np.testing.assert_array_equal(first, second)
