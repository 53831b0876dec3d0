"""The volume type: interpolation against a second implementation, meshes against closed forms."""

from __future__ import annotations

import itertools
import tracemalloc

import igl
import numpy as np
import pytest
import trimesh
from hostile_shapes import slivers
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from tslam_bench.constants import VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import prediction
from tslam_bench.scoring.metrics import iou
from tslam_bench.scoring.prediction import prepare, solid_in_mesh


def tetrahedra_of_a_cell() -> np.ndarray:
    """(24, 4, 3) corners of the pieces of the unit cell: its centre, the centre of a face, the ends of an edge of it."""
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    pieces = []
    for axis, side in itertools.product(range(3), (0.0, 1.0)):
        face = corners[corners[:, axis] == side]
        for a, b in itertools.combinations(face, 2):
            if np.abs(a - b).sum() == 1:
                pieces.append([np.full(3, 0.5), face.mean(axis=0), a, b])
    return np.array(pieces)


@pytest.mark.parametrize("resolution", [1, 2, 7, 16])
def test_linear_query_is_linear_on_the_tetrahedra(resolution: int) -> None:
    """Barycentric coordinates in every tetrahedron of the cell; the one that holds the point decides."""
    generator = np.random.default_rng(resolution)
    values = generator.random((resolution,) * 3).astype(np.float32)
    points = WORKSPACE_LOW + WORKSPACE_EDGE * generator.random((500, 3))
    position = np.clip((points - WORKSPACE_LOW) / WORKSPACE_EDGE * resolution - 0.5, 0, resolution - 1)
    corner = np.clip(np.floor(position).astype(int), 0, max(resolution - 2, 0))
    pieces = tetrahedra_of_a_cell()
    assert len(pieces) == 24
    system = np.concatenate([np.moveaxis(pieces, 1, 2), np.ones((24, 1, 4))], axis=1)
    trilinear = RegularGridInterpolator((np.arange(resolution),) * 3, values) if resolution > 1 else None
    expected = []
    for place, low in zip(position, corner, strict=True):
        weights = np.linalg.solve(system, np.broadcast_to([*(place - low), 1.0], (24, 4))[..., None])[..., 0]
        holder = weights.min(axis=1).argmax()
        assert weights[holder].min() > -1e-9
        at = values[0, 0, 0] if trilinear is None else trilinear(low + pieces[holder])
        expected.append(np.sum(weights[holder] * at))
    np.testing.assert_allclose(Volume(values).query(points), expected, atol=1e-6)


def test_linear_query_is_trilinear_along_edges_and_at_centres() -> None:
    values = np.random.default_rng(0).random((7, 7, 7))
    halves = np.random.default_rng(1).integers(0, 13, (500, 3)) / 2
    along = halves.round()
    along[np.arange(500), np.arange(500) % 3] = np.random.default_rng(2).uniform(0, 6, 500)
    for position in (halves[(halves % 1 != 0).sum(axis=1) != 1], along):
        expected = RegularGridInterpolator((np.arange(7),) * 3, values)(position)
        points = WORKSPACE_LOW + (position + 0.5) / 7 * WORKSPACE_EDGE
        np.testing.assert_allclose(Volume(values).query(points), expected, atol=1e-6)


def test_linear_query_turns_with_the_grid() -> None:
    """No axis and no diagonal is preferred: a turned or mirrored volume is turned or mirrored everywhere."""
    values = np.random.default_rng(0).random((9, 9, 9))
    points = WORKSPACE_LOW + WORKSPACE_EDGE * np.random.default_rng(1).random((1000, 3))
    expected = Volume(values).query(points)
    for order in itertools.permutations(range(3)):
        np.testing.assert_allclose(Volume(values.transpose(order)).query(points[:, order]), expected, atol=1e-6)
    for axis in range(3):
        mirrored = points * np.where(np.arange(3) == axis, -1, 1)
        np.testing.assert_allclose(Volume(np.flip(values, axis)).query(mirrored), expected, atol=1e-6)


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


def plateau() -> np.ndarray:
    """A block of ones, half of it at the threshold, beside a block at the threshold."""
    values = np.zeros((16, 16, 16))
    values[2:8, 3:12, 3:12] = 1
    values[5:8] *= 0.5
    values[10:13, 5:9, 5:9] = 0.5
    return values


def random_field(seed: int, size: int = 12) -> np.ndarray:
    return np.random.default_rng(seed).random((size,) * 3)


def smooth_field(seed: int) -> np.ndarray:
    """Reaches every face of W."""
    values = gaussian_filter(random_field(seed, 32), 3)
    return np.clip(0.5 + 10 * (values - np.median(values)), 0, 1)


def ball(size: int = 48) -> np.ndarray:
    return np.clip(0.5 - (np.linalg.norm(voxel_centres(size), axis=-1) - 0.08) / 0.02, 0, 1)


def checkerboard(size: int) -> np.ndarray:
    return np.indices((size,) * 3).sum(axis=0) % 2


