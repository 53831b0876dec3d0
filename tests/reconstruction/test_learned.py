"""Learned reconstructors: frames, simulated touches, training, checkpoints."""

from __future__ import annotations

import dataclasses
import itertools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from tslam_bench import grids
from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.geometry.sampling import iou_points
from tslam_bench.reconstruction import convonet, ifnet
from tslam_bench.reconstruction.feature_sampling import sample_features
from tslam_bench.reconstruction.learned import (
    NETWORKS,
    LearnedReconstructor,
    build_network,
    save_checkpoint,
)
from tslam_bench.reconstruction.levels import level_of_best_iou
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.touch_data import NEVER, ExploredObject, TouchObject
from tslam_bench.reconstruction.touch_simulation import TouchSimulation, simulate_touches
from tslam_bench.reconstruction.trained import load_reconstructor
from tslam_bench.reconstruction.training import THRESHOLDS, best_threshold, draw_batch, learning_rate, train
from tslam_bench.reconstruction.training_config import TrainingConfig
from tslam_bench.reconstruction.training_shapes import place, training_shape
from tslam_bench.reconstruction.weights import save_weights
from tslam_bench.scoring.metrics import iou

torch.set_num_threads(1)
EMPTY = np.zeros((GRID_SIZE,) * 3, dtype=bool)
SMALLEST = ifnet.IFNetConfig(level_channels=((8,), (8,), (8,)), decoder_channels=(16,), resolutions=(16, 32))
POINT_NETWORKS = [name for name in NETWORKS if name != "unet"]
TINY = TrainingConfig(size="small", steps=4, batch_size=2, points=64, save_every=2, threshold_examples=1)


@pytest.fixture
def smallest_ifnet(monkeypatch):
    """The small IF-Net made smaller still: for what does not depend on the size."""
    monkeypatch.setitem(NETWORKS["ifnet"], "small", SMALLEST)


