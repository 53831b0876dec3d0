"""Metrics against closed forms."""

from __future__ import annotations

import math

import igl
import numpy as np
import pytest
import trimesh
from prepared_shapes import surface_grid
from scipy.spatial.distance import cdist

from tslam_bench.constants import SURFACE_SAMPLES, VOXEL_EDGE, WORKSPACE_EDGE
from tslam_bench.geometry.sampling import iou_cells, iou_points
from tslam_bench.grids import points_to_grid, voxel_centres
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import metrics, prediction
from tslam_bench.scoring.prediction import MESH_BOUND, prepare


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def sphere_samples(radius: float, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Uniform on a true sphere (not a mesh), with normals."""
    normals = generator.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


# --- IoU -------------------------------------------------------------------------------------------------------


def test_iou_counts() -> None:
    a = np.array([1, 1, 1, 0, 0], dtype=bool)
    b = np.array([0, 1, 1, 1, 0], dtype=bool)
    assert metrics.iou(a, b) == 2 / 4
    assert metrics.iou(a, a) == 1
    assert metrics.iou(a, ~a) == 0


def test_iou_of_empty_sets() -> None:
    empty, full = np.zeros(4, dtype=bool), np.ones(4, dtype=bool)
    assert metrics.iou(empty, full) == 0
    assert metrics.iou(full, empty) == 0
    assert metrics.iou(empty, empty) == 1


def test_iou_refuses_different_shapes() -> None:
    with pytest.raises(ValueError, match="differ"):
        metrics.iou(np.ones(3, dtype=bool), np.ones(4, dtype=bool))


def test_iou_weighs_points_by_their_volume() -> None:
    a = np.array([1, 1, 0, 0], dtype=bool)
    b = np.array([0, 1, 1, 0], dtype=bool)
    assert metrics.iou(a, b, np.array([1.0, 3.0, 2.0, 50.0])) == 3 / 6
    assert metrics.iou(a, b, np.full(4, 7.0)) == metrics.iou(a, b)
    with pytest.raises(ValueError, match="weights for"):
        metrics.iou(a, b, np.ones(3))


def two_spheres(radius: float, shift: float, seed: int) -> tuple[float, float]:
    """IoU of two spheres of ``radius`` (m), ``shift`` apart, at one set of points, and its closed form.

    Lens of two spheres: V = pi (4 r + d)(2 r - d)^2 / 12.
    """
    centre = np.array([shift / 2, 0, 0])
    low, high = -radius - centre, radius - centre
    sample = iou_points(low, high, iou_cells(low, high, 4 / 3 * math.pi * radius**3), seed)
    a = np.linalg.norm(sample.points - centre, axis=1) <= radius
    b = np.linalg.norm(sample.points + centre, axis=1) <= radius
    lens = math.pi * (4 * radius + shift) * (2 * radius - shift) ** 2 / 12
    return metrics.iou(a, b, sample.weights), lens / (2 * 4 / 3 * math.pi * radius**3 - lens)


@pytest.mark.parametrize(("radius", "shift"), [(0.06, 0.03), (0.03, 0.004), (0.012, 0.02)])
def test_iou_at_the_points_of_an_object_is_unbiased_and_sharp(radius: float, shift: float) -> None:
    """The true solid is the sphere whose box the points follow; the other one reaches out of it."""
    values = [two_spheres(radius, shift, seed)[0] for seed in range(30)]
    assert np.std(values) < 0.005
    assert np.mean(values) == pytest.approx(two_spheres(radius, shift, 0)[1], abs=4 * np.std(values) / math.sqrt(30))


def test_surface_iou_is_not_solid_iou(sphere) -> None:
    touched = surface_grid(sphere)
    assert metrics.iou(touched, sphere.surface) > 0.9
    assert metrics.iou(touched, sphere.solid) < 0.5


# --- Calibration -----------------------------------------------------------------------------------------------


def test_calibration_error_of_equal_bins_by_hand() -> None:
    """Three points of equal volume in three bins: the mean of |p - y|."""
    p, true, weights = np.array([0.1, 0.9, 0.4]), np.array([False, True, True]), np.ones(3)
    assert metrics.calibration_error(p, true, weights, bins=3) == pytest.approx((0.1 + 0.1 + 0.6) / 3)
    assert metrics.calibration_error(p, true, weights, bins=1) == pytest.approx(abs(p.mean() - 2 / 3))
    assert metrics.brier_score(p, true, weights) == pytest.approx((0.01 + 0.01 + 0.36) / 3)


def test_calibration_weighs_points_by_their_volume() -> None:
    """A point of volume 3 is three points of volume 1."""
    p, true = rng(0).random(40), rng(1).random(40) < 0.5
    counts = rng(2).integers(1, 5, 40)
    repeated = np.repeat(p, counts), np.repeat(true, counts), np.ones(counts.sum())
    weights = counts.astype(float)
    assert metrics.calibration_error(p, true, weights) == pytest.approx(metrics.calibration_error(*repeated), abs=1e-6)
    assert metrics.brier_score(p, true, weights) == pytest.approx(metrics.brier_score(*repeated))


def test_calibration_does_not_depend_on_the_order_of_points() -> None:
    """Also where a cut divides points of one probability."""
    p, true, weights = rng(0).integers(0, 4, 5000) / 4, rng(1).random(5000) < 0.3, rng(2).random(5000)
    order = np.lexsort((true, p))
    expected = metrics.calibration_error(p, true, weights)
    for chosen in (order, order[::-1], rng(3).permutation(5000)):
        assert metrics.calibration_error(p[chosen], true[chosen], weights[chosen]) == pytest.approx(expected, abs=1e-9)


def test_calibration_of_a_calibrated_and_of_an_overconfident_probability() -> None:
    p = rng(0).random(200_000)
    true = rng(1).random(200_000) < p
    weights = np.ones(200_000)
    assert metrics.calibration_error(p, true, weights) < 0.005
    assert metrics.brier_score(p, true, weights) == pytest.approx(1 / 6, abs=0.002)  # mean of p (1 - p)
    # Rounded to 0 and 1: in each half the probability is 1/4 off on average; a bin of both halves evens out.
    assert metrics.calibration_error(np.round(p), true, weights, bins=16) == pytest.approx(0.25, abs=0.005)
    assert metrics.calibration_error(np.round(p), true, weights, bins=15) == pytest.approx(0.25 * 14 / 15, abs=0.005)
    constant = np.full(200_000, 0.5)
    assert metrics.calibration_error(constant, true, weights) < 0.005


# --- Chamfer ---------------------------------------------------------------------------------------------------


def test_match_agrees_with_all_pairs() -> None:
    a, b = rng(1).random((70, 3)), rng(2).random((50, 3))
    distances = cdist(a, b)
    match = metrics.match_surfaces(a, b)
    np.testing.assert_allclose(match.accuracy, distances.min(axis=1))
    np.testing.assert_allclose(match.completeness, distances.min(axis=0))
    np.testing.assert_array_equal(match.nearest_true, distances.argmin(axis=1))
    np.testing.assert_array_equal(match.nearest_predicted, distances.argmin(axis=0))
    assert metrics.chamfer_l2(match) == pytest.approx(
        0.5 * ((distances.min(axis=0) ** 2).mean() + (distances.min(axis=1) ** 2).mean())
    )


def test_chamfer_of_concentric_spheres() -> None:
    """Every nearest neighbour is the radial one: distance R - r, up to the sampling floor."""
    outer, inner, count = 0.30, 0.24, 60_000
    a, _ = sphere_samples(outer, count, rng(1))
    b, _ = sphere_samples(inner, count, rng(2))
    match = metrics.match_surfaces(a, b)
    gap = outer - inner
    floor = 4 * math.pi * outer * outer / (math.pi * count)
    assert gap**2 <= metrics.chamfer_l2(match) <= gap**2 + 2 * floor
    assert gap <= metrics.chamfer_l1(match) <= math.sqrt(gap**2 + 2 * floor)


def test_chamfer_floor_of_a_surface_with_itself() -> None:
    """Poisson process of density N / A: mean squared distance A / (pi N), mean distance 0.5 sqrt(A / N)."""
    radius, count = 0.25, 30_000
    a, _ = sphere_samples(radius, count, rng(1))
    b, _ = sphere_samples(radius, count, rng(2))
    match = metrics.match_surfaces(a, b)
    area = 4 * math.pi * radius**2
    assert metrics.chamfer_l2(match) == pytest.approx(area / (math.pi * count), rel=0.03)
    assert metrics.chamfer_l1(match) == pytest.approx(0.5 * math.sqrt(area / count), rel=0.03)


def test_chamfer_of_parallel_plates() -> None:
    """Two parallel unit squares at distance h: h both ways."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    a, _ = metrics.sample_surface(square[faces], 40_000, rng(1))
    b, _ = metrics.sample_surface(square[faces] + [0, 0, 0.1], 40_000, rng(2))
    match = metrics.match_surfaces(a, b)
    assert metrics.chamfer_l2(match) == pytest.approx(0.01, rel=0.01)
    assert metrics.chamfer_l1(match) == pytest.approx(0.1, rel=0.01)


def test_no_valid_prediction_is_charged_more_than_an_empty_one() -> None:
    match = metrics.match_surfaces(np.full((5, 3), 2.0), np.zeros((5, 3)))
    assert metrics.chamfer_l1(match) == metrics.WORST_DISTANCE
    assert metrics.chamfer_l2(match) == pytest.approx(3)


def test_match_refuses_nothing() -> None:
    with pytest.raises(ValueError, match="at least one sample"):
        metrics.match_surfaces(np.zeros((0, 3)), np.zeros((5, 3)))


# --- Normals ---------------------------------------------------------------------------------------------------


def test_normal_consistency_of_random_normals_is_one_half() -> None:
    points_a, points_b = rng(1).random((20_000, 3)), rng(2).random((20_000, 3))
    _, normals_a = sphere_samples(1, 20_000, rng(3))
    _, normals_b = sphere_samples(1, 20_000, rng(4))
    match = metrics.match_surfaces(points_a, points_b)
    assert metrics.normal_consistency(normals_a, normals_b, match) == pytest.approx(0.5, abs=0.01)


def test_normal_consistency_of_voxel_faces_on_a_sphere() -> None:
    """Voxel faces with normal e_i have the area of the sphere weighted by |n_i|, so from them the mean of |n . e_i| is
    E[sum n_i^2] / E[sum |n_i|] = 2/3. No choice of axis-aligned faces can exceed E[max |n_i|] = 0.83."""
    centres = np.linalg.norm(voxel_centres(128), axis=-1)
    mesh = Volume((centres < 0.1).astype(np.float32), "nearest").to_mesh()
    points, normals = metrics.sample_surface(mesh.triangles, 60_000, rng(1))
    true, true_normals = sphere_samples(0.1, 60_000, rng(2))
    match = metrics.match_surfaces(points, true)
    value = metrics.normal_consistency(normals, true_normals, match)
    assert value == pytest.approx(2 / 3, abs=0.02)
    best = np.eye(3)[np.abs(true_normals).argmax(axis=1)]
    ceiling = metrics.normal_consistency(best, true_normals, metrics.match_surfaces(true, true))
    assert ceiling == pytest.approx(0.831, abs=0.003)


def test_normal_consistency_ignores_orientation() -> None:
    points, normals = sphere_samples(0.2, 500, rng(1))
    match = metrics.match_surfaces(points, points)
    assert metrics.normal_consistency(normals, -normals, match) == pytest.approx(1)


# --- F-score ---------------------------------------------------------------------------------------------------


def test_f_score_is_the_harmonic_mean() -> None:
    true = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    predicted = np.array([[0.005, 0, 0], [1.005, 0, 0], [9, 0, 0]])
    match = metrics.match_surfaces(predicted, true)
    precision, recall = 2 / 3, 2 / 4
    assert metrics.f_score(match, 0.01) == pytest.approx(2 * precision * recall / (precision + recall))


def test_f_score_zero_over_zero_is_zero() -> None:
    match = metrics.match_surfaces(np.zeros((3, 3)), np.ones((3, 3)))
    assert metrics.f_score(match, 0.01) == 0


# --- Sampling --------------------------------------------------------------------------------------------------


def test_samples_are_area_uniform_and_on_the_surface(box) -> None:
    points, normals = metrics.sample_surface(box.vertices[box.faces], 60_000, rng(1))
    half = np.ptp(box.vertices, axis=0) / 2
    axis = np.abs(normals).argmax(axis=1)
    np.testing.assert_allclose(
        points[np.arange(len(points)), axis] / half[axis], np.sign(normals.sum(axis=1)), atol=1e-9
    )
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    np.testing.assert_allclose(np.bincount(axis) / len(points), areas / areas.sum(), atol=0.01)
    # Uniform in a face: the variance along an edge is (edge length)^2 / 12.
    np.testing.assert_allclose(points[axis == 2, 0].var(), (2 * half[0]) ** 2 / 12, rtol=0.03)


def test_samples_are_reproducible_and_skip_degenerate_faces() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], dtype=float)
    faces = np.array([[0, 1, 3], [0, 1, 2], [0, 3, 1]])  # the first and last have no area
    a = metrics.sample_surface(vertices[faces], 1000, rng(5))
    b = metrics.sample_surface(vertices[faces], 1000, rng(5))
    np.testing.assert_array_equal(a[0], b[0])
    assert np.isfinite(a[1]).all()
    np.testing.assert_allclose(a[1], [[0, 0, 1]] * 1000)


