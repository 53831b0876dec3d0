"""Grid, hull and the priors against analytic shapes and independent computations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import Delaunay

from tslam_bench import grids
from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.sampling import iou_points
from tslam_bench.reconstruction.carve import CarveReconstructor, carved_voxels
from tslam_bench.reconstruction.grid import GridReconstructor
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.reconstruction.inputs import read_grids
from tslam_bench.reconstruction.priors import MeanShapeReconstructor, RetrievalReconstructor
from tslam_bench.reconstruction.registry import list_reconstructors, make_reconstructor
from tslam_bench.reconstruction.training_shapes import axis_rotations
from tslam_bench.scoring.metrics import iou

EMPTY = np.zeros((GRID_SIZE,) * 3, dtype=bool)


def voxel_range(distance):
    """Smallest and largest value over each voxel of a function that is monotone in |x|, |y|, |z|."""
    low = WORKSPACE_LOW + VOXEL_EDGE * np.arange(GRID_SIZE)
    near = np.maximum(np.maximum(low, -(low + VOXEL_EDGE)), 0.0)
    far = np.maximum(np.abs(low), np.abs(low + VOXEL_EDGE))
    return (distance(*np.meshgrid(axis, axis, axis, indexing="ij")) for axis in (near, far))


SHAPES = {
    "sphere": lambda r: lambda x, y, z: np.sqrt(x**2 + y**2 + z**2) - r,
    "box": lambda r: lambda x, y, z: np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)) - r,
    "cylinder": lambda r: lambda x, y, z: np.maximum(np.hypot(x, y), np.abs(z)) - r,
}


def crossed(shape: str, radius: float) -> np.ndarray:
    """Voxels that the surface of an analytic shape crosses, computed exactly."""
    nearest, furthest = voxel_range(SHAPES[shape](radius))
    return (nearest <= 0) & (furthest >= 0)


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return (first & second).sum() / (first | second).sum()


def random_touches(seed: int, count: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    touched = EMPTY.copy()
    touched[tuple(generator.integers(6, 26, (3, count)))] = True
    return touched


@pytest.mark.parametrize("radius", [0.02, 0.04, 0.06, 0.1])
def test_hull_of_a_sphere_is_a_sphere(radius):
    touched = crossed("sphere", radius)
    mesh = HullReconstructor().reconstruct(touched, EMPTY).to_mesh()
    distances = np.linalg.norm(mesh.vertices, axis=1)
    # The centre of a crossed voxel is within half a voxel diagonal of the surface, so no hull vertex is further out;
    # the hull holds every voxel centre inside the sphere, so it is nowhere deeper than a voxel diagonal.
    diagonal = np.sqrt(3) * VOXEL_EDGE
    assert distances.max() <= radius + diagonal / 2 + 1e-6
    assert distances.min() >= radius - diagonal
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert 4 / 3 * np.pi * (radius - diagonal) ** 3 < mesh.volume < 4 / 3 * np.pi * (radius + diagonal / 2) ** 3
    # Symmetric about the centre as the sphere is, to a hundredth of a voxel.
    assert np.abs(mesh.center_mass).max() < 0.01 * VOXEL_EDGE


@pytest.mark.parametrize("shape", list(SHAPES))
def test_oracle_touches_of_large_convex_shapes_reach_the_solid(shape):
    sample = iou_points(np.full(3, -0.06), np.full(3, 0.06), (50, 50, 50))
    true = SHAPES[shape](0.06)(*sample.points.T) <= 0
    predicted = HullReconstructor().reconstruct(crossed(shape, 0.06), EMPTY).query(sample.points) >= 0.5
    assert iou(predicted, true, sample.weights) >= 0.85


@pytest.mark.parametrize(("seed", "count"), [(0, 4), (1, 6), (2, 15), (3, 200)])
def test_hull_agrees_with_half_space_membership(seed, count):
    touched = random_touches(seed, count)
    centres = grids.voxel_centres()[touched]
    points = np.random.default_rng(9).uniform(WORKSPACE_LOW, -WORKSPACE_LOW, (20_000, 3))
    expected = Delaunay(centres).find_simplex(points) >= 0  # a triangulation of the hull: other code than ConvexHull's
    volume = HullReconstructor().reconstruct(touched, EMPTY)
    predicted = volume.query(points) >= 0.5
    # Sharp edges are rounded by less than a cell: compare exactly where the whole neighbourhood agrees.
    nudges = volume.cell_edge * np.array(list(itertools.product((-1, 1), repeat=3)))
    around = Delaunay(centres).find_simplex(points[:, None] + nudges) >= 0
    settled = (around == expected[:, None]).all(axis=1)
    assert settled.mean() > 0.8
    assert np.array_equal(predicted[settled], expected[settled])
    if count > 10:
        assert overlap(predicted, expected) > 0.98


@pytest.mark.parametrize(
    "voxels",
    [
        [(10, 20, 5)],
        [(3, 3, 3), (9, 3, 3)],
        [(4, 4, 4), (6, 6, 6), (9, 9, 9)],
        [(4, 4, 7), (20, 4, 7), (4, 20, 7), (20, 20, 7), (12, 11, 7)],
        [(1, 2, 3), (5, 9, 20), (30, 12, 8)],
    ],
)
def test_touches_without_volume_give_the_hull_of_their_voxels(voxels):
    touched = EMPTY.copy()
    touched[tuple(np.array(voxels).T)] = True
    corners = np.array([np.array(v) + c for v in voxels for c in itertools.product((0, 1), repeat=3)])
    hull = Delaunay(WORKSPACE_LOW + VOXEL_EDGE * corners)
    points = WORKSPACE_LOW + VOXEL_EDGE * np.random.default_rng(4).uniform(-0.99, 33, (60_000, 3))
    points = points[np.abs(points).max(axis=1) < WORKSPACE_EDGE / 2]
    expected = hull.find_simplex(points) >= 0
    volume = HullReconstructor().reconstruct(touched, EMPTY)
    nudges = volume.cell_edge * np.array(list(itertools.product((-1, 1), repeat=3)))
    settled = ((hull.find_simplex(points[:, None] + nudges) >= 0) == expected[:, None]).all(axis=1)
    assert np.array_equal((volume.query(points) >= 0.5)[settled], expected[settled])
    assert (volume.query(grids.voxel_centres()[touched]) >= 0.5).all()
    assert volume.to_mesh().volume > 0


def test_single_touched_voxel_is_that_voxel():
    touched = EMPTY.copy()
    touched[4, 15, 31] = True
    mesh = HullReconstructor().reconstruct(touched, EMPTY).to_mesh()
    low = WORKSPACE_LOW + VOXEL_EDGE * np.array([4, 15, 31])
    assert np.allclose(mesh.bounds, [low, low + VOXEL_EDGE], atol=1e-4)


def test_hull_ignores_free_space_and_the_order_of_axes():
    touched = random_touches(5, 30)
    visited = random_touches(6, 500)
    first = HullReconstructor().reconstruct(touched, EMPTY).probability
    assert np.array_equal(first, HullReconstructor().reconstruct(touched, visited).probability)
    turned = HullReconstructor().reconstruct(touched.transpose(2, 0, 1), EMPTY).probability
    assert np.allclose(turned, first.transpose(2, 0, 1), atol=1e-6)


def test_grid_round_trip():
    touched = random_touches(1, 300)
    volume = GridReconstructor().reconstruct(touched, EMPTY)
    assert np.array_equal(volume.query(grids.voxel_centres().reshape(-1, 3)).reshape(touched.shape) >= 0.5, touched)
    points = np.random.default_rng(0).uniform(WORKSPACE_LOW, -WORKSPACE_LOW, (100_000, 3))
    assert np.array_equal(
        grids.points_to_grid(points[volume.query(points) >= 0.5]), touched & grids.points_to_grid(points)
    )
    assert volume.to_mesh().volume == pytest.approx(touched.sum() * VOXEL_EDGE**3, rel=1e-9)


@pytest.mark.parametrize("name", ["grid", "hull", "carve"])
def test_nothing_touched_gives_nothing(name):
    volume = make_reconstructor(name).reconstruct(EMPTY, random_touches(0, 100))
    assert not volume.probability.any()
    assert len(volume.to_mesh().faces) == 0


@pytest.mark.parametrize("name", ["grid", "hull", "carve"])
@pytest.mark.parametrize("bad", [np.zeros((31, 32, 32), bool), np.full((32,) * 3, 0.5), np.full((32,) * 3, np.nan)])
def test_bad_grids_are_refused(name, bad):
    with pytest.raises(InvalidInputError, match=r"^(touched|visited): "):
        make_reconstructor(name).reconstruct(bad, EMPTY)
    with pytest.raises(InvalidInputError, match=r"^visited: "):
        make_reconstructor(name).reconstruct(EMPTY, bad)


def test_registry_names_what_it_knows():
    names = [info.id for info in list_reconstructors()]
    assert names[:4] == ["grid", "hull", "carve", "ifnet"]
    assert len(set(names)) == len(names)
    with pytest.raises(InvalidInputError, match=", ".join(names)):
        make_reconstructor("poisson")
    with pytest.raises(InvalidInputError, match="needs a model"):
        make_reconstructor("ifnet")
    with pytest.raises(InvalidInputError, match="takes no model"):
        make_reconstructor("hull", model="somewhere.pt")


# --- Carve ---------------------------------------------------------------------------------------------------------
def block(low: tuple[int, int, int], high: tuple[int, int, int]) -> np.ndarray:
    """Voxels from ``low`` up to and without ``high``."""
    grid = EMPTY.copy()
    grid[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    return grid


def shell(grid: np.ndarray) -> np.ndarray:
    return grid & ~binary_erosion(grid)


def test_carve_of_a_box_with_a_visited_tunnel():
    box = block((8, 8, 8), (20, 24, 18))
    tunnel = block((8, 12, 10), (20, 16, 14))
    touched = shell(box) & ~tunnel
    kept = carved_voxels(touched, tunnel)
    assert np.array_equal(kept, box & ~tunnel)
    volume = CarveReconstructor().reconstruct(touched, tunnel)
    at_centres = volume.query(grids.voxel_centres().reshape(-1, 3)).reshape(kept.shape) >= 0.5
    assert np.array_equal(at_centres, kept)
    # From centre to centre outside, from face to face inside; only the tunnel's edges and the box's corners are rounded.
    expected = (11 * 15 * 9 - 11 * 4 * 4) * VOXEL_EDGE**3
    assert volume.to_mesh().volume == pytest.approx(expected, rel=0.02)
    assert volume.to_mesh().euler_number == 0  # a ring


def test_carve_without_free_space_is_the_hull():
    """Where the hull is thick; a voxel of the hull that no face connects with a touched one is left out."""
    touched = shell(block((6, 9, 12), (20, 22, 25)))
    hull, carve = (make_reconstructor(name).reconstruct(touched, EMPTY) for name in ("hull", "carve"))
    points = np.random.default_rng(0).uniform(WORKSPACE_LOW, -WORKSPACE_LOW, (50_000, 3))
    assert np.array_equal(hull.query(points) >= 0.5, carve.query(points) >= 0.5)


def test_carve_parts_two_solids_when_the_space_between_was_visited():
    one, other = block((4, 10, 10), (10, 16, 16)), block((20, 10, 10), (26, 16, 16))
    between = block((10, 0, 0), (20, 32, 32))
    kept = carved_voxels(shell(one) | shell(other), between)
    assert np.array_equal(kept, one | other)
    assert carved_voxels(shell(one) | shell(other), EMPTY).sum() == 22 * 6 * 6  # not visited: one bar
    assert CarveReconstructor().reconstruct(shell(one) | shell(other), between).to_mesh().body_count == 2


def test_carve_drops_what_no_touch_holds():
    """A piece of the hull that free space cuts off from all touches, also where only edges connect them."""
    touched = shell(block((4, 4, 4), (24, 24, 24)))
    inner = block((10, 10, 10), (14, 14, 14))
    moat = block((9, 9, 9), (15, 15, 15)) & ~inner
    assert not (carved_voxels(touched, moat) & inner).any()
    opened = moat & ~block((9, 9, 9), (10, 10, 10))  # a corner: it touches the inner piece at a point only
    assert not (carved_voxels(touched, opened) & inner).any()
    bridged = moat & ~block((9, 12, 12), (10, 13, 13))
    assert (carved_voxels(touched, bridged) & inner).sum() == inner.sum()


def test_carve_keeps_touched_voxels_that_were_visited():
    touched = random_touches(3, 60)
    kept = carved_voxels(touched, ~EMPTY)
    assert np.array_equal(kept, touched)
    volume = CarveReconstructor().reconstruct(touched, ~EMPTY)
    assert (volume.query(grids.voxel_centres()[touched]) >= 0.5).all()


def test_carve_of_one_touch_holds_its_voxel_and_no_other():
    touched = EMPTY.copy()
    touched[4, 15, 31] = True
    for visited in (EMPTY, ~EMPTY):
        assert np.array_equal(carved_voxels(touched, visited), touched)
        mesh = CarveReconstructor().reconstruct(touched, visited).to_mesh()
        low = WORKSPACE_LOW + VOXEL_EDGE * np.array([4, 15, 31])
        assert mesh.is_watertight
        assert (mesh.bounds[0] >= low - 1e-6).all() and (mesh.bounds[1] <= low + VOXEL_EDGE + 1e-6).all()
        assert (np.abs(mesh.center_mass - low - VOXEL_EDGE / 2)[:2] < 1e-6).all()


@pytest.mark.parametrize("seed", range(4))
def test_carved_voxels_agree_with_a_flood(seed):
    """Membership in the hull by triangulation, connection by growing from the touches: other code than the carver's."""
    touched, visited = random_touches(seed, 40), random_touches(seed + 10, 6000)
    inside = Delaunay(grids.voxel_centres()[touched]).find_simplex(grids.voxel_centres(), tol=1e-9) >= 0
    allowed = touched | (inside & ~visited)
    kept, before = touched, EMPTY
    while not np.array_equal(kept, before):
        before, kept = kept, binary_dilation(kept) & allowed
    assert 0 < (allowed & ~kept).sum() < allowed.sum()
    assert np.array_equal(carved_voxels(touched, visited), kept)