def shape_of(mesh: trimesh.Trimesh, name: str = "shape", seed: int = 0):
    return training_shape(name, mesh.vertices, mesh.faces, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def ball():
    return shape_of(trimesh.creation.icosphere(5, 0.05), "ball")


@pytest.fixture(scope="module")
def torus():
    return shape_of(trimesh.creation.torus(0.06, 0.025, 96, 48), "torus")


@pytest.fixture(scope="module")
def wedge():
    """A box with unequal edges: every rotation shows."""
    return shape_of(trimesh.creation.box((0.16, 0.08, 0.04)), "wedge")


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    return (first & second).sum() / (first | second).sum()


# --- Frames --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("size", [4, 8, 32])
def test_sampling_at_cell_centres_returns_the_cells_in_index_order(size):
    grid = torch.arange(2 * size**3, dtype=torch.float32).reshape(1, 2, size, size, size)
    centres = torch.from_numpy(grids.voxel_centres(size).reshape(1, -1, 3).astype(np.float32))
    sampled = sample_features(grid, centres)
    assert torch.allclose(sampled, grid.reshape(1, 2, -1), rtol=1e-5, atol=1e-2 * size)
    assert sampled[0, 0].round().long().tolist() == list(range(size**3))


def test_sampling_is_trilinear_in_metres():
    centres = grids.voxel_centres().astype(np.float32)
    slopes = np.array([3.0, -7.0, 11.0], dtype=np.float32)
    grid = torch.from_numpy(np.moveaxis(centres * slopes, -1, 0)[None].copy())  # channel a: slope_a * coordinate a
    limit = WORKSPACE_EDGE / 2 - VOXEL_EDGE / 2
    points = np.random.default_rng(0).uniform(-limit, limit, (1, 500, 3)).astype(np.float32)
    assert np.allclose(sample_features(grid, torch.from_numpy(points))[0].T, points[0] * slopes, atol=1e-5)


@pytest.mark.parametrize(("name", "size"), [(name, size) for name in POINT_NETWORKS for size in NETWORKS[name]])
def test_networks_have_the_shapes_they_say(name, size):
    network = build_network(name, NETWORKS[name][size]).eval()
    with torch.inference_mode():
        logits = network(torch.zeros(2, 2, 32, 32, 32), torch.zeros(2, 5, 3))
    assert logits.shape == (2, 5)
    assert torch.isfinite(logits).all()


def test_ifnet_reads_the_point_and_its_six_neighbours_at_every_scale():
    """Seven points, each with every channel of the input and of all levels, go into the decoder."""
    network = ifnet.IFNet(ifnet.IFNetConfig(level_channels=((3, 4), (5,)), decoder_channels=(8,), displacement=2.0))
    assert network.decoder[0].in_channels == 7 * (2 + 4 + 5)
    features = network.encode(torch.zeros(1, 2, 32, 32, 32))
    assert [tuple(f.shape[1:]) for f in features] == [(2, 32, 32, 32), (4, 32, 32, 32), (5, 16, 16, 16)]
    # A network whose decoder adds up the touched channel counts the touched ones among the point and its neighbours.
    with torch.no_grad():
        first, last = network.decoder[0], network.decoder[2]
        for parameter in network.decoder.parameters():
            parameter.zero_()
        first.weight[0, :7, 0] = 1  # channel-major: the seven positions of channel 0 come first
        last.weight[0, 0, 0] = 1
    grid = torch.zeros(1, 2, 32, 32, 32)
    for offset in [(0, 0, 0), (2, 0, 0), (0, -2, 0), (0, 0, 2), (1, 0, 0), (2, 2, 0)]:
        grid[0, 0, 10 + offset[0], 15 + offset[1], 20 + offset[2]] = 1
    point = torch.from_numpy(grids.voxel_centres()[10, 15, 20].astype(np.float32))[None, None]
    assert network.decode(network.encode(grid), point).item() == pytest.approx(4, abs=1e-4)


class Ball(torch.nn.Module):
    """An analytic occupancy: logit 200 per metre of depth in a ball off the centre."""

    config = SimpleNamespace(resolutions=(16, 32, 64))
    centre = torch.tensor([0.02, -0.03, 0.04])

    def encode(self, grids):
        return [grids]

    def decode(self, features, points):
        return 200 * (0.05 - (points - self.centre).norm(dim=-1))


@pytest.mark.parametrize("threshold", [0.5, 0.2])
def test_volume_of_a_known_occupancy_is_where_it_should_be(threshold):
    touched = EMPTY.copy()
    touched[3, 4, 5] = True
    volume = LearnedReconstructor("ball", Ball(), threshold=threshold).reconstruct(touched, EMPTY)
    mesh = volume.to_mesh()
    # The threshold's level of the logit is a ball too, larger by logit / 200.
    radius = 0.05 - np.log(threshold / (1 - threshold)) / 200
    distances = np.linalg.norm(mesh.vertices - Ball.centre.numpy(), axis=1)
    assert np.abs(distances - radius).max() < 3e-4
    assert volume.resolution == 64


def test_refinement_changes_nothing_near_the_surface():
    touched = EMPTY.copy()
    touched[3, 4, 5] = True
    volume = LearnedReconstructor("ball", Ball()).reconstruct(touched, EMPTY)
    points = torch.from_numpy(grids.voxel_centres(64).reshape(-1, 3).astype(np.float32))
    full = torch.sigmoid(Ball().decode([], points)).numpy().reshape((64,) * 3)
    assert np.array_equal(volume.probability >= 0.5, full >= 0.5)
    assert np.allclose(volume.probability[np.abs(full - 0.5) < 0.2], full[np.abs(full - 0.5) < 0.2], atol=1e-6)
    assert np.abs(volume.probability - full).max() < 0.1


class Ripples(torch.nn.Module):
    """Occupancy that is low everywhere, between 0.06 and 0.23, in waves that a coarse lattice does not see."""

    config = SimpleNamespace(resolutions=(16, 32))

    def encode(self, grids):
        return [grids]

    def decode(self, features, points):
        return -2 + 0.8 * torch.sin(points[..., 0] * (2 * np.pi / (WORKSPACE_EDGE / 9)) + 0.3)


@pytest.mark.parametrize("threshold", [0.12, None])
def test_low_levels_are_refined_like_high_ones(threshold):
    touched = EMPTY.copy()
    touched[3, 4, 5] = True
    volume = LearnedReconstructor("ripples", Ripples(), threshold=threshold).reconstruct(touched, EMPTY)
    points = torch.from_numpy(grids.voxel_centres().reshape(-1, 3).astype(np.float32))
    full = torch.sigmoid(Ripples().decode([], points)).numpy().reshape((GRID_SIZE,) * 3)
    level = level_of_best_iou(full) if threshold is None else threshold
    clear = np.abs(full - level) > 1e-4
    assert np.array_equal((volume.probability >= 0.5)[clear], (full >= level)[clear])


@pytest.mark.parametrize("architecture", POINT_NETWORKS)
def test_networks_for_points_learn_from_collected_touches(architecture, smallest_ifnet, tmp_path, box):
    """Their level follows from their own probabilities, through a checkpoint and through exported weights."""
    surface, free = box.surface, ~box.solid
    first = np.where(np.stack([surface, free]), 0, NEVER).astype(np.uint8)
    item = TouchObject.of(box, [ExploredObject(np.stack([first] * 8), np.arange(8))], None)
    config = dataclasses.replace(TINY, architecture=architecture, steps=60, learning_rate=1e-2)
    made = train([item], config, tmp_path / "model.pt")
    assert made.threshold is None
    save_weights(tmp_path / "model.safetensors", [tmp_path / "model.pt"], {})
    shipped = load_reconstructor(tmp_path / "model.safetensors", architecture)
    assert shipped.threshold is None
    sample = box.iou_points()
    for reconstructor in (made, shipped):
        solid = reconstructor.reconstruct(surface, free).query(sample.points) >= 0.5
        assert iou(solid, box.solid_at_iou_points, sample.weights) > 0.5


def test_nothing_touched_gives_nothing():
    volume = LearnedReconstructor("ball", Ball()).reconstruct(EMPTY, ~EMPTY)
    assert not volume.probability.any()


# --- Examples ------------------------------------------------------------------------------------------------------
def test_labels_are_those_of_the_analytic_ball(ball):
    generator = np.random.default_rng(0)
    for _ in range(5):
        placed = place(ball, generator)
        points, labels = placed.query_points(4000, generator)
        distances = np.linalg.norm(points, axis=1)
        radius = 0.05 * placed.scale
        clear = np.abs(distances - radius) > 1e-4  # the mesh is inscribed in the ball
        assert np.array_equal(labels[clear] > 0.5, distances[clear] < radius)
        assert np.abs(points).max() <= WORKSPACE_EDGE / 2
        share = (4 / 3 * np.pi * radius**3) / WORKSPACE_EDGE**3
        assert abs(labels[2000:].mean() - share) < 5 * np.sqrt(share / 2000)  # the second half is uniform in W


def test_uniform_points_are_uniform_in_the_workspace(torus):
    generator = np.random.default_rng(1)
    placed = place(torus, generator, continuous_rotation=True)
    points = np.concatenate([placed.query_points(1024, generator)[0][512:] for _ in range(60)])
    cells = np.floor((points - WORKSPACE_LOW) / (WORKSPACE_EDGE / 4)).astype(int).clip(0, 3)
    counts = np.bincount(np.ravel_multi_index(cells.T, (4, 4, 4)), minlength=64)
    expected = len(points) / 64
    # Chi-squared with 63 degrees of freedom: mean 63, standard deviation 11.
    assert ((counts - expected) ** 2 / expected).sum() < 63 + 6 * 11


@pytest.mark.parametrize("continuous", [False, True])
def test_placed_shapes_are_centred_in_the_workspace(wedge, continuous):
    generator = np.random.default_rng(3)
    seen = set()
    for _ in range(40):
        placed = place(wedge, generator, (0.5, 3.0), continuous)
        surface, normals = placed.surface()
        corners = placed.to_workspace(wedge.vertices)
        assert np.allclose(corners.min(axis=0), -corners.max(axis=0), atol=1e-12)
        assert np.abs(corners).max() <= WORKSPACE_EDGE / 2
        # Inside and outside lie where the normals say (but for the box's edges, where the lookup is too coarse).
        assert placed.inside(surface - 0.006 * placed.scale * normals).mean() > 0.9
        assert placed.inside(surface + 0.006 * placed.scale * normals).mean() < 0.03
        seen.add(tuple(np.round(corners.max(axis=0) / placed.scale, 4)))
    assert len(seen) == (40 if continuous else 6)  # 24 rotations of a box show 6 orders of its edges


def test_simulated_touches_lie_on_the_surface_and_the_hand_stays_outside(ball):
    generator = np.random.default_rng(5)
    sweeps = 0
    for _ in range(6):
        placed = place(ball, generator)
        touches = simulate_touches(placed, generator)
        radius = 0.05 * placed.scale
        assert np.abs(np.linalg.norm(touches.contact_points, axis=1) - radius).max() < 2e-3  # 6 standard deviations
        assert np.array_equal(touches.touched, grids.points_to_grid(touches.contact_points))
        # The lookup's samples are 4 mm apart: no finger point is deeper than half a diagonal of its cells.
        depth = radius - np.linalg.norm(touches.finger_points, axis=1)
        assert depth.max() < 0.5 * np.sqrt(3) * 0.004 * placed.scale
        # Swept voxels lie outside altogether: their centres are at least the mesh's sagitta and half an edge away.
        distances = np.linalg.norm(grids.voxel_centres()[touches.swept_voxels], axis=1)
        assert distances.min(initial=1.0) > radius + 0.4 * VOXEL_EDGE
        assert np.array_equal(touches.visited, grids.points_to_grid(touches.finger_points) | touches.swept_voxels)
        assert (touches.touched & touches.visited).sum() > 0.6 * touches.touched.sum()
        sweeps += touches.swept_voxels.sum()
    assert sweeps > 6 * 500


def test_simulated_sweeps_stay_out_of_closed_rooms():
    """A hollow box: nothing gets in."""
    outer, inner = trimesh.creation.box((0.14, 0.14, 0.14)), trimesh.creation.box((0.1, 0.1, 0.1))
    inner.invert()
    placed = place(shape_of(trimesh.util.concatenate([outer, inner])), np.random.default_rng(0), (1.0, 1.0))
    simulation = TouchSimulation(approaches=(8, 8), touched_voxels=(10, 10), sweeps=(20, 20))
    room = np.abs(grids.voxel_centres()).max(axis=-1) < 0.04
    for seed in range(3):
        touches = simulate_touches(placed, np.random.default_rng(seed), simulation)
        assert not (touches.visited & room).any()
        assert touches.swept_voxels.sum() > 10_000


def test_simulated_touches_reach_the_number_aimed_at(torus):
    generator = np.random.default_rng(6)
    for aimed in (1, 10, 60):
        placed = place(torus, generator, (1.0, 1.0))
        simulation = TouchSimulation(touched_voxels=(aimed, aimed), approaches=(4, 4))
        touched = simulate_touches(placed, generator, simulation).touched.sum()
        assert 4 * aimed <= touched <= 4 * aimed + 30  # the last patch may go over


def test_examples_depend_on_the_generator_alone(torus, wedge):
    batches = [draw_batch([torus, wedge], TINY, np.random.default_rng(s)) for s in (1, 1, 2)]
    for name in ("grids", "points", "labels"):
        first, same, other = (getattr(batch, name) for batch in batches)
        assert np.array_equal(first, same)
        assert not np.array_equal(first, other)


def test_meshes_that_cannot_be_learned_from_are_refused():
    generator = np.random.default_rng(0)
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]], process=False)
    big = trimesh.creation.box((0.3, 0.1, 0.1))
    with pytest.raises(InvalidInputError, match="plate: encloses no volume"):
        training_shape("plate", flat.vertices, flat.faces, generator)
    with pytest.raises(InvalidInputError, match=r"crate: 0\.300 m long"):
        training_shape("crate", big.vertices, big.faces, generator)
    with pytest.raises(InvalidInputError, match="void"):
        training_shape("void", np.zeros((0, 3)), np.zeros((0, 3)), generator)