def test_sampling_refuses_a_mesh_without_area() -> None:
    with pytest.raises(ValueError, match="no area"):
        metrics.sample_surface(np.zeros((1, 3, 3)), 10, rng())
    with pytest.raises(ValueError, match="no area"):
        metrics.sample_surface(np.zeros((0, 3, 3)), 10, rng())


# --- Exploration -----------------------------------------------------------------------------------------------


def brute_recall(points: np.ndarray, touched: np.ndarray) -> float:
    centres = voxel_centres()[touched]
    return float((cdist(points, centres).min(axis=1) <= VOXEL_EDGE).mean()) if len(centres) else 0.0


def test_recall_agrees_with_all_pairs(torus) -> None:
    points = torus.surface_points[:3000].astype(np.float64)
    coverage = metrics.TouchCoverage(points)
    for share in (0.0, 0.05, 0.4, 1.0):
        touched = surface_grid(torus) & (rng(3).random((32, 32, 32)) < share)
        assert coverage.recall(touched) == pytest.approx(brute_recall(points, touched), abs=1e-12)


def test_recall_of_all_and_of_nothing(sphere) -> None:
    coverage = metrics.TouchCoverage(sphere.surface_points)
    assert coverage.recall(surface_grid(sphere)) == 1
    assert coverage.recall(np.zeros((32, 32, 32), dtype=bool)) == 0
    assert coverage.recall(points_to_grid(np.array([[0.1, 0.1, 0.1]]))) == 0


