"""Collected touches, the dense network, its level and what it is unsure of."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from prepared_shapes import prepare_primitive

from tslam_bench.constants import GRID_SIZE, NUM_POSES, VOXEL_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import turn, voxel_centres
from tslam_bench.objects.store import PreparedObject
from tslam_bench.reconstruction import unet
from tslam_bench.reconstruction.dense import SYMMETRIES, DenseReconstructor
from tslam_bench.reconstruction.learned import NETWORKS, build_network
from tslam_bench.reconstruction.levels import level_of_best_iou, volume_at_level
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.touch_data import (
    COUNTS_SIZE,
    NEVER,
    SIMULATED_FOLDER,
    ExampleMixture,
    ExploredObject,
    SimulatedObject,
    TouchObject,
    draw_example,
    load_touch_data,
    random_symmetry,
    simulate_object,
)
from tslam_bench.reconstruction.trained import load_reconstructor
from tslam_bench.reconstruction.training import draw_batch, train
from tslam_bench.reconstruction.training_config import TrainingConfig
from tslam_bench.reconstruction.weights import save_weights
from tslam_bench.scoring.metrics import calibration_error, iou

torch.set_num_threads(1)
EMPTY = np.zeros((GRID_SIZE,) * 3, dtype=bool)
SMALLEST = unet.UNetConfig(level_channels=(8, 8))
TINY = TrainingConfig(architecture="unet", steps=6, batch_size=2, save_every=2, average=0.9, weight_decay=0.01)
EXPLORED, SIMULATED = ExampleMixture(simulated=0, whole_surface=0), ExampleMixture(simulated=1, whole_surface=0)


@pytest.fixture
def smallest_unet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NETWORKS["unet"], "small", SMALLEST)


@pytest.fixture(scope="module")
def angle() -> PreparedObject:
    """A solid without any symmetry: three boxes of different lengths that share a corner."""
    boxes = [
        trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))
        for extents, centre in (
            ((0.12, 0.03, 0.03), (0.0, -0.03, -0.02)),
            ((0.03, 0.09, 0.03), (-0.045, 0.0, -0.02)),
            ((0.03, 0.03, 0.07), (-0.045, -0.03, 0.0)),
        )
    ]
    mesh = trimesh.boolean.union(boxes)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return prepare_primitive(mesh, boxes, "angle")


def episodes_of(item: PreparedObject, seed: int = 0) -> ExploredObject:
    """Eight episodes that feel random parts of the surface, a voxel at a time."""
    generator = np.random.default_rng(seed)
    first = np.full((NUM_POSES, 2, *(GRID_SIZE,) * 3), NEVER, dtype=np.uint8)
    for pose in range(NUM_POSES):
        felt = np.argwhere(item.surface)[generator.permutation(item.surface.sum())[:100]]
        first[pose, 0][tuple(felt.T)] = generator.permutation(200)[:100]
        swept = np.argwhere(~item.solid)[generator.permutation((~item.solid).sum())[:3000]]
        first[pose, 1][tuple(swept.T)] = generator.integers(0, 200, 3000)
    return ExploredObject(first, np.arange(NUM_POSES))


@pytest.fixture(scope="module")
def data(angle: PreparedObject) -> TouchObject:
    simulated = simulate_object(angle, 3, np.random.default_rng(1))
    return TouchObject.of(angle, [episodes_of(angle, 0), episodes_of(angle, 1)], simulated)


def test_solid_counts_are_the_analytic_ball_at_every_scale(sphere: PreparedObject) -> None:
    radius = float(np.linalg.norm(sphere.vertices, axis=1).max())
    item = TouchObject.of(sphere, [], None)
    for scale in (1.0, 0.7, 1.15):
        counts = item.counts if scale == 1 else item.scaled(scale)
        distance = np.linalg.norm(voxel_centres(COUNTS_SIZE), axis=-1)
        margin = 0.004  # half a diagonal of a cell, and the facets of the mesh
        assert (counts[distance < scale * radius - margin] == 8).all()
        assert (counts[distance > scale * radius + margin] == 0).all()
        volume = counts.sum() * (0.25 / 128) ** 3
        assert volume == pytest.approx(4 / 3 * np.pi * (scale * radius) ** 3, rel=0.02)


@pytest.mark.parametrize("mixture", [EXPLORED, SIMULATED, ExampleMixture(whole_surface=1)], ids=["e", "s", "w"])
def test_touches_and_solid_are_turned_together(data: TouchObject, mixture: ExampleMixture) -> None:
    """Whatever the symmetry: what was touched is in voxels that are partly solid and partly not, or next to such."""
    generator = np.random.default_rng(2)
    for _ in range(25):
        example = draw_example(data, mixture, generator)
        padded = np.pad(example.counts.astype(int), 1, mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (4, 4, 4))[
            ::2, ::2, ::2
        ]  # a voxel and a cell around it
        mixed = (windows.min(axis=(3, 4, 5)) < 8) & (windows.max(axis=(3, 4, 5)) > 0)
        assert example.grids[0].any() and not (example.grids[0] & ~mixed).any()


def test_symmetries_are_all_48_and_the_views_are_among_them() -> None:
    generator = np.random.default_rng(0)
    drawn = {random_symmetry(generator).tobytes() for _ in range(2000)}
    assert len(drawn) == 48
    assert len({np.asarray(s, dtype=np.int64).tobytes() for s in SYMMETRIES} & drawn) == len(SYMMETRIES) == 8


def test_an_explored_example_unites_poses_up_to_a_step(data: TouchObject) -> None:
    """Against every union of one policy's poses, cut at every step, in every symmetry: by the number of voxels."""
    both = ExampleMixture(simulated=0, whole_surface=0, cut=1.0, one_policy=1.0, poses=(0, 1, 0, 0, 0, 0, 0, 0))
    possible = set()
    for explored in data.explored:
        for first_pose in range(NUM_POSES):
            for second in range(first_pose):
                earliest = np.minimum(explored.first[first_pose], explored.first[second])
                for until in range(1, 200):
                    felt = earliest < until
                    possible.add((int(felt[0].sum()), int(felt[1].sum())))
    generator = np.random.default_rng(3)
    for _ in range(50):
        grids = draw_example(data, both, generator).grids
        assert (int(grids[0].sum()), int(grids[1].sum())) in possible


