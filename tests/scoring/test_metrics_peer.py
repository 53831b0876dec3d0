"""The figures of scoring against a second implementation, on real test objects.

It shares no code with the benchmark but the readers of objects and the points: occupancy by Open3D's ray casting where Open3D
is installed (it is not among the test dependencies: a wheel of hundreds of megabytes and thirty packages), else by exact
winding numbers; distances by scipy's k-d tree; samples by trimesh; everything else written out in numpy.
"""

from __future__ import annotations

import igl
import numpy as np
import pytest
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from tslam_bench.constants import QUICK_OBJECTS, WORKSPACE_EDGE
from tslam_bench.geometry.nearest import NearestSamples
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.measure import Truth, score_reconstruction


def winding(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    return igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), points) > 0.5


def ray_casting(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    open3d = pytest.importorskip("open3d", exc_type=ImportError)  # its libraries may be missing, too
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    return scene.compute_occupancy(points.astype(np.float32), nsamples=5).numpy() > 0.5


def peer_iou(predicted: np.ndarray, true: np.ndarray, weights: np.ndarray) -> float:
    """One point at a time, in exact sums."""
    both = sum(w for p, t, w in zip(predicted.tolist(), true.tolist(), weights.tolist(), strict=True) if p and t)
    either = sum(w for p, t, w in zip(predicted.tolist(), true.tolist(), weights.tolist(), strict=True) if p or t)
    return both / either


def peer_distances(mesh: trimesh.Trimesh, item: PreparedObject, seed: int) -> dict[str, float]:
    """Chamfer, normal consistency and F-scores from trimesh's samples and a k-d tree, as the protocol words them."""
    points, faces = trimesh.sample.sample_surface(mesh, 100_000, seed=seed)
    predicted, normals = np.asarray(points) / WORKSPACE_EDGE, mesh.face_normals[faces]
    true, true_normals = item.surface_points.astype(np.float64) / WORKSPACE_EDGE, item.surface_normals
    there, nearest_true = cKDTree(true).query(predicted)
    back, nearest_predicted = cKDTree(predicted).query(true)
    cosine = np.abs((normals * true_normals[nearest_true]).sum(axis=1)).mean()
    cosine_back = np.abs((true_normals * normals[nearest_predicted]).sum(axis=1)).mean()
    values = {
        "chamfer_l2": (np.mean(there**2) + np.mean(back**2)) / 2,
        "chamfer_l1": (np.mean(there) + np.mean(back)) / 2,
        "normal_consistency": (cosine + cosine_back) / 2,
    }
    for percent in (1, 2):
        precision, recall = np.mean(there <= percent / 100), np.mean(back <= percent / 100)
        values[f"f_score_{percent}"] = 2 / (1 / precision + 1 / recall)
    return {name: float(value) for name, value in values.items()}


def prediction(item: PreparedObject, kind: str) -> Volume | trimesh.Trimesh:
    """A partial exploration rebuilt by ``hull`` or ``grid``, or the true mesh 3 mm aside."""
    if kind == "shifted":
        return trimesh.Trimesh(item.vertices + np.array([0.001, 0.002, 0.002]), item.faces, process=False)
    touched = item.surface & (np.random.default_rng(0).random(item.surface.shape) < 0.3)
    return make_reconstructor(kind).reconstruct(touched, ~item.solid)


TOLERANCES = {
    "chamfer_l2": {"rel": 0.03},
    "chamfer_l1": {"rel": 0.01},
    "normal_consistency": {"abs": 0.003},
    "f_score_1": {"abs": 0.005},
    "f_score_2": {"abs": 0.005},
}
"""The samples differ, so the figures do a little."""


@pytest.mark.parametrize("kind", ["shifted", "hull", "grid"])
@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_scores_of_real_objects_agree_with_the_peer(name: str, kind: str) -> None:
    item = load_object(name)
    truth = Truth.of(item)
    made = prediction(item, kind)
    values, reason = score_reconstruction(made, truth)
    assert reason is None
    mesh = made.to_mesh() if isinstance(made, Volume) else made
    expected = peer_distances(mesh, item, seed=7)
    for metric, tolerance in TOLERANCES.items():
        assert values[metric] == pytest.approx(expected[metric], **tolerance), metric


@pytest.mark.parametrize("occupancy", [winding, ray_casting])
@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_iou_of_a_mesh_at_the_same_points_agrees_with_the_peer(name: str, occupancy) -> None:
    """Away from both surfaces by more than rounding there is nothing to disagree on: the figures are equal."""
    item = load_object(name)
    truth = Truth.of(item)
    sample = item.iou_points()
    made = prediction(item, "shifted")
    assert isinstance(made, trimesh.Trimesh)
    near = (np.abs(sample.points) <= np.abs(item.vertices).max(axis=0) + 0.005).all(axis=1)
    predicted, true = np.zeros(len(near), dtype=bool), np.zeros(len(near), dtype=bool)
    predicted[near] = occupancy(made, sample.points[near])
    true[near] = occupancy(trimesh.Trimesh(item.vertices, item.faces, process=False), sample.points[near])
    values, _ = score_reconstruction(made, truth)
    assert values["iou"] == pytest.approx(peer_iou(predicted, true, sample.weights), abs=1e-12)


@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_iou_and_calibration_of_a_volume_agree_with_the_peer(name: str) -> None:
    """A nearest volume is read by scipy; calibration is summed bin by bin over points in order of probability."""
    item = load_object(name)
    sample, true = item.iou_points(), item.solid_at_iou_points
    probability = np.random.default_rng(1).random((32, 32, 32)).astype(np.float32) * np.where(item.solid, 1, 0.6)
    values, _ = score_reconstruction(Volume(probability, "nearest"), Truth.of(item))
    index = np.floor((sample.points + WORKSPACE_EDGE / 2) / WORKSPACE_EDGE * 32).clip(0, 31)
    read = map_coordinates(probability.astype(np.float32), index.T, order=0, prefilter=False)
    assert values["iou"] == pytest.approx(peer_iou(read >= 0.5, true, sample.weights), abs=1e-12)
    assert values["brier"] == pytest.approx(np.average((read - true.astype(float)) ** 2, weights=sample.weights))
    order = np.argsort(read, kind="stable")
    bins = np.minimum((np.cumsum(sample.weights[order]) / sample.weights.sum() * 15).astype(int), 14)
    error = 0.0
    for number in range(15):
        chosen = order[bins == number]
        volume = sample.weights[chosen].sum()
        gap = np.average(read[chosen], weights=sample.weights[chosen]) - np.average(
            true[chosen], weights=sample.weights[chosen]
        )
        error += volume / sample.weights.sum() * abs(gap)
    assert values["calibration_error"] == pytest.approx(error, abs=2e-4)  # whole points here, divided ones there


@pytest.mark.parametrize("name", QUICK_OBJECTS)
def test_nearest_samples_are_those_of_a_k_d_tree(name: str) -> None:
    points = load_object(name).surface_points.astype(np.float64) / WORKSPACE_EDGE
    others = points[::7] @ trimesh.transformations.rotation_matrix(0.3, [1, 2, 3])[:3, :3].T + [0.01, -0.02, 0.03]
    for searched, asking in ((points, others), (others, points)):
        distance, index = NearestSamples(searched).query(NearestSamples(asking))
        expected, nearest = cKDTree(searched).query(asking)
        np.testing.assert_allclose(distance, expected, rtol=1e-12)
        assert np.mean(index == nearest) > 0.9999  # the others are ties