FIELDS = {
    "a plateau at the threshold": plateau(),
    "ones": np.ones((8, 8, 8)),
    "the threshold": np.full((5, 5, 5), 0.5),
    "one cell": np.ones((1, 1, 1)),
    "a checkerboard": checkerboard(8),
    "a checkerboard of an odd size": checkerboard(9),
    "noise": random_field(0),
    "more noise": random_field(1),
    "noise that often equals the threshold": random_field(2).round(1),
    "a smooth field": smooth_field(0),
    "a ball": ball(),
}


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
@pytest.mark.parametrize("name", list(FIELDS))
def test_mesh_and_query_bound_the_same_solid(name: str, interpolation) -> None:
    """Exact winding numbers of the mesh against the query at random points, in the hardest fields."""
    volume = Volume(FIELDS[name], interpolation)
    points = WORKSPACE_LOW + WORKSPACE_EDGE * np.random.default_rng(0).random((5000, 3))
    mesh = volume.to_mesh()
    winding = igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), points)
    solid = volume.query(points) >= 0.5
    assert iou(winding > 0.5, solid) > 0.9995
    np.testing.assert_allclose(winding, winding.round(), atol=1e-6)  # closed, and nowhere covered twice
    assert mesh.is_winding_consistent
    if interpolation == "linear":
        assert mesh.is_watertight
        merged = trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces, process=True)  # as read from a file
        assert merged.is_watertight
    assert solid_in_mesh(mesh, points).tolist() == (winding > 0.5).tolist()  # as scoring decides for meshes
    np.testing.assert_allclose(volume.triangles().reshape(-1, 3), mesh.vertices[mesh.faces].reshape(-1, 3), atol=1e-12)


def test_a_plateau_at_the_threshold_is_solid_up_to_its_outermost_samples() -> None:
    values = np.zeros((16, 16, 16))
    values[4:9, 4:9, 4:9] = 0.5
    mesh = Volume(values).to_mesh()
    edge = WORKSPACE_EDGE / 16
    assert mesh.volume == pytest.approx((4 * edge) ** 3, rel=3e-4)
    np.testing.assert_allclose(
        mesh.bounds, WORKSPACE_LOW + edge * np.array([[4.5] * 3, [8.5] * 3]), atol=1.01e-4 * edge
    )


def test_the_solid_follows_the_threshold() -> None:
    volume = Volume(smooth_field(3))
    points = WORKSPACE_LOW + WORKSPACE_EDGE * np.random.default_rng(0).random((3000, 3))
    for threshold in (0.2, 0.7):
        assert iou(solid_in_mesh(volume.to_mesh(threshold), points), volume.query(points) >= threshold) > 0.999


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
def test_a_surface_is_made_up_to_exactly_the_bound(interpolation) -> None:
    volume = Volume(random_field(0), interpolation)
    count = len(volume.to_mesh().faces)
    assert len(volume.to_mesh(most=count).faces) == count
    with pytest.raises(InvalidInputError, match=f"more than {count - 1:,} triangles; smooth it"):
        volume.to_mesh(most=count - 1)


@pytest.mark.parametrize(("interpolation", "size"), [("nearest", 256), ("linear", 256), ("linear", 96)])
@pytest.mark.parametrize("field", [checkerboard, lambda size: random_field(0, size)])
def test_a_surface_beyond_all_bounds_counts_as_empty_and_is_not_made(field, interpolation, size: int) -> None:
    volume = Volume(field(size), interpolation)
    tracemalloc.start()
    try:
        prediction = prepare(volume, np.zeros((1, 3)))
        assert tracemalloc.get_traced_memory()[1] < 700e6  # the samples with a border around them, no triangles
    finally:
        tracemalloc.stop()
    assert prediction.reason == (
        "volume: the surface has more than 8,000,000 triangles; smooth it or lower its resolution"
    )


@pytest.mark.parametrize("count", [500, 40_000])
def test_faces_right_across_the_mesh_do_not_each_cost_every_point(count: int, monkeypatch) -> None:
    """A tree over such faces looks at all of them for every point: 160,000 for 100,000 points took an hour."""
    mesh = slivers(count)
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (100_000, 3))  # other numbers than the slivers' corners
    monkeypatch.setattr(prediction, "_MOST_EVALUATIONS", 10_000_000)
    counted = solid_in_mesh(mesh, points)
    some = points[:: 100_000 // 200]
    expected = igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), some) >= 0.5
    np.testing.assert_array_equal(counted[:: 100_000 // 200], expected)
    assert counted.any()


def test_faces_that_are_too_much_work_make_an_empty_prediction(monkeypatch) -> None:
    monkeypatch.setattr(prediction, "_MOST_EVALUATIONS", 1000)
    monkeypatch.setattr(prediction, "_MOST_CROSSINGS", 1000)
    found = prepare(slivers(100), np.random.default_rng(0).uniform(-0.1, 0.1, (1000, 3)))
    assert found.reason == "the mesh has too many long faces to tell its inside from its outside"
    assert not found.solid.any() and found.points.shape == (0, 3)


def test_full_volume_fills_the_workspace() -> None:
    mesh = Volume(np.ones((16, 16, 16))).to_mesh()
    np.testing.assert_allclose(mesh.bounds, [[WORKSPACE_LOW] * 3, [-WORKSPACE_LOW] * 3], rtol=2e-5)
    assert mesh.volume == pytest.approx(WORKSPACE_EDGE**3, rel=1e-4)


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