def test_files_come_back_and_damaged_ones_are_one_line(
    data: TouchObject, angle: PreparedObject, tmp_path: Path
) -> None:
    for index, explored in enumerate(data.explored):
        explored.save(tmp_path / f"policy{index}", angle.name)
    assert data.simulated is not None
    data.simulated.save(tmp_path / SIMULATED_FOLDER, angle.name)
    (again,) = load_touch_data(tmp_path, [angle])
    for first, second in zip(data.explored, again.explored, strict=True):
        assert np.array_equal(first.first, second.first) and np.array_equal(first.poses, second.poses)
    assert again.simulated is not None and np.array_equal(again.simulated.grids, data.simulated.grids)
    assert np.array_equal(again.counts, data.counts)
    path = tmp_path / "policy0" / f"{angle.name}.npz"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InvalidInputError, match=r"policy0/angle\.npz: cannot be read; delete it"):
        load_touch_data(tmp_path, [angle])
    np.savez(path, first=np.zeros((8, 2, 4, 4, 4), np.uint8), poses=np.arange(8))
    with pytest.raises(InvalidInputError, match="holds no explored episodes"):
        load_touch_data(tmp_path, [angle])
    path.unlink()
    with pytest.raises(InvalidInputError, match="missing; collect it with"):
        load_touch_data(tmp_path, [angle])
    with pytest.raises(InvalidInputError, match="holds no collected touches"):
        load_touch_data(tmp_path / "nowhere", [angle])
    with pytest.raises(InvalidInputError, match="missing"):
        SimulatedObject.load(tmp_path / SIMULATED_FOLDER, "other")


