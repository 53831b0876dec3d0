"""From actions to drive targets (protocol section 2), batched over environments, on numpy or torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tslam_bench.engine.arrays import Array, Backend
from tslam_bench.engine.requests import check_control_mode
from tslam_bench.hand_constants import (
    COUPLED_JOINTS,
    COUPLING_END,
    COUPLING_MIDDLE,
    COUPLING_SLACK,
    DELTA_STEP,
    JOINT_LIMITS,
    JOINT_NAMES,
)

MIDDLE = np.array([JOINT_NAMES.index(middle) for middle, _ in COUPLED_JOINTS])
END = np.array([JOINT_NAMES.index(end) for _, end in COUPLED_JOINTS])


class DriveTargets:
    """Computes the 28 drive targets of E hands.

    Args:
        mode: ``pd_joint_delta_pos`` or ``pd_joint_pos``.
        backend: numpy or torch.
        step_limit: (28,) how far each target may be ahead of its joint (m or rad).

    Raises:
        InvalidInputError: unknown mode.
    """

    def __init__(self, mode: str, backend: Backend, step_limit: NDArray[np.float64] = DELTA_STEP) -> None:
        self.mode = check_control_mode(mode)
        self._backend = backend
        limits = JOINT_LIMITS.astype(np.float32)
        self._low, self._high = backend.array(limits[:, 0]), backend.array(limits[:, 1])
        self._half_range = backend.array((limits[:, 1] - limits[:, 0]) / 2)
        self._middle_range = backend.array((limits[:, 1] + limits[:, 0]) / 2)
        self._delta = backend.array(step_limit.astype(np.float32))
        self._coupled = backend.array(MIDDLE), backend.array(END)  # on the device: no copy per step

    def __call__(self, action: Array, qpos: Array) -> Array:
        """Targets (E, 28) for actions (E, 28), clipped to [-1, 1], at joint positions (E, 28); m and rad."""
        clip = self._backend.clip
        action = clip(action, -1.0, 1.0)
        if self.mode == "pd_joint_delta_pos":
            target = qpos + action * self._delta
        else:  # no faster than the other mode: the goal may be anywhere, the target is within a step of the joint
            away = self._middle_range + action * self._half_range - qpos
            xp = self._backend.module
            target = qpos + xp.minimum(xp.maximum(away, -self._delta), self._delta)
        coupled = _couple(self._clip_to_limits(target), self._backend, *self._coupled)
        return _pull_back(self._clip_to_limits(coupled), self._backend, *self._coupled)

    def _clip_to_limits(self, target: Array) -> Array:
        xp = self._backend.module
        return xp.minimum(xp.maximum(target, self._low), self._high)


def _couple(target: Array, backend: Backend, middles: Array, ends: Array) -> Array:
    """Projects each finger's middle and end joint onto what its tendon allows: the nearest point of the band."""
    middle, end = target[:, middles], target[:, ends]
    stretch = COUPLING_END * end - COUPLING_MIDDLE * middle
    excess = stretch - backend.clip(stretch, -COUPLING_SLACK, COUPLING_SLACK)
    scale = 1.0 / (COUPLING_END**2 + COUPLING_MIDDLE**2)
    coupled = backend.array(target)
    coupled[:, middles] = middle + (COUPLING_MIDDLE * scale) * excess
    coupled[:, ends] = end - (COUPLING_END * scale) * excess
    return coupled


def _pull_back(target: Array, backend: Backend, middles: Array, ends: Array) -> Array:
    """Straightens the joint that is ahead of its tendon: mends what clipping did to the coupling, inside the limits."""
    xp = backend.module
    middle, end = target[:, middles], target[:, ends]
    pulled = backend.array(target)
    pulled[:, ends] = xp.minimum(end, (COUPLING_SLACK + COUPLING_MIDDLE * middle) * (1.0 / COUPLING_END))
    pulled[:, middles] = xp.minimum(middle, (COUPLING_SLACK + COUPLING_END * end) * (1.0 / COUPLING_MIDDLE))
    return pulled
