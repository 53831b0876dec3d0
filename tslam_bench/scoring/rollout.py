"""One episode and its file, the same in a run's folder and in a submission (protocol section 12).

The file ``<object>/pose<k>_seed<s>.npz`` holds the arrays of :data:`ARRAYS`; its name tells the episode. Format 1, which had
no joint checkpoints, is refused.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS
from tslam_bench.episodes import Episode
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file, read_plain_file
from tslam_bench.grids import pack, unpack
from tslam_bench.scoring.untrusted_arrays import Expected, read_npz
from tslam_bench.scoring.untrusted_files import MAX_FILE_SIZE

ROLLOUT_FORMAT: Final = 2
"""Version of a file's content."""
CHECKPOINT_SPACING: Final = 10
"""Control steps between the joint checkpoints."""
CHECKPOINTS: Final = HORIZON // CHECKPOINT_SPACING + 1
"""Joint checkpoints of an episode, with the one before the first step."""
ARRAYS: Final = {
    "format": Expected("int16", ()),
    "actions": Expected("float32", (HORIZON, NUM_JOINTS)),
    "touched": Expected("uint8", (GRID_SIZE**3 // 8,)),
    "visited": Expected("uint8", (GRID_SIZE**3 // 8,)),
    "touched_step": Expected("int16", (GRID_SIZE,) * 3),
    "joint_checkpoints": Expected("float32", (CHECKPOINTS, NUM_JOINTS)),
}
"""Arrays of a file; the two grids are packed (:func:`tslam_bench.grids.pack`)."""
OBJECT_NAME: Final = r"[A-Za-z0-9][A-Za-z0-9_-]{0,79}"
"""Pattern of an object's name in a file's name."""
_FORMAT_1: Final[dict[tuple[str, ...], str]] = {
    ("actions", "touched", "touched_step", "visited"): (
        "rollout format 1, which has no joint checkpoints; remove it and explore again with this version"
    )
}
_FILE: Final = re.compile(rf"({OBJECT_NAME})/pose([0-7])_seed(0|[1-9][0-9]{{0,9}})\.npz")


def rollout_file(object_name: str, pose: int, seed: int) -> str:
    """Name of an episode's file below a folder of rollouts."""
    return f"{object_name}/pose{pose}_seed{seed}.npz"


def parse_rollout_file(name: str) -> Episode | None:
    """The episode that :func:`rollout_file` gives ``name`` for, or None."""
    match = _FILE.fullmatch(name)
    return (match[1], int(match[2]), int(match[3])) if match else None


@dataclass(frozen=True, eq=False)
class Rollout:
    """One episode: one object, one pose, one seed. Grids are in the world frame of that pose.

    Attributes:
        object, pose, seed: what was explored; the episode's own seed is ``episode_seed(pose, seed)``.
        actions: (200, 28) float32 in [-1, 1], one row per control step.
        touched: (32, 32, 32) bool, voxels touched by the end.
        visited: (32, 32, 32) bool, voxels visited by the end.
        touched_step: (32, 32, 32) int16, control step (from 0) at which a voxel was first touched, -1 for never.
        joint_checkpoints: (21, 28) float32, joint positions (m, rad) as observed before the first step and after every tenth,
            in the order of ``JOINT_NAMES``: for replays and players.

    Raises:
        InvalidInputError: no such pose or name, shapes, data types or values are wrong, or ``touched_step`` and ``touched``
            disagree.
    """

    object: str
    pose: int
    seed: int
    actions: NDArray[np.float32]
    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]
    touched_step: NDArray[np.int16]
    joint_checkpoints: NDArray[np.float32]

    def __post_init__(self) -> None:
        if parse_rollout_file(self.file) is None:
            raise InvalidInputError(f"{self.file}: not the name of a rollout; check object, pose and seed")
        grid = (GRID_SIZE,) * 3
        for name, dtype, shape in (
            ("actions", np.float32, (HORIZON, NUM_JOINTS)),
            ("touched", np.bool_, grid),
            ("visited", np.bool_, grid),
            ("touched_step", np.int16, grid),
            ("joint_checkpoints", np.float32, (CHECKPOINTS, NUM_JOINTS)),
        ):
            value = np.asarray(getattr(self, name))
            if value.shape != shape or value.dtype != dtype:
                wanted = f"{shape} {np.dtype(dtype)}"
                raise InvalidInputError(f"{name} is {value.shape} {value.dtype}; expected {wanted}")
        if not np.isfinite(self.actions).all():
            raise InvalidInputError("actions hold NaN or infinite values; store the actions that were executed")
        if np.abs(self.actions).max() > 1:
            raise InvalidInputError("actions leave [-1, 1]; clip them before they are executed and stored")
        if not np.isfinite(self.joint_checkpoints).all():
            raise InvalidInputError("joint_checkpoints hold NaN or infinite values; store the observed joint positions")
        if ((self.touched_step < -1) | (self.touched_step >= HORIZON)).any():
            raise InvalidInputError(f"touched_step holds values outside -1..{HORIZON - 1}")
        if not np.array_equal(self.touched_step >= 0, self.touched):
            raise InvalidInputError("touched_step and touched disagree; a voxel is touched iff its step is 0 or more")

    @property
    def file(self) -> str:
        """Name of its file below a folder of rollouts."""
        return rollout_file(self.object, self.pose, self.seed)

    def to_bytes(self) -> bytes:
        """Content of its file; equal rollouts give equal bytes."""
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            format=np.int16(ROLLOUT_FORMAT),
            actions=self.actions,
            touched=pack(self.touched),
            visited=pack(self.visited),
            touched_step=self.touched_step,
            joint_checkpoints=self.joint_checkpoints,
        )
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, episode: Episode, where: str) -> Rollout:
        """Reads :meth:`to_bytes`'s result without trusting it.

        Args:
            episode: object, pose and seed.
            where: the file's name for messages.

        Raises:
            InvalidInputError: of another format, truncated, pickled, arrays missing or unknown, or not a rollout.
        """
        arrays = read_npz(data, ARRAYS, where, _FORMAT_1)
        if arrays["format"] != ROLLOUT_FORMAT:
            raise InvalidInputError(
                f"{where}: rollout format {arrays['format']}, this version reads {ROLLOUT_FORMAT}; explore again with it"
            )
        touched, visited = unpack(arrays["touched"]), unpack(arrays["visited"])
        try:
            return cls(
                *episode, arrays["actions"], touched, visited, arrays["touched_step"], arrays["joint_checkpoints"]
            )
        except InvalidInputError as error:
            raise InvalidInputError(f"{where}: {error}") from error

    def save(self, folder: Path) -> Path:
        """Writes the file below ``folder``, whole or not at all, and returns its path."""
        path = folder / self.file
        with atomic_file(path) as temporary:
            temporary.write_bytes(self.to_bytes())
        return path

    @classmethod
    def load(cls, path: Path) -> Rollout:
        """Reads a file that :meth:`save` wrote.

        Raises:
            InvalidInputError: it is missing or damaged, or is not a rollout.
        """
        episode = parse_rollout_file("/".join(path.parts[-2:]))
        if episode is None:
            raise InvalidInputError(f"{path}: not the name of a rollout, <object>/pose<k>_seed<s>.npz")
        return cls.from_bytes(read_plain_file(path, MAX_FILE_SIZE), episode, str(path))
