"""Openings of surfaces: what is closed, what stays open, what is refused; and that repair keeps the inside of closed bodies."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, to_manifold
from tslam_bench.preparation import openings, repair
from tslam_bench.preparation.openings import MAX_HOLE, MAX_MOUTH, close, find_openings


def plate_with_hole(size: tuple[float, float, float], hole: np.ndarray) -> TriangleMesh:
    """A box of edges ``size`` (m) whose underside has a hole with the corners ``hole`` (4 N, 2), N in each quadrant."""
    x, y, z = np.array(size) / 2
    low = [[x, y, -z], [-x, y, -z], [-x, -y, -z], [x, -y, -z]]
    vertices = np.array([*low, *([a, b, z] for a, b, _ in low), *([a, b, -z] for a, b in hole)])
    per, faces = len(hole) // 4, [[4, 5, 6], [4, 6, 7]]
    for k in range(4):
        n = (k + 1) % 4
        rim = [8 + (k * per + j) % len(hole) for j in range(per + 1)]
        faces += [[k, n, 4 + n], [k, 4 + n, 4 + k], [k, rim[-1], n]]
        faces += [[k, a, b] for a, b in itertools.pairwise(rim)]
    return TriangleMesh(vertices, np.array(faces))


def circle(diameter: float, corners: int = 32) -> np.ndarray:
    turns = 2 * np.pi * np.arange(corners) / corners
    return diameter / 2 * np.stack([np.cos(turns), np.sin(turns)], axis=1)


def carton(diameter: float, size: tuple[float, float, float] = (0.18, 0.13, 0.09)) -> TriangleMesh:
    return plate_with_hole(size, circle(diameter))


VOLUME = 0.18 * 0.13 * 0.09


def bottle(neck: float) -> TriangleMesh:
    """A skin without thickness: a bottle of 7 cm across and 18 cm with an open neck of this diameter (m)."""
    profile = [[0, 0], [0.035, 0], [0.035, 0.12], [neck / 2, 0.15], [neck / 2, 0.18]]
    mesh = trimesh.creation.revolve(np.array(profile), sections=48)
    mesh.merge_vertices()
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Surfaces are rebuilt on coarser grids, to be faster."""
    monkeypatch.setattr(repair, "REMESH_CELLS", 128)
    monkeypatch.setattr(repair, "BALL_CELLS", 128)


def test_a_hole_in_a_wall_is_told_from_a_mouth() -> None:
    (hole,) = find_openings(carton(0.02))
    assert hole.in_wall and hole.width == pytest.approx(0.02, rel=0.01)
    (mouth,) = find_openings(bottle(0.02))
    assert not mouth.in_wall and mouth.width == pytest.approx(0.02, rel=0.01)
    no_lid = carton(0.01)
    no_lid = no_lid._replace(faces=no_lid.faces[2:])
    lid, small = sorted(find_openings(no_lid), key=lambda o: -o.width)
    assert not lid.in_wall and small.in_wall
    assert find_openings(from_manifold(to_manifold(TriangleMesh(*trimesh_box())))) == []


def trimesh_box() -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box(extents=[0.1, 0.1, 0.1])
    return np.array(box.vertices), np.array(box.faces, dtype=np.int64)


def test_the_width_of_a_slit_is_twice_its_breadth() -> None:
    slit = np.repeat([[0.05, 0.001], [-0.05, 0.001], [-0.05, -0.001], [0.05, -0.001]], 1, axis=0)
    (opening,) = find_openings(plate_with_hole((0.18, 0.13, 0.09), slit))
    assert opening.width == pytest.approx(4 * 0.1 * 0.002 / 0.204)


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [
        (carton(0.024), "damage"),
        (carton(0.026), "unclear"),
        (carton(0.017, (0.06, 0.05, 0.05)), "unclear"),  # above a quarter of the longest edge
        (carton(0.011, (0.05, 0.04, 0.04)), "damage"),
        (carton(0.1), "mouth"),  # more than half of the longest edge: how it was meant
        (bottle(0.007), "damage"),
        (bottle(0.017), "mouth"),
    ],
)
def test_what_an_opening_is_taken_for(mesh: TriangleMesh, kind: str) -> None:
    (opening,) = find_openings(mesh)
    assert opening.kind(mesh.extents) == kind