def test_curves_agree_with_the_metric_at_every_step(sphere) -> None:
    points = sphere.surface_points[:2000]
    coverage = metrics.TouchCoverage(points)
    steps = np.where(rng(1).random((32, 32, 32)) < 0.02, 3, -1).astype(np.int16)
    steps[surface_grid(sphere)] = rng(2).integers(-1, 20, size=surface_grid(sphere).sum())
    recall = coverage.recall_curve(steps, 20)
    surface = metrics.surface_iou_curve(steps, sphere.surface, 20)
    assert recall.shape == surface.shape == (21,)
    for step in (0, 1, 4, 13, 20):
        touched = (steps >= 0) & (steps < step)
        assert recall[step] == pytest.approx(brute_recall(points, touched), abs=1e-12)
        assert surface[step] == pytest.approx(metrics.iou(touched, sphere.surface))


def test_area_under_curve() -> None:
    assert metrics.area_under_curve(np.ones(11)) == 1
    assert metrics.area_under_curve(np.linspace(0, 1, 11)) == pytest.approx(0.5)
    assert metrics.area_under_curve(np.array([0, 0, 1])) == pytest.approx(0.25)
    with pytest.raises(ValueError, match="two values"):
        metrics.area_under_curve(np.ones(1))


# --- Predictions -----------------------------------------------------------------------------------------------


