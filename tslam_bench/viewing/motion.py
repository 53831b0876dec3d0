"""How the hand moved in an episode, step by step, and where that is known from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.scoring.rollout import CHECKPOINT_SPACING, CHECKPOINTS, Rollout

Source = Literal["live", "replayed", "interpolated"]
BETWEEN: Final = f"The hand's path is interpolated between the joint positions of every {CHECKPOINT_SPACING}th step."


@dataclass(frozen=True, eq=False)
class Motion:
    """Joint positions of one episode.

    Attributes:
        joints: (201, 28) float32, m and rad, before the first step and after every step.
        touch: (200, 17) bool, whether each of ``SKIN_LINKS`` touched the object after each step; None: not known.
        source: ``live`` (just simulated), ``replayed`` (the stored actions, simulated again, and they reproduce) or
            ``interpolated`` (between the file's checkpoints).
        note: what the page says about it.
    """

    joints: NDArray[np.float32]
    touch: NDArray[np.bool_] | None
    source: Source
    note: str = ""

    def __post_init__(self) -> None:
        if self.joints.shape != (HORIZON + 1, NUM_JOINTS) or not np.isfinite(self.joints).all():
            raise InvalidInputError(f"motion: joints are {self.joints.shape}; give {(HORIZON + 1, NUM_JOINTS)}, finite")
        if self.touch is not None and self.touch.shape != (HORIZON, len(SKIN_LINKS)):
            raise InvalidInputError(f"motion: touch is {self.touch.shape}; give {(HORIZON, len(SKIN_LINKS))}")


@dataclass(frozen=True)
class MotionSource:
    """Where motions come from.

    Attributes:
        name: part of the names of files that hold them.
        make: (rollouts of one split, control mode of their actions or empty if not known, split) -> their motions.
    """

    name: str
    make: Callable[[Sequence[Rollout], str, str], list[Motion]]


def interpolate(rollout: Rollout, why: str) -> Motion:
    """The motion between a rollout's joint checkpoints, which needs no simulator; ``why`` is told on the page."""
    known, steps = np.arange(CHECKPOINTS) * CHECKPOINT_SPACING, np.arange(HORIZON + 1)
    columns = [np.interp(steps, known, column) for column in rollout.joint_checkpoints.T.astype(np.float64)]
    return Motion(np.stack(columns, axis=1).astype(np.float32), None, "interpolated", f"{BETWEEN} {why}".strip())


def interpolation(why: str = "The actions were not simulated again.") -> MotionSource:
    """The source that needs no simulator."""
    return MotionSource(
        "interpolated", lambda rollouts, mode, split: [interpolate(rollout, why) for rollout in rollouts]
    )