# --- Priors --------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def library():
    """Solid and surface voxels (3, 32, 32, 32) of an L of two boxes, a half ball and a torus, centred nowhere special."""
    x, y, z = np.moveaxis(grids.voxel_centres(), -1, 0)
    solids = np.stack(
        [
            (np.abs(x) < 0.06) & (np.abs(y) < 0.03) & (np.abs(z) < 0.03)
            | (np.abs(x - 0.05) < 0.02) & (np.abs(y) < 0.03) & (np.abs(z - 0.03) < 0.05),
            (x**2 + y**2 + z**2 < 0.07**2) & (y < 0.02),
            (np.hypot(x, y) - 0.06) ** 2 + z**2 < 0.022**2,
        ]
    )
    surfaces = np.stack([binary_dilation(solid) & ~binary_erosion(solid) for solid in solids])
    return solids, surfaces


def test_axis_rotations_are_the_rotations_of_the_cube():
    rotations = axis_rotations()
    keys = {tuple(r.ravel()) for r in rotations}
    assert len(keys) == 24
    assert all(round(np.linalg.det(r)) == 1 for r in rotations)
    assert {tuple((a @ b).ravel()) for a in rotations for b in rotations} == keys


def test_turned_grids_follow_their_voxel_centres():
    grid = random_touches(8, 50)
    for rotation in axis_rotations():
        moved = grids.points_to_grid(grids.voxel_centres()[grid] @ rotation.T)
        assert np.array_equal(grids.turn(grid, rotation), moved)


