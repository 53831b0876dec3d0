"""Is the GPU simulation the same task as the CPU one? Records episodes on both and compares them.

Contact is chaotic: two simulations that differ in the last bit part ways, so equality cannot be asked for. The yardstick
is the CPU itself: the same episodes with actions changed by ``PERTURBATION``. The GPU may differ from the CPU by no more than
that does, within the margins below.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.evaluation.observations import last_observation

PERTURBATION: Final = 1e-4
"""Largest change of an action (of 1) in the yardstick's episodes."""
TOUCH_MARGIN: Final = 0.01
"""The share of equal touch bits may lie this far below the yardstick's."""
GRID_MARGIN: Final = 0.10
"""The mean IoU of touched, and of visited, grids may lie this far below the yardstick's."""
RETURN_MARGIN: Final = 0.10
"""The mean episode return may differ by this share from the CPU's, beyond what the yardstick's does."""
FREE_MOTION_LIMIT: Final = 5e-3
"""Largest difference of a joint position (m or rad) in the steps before an episode's first touch."""


@dataclass(frozen=True)
class Episodes:
    """What is simulated: one object, pose and seed per environment, and actions (200, num_envs, 28) float32."""

    objects: tuple[str, ...]
    poses: tuple[int, ...]
    seeds: tuple[int, ...]
    actions: NDArray[np.float32]

    @classmethod
    def draw(cls, objects: Sequence[str], poses: Sequence[int], num_envs: int, seed: int = 0) -> Episodes:
        """Objects and poses in turn; hands that come down and then move at random."""
        generator = np.random.Generator(np.random.PCG64(seed))
        actions = generator.uniform(-1, 1, (HORIZON, num_envs, NUM_JOINTS)).astype(np.float32)
        actions[:40, :, 1] = -1.0
        return cls(
            tuple(objects[env % len(objects)] for env in range(num_envs)),
            tuple(poses[env // len(objects) % len(poses)] for env in range(num_envs)),
            tuple(range(seed, seed + num_envs)),
            actions,
        )

    def perturbed(self) -> Episodes:
        """The same episodes with every action changed by up to ``PERTURBATION``."""
        generator = np.random.Generator(np.random.PCG64(1))
        noise = generator.uniform(-PERTURBATION, PERTURBATION, self.actions.shape).astype(np.float32)
        return Episodes(self.objects, self.poses, self.seeds, self.actions + noise)


@dataclass(frozen=True)
class Recording:
    """What the episodes gave.

    Attributes:
        touch: (T, E, L) bool, touch bits.
        qpos: (T, E, 28) float32.
        rewards: (T, E) float32.
        touched, visited: (E, 32, 32, 32) bool, at the end.
        seconds: wall time of the steps.
    """

    touch: NDArray[np.bool_]
    qpos: NDArray[np.float32]
    rewards: NDArray[np.float32]
    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    seconds: float

    @property
    def steps_per_second(self) -> float:
        """Control steps of all environments per second of wall time, observations copied to the host."""
        return self.rewards.size / self.seconds


def record(envs: VectorEnv, episodes: Episodes) -> Recording:
    """Plays one episode in each environment of ``make_vec`` (numpy or torch, any device)."""
    seeds: Any = list(episodes.seeds)
    options = {"object": list(episodes.objects), "pose": list(episodes.poses), "reconfigure": True}
    observation, _ = envs.reset(seed=seeds, options=options)
    touch, qpos, rewards = [], [], []
    start = time.perf_counter()
    for action in episodes.actions:
        observation, reward, _, _, info = envs.step(action)
        last = last_observation(observation, info)
        touch.append(_host(last["touch"]).astype(bool))
        qpos.append(_host(last["qpos"]))
        rewards.append(_host(reward).astype(np.float32))
    seconds = time.perf_counter() - start
    occupancy = _host(last["occupancy"]).astype(bool)
    return Recording(np.stack(touch), np.stack(qpos), np.stack(rewards), occupancy[:, 0], occupancy[:, 1], seconds)


def _host(value: Any) -> NDArray:
    return np.array(value) if isinstance(value, np.ndarray) else value.cpu().numpy().copy()


@dataclass(frozen=True)
class Agreement:
    """How alike two recordings of the same episodes are.

    Attributes:
        touch: share of equal touch bits among those of (step, environment, link) where either hand touches anything.
        touched_iou, visited_iou: mean over environments of the grids' intersection over union (1 if both are empty).
        mean_return: mean episode return of the second over that of the first, minus 1.
        free_motion: largest difference of a joint position before either hand's first touch (m or rad).
        contacts: touch bits that are on in the first recording.
    """

    touch: float
    touched_iou: float
    visited_iou: float
    mean_return: float
    free_motion: float
    contacts: int


def compare(reference: Recording, other: Recording) -> Agreement:
    """Compares two recordings of the same episodes."""
    anything = reference.touch.any(axis=2) | other.touch.any(axis=2)
    equal = reference.touch == other.touch
    free = ~np.logical_or.accumulate(anything, axis=0)
    difference = np.abs(reference.qpos - other.qpos).max(axis=2)
    total = float(reference.rewards.sum())
    return Agreement(
        touch=float(equal[anything].mean()) if anything.any() else 1.0,
        touched_iou=_mean_iou(reference.touched, other.touched),
        visited_iou=_mean_iou(reference.visited, other.visited),
        mean_return=float(other.rewards.sum()) / total - 1 if total else float(other.rewards.sum()),
        free_motion=float(difference[free].max()) if free.any() else 0.0,
        contacts=int(reference.touch.sum()),
    )


def _mean_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    both, either = (a & b).sum(axis=(1, 2, 3)), (a | b).sum(axis=(1, 2, 3))
    return float(np.where(either > 0, both / np.maximum(either, 1), 1.0).mean())


@dataclass(frozen=True)
class Finding:
    """One figure against its limit."""

    name: str
    value: float
    limit: float
    passed: bool


def judge(found: Agreement, yardstick: Agreement) -> list[Finding]:
    """The figures of a GPU run against what a perturbed CPU run shows."""

    def at_least(name: str, margin: float) -> Finding:
        value, limit = getattr(found, name), getattr(yardstick, name) - margin
        return Finding(name, value, limit, bool(value >= limit))

    def at_most(name: str, limit: float) -> Finding:
        value = abs(getattr(found, name))
        return Finding(name, value, limit, bool(value <= limit))

    return [
        at_least("touch", TOUCH_MARGIN),
        at_least("touched_iou", GRID_MARGIN),
        at_least("visited_iou", GRID_MARGIN),
        at_most("mean_return", RETURN_MARGIN + abs(yardstick.mean_return)),
        at_most("free_motion", FREE_MOTION_LIMIT),
        Finding("contacts", found.contacts, 1, found.contacts >= 1),
    ]
