"""Every reward mode against a plain second implementation of its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tslam_bench.constants import REWARD_MODES, VOXEL_EDGE, WORKSPACE_EDGE
from tslam_bench.engine.arrays import NumpyBackend, TorchBackend
from tslam_bench.engine.rewards import COVERAGE_WEIGHT, MODE_SCALE, SURFACE_SUBSAMPLE, Rewards
from tslam_bench.engine.sensing import MAX_NEW_CONTACTS, Contacts
from tslam_bench.geometry.alpha_shape import alpha_shape_samples, alpha_shape_triangles, chamfer_l2, thin_out

ENVS, PROBES, STEPS = 3, 50, 8


def random_contacts(seed: int) -> list[Contacts]:
    generator = np.random.default_rng(seed)
    steps = []
    on = np.zeros((ENVS, PROBES), dtype=bool)
    for _ in range(STEPS):
        now = generator.random((ENVS, PROBES)) < 0.2
        now[generator.integers(ENVS)] = False
        new = now & ~on
        on = now
        mask = np.zeros((ENVS, MAX_NEW_CONTACTS), dtype=bool)
        points = np.zeros((ENVS, MAX_NEW_CONTACTS, 3), dtype=np.float32)
        for env in range(ENVS):
            count = int(new[env].sum())
            mask[env, :count] = True
            direction = generator.normal(size=(count, 3))
            points[env, :count] = 0.05 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        visited, touched = generator.integers(0, 90, ENVS), np.minimum(new.sum(1), generator.integers(0, 9, ENVS))
        steps.append(Contacts(now, new, points, mask, touched, visited))
    return steps


def play(mode: str, steps: list[Contacts], surface: np.ndarray | None = None, backend=None) -> np.ndarray:
    rewards = Rewards(mode, ENVS, backend or NumpyBackend())
    if surface is not None:
        for env in range(ENVS):
            rewards.set_surface(env, surface)
    rewards.begin(range(ENVS))
    return np.stack([np.asarray(rewards.step(contacts)) for contacts in steps])


def as_tensors(steps: list[Contacts]) -> list[Contacts]:
    names = ("on", "new", "points", "mask", "new_touched", "new_visited")
    return [Contacts(**{name: torch.from_numpy(np.asarray(getattr(c, name))) for name in names}) for c in steps]


def test_terms_of_the_papers_reward():
    steps = random_contacts(0)
    touched = np.stack([c.new_touched for c in steps])
    visited = np.stack([c.new_visited for c in steps])
    np.testing.assert_allclose(play("no_coverage", steps), touched, rtol=1e-6)
    np.testing.assert_allclose(play("no_discovery", steps), COVERAGE_WEIGHT * visited, rtol=1e-6)
    np.testing.assert_allclose(play("tslam", steps), touched + COVERAGE_WEIGHT * visited, rtol=1e-6)


def test_points_and_contact():
    steps = random_contacts(1)
    coverage = COVERAGE_WEIGHT * np.stack([c.new_visited for c in steps])
    points = np.stack([c.new.sum(axis=1) for c in steps])
    np.testing.assert_allclose(play("points", steps), MODE_SCALE["points"] * points + coverage, rtol=1e-6)
    contact = np.stack([[bool(row.any()) for row in c.on] for c in steps])
    np.testing.assert_allclose(play("contact", steps), MODE_SCALE["contact"] * contact + coverage, rtol=1e-6)


def test_knn_is_the_mean_distance_to_five_nearest_known_points():
    steps = random_contacts(2)
    expected = []
    known = [np.zeros((0, 3)) for _ in range(ENVS)]
    for c in steps:
        row = []
        for env in range(ENVS):
            new, value = c.points[env][c.mask[env]].astype(np.float64), 0.0
            if len(new) and len(known[env]):
                distance = np.linalg.norm(new[:, None] - known[env][None], axis=2)
                value = np.mean([np.sort(d)[:5].mean() for d in distance]) / VOXEL_EDGE
            known[env] = np.concatenate([known[env], new])
            row.append(MODE_SCALE["knn"] * value + COVERAGE_WEIGHT * c.new_visited[env])
        expected.append(row)
    np.testing.assert_allclose(play("knn", steps), expected, rtol=1e-5)


def test_chamfer_is_the_relative_decrease_of_the_distance_to_the_true_surface():
    steps = random_contacts(3)
    direction = np.random.default_rng(4).normal(size=(SURFACE_SUBSAMPLE, 3))
    surface = 0.06 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    expected = []
    known, last, first = [np.zeros((0, 3))] * ENVS, [None] * ENVS, [None] * ENVS
    for c in steps:
        row = []
        for env in range(ENVS):
            known[env] = np.concatenate([known[env], c.points[env][c.mask[env]]])
            value = 0.0
            if len(known[env]):
                to_surface = cKDTree(surface).query(known[env])[0] / WORKSPACE_EDGE
                to_points = cKDTree(known[env]).query(surface)[0] / WORKSPACE_EDGE
                now = 0.5 * (np.mean(to_surface**2) + np.mean(to_points**2))
                if first[env] is None:
                    first[env] = now
                else:
                    value = (last[env] - now) / first[env]
                last[env] = now
            row.append(MODE_SCALE["chamfer"] * value + COVERAGE_WEIGHT * c.new_visited[env])
        expected.append(row)
    np.testing.assert_allclose(play("chamfer", steps, surface), expected, rtol=2e-4, atol=2e-4)


def test_disagreement_is_the_chamfer_distance_between_successive_alpha_shapes():
    steps = random_contacts(5)
    expected = []
    known, before = [np.zeros((0, 3), dtype=np.float32)] * ENVS, [None] * ENVS
    for c in steps:
        row = []
        for env in range(ENVS):
            new, value = c.points[env][c.mask[env]], 0.0
            if len(new):
                known[env] = np.concatenate([known[env], new])
                after = alpha_shape_samples(thin_out(known[env]))
                if before[env] is not None:
                    value = chamfer_l2(before[env], after) / WORKSPACE_EDGE**2
                before[env] = after
            row.append(MODE_SCALE["disagreement"] * value + COVERAGE_WEIGHT * c.new_visited[env])
        expected.append(row)
    np.testing.assert_allclose(play("disagreement", steps), expected, rtol=1e-5)


def test_chamfer_of_two_point_sets():
    a, b = (np.random.default_rng(seed).normal(size=(count, 3)) for seed, count in ((0, 40), (1, 70)))
    expected = 0.5 * (np.mean(cKDTree(b).query(a)[0] ** 2) + np.mean(cKDTree(a).query(b)[0] ** 2))
    assert chamfer_l2(a, b) == pytest.approx(expected, rel=1e-9)
    assert chamfer_l2(a, a) == 0


def test_alpha_shape_of_a_filled_cube_is_its_surface():
    axis = np.linspace(-0.03, 0.03, 5)
    jitter = np.random.default_rng(0).uniform(-1e-5, 1e-5, (125, 3))
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3) + jitter
    triangles = alpha_shape_triangles(points)
    area = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    assert area.sum() == pytest.approx(6 * 0.06**2, rel=0.05)
    assert np.abs(np.abs(alpha_shape_samples(thin_out(points))).max(axis=1) - 0.03).max() < 2e-3
    assert len(alpha_shape_triangles(points[:3])) == 0, "three points enclose nothing"
    flat = points.copy()
    flat[:, 2] = 0.0
    assert len(alpha_shape_triangles(flat)) == 0, "coplanar points enclose nothing"


@pytest.mark.parametrize("mode", REWARD_MODES)
def test_torch_agrees_with_numpy_and_batches_do_not_matter(mode):
    steps = random_contacts(6)
    surface = np.random.default_rng(7).uniform(-0.06, 0.06, (SURFACE_SUBSAMPLE, 3))
    batch = play(mode, steps, surface)
    np.testing.assert_allclose(play(mode, as_tensors(steps), surface, TorchBackend("cpu")), batch, rtol=1e-4, atol=1e-5)
    rewards = Rewards(mode, 1, NumpyBackend())
    rewards.set_surface(0, surface)
    rewards.begin([0])
    names = ("on", "new", "points", "mask", "new_touched", "new_visited")
    alone = [rewards.step(Contacts(**{n: getattr(c, n)[1:2] for n in names}))[0] for c in steps]
    np.testing.assert_array_equal(alone, batch[:, 1])
