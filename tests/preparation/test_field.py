"""The signed-distance field against closed forms and against libigl's own signed distance."""

import igl
import numpy as np
import pytest
from manifold3d import Manifold

from tslam_bench.constants import SIGNED_DISTANCE_TOLERANCE
from tslam_bench.geometry.interpolation import trilinear
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold
from tslam_bench.objects.store import SignedDistanceField
from tslam_bench.preparation import decompose, field

HALF = np.array([0.03, 0.02, 0.01])


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Closed form of the signed distance to a box centred on the origin."""
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def split_box() -> list[TriangleMesh]:
    """The box as two overlapping halves."""
    left = Manifold.cube(2 * HALF, center=True).trim_by_plane([-1, 0, 0], -0.005)
    right = Manifold.cube(2 * HALF, center=True).trim_by_plane([1, 0, 0], -0.005)
    return [from_manifold(left), from_manifold(right)]


def read(field: SignedDistanceField, points: np.ndarray) -> np.ndarray:
    return trilinear(field.values, field.origin, field.spacing, points)


@pytest.fixture(scope="module")
def box_field():
    return field.build_field(split_box())


def test_exact_distance_of_two_halves_is_that_of_the_box():
    hulls = split_box()
    surface = from_manifold(decompose.hull_union(hulls))
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (3000, 3))
    np.testing.assert_allclose(field.signed_distance(points, hulls, surface), box_distance(points, HALF), atol=1e-9)


def test_field_of_the_box(box_field):
    generator = np.random.default_rng(1)
    points = generator.uniform(-HALF - 0.015, HALF + 0.015, (20_000, 3))
    exact = box_distance(points, HALF)
    values = read(box_field, points)
    outside = exact > -5e-4
    assert np.abs(values - exact)[outside].max() < 2 * SIGNED_DISTANCE_TOLERANCE
    assert np.quantile(np.abs(values - exact)[outside], 0.99) < 0.3e-3
    # Deep inside, where the halves meet, nothing reads as surface.
    assert values[exact < -2e-3].max() < -1e-3
    # Touch compares with 1 mm: on the surface the field is within tolerance.
    on_surface = points.copy()
    axis = generator.integers(3, size=len(points))
    rows = np.arange(len(points))
    on_surface = np.clip(on_surface, -HALF, HALF)
    on_surface[rows, axis] = np.sign(on_surface[rows, axis]) * HALF[axis]
    assert np.abs(read(box_field, on_surface)).max() <= SIGNED_DISTANCE_TOLERANCE
    assert box_field.surface_error <= SIGNED_DISTANCE_TOLERANCE


def test_gradient_points_away_from_the_surface(box_field):
    points = np.array([[0.04, 0.0, 0.0], [0.0, -0.03, 0.0], [0.0, 0.0, 0.018]])
    step = 0.5 * box_field.spacing
    gradient = np.stack(
        [(read(box_field, points + step * e) - read(box_field, points - step * e)) / (2 * step) for e in np.eye(3)],
        axis=1,
    )
    np.testing.assert_allclose(gradient, np.sign(points), atol=0.03)


def test_field_covers_the_padding(box_field):
    far = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * (HALF + field.PADDING)
    index = (far - box_field.origin) / box_field.spacing
    assert (index >= -1e-9).all()
    assert (index <= np.array(box_field.values.shape) - 1 + 1e-9).all()


def test_field_of_a_thin_wall_agrees_with_libigl():
    wall = Manifold.cube([0.05, 0.0018, 0.04], center=True)
    cross = Manifold.cube([0.0018, 0.05, 0.04], center=True)
    hulls = [from_manifold(wall), from_manifold(cross)]
    built = field.build_field(hulls)
    surface = from_manifold(decompose.hull_union(hulls))
    points = np.random.default_rng(2).uniform(-0.035, 0.035, (20_000, 3))
    exact = igl.signed_distance(points, surface.vertices, surface.faces)[0]
    near = (exact > 0) & (exact < 0.003)
    error = np.abs(read(built, points) - exact)
    assert built.surface_error <= SIGNED_DISTANCE_TOLERANCE
    assert np.quantile(error[near], 0.95) < 0.3e-3
    assert (read(built, points)[exact < -4e-4] < 0).mean() > 0.95