# --- Training ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("architecture", POINT_NETWORKS)
def test_network_overfits_one_shape(architecture, torus):
    """Real training on one input: the solid torus comes out of a part of its surface."""
    generator = np.random.default_rng(0)
    placed = dataclasses.replace(
        place(torus, generator, (1.0, 1.0)), rotation=np.eye(3), scale=1.0, translation=np.zeros(3)
    )
    touches = simulate_touches(placed, generator, TouchSimulation(approaches=(4, 4), touched_voxels=(40, 40)))
    inputs = torch.from_numpy(np.stack([touches.touched, touches.visited])[None].astype(np.float32))
    network = build_network(architecture, NETWORKS[architecture]["small"], seed=0)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 100)
    for _ in range(100):
        points, labels = placed.query_points(1500, generator)
        logits = network(inputs, torch.from_numpy(points)[None])
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits[0], torch.from_numpy(labels))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    volume = LearnedReconstructor(architecture, network.eval()).reconstruct(touches.touched, touches.visited)
    sample = iou_points(np.array([-0.085, -0.085, -0.025]), np.array([0.085, 0.085, 0.025]), (60, 60, 30))
    x, y, z = sample.points.T
    true = (np.hypot(x, y) - 0.06) ** 2 + z**2 < 0.025**2
    assert iou(volume.query(sample.points) >= 0.5, true, sample.weights) > 0.9