def test_closed_openings_leave_a_solid_of_the_right_volume() -> None:
    mesh = carton(0.02)
    two = TriangleMesh(mesh.vertices, np.delete(mesh.faces, 0, axis=0))
    solid = to_manifold(close(two, find_openings(two)))
    assert solid.volume() == pytest.approx(VOLUME, rel=1e-9)


def test_chains_that_cross_themselves_are_cut() -> None:
    """Two triangles are missing that meet in one corner."""
    sphere = trimesh.creation.icosphere(2, 0.05)
    first = sphere.faces[0]
    second = next(k for k, f in enumerate(sphere.faces) if len(set(f) & set(first)) == 1)
    mesh = TriangleMesh(
        np.array(sphere.vertices), np.delete(np.array(sphere.faces, dtype=np.int64), [0, second], axis=0)
    )
    found = find_openings(mesh)
    assert sorted(len(o.corners) for o in found) == [3, 3]
    assert to_manifold(close(mesh, found)).volume() == pytest.approx(sphere.volume)


@pytest.mark.usefixtures("coarse")
def test_a_closed_carton_with_a_hole_keeps_its_inside() -> None:
    mesh = carton(0.016)
    lost = repair._rebuilt(mesh)[0]
    assert lost.volume() < 0.3 * VOLUME  # what rebuilding alone makes of it: a shell
    repaired = repair.repair(mesh)
    assert repaired.method == "closed"
    assert repaired.solid.volume() == pytest.approx(VOLUME, rel=1e-6)
    np.testing.assert_allclose(from_manifold(repaired.solid).extents, mesh.extents)


@pytest.mark.usefixtures("coarse")
def test_a_hole_of_which_nobody_can_say_is_refused_in_one_line() -> None:
    with pytest.raises(AssetError, match=r"lose the inside through an opening of 40 mm \(.* of 2106 cm3") as caught:
        repair.repair(carton(0.04))
    assert "\n" not in str(caught.value) and "wall a thickness" in str(caught.value)


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("mesh", [bottle(0.02), carton(0.01)._replace(faces=carton(0.01).faces[2:])])
def test_vessels_stay_open(mesh: TriangleMesh) -> None:
    """An open neck, and a box without its lid."""
    repaired = repair.repair(mesh)
    assert repaired.method != "closed"
    solid = from_manifold(repaired.solid)
    inside = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    middle = mesh.bounds.mean(axis=0)
    assert not inside.contains([middle]).any()


@pytest.mark.usefixtures("coarse")
def test_a_body_of_a_hole_and_much_else_is_rebuilt_after_the_hole_is_closed() -> None:
    """A carton with a hole whose faces do not fit together elsewhere: a second sheet stands in it."""
    mesh = carton(0.016)
    count = len(mesh.vertices)
    sheet = np.array([[0.0, -0.02, -0.02], [0.0, 0.02, -0.02], [0.0, 0.0, 0.02]])
    both = TriangleMesh(
        np.concatenate([mesh.vertices, sheet]),
        np.concatenate([mesh.faces, [[count, count + 1, count + 2], [count, count + 2, count + 1]]]),
    )
    repaired = repair.repair(both)
    assert repaired.method == "closed"
    assert repaired.solid.volume() == pytest.approx(VOLUME, rel=0.05)


def test_the_limits_are_those_of_the_documentation() -> None:
    assert (MAX_HOLE, MAX_MOUTH) == (0.025, 0.008)
    assert (openings.MAX_HOLE_SHARE, openings.GAPING) == (0.25, 0.5)
