"""The volume type: interpolation against a second implementation, meshes against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from tslam_bench.constants import VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.leaderboard.metrics import iou
from tslam_bench.leaderboard.prediction import solid_in_mesh
from tslam_bench.reconstruction.volume import Volume


@pytest.mark.parametrize("resolution", [1, 2, 7, 32])
def test_linear_query_agrees_with_scipy(resolution: int) -> None:
    generator = np.random.default_rng(resolution)
    values = generator.random((resolution,) * 3)
    points = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((500, 3))
    axis = WORKSPACE_LOW + (np.arange(resolution) + 0.5) * WORKSPACE_EDGE / resolution
    clamped = np.clip(points, axis[0], axis[-1])
    expected = (
        np.full(500, values[0, 0, 0]) if resolution == 1 else RegularGridInterpolator((axis,) * 3, values)(clamped)
    )
    np.testing.assert_allclose(Volume(values).query(points), expected, atol=1e-6)


def test_nearest_query_reads_the_containing_voxel() -> None:
    generator = np.random.default_rng(0)
    grid = generator.random((32, 32, 32)) < 0.3
    volume = Volume(grid, "nearest")
    points = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((2000, 3))
    single = np.array([(points_to_grid(p[None]) & grid).any() for p in points[:200]])
    np.testing.assert_array_equal(volume.query(points[:200]) == 1, single)


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
def test_query_is_zero_outside_the_workspace(interpolation) -> None:
    volume = Volume(np.ones((4, 4, 4)), interpolation)
    edge = WORKSPACE_EDGE / 2
    points = np.array([[0, 0, 0], [-edge, -edge, -edge], [edge, 0, 0], [0, -edge - 1e-9, 0], [0, 0, 9]])
    np.testing.assert_array_equal(volume.query(points), [1, 1, 0, 0, 0])


def test_sphere_mesh() -> None:
    radius = 0.08
    distance = np.linalg.norm(voxel_centres(64), axis=-1) - radius
    mesh = Volume(np.clip(0.5 - distance / 0.02, 0, 1)).to_mesh()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(radius, abs=1e-4)
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-6)


def test_cube_faces_have_exact_volume_and_place() -> None:
    solid = np.zeros((32, 32, 32), dtype=bool)
    solid[3:9, 10:12, 30:32] = True
    mesh = Volume(solid, "nearest").to_mesh()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(solid.sum() * VOXEL_EDGE**3)
    np.testing.assert_allclose(mesh.bounds, WORKSPACE_LOW + VOXEL_EDGE * np.array([[3, 10, 30], [9, 12, 32]]))


@pytest.mark.parametrize("seed", range(5))
def test_linear_mesh_of_noise_is_closed(seed: int) -> None:
    values = np.random.default_rng(seed).random((12, 12, 12)).round(1)  # many samples equal the threshold
    mesh = Volume(values).to_mesh()
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


@pytest.mark.parametrize("seed", range(5))
def test_mesh_and_query_bound_the_same_solid(seed: int) -> None:
    generator = np.random.default_rng(seed)
    values = gaussian_filter(generator.random((32, 32, 32)), 3)
    volume = Volume(np.clip(0.5 + 10 * (values - np.median(values)), 0, 1))  # reaches every face of W
    points = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((4000, 3))
    mesh = volume.to_mesh()
    assert mesh.is_watertight
    assert iou(solid_in_mesh(mesh, points), volume.query(points) >= 0.5) > 0.98


def test_full_volume_fills_the_workspace() -> None:
    mesh = Volume(np.ones((16, 16, 16))).to_mesh()
    np.testing.assert_allclose(mesh.bounds, [[WORKSPACE_LOW] * 3, [-WORKSPACE_LOW] * 3])
    assert mesh.volume == pytest.approx(WORKSPACE_EDGE**3, rel=0.01)


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
def test_empty_volume_gives_an_empty_mesh(interpolation) -> None:
    mesh = Volume(np.full((8, 8, 8), 0.49), interpolation).to_mesh()
    assert len(mesh.vertices) == len(mesh.faces) == 0


@pytest.mark.parametrize(
    "values",
    [np.zeros((4, 4)), np.zeros((4, 4, 5)), np.zeros((0, 0, 0)), np.full((2, 2, 2), np.nan), np.full((2, 2, 2), 1.1)],
)
def test_bad_probabilities_are_refused(values: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="probability"):
        Volume(values)


def test_unknown_interpolation_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="cubic"):
        Volume(np.zeros((2, 2, 2)), "cubic")  # type: ignore[arg-type]