def test_training_is_reproducible_and_resumes_exactly(smallest_ifnet, tmp_path, torus, wedge):
    shapes = [torus, wedge]
    whole = train(shapes, TINY, tmp_path / "whole.pt")
    again = train(shapes, TINY, tmp_path / "again.pt")
    other = train(shapes, dataclasses.replace(TINY, seed=1), tmp_path / "other.pt")
    for stop_at in (1, 3):  # before the first regular save, and between two
        path = tmp_path / f"resumed{stop_at}.pt"
        assert train(shapes, TINY, path, stop=lambda done, at=stop_at: done == at) is None
        assert not path.exists()
        steps = []
        resumed = train(shapes, TINY, path, progress=lambda done, loss, steps=steps: steps.append(done))
        assert steps == list(range(stop_at, TINY.steps + 1))
        assert list(tmp_path.glob(f"resumed{stop_at}*")) == [path]
        assert resumed.threshold == whole.threshold
        for name, value in whole.network.state_dict().items():
            assert torch.equal(value, resumed.network.state_dict()[name]), name
    assert again.threshold == whole.threshold
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, again.network.state_dict()[name]), name
    assert any(not torch.equal(v, other.network.state_dict()[n]) for n, v in whole.network.state_dict().items())


def test_finished_training_is_reused_and_never_overwritten(smallest_ifnet, tmp_path, torus, wedge):
    path = tmp_path / "model.pt"
    first = train([torus], TINY, path)
    content = path.read_bytes()
    steps = []
    again = train([torus], TINY, path, progress=lambda done, loss: steps.append(done))
    assert steps == []
    assert path.read_bytes() == content
    assert all(torch.equal(v, again.network.state_dict()[n]) for n, v in first.network.state_dict().items())
    with pytest.raises(InvalidInputError, match=r"model\.pt: is of another run \(steps 4, not 5\)"):
        train([torus], dataclasses.replace(TINY, steps=5), path)
    with pytest.raises(InvalidInputError, match=r"model\.pt: is of another run \(other objects\)"):
        train([wedge], TINY, path)
    assert path.read_bytes() == content


