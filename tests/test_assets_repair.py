"""The repair ladder on damaged meshes of known shape."""

import numpy as np
import pytest
from manifold3d import Manifold

from tslam_bench.assets import repair
from tslam_bench.assets.distance import distance_to_mesh, sample_surface
from tslam_bench.assets.meshes import TriangleMesh, from_manifold, to_manifold
from tslam_bench.assets.solids import circle, ring
from tslam_bench.errors import AssetError


def torus() -> TriangleMesh:
    return from_manifold(ring(circle(0.015, 32) + np.array([0.04, 0.0]), 64))


def test_a_clean_mesh_is_kept():
    mesh = torus()
    repaired = repair.repair(mesh)
    assert repaired.method == "kept"
    assert repaired.kept_share == 1.0
    assert repaired.solid.genus() == 1
    np.testing.assert_allclose(repaired.solid.volume(), to_manifold(mesh).volume(), rtol=1e-5)


def test_an_inside_out_mesh_is_turned():
    mesh = torus()
    repaired = repair.repair(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]))
    assert repaired.solid.volume() == pytest.approx(to_manifold(mesh).volume(), rel=1e-5)


def test_small_holes_are_closed_by_winding_numbers_and_the_hole_of_the_torus_stays():
    mesh = torus()
    damaged = TriangleMesh(mesh.vertices, mesh.faces[np.random.default_rng(0).random(len(mesh.faces)) > 0.002])
    assert 0 < len(mesh.faces) - len(damaged.faces) < 20
    repaired = repair.repair(damaged)
    assert repaired.method == "winding"
    assert repaired.solid.genus() == 1
    points, _ = sample_surface(damaged, 5000, np.random.default_rng(1))
    assert np.quantile(distance_to_mesh(points, from_manifold(repaired.solid)), 0.99) < 1e-3
    assert repaired.solid.volume() == pytest.approx(to_manifold(mesh).volume(), rel=0.02)


def test_flipped_faces_are_mended_by_the_ball():
    mesh = torus()
    generator = np.random.default_rng(3)
    faces = mesh.faces.copy()
    flipped = generator.random(len(faces)) < 0.3
    faces[flipped] = faces[flipped][:, ::-1]
    repaired = repair.repair(TriangleMesh(mesh.vertices, faces))
    assert repaired.method == "ball"
    assert repaired.solid.genus() == 1
    # The ball's surface lies 0.9 of a sample spacing outside (0.6 mm here).
    assert to_manifold(mesh).volume() < repaired.solid.volume() < 1.12 * to_manifold(mesh).volume()


def test_only_the_largest_part_is_kept():
    large, small = Manifold.sphere(0.03, 48), Manifold.sphere(0.01, 48).translate([0.08, 0, 0])
    repaired = repair.repair(from_manifold(Manifold.compose([large, small])))
    assert repaired.solid.volume() == pytest.approx(large.volume(), rel=1e-3)
    assert repaired.kept_share == pytest.approx(27 / 28, rel=1e-3)


def test_overlapping_parts_are_united():
    first, second = Manifold.cube([0.04] * 3), Manifold.cube([0.04] * 3).translate([0.02, 0, 0])
    repaired = repair.repair(from_manifold(Manifold.compose([first, second])))
    assert repaired.solid.volume() == pytest.approx(0.06 * 0.04 * 0.04, rel=1e-4)


def test_a_single_triangle_is_no_solid_or_a_thin_one():
    """A sheet without thickness becomes a thin solid; nothing at all is refused."""
    sheet = TriangleMesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], dtype=float), np.array([[0, 1, 2]]))
    repaired = repair.repair(sheet)
    assert repaired.method == "ball"
    assert 0 < repaired.solid.volume() < 0.005 * 2 * 0.005
    with pytest.raises(AssetError):
        repair.repair(TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