def test_mean_shape_is_the_best_level_of_the_mean(library):
    solids, surfaces = library
    volume = MeanShapeReconstructor(solids).reconstruct(EMPTY, EMPTY)
    share = solids.mean(axis=0)
    best = max(np.mean([overlap(share >= level - 1e-9, solid) for solid in solids]) for level in (1 / 3, 2 / 3, 1.0))
    chosen = volume.query(grids.voxel_centres().reshape(-1, 3)).reshape(share.shape) >= 0.5
    assert np.mean([overlap(chosen, solid) for solid in solids]) == pytest.approx(best)
    again = MeanShapeReconstructor(solids).reconstruct(surfaces[0], ~solids[0])
    assert np.array_equal(again.probability, volume.probability)


def test_mean_shape_of_one_object_is_that_object(library):
    volume = MeanShapeReconstructor(library[0][:1]).reconstruct(EMPTY, EMPTY)
    assert np.array_equal(volume.probability >= 0.5, library[0][0])


@pytest.mark.parametrize("index", [0, 1, 2])
def test_retrieval_finds_the_shape_however_it_is_turned(library, index):
    generator = np.random.default_rng(index)
    for rotation in axis_rotations():
        surface, solid = (grids.turn(grid[index], rotation) for grid in (library[1], library[0]))
        touched = surface & (generator.random(surface.shape) < 0.15)
        visited = ~solid & (generator.random(surface.shape) < 0.5)
        volume = RetrievalReconstructor(*library).reconstruct(touched, visited)
        assert np.array_equal(volume.probability >= 0.5, solid)  # its symmetries may give another rotation