def test_training_lowers_the_loss(smallest_ifnet, tmp_path, torus, wedge):
    losses = []
    config = dataclasses.replace(TINY, steps=40, points=256, learning_rate=5e-3)
    train([torus, wedge], config, tmp_path / "model.pt", progress=lambda done, loss: losses.append(loss))
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:3])


def test_threshold_is_the_candidate_with_the_best_overlap(ball):
    class Blurred(torch.nn.Module):
        """Knows the ball, but is so unsure of it that 0.3 is the level of its surface."""

        def encode(self, grids):
            return []

        def decode(self, features, points):
            return float(np.log(0.3 / 0.7)) + 20 * (0.05 - points.norm(dim=-1))

    config = dataclasses.replace(TINY, threshold_examples=3)
    assert best_threshold(Blurred(), [ball], config) == pytest.approx(0.3, abs=0.021)
    assert 0.3 in THRESHOLDS


def test_learning_rate_rises_and_falls_to_zero():
    config = TrainingConfig(steps=100, learning_rate=1e-3)
    rates = [learning_rate(config, step) for step in range(101)]
    assert max(rates) == rates[5] == pytest.approx(1e-3)
    assert rates[:5] == pytest.approx([2e-4, 4e-4, 6e-4, 8e-4, 1e-3])
    assert all(a >= b for a, b in itertools.pairwise(rates[5:]))
    assert rates[100] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"learning_rate": -1.0}, {"scale_range": (1.2, 0.8)}, {"points": -3}])
