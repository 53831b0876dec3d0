"""Inside tests, distances, samples and simplification against closed forms and against each other."""

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold

from tslam_bench.errors import AssetError
from tslam_bench.geometry.distance import InsideTest, contains, distance_to_mesh
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, is_valid, parse_stl, simplify, to_manifold
from tslam_bench.geometry.sampling import sample_surface
from tslam_bench.geometry.scanline import inside_grid
from tslam_bench.sources.generator import generate


@pytest.fixture(scope="module")
def mug() -> TriangleMesh:
    return generate.draw("mug", 0)[0]


def test_scanline_and_winding_numbers_agree(mug):
    spacing = 0.0023
    origin = mug.bounds[0] - 2.3 * spacing
    shape = tuple(int(n) for n in np.ceil(mug.extents / spacing) + 5)
    points = origin + np.argwhere(np.ones(shape)) * spacing
    scanned = inside_grid(mug, origin, spacing, shape).ravel()
    wound = contains(points, mug)
    different = scanned != wound
    assert scanned.sum() > 1000
    # The scan lines are nudged by a thousandth of a spacing, so only samples that close to the surface may differ.
    assert different.sum() == 0 or distance_to_mesh(points[different], mug).max() < 1e-3 * spacing


def test_inside_grid_of_a_box_is_exact():
    mesh = from_manifold(Manifold.cube([0.1, 0.06, 0.04], center=True))
    inside = inside_grid(mesh, np.full(3, -0.0805), 0.007, (24, 24, 24))
    axis = -0.0805 + 0.007 * np.arange(24)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    np.testing.assert_array_equal(inside, (np.abs(x) < 0.05) & (np.abs(y) < 0.03) & (np.abs(z) < 0.02))


def test_distance_to_a_sphere():
    sphere = from_manifold(Manifold.sphere(0.05, 256))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3))
    expected = np.abs(np.linalg.norm(points, axis=1) - 0.05)
    np.testing.assert_allclose(distance_to_mesh(points, sphere), expected, atol=2e-5)


def test_surface_samples_are_area_uniform(mug):
    count = 50_000
    points, face = sample_surface(mug, count, np.random.default_rng(1))
    assert distance_to_mesh(points, mug).max() < 1e-9
    area = trimesh.Trimesh(mug.vertices, mug.faces, process=False).area_faces
    # Shares of ten groups of faces, as large as their area says, within five standard deviations.
    group = np.arange(len(area)) * 10 // len(area)
    share = np.bincount(group, area) / area.sum()
    found = np.bincount(group[face], minlength=10) / count
    assert (np.abs(found - share) < 5 * np.sqrt(share * (1 - share) / count)).all()


def test_simplify_reaches_its_limit_and_stays_close(mug):
    solid = to_manifold(mug)
    simple = simplify(solid, 500)
    assert simple.num_tri() <= 500
    assert is_valid(simple)
    assert simple.genus() == solid.genus() == 1
    points, _ = sample_surface(from_manifold(simple), 5000, np.random.default_rng(2))
    assert distance_to_mesh(points, mug).max() < 0.02 * mug.extents.max()


def test_parse_stl_reads_what_trimesh_writes(mug):
    data = trimesh.Trimesh(mug.vertices, mug.faces, process=False).export(file_type="stl")
    mesh = parse_stl(data)
    assert len(mesh.faces) == len(mug.faces)
    np.testing.assert_allclose(to_manifold(mesh, merge=True).volume(), to_manifold(mug).volume(), rtol=1e-4)


@pytest.mark.parametrize("data", [b"", b"solid nothing\nendsolid", b"\x00" * 500, b"not a mesh at all" * 20])
def test_parse_stl_refuses_what_is_no_mesh(data):
    with pytest.raises(AssetError) as caught:
        parse_stl(data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("category", ["mug", "fork", "whisk"])
def test_inside_tests_by_cells_answer_like_winding_numbers(category):
    mesh = generate.draw(category, 0)[0]
    points = np.random.default_rng(3).uniform(*mesh.bounds, (4_000, 3))
    inside = contains(points, mesh)
    assert 0 < inside.mean() < 0.9
    np.testing.assert_array_equal(InsideTest(mesh)(points), inside)
