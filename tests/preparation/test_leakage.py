"""Copies of a shape are found whatever their pose, mirror image, scale or triangulation; other shapes are not."""

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, simplify, to_manifold
from tslam_bench.preparation import leakage
from tslam_bench.sources.generator import generate


def copy_of(mesh: TriangleMesh, seed: int, mirror: bool, triangles: int = 2000) -> TriangleMesh:
    """The mesh simplified, turned, mirrored if asked to, scaled and moved."""
    generator = np.random.default_rng(seed)
    reduced = from_manifold(simplify(to_manifold(mesh), triangles))
    turn = Rotation.random(rng=generator).as_matrix() @ np.diag([1, 1, -1 if mirror else 1])
    vertices = generator.uniform(0.3, 3) * reduced.vertices @ turn.T + generator.normal(size=3)
    return TriangleMesh(vertices, reduced.faces[:, ::-1] if mirror else reduced.faces)


@pytest.fixture(scope="module")
def references():
    return [leakage.normalise(name, generate.draw(name, 0)[0]) for name in ("mug", "quadruped", "frying-pan", "wrench")]


@pytest.mark.parametrize(
    ("name", "mirror"), [("mug", False), ("quadruped", True), ("frying-pan", False), ("wrench", True)]
)
def test_copies_are_found(references, name, mirror):
    match = leakage.closest(copy_of(generate.draw(name, 0)[0], 1, mirror), references)
    assert match.name == name
    assert match.overlap > leakage.MAX_OVERLAP
    assert match.is_copy


@pytest.mark.parametrize("name", ["mug", "quadruped", "screwdriver", "book"])
def test_other_shapes_are_not_copies(references, name):
    assert not leakage.closest(generate.draw(name, 1)[0], references).is_copy


def test_overlap_of_boxes_has_a_closed_form():
    """A cube and a slightly taller box, both normalised: the best overlap is that of concentric, aligned boxes."""
    proportions = np.array([1.0, 1.0, 1.2])
    cube = leakage.normalise("cube", from_manifold(Manifold.cube([1, 1, 1])))
    tall = leakage.normalise("tall", from_manifold(Manifold.cube(proportions)))
    edge_cube = 2.0  # mean squared distance to the centre of an a x b x c box: (a^2 + b^2 + c^2) / 12
    edges_tall = proportions * np.sqrt(12 / (proportions**2).sum())
    common = np.minimum(edge_cube, edges_tall).prod()
    expected = common / (edge_cube**3 + edges_tall.prod() - common)
    assert leakage.overlap(cube, tall) == pytest.approx(expected, abs=0.02)


def test_normalisation_is_exact():
    shape = leakage.normalise("box", from_manifold(Manifold.cube([0.3, 0.2, 0.1])))
    edges = np.array([0.3, 0.2, 0.1]) * np.sqrt(12 / (0.09 + 0.04 + 0.01))
    np.testing.assert_allclose(shape.mesh.bounds, [-edges / 2, edges / 2], atol=1e-9)
    assert shape.volume == pytest.approx(edges.prod())


def test_a_mesh_without_volume_is_refused():
    flat = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float), np.array([[0, 1, 2], [0, 2, 1]]))
    with pytest.raises(AssetError, match="volume"):
        leakage.normalise("flat", flat)
