"""Areas, normals, moments and interpolation against closed forms."""

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from tslam_bench.errors import AssetError
from tslam_bench.geometry import triangles
from tslam_bench.geometry.interpolation import trilinear
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold
from tslam_bench.geometry.moments import centroid, moments, volume

EDGES = np.array([0.3, 0.2, 0.1])
TURN = Rotation.from_euler("xyz", [0.3, 1.1, -0.7]).as_matrix()
PLACE = np.array([0.4, -1.0, 2.0])


@pytest.fixture
def box() -> TriangleMesh:
    """A box with edges EDGES, turned, centred on PLACE."""
    mesh = from_manifold(Manifold.cube(EDGES, center=True))
    return TriangleMesh(mesh.vertices @ TURN.T + PLACE, mesh.faces)


def test_areas_and_normals(box):
    corners = np.array([[[0, 0, 0], [2, 0, 0], [0, 3, 0]], [[0, 0, 0], [1, 1, 1], [2, 2, 2]]], dtype=float)
    np.testing.assert_array_equal(triangles.areas(corners), [3, 0])
    np.testing.assert_array_equal(triangles.face_normals(corners), [[0, 0, 1], [0, 0, 0]])
    assert box.area() == pytest.approx(2 * (EDGES[0] * EDGES[1] + EDGES[0] * EDGES[2] + EDGES[1] * EDGES[2]))
    outward = box.triangles().mean(axis=1) - PLACE
    assert (np.einsum("ij,ij->i", box.face_normals(), outward) > 0).all()


def test_points_are_uniform_over_a_triangle():
    """Their mean is the centroid, and each corner's part of the triangle holds its share."""
    corners = np.broadcast_to(np.array([[0, 0, 0], [2, 0, 0], [0, 3, 1]], dtype=float), (40_000, 3, 3))
    u, v = np.random.default_rng(0).random((2, 40_000, 1))
    weights = np.linalg.solve(corners[0].T + 1, (triangles.points_on(corners, u, v) + 1).T).T
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert weights.min() > -1e-12
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3, atol=5e-3)
    np.testing.assert_allclose((weights > 0.5).mean(axis=0), 1 / 4, atol=1e-2)


def test_moments_of_a_box(box):
    solid = moments(box)
    variances = EDGES**2 / 12
    assert solid.volume == pytest.approx(EDGES.prod())
    assert volume(box) == pytest.approx(EDGES.prod())
    np.testing.assert_allclose(solid.centroid, PLACE, atol=1e-12)
    np.testing.assert_allclose(centroid(box), PLACE, atol=1e-12)
    np.testing.assert_allclose(solid.covariance, TURN @ np.diag(variances) @ TURN.T, atol=1e-12)
    assert solid.radius == pytest.approx(np.sqrt(variances.sum()))
    inside_out = TriangleMesh(box.vertices, box.faces[:, ::-1])
    assert volume(inside_out) == pytest.approx(-EDGES.prod())
    with pytest.raises(AssetError, match="volume"):
        moments(inside_out)


def test_interpolation_is_exact_for_a_linear_function_and_stays_at_the_border():
    index = np.indices((4, 5, 6)).transpose(1, 2, 3, 0)
    origin, slope = np.array([-0.1, 0.2, 0.0]), np.array([2.0, -1.0, 0.5])
    values = (origin + 0.1 * index) @ slope
    points = origin + np.random.default_rng(1).uniform(0, [0.3, 0.4, 0.5], (200, 3))
    np.testing.assert_allclose(trilinear(values, origin, 0.1, points), points @ slope, atol=1e-12)
    far = trilinear(values, origin, 0.1, np.array([[-9.0, -9.0, -9.0], [9.0, 9.0, 9.0]]))
    np.testing.assert_allclose(far, [values[0, 0, 0], values[-1, -1, -1]])
