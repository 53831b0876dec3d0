"""Generated shapes: clean, of the intended topology, varied, and the same for the same seed."""

import numpy as np
import pytest
import trimesh

from tslam_bench.errors import InvalidInputError
from tslam_bench.sources.generator import generate, household


@pytest.mark.parametrize("category", sorted(household.CATEGORIES))
def test_every_category(category):
    kind = household.CATEGORIES[category]
    shapes = [generate.draw(category, index) for index in range(2)]
    for mesh, details in shapes:
        checked = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)  # a second judge beside manifold3d
        assert checked.is_watertight
        assert checked.is_winding_consistent
        assert checked.volume > 0
        assert checked.body_count == 1
        assert checked.euler_number == 2 - 2 * details["genus"]
        assert len(mesh.faces) <= generate.MAX_TRIANGLES
        longest = mesh.extents.max()
        assert 0.04 <= longest <= 0.24
        assert kind.size[0] * 0.99 <= longest <= kind.size[1] * 1.01
        np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-3)
    (first, _), (second, _) = shapes
    ratios = [np.sort(mesh.extents) / mesh.extents.max() for mesh in (first, second)]
    share = [mesh_volume(mesh) / mesh.extents.prod() for mesh in (first, second)]
    assert np.abs(ratios[0] - ratios[1]).max() > 0.005 or abs(share[0] - share[1]) > 0.005  # not scaled copies


def mesh_volume(mesh) -> float:
    return float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume)


def test_the_same_seed_gives_the_same_shape():
    first, _ = generate.draw("quadruped", 3)
    second, _ = generate.draw("quadruped", 3)
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()


def test_val_holds_out_whole_categories():
    categories = {split: {s.category for s in generate.candidates(split, rounds=1)} for split in ("train", "val")}
    assert len(categories["train"]) >= 25
    assert len(categories["val"]) >= 6
    assert not categories["train"] & categories["val"]


def test_candidates_take_every_category_in_turn():
    count = len({s.category for s in generate.candidates("train", rounds=1)})
    some = generate.candidates("train", rounds=3)
    assert len({s.name for s in some}) == 3 * count
    assert [s.category for s in some[:count]] == [s.category for s in some[count : 2 * count]]


def test_unknown_names():
    with pytest.raises(InvalidInputError, match="spaceship"):
        generate.draw("spaceship", 0)
    with pytest.raises(InvalidInputError, match="test"):
        generate.candidates("test")