def test_bad_configurations_are_refused(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        TrainingConfig(**wrong).check()


# --- Checkpoints ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("architecture", POINT_NETWORKS)
def test_checkpoint_round_trip(smallest_ifnet, tmp_path, architecture, torus):
    generator = np.random.default_rng(0)
    placed = place(torus, generator)
    touches = simulate_touches(placed, generator)
    network = build_network(architecture, NETWORKS[architecture]["small"], seed=3).eval()
    path = tmp_path / "model.pt"
    save_checkpoint(path, architecture, network, {"objects": ["torus"], "seed": 3}, threshold=0.4)
    expected = LearnedReconstructor(architecture, network, threshold=0.4).reconstruct(touches.touched, touches.visited)
    loaded = load_reconstructor(path)
    assert loaded.name == architecture
    assert loaded.threshold == 0.4
    assert loaded.training == {"objects": ["torus"], "seed": 3}
    assert loaded.network.config == network.config
    made = make_reconstructor(architecture, path)
    for reconstructor in (loaded, made):
        got = reconstructor.reconstruct(touches.touched, touches.visited)
        assert np.array_equal(got.probability, expected.probability)
    wrong = next(name for name in POINT_NETWORKS if name != architecture)
    with pytest.raises(InvalidInputError, match=f"holds a network of '{architecture}', not '{wrong}'"):
        make_reconstructor(wrong, path)


def test_custom_sizes_survive_a_checkpoint(tmp_path):
    config = ifnet.IFNetConfig(level_channels=((8,), (8, 16)), decoder_channels=(16,), displacement=0.7)
    save_checkpoint(tmp_path / "model.pt", "ifnet", build_network("ifnet", config), {})
    assert load_reconstructor(tmp_path / "model.pt").network.config == config
    small = convonet.ConvONetConfig(level_channels=(8, 16), decoder_channels=(8,))
    save_checkpoint(tmp_path / "other.pt", "convonet", build_network("convonet", small), {})
    assert load_reconstructor(tmp_path / "other.pt").network.config == small


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("the checkpoint was executed",))


def test_corrupt_checkpoints_give_one_line(tmp_path):
    good = tmp_path / "good.pt"
    save_checkpoint(good, "ifnet", build_network("ifnet", ifnet.SMALL), {})
    content = torch.load(good, weights_only=True)
    whole = good.read_bytes()
    (tmp_path / "empty.pt").write_bytes(b"")
    (tmp_path / "text.pt").write_text("not a model")
    (tmp_path / "cut.pt").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "folder.pt").mkdir()
    torch.save({"weights": {}}, tmp_path / "foreign.pt")
    torch.save({**content, "weights": {}}, tmp_path / "weightless.pt")
    torch.save({**content, "architecture": "pointnet"}, tmp_path / "unknown.pt")
    torch.save({**content, "threshold": float("nan")}, tmp_path / "threshold.pt")
    torch.save({**content, "config": {**content["config"], "depth": 3}}, tmp_path / "config.pt")
    torch.save({**content, "training": Bomb()}, tmp_path / "bomb.pt")
    (tmp_path / "pickle.pt").write_bytes(pickle.dumps(Bomb(), protocol=2))
    written = sorted(path.stem for path in tmp_path.iterdir() if path != good)
    assert len(written) == 11
    for name in ["missing", *written]:
        with pytest.raises(InvalidInputError, match=rf"{name}\.pt: ") as caught:
            load_reconstructor(tmp_path / f"{name}.pt")
        assert "\n" not in str(caught.value)
    load_reconstructor(good)