def test_examples_depend_on_the_generator_alone(data: TouchObject) -> None:
    config = dataclasses.replace(TINY, batch_size=6)
    first, second = (draw_batch([data], config, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.grids, second.grids) and np.array_equal(first.labels, second.labels)
    assert first.points is None and first.labels.shape == (6, 64, 64, 64)
    assert first.labels.min() >= 0 and first.labels.max() == 1


def test_points_of_collected_touches_carry_their_cells_share(data: TouchObject) -> None:
    config = TrainingConfig(architecture="ifnet", batch_size=1, points=4000)
    batch = draw_batch([data], config, np.random.default_rng(6))
    assert batch.points is not None and batch.points.shape == (1, 4000, 3) and np.abs(batch.points).max() <= 0.125
    solid = dataclasses.replace(TINY, batch_size=1)
    cells = draw_batch([data], solid, np.random.default_rng(6)).labels[0]
    index = np.floor((batch.points[0] + 0.125) / (0.25 / COUNTS_SIZE)).astype(int)
    assert np.allclose(batch.labels[0], cells[tuple(index.T)])  # the same draw of object, episodes and symmetry


def test_level_has_the_best_mean_iou_over_truths_drawn_from_the_probabilities() -> None:
    generator = np.random.default_rng(7)
    for power in (1, 3, 8):
        probability = generator.random(20_000) ** power
        level = level_of_best_iou(probability)
        truths = generator.random((40, len(probability))) < probability
        candidates = np.append(np.arange(0.1, 0.61, 0.02), level)
        means = [np.mean([iou(probability >= t, truth) for truth in truths]) for t in candidates]
        assert means[-1] >= max(means) - 1e-3
        assert level < 0.5 - 1e-3


@pytest.mark.parametrize("probability", [np.zeros(100), np.ones(100), np.repeat([0.02, 0.95], 50)])
def test_level_of_certain_volumes_is_a_half(probability: np.ndarray) -> None:
    assert level_of_best_iou(probability) == 0.5


class Answers(torch.nn.Module):
    """Logits that follow from the touched grid alone, or, if ``place`` is not 0, from the cell's place too."""

    def __init__(self, place: float = 0.0) -> None:
        super().__init__()
        self.place = torch.from_numpy((place * voxel_centres(64)[..., 0] / VOXEL_EDGE).astype(np.float32))

    def forward(self, grids: torch.Tensor) -> torch.Tensor:
        fine = grids[:, 0].repeat_interleave(2, 1).repeat_interleave(2, 2).repeat_interleave(2, 3)
        return 6 * fine - 3 + self.place


def test_views_are_turned_back(angle: PreparedObject) -> None:
    expected = 1 / (1 + np.exp(3 - 6 * angle.surface.repeat(2, 0).repeat(2, 1).repeat(2, 2).astype(float)))
    belief = DenseReconstructor("unet", [Answers()], views=8).believe(angle.surface, ~angle.solid)
    assert np.allclose(belief.probability, expected, atol=1e-6) and belief.variance.max() < 1e-12
    assert np.allclose(
        belief.entropy, -(expected * np.log(expected) + (1 - expected) * np.log(1 - expected)), atol=1e-5
    )
    partial = DenseReconstructor("unet", [Answers(place=0.1)], views=8).believe(angle.surface, ~angle.solid)
    assert partial.variance.max() > 1e-3


def test_networks_are_averaged_and_their_disagreement_is_the_variance(angle: PreparedObject) -> None:
    class Constant(torch.nn.Module):
        def __init__(self, logit: float) -> None:
            super().__init__()
            self.logit = logit

        def forward(self, grids: torch.Tensor) -> torch.Tensor:
            return torch.full((len(grids), 16, 16, 16), self.logit)

    belief = DenseReconstructor("unet", [Constant(0.0), Constant(float(np.log(3)))], views=2).believe(
        angle.surface, EMPTY
    )
    assert np.allclose(belief.probability, 0.625) and np.allclose(belief.variance, 0.125**2)
    warm = DenseReconstructor("unet", [Constant(float(np.log(9)))], views=1, temperature=2.0)
    assert np.allclose(warm.believe(angle.surface, EMPTY).probability, 0.75)


def test_surface_is_where_the_expected_iou_is_best() -> None:
    generator = np.random.default_rng(8)
    probability = generator.random((16, 16, 16)) ** 4
    volume = volume_at_level(probability)
    level = level_of_best_iou(probability)
    assert np.array_equal(volume.probability >= 0.5, probability >= level - 1e-7) and level < 0.45
    assert DenseReconstructor("unet", [Answers()]).reconstruct(EMPTY, ~EMPTY).probability.max() == 0


@pytest.mark.parametrize("views", [0, 9])
def test_bad_views_are_refused(views: int) -> None:
    with pytest.raises(InvalidInputError, match="choose 1 to 8"):
        DenseReconstructor("unet", [Answers()], views=views)
    with pytest.raises(InvalidInputError, match="no network"):
        DenseReconstructor("unet", [])


def test_folding_and_unfolding_keep_places() -> None:
    """A touch changes the answer most where it is: the cells of the output lie where those of the input do."""
    network = build_network("unet", unet.UNetConfig(level_channels=(8,))).eval()
    for voxel in ((3, 20, 11), (30, 1, 16)):
        touched = EMPTY.copy()
        touched[voxel] = True
        with torch.inference_mode():
            pair = torch.from_numpy(np.stack([[EMPTY, EMPTY], [touched, EMPTY]]).astype(np.float32))
            without, with_touch = network(pair).numpy()
        change = np.abs(with_touch - without)
        most = np.unravel_index(change.argmax(), change.shape)  # normalisation changes all cells a little
        assert (
            np.abs(voxel_centres(64)[most] - voxel_centres()[voxel]).max() < 0.032
        )  # the cell of 16 mm, or one beside it


def test_training_resumes_exactly_and_is_reused(smallest_unet: None, data: TouchObject, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole.pt", tmp_path / "parts.pt"
    train([data], TINY, whole)
    assert train([data], TINY, parts, stop=lambda done: done == 3) is None
    train([data], TINY, parts)
    first, second = (load_reconstructor(path) for path in (whole, parts))
    assert isinstance(first, DenseReconstructor) and isinstance(second, DenseReconstructor)
    for a, b in zip(first.networks[0].parameters(), second.networks[0].parameters(), strict=True):
        assert torch.equal(a, b)
    made = make_reconstructor("unet", whole)
    assert made.reconstruct(data.surface, ~data.solid).probability.shape == (64, 64, 64)
    with pytest.raises(InvalidInputError, match="is of another run"):
        train([data], dataclasses.replace(TINY, weight_decay=0.1), whole)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_network_learns_one_shape(precision: str, data: TouchObject, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(NETWORKS["unet"], "small", unet.UNetConfig(level_channels=(16, 16, 16)))
    config = TrainingConfig(
        architecture="unet", steps=80, batch_size=4, average=0.9, learning_rate=1e-2, precision=precision
    )
    made = train([data], config, tmp_path / "model.pt")
    assert isinstance(made, DenseReconstructor)
    felt = (data.explored[0].first != NEVER).any(axis=0)
    for symmetry in (np.eye(3, dtype=np.int64), SYMMETRIES[2], SYMMETRIES[3]):
        volume = made.reconstruct(turn(felt[0], symmetry), turn(felt[1], symmetry))
        true = turn(data.counts, symmetry) >= 4
        assert iou(volume.probability >= 0.5, true) > 0.6
        belief = made.believe(turn(felt[0], symmetry), turn(felt[1], symmetry))
        weights = np.ones(true.size)
        assert calibration_error(belief.probability.reshape(-1), true.reshape(-1), weights) < 0.05


def test_exported_weights_are_the_same_network_in_half_precision(
    smallest_unet: None, data: TouchObject, tmp_path: Path
) -> None:
    paths = [tmp_path / f"{seed}.pt" for seed in range(2)]
    for seed, path in enumerate(paths):
        train([data], dataclasses.replace(TINY, steps=2, seed=seed), path)
    exported = tmp_path / "both.safetensors"
    save_weights(exported, paths, {"views": 2, "temperature": 1.5})
    made = load_reconstructor(exported, "unet")
    assert isinstance(made, DenseReconstructor) and (made.views, made.temperature) == (2, 1.5)
    assert [record["seed"] for record in made.training] == [0, 1]
    whole = [load_reconstructor(path) for path in paths]
    for original, network in zip(whole, made.networks, strict=True):
        assert isinstance(original, DenseReconstructor)
        for a, b in zip(original.networks[0].parameters(), network.parameters(), strict=True):
            assert torch.equal(a.half().float(), b)
    networks = [model.networks[0] for model in whole if isinstance(model, DenseReconstructor)]
    expected = DenseReconstructor("unet", networks, views=2, temperature=1.5).believe(data.surface, ~data.solid)
    assert np.allclose(made.believe(data.surface, ~data.solid).probability, expected.probability, atol=2e-3)

    with pytest.raises(InvalidInputError, match="not 'ifnet'"):
        load_reconstructor(exported, "ifnet")
    content = exported.read_bytes()
    for damaged in (content[:100], content[:-100], b"", content.replace(b"version 1", b"version 9")):
        exported.write_bytes(damaged)
        with pytest.raises(InvalidInputError, match=r"both\.safetensors: damaged, or no weights"):
            load_reconstructor(exported)
    with pytest.raises(InvalidInputError, match="of 0 architectures"):
        save_weights(exported, [], {})


def test_bad_sizes_are_refused() -> None:
    for wrong in ({"level_channels": ()}, {"level_channels": (12,)}, {"resolution": 40}):
        with pytest.raises(InvalidInputError, match="multiple"):
            unet.UNet(dataclasses.replace(SMALLEST, **wrong))


@pytest.mark.parametrize("shape", ["sphere", "box", "torus"])
def test_shipped_weights_rebuild_what_was_felt_all_over(shape: str, request: pytest.FixtureRequest) -> None:
    """No shape that they learned from, none of the test objects: the true solid at the points where scores are measured."""
    item: PreparedObject = request.getfixturevalue(shape)
    made = make_reconstructor("unet")
    volume = made.reconstruct(item.surface, ~item.solid)
    sample = item.iou_points()
    assert iou(volume.query(sample.points) >= 0.5, item.solid_at_iou_points, sample.weights) > 0.8