def test_retrieval_needs_touches_and_objects(library):
    solids, surfaces = library
    assert not RetrievalReconstructor(solids, surfaces).reconstruct(EMPTY, ~EMPTY).probability.any()
    with pytest.raises(InvalidInputError, match="training solids"):
        MeanShapeReconstructor(solids[:0])
    with pytest.raises(InvalidInputError, match="training surfaces: 2 for 3"):
        RetrievalReconstructor(solids, surfaces[:2])


# --- Files ---------------------------------------------------------------------------------------------------------
def test_grids_are_read_packed_and_plain(tmp_path):
    touched, visited = random_touches(0, 40), random_touches(1, 900)
    np.savez(tmp_path / "plain.npz", touched=touched, visited=visited.astype(np.uint8))
    np.savez(tmp_path / "packed.npz", touched=grids.pack(touched), visited=grids.pack(visited))
    np.savez(tmp_path / "alone.npz", touched=touched)
    for name in ("plain.npz", "packed.npz"):
        read = read_grids(tmp_path / name)
        assert np.array_equal(read[0], touched)
        assert np.array_equal(read[1], visited)
    assert not read_grids(tmp_path / "alone.npz")[1].any()


def test_bad_grid_files_are_refused_in_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", visited=EMPTY)
    np.savez(tmp_path / "shape.npz", touched=np.zeros((4, 4)))
    np.savez(tmp_path / "object.npz", touched=np.array([{"a": 1}], dtype=object))
    np.savez(tmp_path / "whole.npz", touched=EMPTY)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:200])
    np.save(tmp_path / "single.npz.npy", EMPTY)
    for name in ("missing.npz", "text.npz", "other.npz", "shape.npz", "object.npz", "cut.npz", "single.npz.npy"):
        with pytest.raises(InvalidInputError, match=name) as caught:
            read_grids(tmp_path / name)
        assert "\n" not in str(caught.value)
