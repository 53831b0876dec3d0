"""Copies within the training splits are found by geometry and dropped, in the same way however they are prepared."""

import dataclasses

import numpy as np
import pytest
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from tslam_bench.geometry.meshes import TriangleMesh, from_manifold
from tslam_bench.objects import splits
from tslam_bench.preparation import copies, schedule
from tslam_bench.sources.generator import generate
from tslam_bench.sources.source import SourceMesh


def turned(mesh: TriangleMesh, factor: float, seed: int | None = None) -> TriangleMesh:
    """The mesh mirrored, scaled and turned: by a right angle about z, or at random."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=float)
    if seed is not None:
        turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    return TriangleMesh(factor * mesh.vertices * [1, -1, 1] @ turn.T, mesh.faces[:, ::-1])


def test_integrals_of_a_box_have_a_closed_form():
    edges = np.array([0.3, 0.2, 0.1])
    mesh = turned(from_manifold(Manifold.cube(edges)), 1.7, seed=3)
    radius = np.sqrt((edges**2).sum() / 12)
    deviations = np.sort(edges / np.sqrt(12)) / radius
    surface = 2 * (edges[0] * edges[1] + edges[0] * edges[2] + edges[1] * edges[2])
    measures, axes = copies.measure(mesh)
    np.testing.assert_allclose(measures, [edges.prod() / radius**3, surface / radius**2, *deviations], rtol=1e-9)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("name", ["frying-pan", "whisk", "stool", "spool"])
def test_copies_align(name):
    """Thin, branching, symmetric and round shapes, whatever their pose, mirror image and scale."""
    mesh, _ = generate.draw(name, 0)
    assert copies.aligned_overlap(turned(mesh, 0.6, seed=1), mesh) > copies.MAX_OVERLAP


def test_the_verdict_does_not_depend_on_the_order():
    """One search finds 0.966 from the first to the second and less the other way: asked again, the kept one was dropped."""
    first, second = generate.draw("trophy", 0)[0], generate.draw("trophy", 4)[0]
    value = copies.aligned_overlap(first, second)
    assert copies.aligned_overlap(second, first) == pytest.approx(value, abs=1e-9)
    assert value > copies.MAX_OVERLAP


@pytest.mark.parametrize("name", ["stool", "frying-pan", "carton"])
def test_other_draws_of_a_category_are_no_copies(name):
    first, second = generate.draw(name, 0)[0], generate.draw(name, 1)[0]
    differ = np.abs(np.log(copies.measure(first)[0] / copies.measure(second)[0])).max()
    assert differ > copies.MAX_DIFFERENCE or copies.aligned_overlap(first, second) <= copies.MAX_OVERLAP


@dataclasses.dataclass(frozen=True)
class TurnedSource:
    """A generated object once more: turned, mirrored and at another size, under another name."""

    split: str
    original: str
    factor: float

    @property
    def name(self) -> str:
        return f"turned-{self.original}-{self.split}"

    def fingerprint(self) -> str:
        return f"{self.name}:{self.factor}"

    def load(self, cache):
        mesh, _ = generate.draw(self.original, 0)
        return SourceMesh(
            self.name, self.split, "thing", turned(mesh, self.factor), "a test", "Apache-2.0", self.fingerprint()
        )


@pytest.mark.slow
def test_copies_are_dropped_and_remembered(tmp_path):
    """The copy goes, the next source takes its place, val gives way to train, and the order of the runs does not matter."""
    book, dumbbell, carton = (
        generate.GeneratedSource("train", *key) for key in [("book", 0), ("dumbbell", 0), ("carton", 1)]
    )
    copy, copy_in_val = TurnedSource("train", "book", 0.8), TurnedSource("val", "dumbbell", 0.9)
    assert [o.status for o in schedule.prepare_distinct([copy_in_val], cache=tmp_path)] == ["prepared"]

    outcomes = list(schedule.prepare_distinct([book, copy, dumbbell, carton], count=3, cache=tmp_path))
    final = {outcome.name: outcome for outcome in outcomes}
    assert {name: outcome.status for name, outcome in final.items()} == {
        "book-000": "prepared",
        copy.name: "rejected",
        "dumbbell-000": "prepared",
        "carton-001": "prepared",
    }
    assert "copy of train/book-000" in final[copy.name].message
    assert splits.prepared_names("train", tmp_path) == ["book-000", "carton-001", "dumbbell-000"]
    assert splits.prepared_names("val", tmp_path) == []

    again = {o.name: o for o in schedule.prepare_distinct([copy, book], cache=tmp_path)}
    assert again[copy.name].status == "rejected"
    assert again[copy.name].message == final[copy.name].message
    assert [o.status for o in schedule.prepare_distinct([copy_in_val], cache=tmp_path)] == ["rejected"]
