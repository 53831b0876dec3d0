"""Unreachable inner voids are filled, everything that is open stays."""

import numpy as np
import pytest
from manifold3d import Manifold

from tslam_bench.geometry.distance import distance_to_mesh
from tslam_bench.geometry.meshes import from_manifold, to_manifold
from tslam_bench.geometry.sampling import sample_surface
from tslam_bench.preparation.voids import fill_voids
from tslam_bench.sources.generator import generate
from tslam_bench.sources.generator.solids import circle, cylinder, ring

RADIUS, WALL = 0.03, 0.004


def shell() -> Manifold:
    return Manifold.sphere(RADIUS, 64) - Manifold.sphere(RADIUS - WALL, 64)


def drilled(hole_radius: float) -> Manifold:
    return shell() - cylinder(hole_radius, 0.05).translate([0, 0, 0.025])


def test_a_closed_void_is_filled_exactly():
    filled = fill_voids(shell())
    ball = Manifold.sphere(RADIUS, 64).volume()
    assert filled.solid.volume() == pytest.approx(ball, rel=1e-9)
    assert filled.volume == pytest.approx(ball - shell().volume(), rel=1e-9)


def test_a_void_behind_a_narrow_opening_is_filled_and_the_outside_stays():
    original = drilled(0.002)
    filled = fill_voids(original)
    ball = Manifold.sphere(RADIUS, 64).volume()
    assert 0.985 * ball < filled.solid.volume() <= ball
    assert len(filled.solid.decompose()) == 1
    points, _ = sample_surface(from_manifold(filled.solid), 20_000, np.random.default_rng(0))
    radii = np.linalg.norm(points, axis=1)
    assert radii.max() < RADIUS + 1e-4
    assert (radii > RADIUS - 1e-4).mean() > 0.98  # all but the dimple where the opening was


def test_a_void_behind_a_wide_opening_stays():
    filled = fill_voids(drilled(0.007))
    assert filled.volume == 0.0
    assert filled.solid.volume() == pytest.approx(drilled(0.007).volume())


def test_holes_slits_and_cups_stay():
    block = Manifold.cube([0.06, 0.04, 0.03], center=True)
    narrow_slit = block - Manifold.cube([0.05, 0.002, 0.04], center=True)
    torus = ring(circle(0.008, 32) + np.array([0.012, 0.0]), 64)
    mug = to_manifold(generate.draw("mug", 0)[0])
    for solid in (narrow_slit, torus, mug):
        filled = fill_voids(solid)
        assert filled.volume == 0.0
        assert filled.solid.genus() == solid.genus()


def test_the_filling_does_not_reach_outside():
    """A box with a slotted front: the filled solid adds nothing outside the box's own outline."""
    outer = Manifold.cube([0.05, 0.05, 0.05], center=True)
    hollow = outer - Manifold.cube([0.042, 0.042, 0.042], center=True)
    slotted = hollow - Manifold.cube([0.003, 0.03, 0.1], center=True)
    filled = fill_voids(slotted)
    assert filled.volume > 0.9 * 0.042**3
    assert (filled.solid - outer).volume() < 1e-4 * outer.volume()
    points, _ = sample_surface(from_manifold(outer), 5000, np.random.default_rng(1))
    assert np.quantile(distance_to_mesh(points, from_manifold(filled.solid)), 0.9) < 1e-4