def test_mesh_and_volume_of_one_box_agree_with_the_true_box(box) -> None:
    """Translated by d along x, boxes of length l overlap by (l - d) / (l + d)."""
    shift = 0.02
    mesh = trimesh.creation.box(extents=np.ptp(box.vertices, axis=0))
    mesh.apply_translation([shift, 0, 0])
    length = float(np.ptp(box.vertices[:, 0]))
    expected = (length - shift) / (length + shift)
    sample = box.iou_points()
    prediction = prepare(mesh, sample.points)
    found = metrics.iou(prediction.solid, box.solid_at_iou_points, sample.weights)
    assert found == pytest.approx(expected, abs=0.01)

    half = np.ptp(box.vertices, axis=0) / 2
    outside = (np.abs(voxel_centres(128) - [shift, 0, 0]) - half).max(axis=-1)
    volume = Volume(np.clip(0.5 - outside / (2 * WORKSPACE_EDGE / 128), 0, 1))
    from_volume = prepare(volume, sample.points)
    assert metrics.iou(from_volume.solid, prediction.solid, sample.weights) > 0.98
    assert np.mean(from_volume.points, axis=0) == pytest.approx([shift, 0, 0], abs=1e-3)


def test_perfect_prediction_reaches_the_ceilings(sphere) -> None:
    prediction = prepare(trimesh.Trimesh(sphere.vertices, sphere.faces), sphere.iou_points().points)
    match = metrics.match_surfaces(metrics.to_metric(prediction.points), metrics.to_metric(sphere.surface_points))
    area = 4 * math.pi * (0.05 / WORKSPACE_EDGE) ** 2
    assert metrics.iou(prediction.solid, sphere.solid_at_iou_points) == 1
    assert metrics.chamfer_l2(match) == pytest.approx(area / (math.pi * SURFACE_SAMPLES), rel=0.05)
    assert metrics.normal_consistency(prediction.normals, sphere.surface_normals, match) > 0.99
    assert metrics.f_score(match, 0.01) == 1


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (None, "missing"),
        (Volume(np.zeros((8, 8, 8))), "nothing is solid"),
        (trimesh.Trimesh(), "no faces"),
        (trimesh.Trimesh(np.eye(3) * 0.1, [[0, 1, 2]]), "watertight"),
        (trimesh.creation.box(extents=[1, 1, 1]), "outside the workspace"),
        (trimesh.Trimesh(np.full((3, 3), np.nan), [[0, 1, 2]], process=False), "finite"),
    ],
)
def test_invalid_predictions_count_as_empty(mesh, reason: str) -> None:
    prediction = prepare(mesh, rng().uniform(-0.1, 0.1, (100, 3)))
    assert reason in (prediction.reason or "")
    assert not prediction.solid.any()
    assert prediction.points.shape == prediction.normals.shape == (0, 3)


