"""Collision hulls: limits, volume, convexity, determinism, and what they leave open."""

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.spatial import ConvexHull

from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, to_manifold
from tslam_bench.preparation import decompose
from tslam_bench.sources.generator.solids import circle, ring

QUICK = decompose.DecompositionSettings(iterations=20, input_triangles=800)


def test_a_rounded_hull_is_reduced_without_losing_volume():
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points *= np.array([0.04, 0.03, 0.02]) / np.linalg.norm(points, axis=1, keepdims=True)
    hull = decompose.reduce_hull(points)
    assert hull is not None
    assert len(hull.vertices) <= 34
    assert len(hull.faces) <= 64
    assert decompose.volume(hull) == pytest.approx(ConvexHull(points).volume, rel=1e-9)
    planes = ConvexHull(hull.vertices)
    assert len(planes.vertices) == len(hull.vertices)  # every vertex is a corner: it is convex


def test_a_small_hull_is_kept_as_it_is():
    corners = np.array(list(np.ndindex(2, 2, 2))) * [0.1, 0.05, 0.02]
    hull = decompose.reduce_hull(np.vstack([corners, corners.mean(axis=0)]))
    assert hull is not None
    assert sorted(map(tuple, hull.vertices)) == sorted(map(tuple, corners))
    assert to_manifold(hull).volume() == pytest.approx(1e-4)  # outward faces


def test_flat_and_tiny_point_sets_are_no_hulls():
    flat = np.random.default_rng(1).uniform(size=(20, 3)) * [0.1, 0.1, 0.0]
    assert decompose.reduce_hull(flat) is None
    assert decompose.reduce_hull(1e-5 * np.array(list(np.ndindex(2, 2, 2)), dtype=float)) is None


def test_an_l_shape_is_two_boxes():
    solid = Manifold.cube([0.1, 0.04, 0.04]) + Manifold.cube([0.04, 0.1, 0.04])
    hulls = decompose.decompose(from_manifold(solid), QUICK)
    union = decompose.hull_union(hulls)
    assert 2 <= len(hulls) <= 4
    assert decompose.intersection_over_union(union, solid) > 0.97


def test_the_hole_of_a_torus_stays_open_and_equal_seeds_give_equal_bytes():
    torus = ring(circle(0.015, 24) + np.array([0.04, 0.0]), 48)
    mesh = from_manifold(torus)
    first = decompose.decompose(mesh, QUICK)
    second = decompose.decompose(mesh, QUICK)
    assert all(a.vertices.tobytes() == b.vertices.tobytes() for a, b in zip(first, second, strict=True))
    union = decompose.hull_union(first)
    assert union.genus() >= 1
    assert (union ^ Manifold.cylinder(0.1, 0.02, center=True)).volume() < 0.01 * torus.volume()
    assert decompose.intersection_over_union(union, torus) > 0.85


def test_the_cache_is_used_and_survives_damage(tmp_path):
    mesh = from_manifold(Manifold.cube([0.1, 0.05, 0.04]))
    hulls = decompose.decompose_cached(mesh, QUICK, tmp_path)
    (entry,) = tmp_path.glob("*.npz")
    written = entry.stat().st_mtime_ns
    again = decompose.decompose_cached(mesh, QUICK, tmp_path)
    assert entry.stat().st_mtime_ns == written
    np.testing.assert_array_equal(hulls[0].vertices, again[0].vertices)
    entry.write_bytes(entry.read_bytes()[:100])
    repaired = decompose.decompose_cached(mesh, QUICK, tmp_path)
    np.testing.assert_array_equal(hulls[0].vertices, repaired[0].vertices)


def test_the_cache_key_depends_on_mesh_and_settings():
    mesh = from_manifold(Manifold.cube([0.1, 0.05, 0.04]))
    moved = TriangleMesh(mesh.vertices + 1e-9, mesh.faces)
    keys = {decompose.cache_key(m, s) for m in (mesh, moved) for s in (QUICK, decompose.STANDARD)}
    assert len(keys) == 4