@pytest.mark.parametrize("most_work", [0, 50_000_000])
def test_inside_a_mesh_is_by_winding_number_wherever_the_point_is(torus, most_work: int, monkeypatch) -> None:
    """A torus, a ball in its middle that is hollow, and a ball that overlaps the torus: cells and regions of every kind."""
    hollow = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
    hollow.invert()
    overlapping = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    overlapping.apply_translation([0.045, 0, 0])
    parts = [trimesh.Trimesh(torus.vertices, torus.faces), trimesh.creation.icosphere(radius=0.02), hollow, overlapping]
    mesh = trimesh.util.concatenate(parts)
    monkeypatch.setattr(prediction, "_MOST_WORK", most_work)
    points = rng().uniform(-0.08, 0.08, (4000, 3))
    winding = igl.winding_number(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), points)
    assert {0, 1, 2} == set(np.unique(winding.round().astype(int)))
    np.testing.assert_array_equal(prediction.solid_in_mesh(mesh, points), winding >= 0.5)


def test_inverted_mesh_counts_as_empty() -> None:
    mesh = trimesh.creation.box(extents=[0.1, 0.1, 0.1])
    mesh.invert()
    assert "inwards" in (prepare(mesh, rng().uniform(-0.1, 0.1, (100, 3))).reason or "")


def test_mesh_bound_leaves_room_for_the_surface_of_a_full_volume() -> None:
    assert np.abs(Volume(np.ones((8, 8, 8))).to_mesh().vertices).max() < MESH_BOUND
