"""Collected touches to learn from: explored episodes and simulated ones, and the solids that they were felt on.

Everything is kept in the object frame. An example unites the touches of some episodes of one object, cut off at some step, and
turns or mirrors them together with the solid: one of the 48 symmetries of the grid, which cost nothing and lose nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_POSES, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.scanline import inside_grid
from tslam_bench.grids import pack, turn, unpack
from tslam_bench.objects.store import PreparedObject
from tslam_bench.reconstruction.touch_simulation import simulate_touches
from tslam_bench.reconstruction.training_shapes import PlacedShape, training_shape

NEVER: Final = 255
"""First step of a voxel that was never touched or never visited."""
FINE_SIZE: Final = 128
"""Cells per axis at which solids are kept: 2 mm."""
COUNTS_SIZE: Final = 64
"""Cells per axis of the solids' counts; each cell counts its 2^3 fine ones."""
SIMULATED_FOLDER: Final = "simulated"
_FAR_FROM_EMPTY: Final = 20  # draws before a row of untouched examples counts as an object that cannot be felt


def explored_file(folder: Path, name: str) -> Path:
    """Where an object's explored episodes are kept."""
    return folder / f"{name}.npz"


@dataclass(frozen=True, eq=False)
class ExploredObject:
    """Episodes of one policy with one object.

    Attributes:
        first: (E, 2, 32, 32, 32) uint8, touched and visited: the step, 0 to 199, in which it first was, or ``NEVER``.
        poses: (E,) int64, the episodes' poses.
    """

    first: NDArray[np.uint8]
    poses: NDArray[np.int64]

    def save(self, folder: Path, name: str) -> None:
        """Writes the object's file, atomically."""
        _write(explored_file(folder, name), first=self.first, poses=self.poses)

    @classmethod
    def load(cls, folder: Path, name: str) -> ExploredObject:
        """Reads the object's file.

        Raises:
            InvalidInputError: it is missing, cannot be read, or holds something else.
        """
        arrays = _read(explored_file(folder, name), ("first", "poses"))
        first, poses = arrays["first"], arrays["poses"]
        if first.dtype != np.uint8 or first.shape != (len(poses), 2, *(GRID_SIZE,) * 3):
            raise InvalidInputError(f"{explored_file(folder, name)}: holds no explored episodes; collect them again")
        return cls(first, poses)


@dataclass(frozen=True, eq=False)
class SimulatedObject:
    """Simulated explorations of one object, each at a scale of its own about the centre of W.

    Attributes:
        grids: (K, 2, 4096) uint8, touched and visited, packed.
        scales: (K,) float64.
    """

    grids: NDArray[np.uint8]
    scales: NDArray[np.float64]

    def save(self, folder: Path, name: str) -> None:
        """Writes the object's file, atomically."""
        _write(explored_file(folder, name), grids=self.grids, scales=self.scales)

    @classmethod
    def load(cls, folder: Path, name: str) -> SimulatedObject:
        """Reads the object's file.

        Raises:
            InvalidInputError: it is missing, cannot be read, or holds something else.
        """
        arrays = _read(explored_file(folder, name), ("grids", "scales"))
        grids, scales = arrays["grids"], arrays["scales"]
        if grids.dtype != np.uint8 or grids.shape != (len(scales), 2, GRID_SIZE**3 // 8):
            raise InvalidInputError(f"{explored_file(folder, name)}: holds no simulated touches; collect them again")
        return cls(grids, scales)


def simulate_object(item: PreparedObject, count: int, generator: np.random.Generator) -> SimulatedObject:
    """Draws ``count`` simulated explorations of a prepared object, scaled by .7 to 1.2 as far as W allows."""
    shape = training_shape(item.name, item.vertices, item.faces, generator)
    most = 0.98 * WORKSPACE_EDGE / float(2 * shape.half_extents.max())
    grids, scales = [], []
    for _ in range(count):
        scale = min(float(generator.uniform(0.7, 1.2)), most)
        touches = simulate_touches(PlacedShape(shape, np.eye(3), scale, np.zeros(3)), generator)
        grids.append([pack(touches.touched), pack(touches.visited)])
        scales.append(scale)
    return SimulatedObject(np.array(grids, dtype=np.uint8), np.array(scales))


def _write(path: Path, **arrays: NDArray) -> None:
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def _read(path: Path, names: Sequence[str]) -> dict[str, NDArray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except FileNotFoundError:
        raise InvalidInputError(f"{path}: missing; collect it with `tslam-bench reconstruct collect`") from None
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InvalidInputError(f"{path}: cannot be read; delete it and collect it again") from error


@dataclass(frozen=True)
class ExampleMixture:
    """What the examples are drawn from. Shares are probabilities."""

    simulated: float = 0.25
    """Share of simulated explorations, at other scales; the rest are explored ones at the true scale."""
    whole_surface: float = 0.06
    """Share in which the whole surface was touched, or most of it, and all free space swept."""
    poses: tuple[float, ...] = (0.22, 0.20, 0.08, 0.20, 0.04, 0.04, 0.04, 0.18)
    """Of the explored ones: shares of 1, 2, ... 8 poses."""
    one_policy: float = 0.7
    """Of the explored ones: share in which one policy played all poses; else each pose draws its own."""
    cut: float = 0.25
    """Of the explored ones: share whose episodes are all cut off at a step drawn from 1 to 200."""


@dataclass(frozen=True, eq=False)
class TouchObject:
    """One object to learn from.

    Attributes:
        name: for the training record.
        surface, solid: (32, 32, 32) bool at the true scale, see :class:`tslam_bench.objects.store.PreparedObject`.
        fine: (128^3 / 8,) uint8, packed: the solid at the true scale.
        counts: (64, 64, 64) uint8, 0 to 8: solid fine cells in each.
        explored: episodes, one entry per policy.
        simulated: simulated explorations, or None.
    """

    name: str
    surface: NDArray[np.bool_]
    solid: NDArray[np.bool_]
    fine: NDArray[np.uint8]
    counts: NDArray[np.uint8]
    explored: tuple[ExploredObject, ...]
    simulated: SimulatedObject | None

    @classmethod
    def of(
        cls, item: PreparedObject, explored: Sequence[ExploredObject], simulated: SimulatedObject | None
    ) -> TouchObject:
        """The solid of a prepared object, sampled, with what was collected on it."""
        edge = WORKSPACE_EDGE / FINE_SIZE
        origin = np.full(3, WORKSPACE_LOW + edge / 2)
        fine = inside_grid(TriangleMesh(item.vertices, item.faces), origin, edge, (FINE_SIZE,) * 3)
        return cls(item.name, item.surface, item.solid, np.packbits(fine), _count(fine), tuple(explored), simulated)

    def scaled(self, scale: float) -> NDArray[np.uint8]:
        """Counts (64, 64, 64) of the solid scaled about the centre of W."""
        fine = np.unpackbits(self.fine).reshape((FINE_SIZE,) * 3)
        centre = (FINE_SIZE - 1) / 2
        index = np.rint((np.arange(FINE_SIZE) - centre) / scale + centre).astype(np.int64)
        within = (index >= 0) & (index < FINE_SIZE)
        axis = np.clip(index, 0, FINE_SIZE - 1)
        taken = fine[np.ix_(axis, axis, axis)]
        taken[~within] = 0
        taken[:, ~within] = 0
        taken[:, :, ~within] = 0
        return _count(taken)


def _count(fine: NDArray) -> NDArray[np.uint8]:
    """Solid cells (128, 128, 128) -> how many of the 2^3 in each of 64^3."""
    blocks = fine.astype(np.uint8, copy=False).reshape(COUNTS_SIZE, 2, COUNTS_SIZE, 2, COUNTS_SIZE, 2)
    return np.asarray(blocks.sum(axis=(1, 3, 5), dtype=np.uint8))


def load_touch_data(
    folder: Path, items: Sequence[PreparedObject], progress: Callable[[int, int], None] | None = None
) -> list[TouchObject]:
    """Objects with everything that ``folder`` holds on them: ``<policy>/<object>.npz`` and ``simulated/<object>.npz``.

    Raises:
        InvalidInputError: no such folder, nothing in it, or files missing or unreadable.
    """
    policies = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    if not policies:
        raise InvalidInputError(f"{folder}: holds no collected touches; run `tslam-bench reconstruct collect` first")
    data = []
    for done, item in enumerate(items):
        explored = [ExploredObject.load(folder / name, item.name) for name in policies if name != SIMULATED_FOLDER]
        simulated = SimulatedObject.load(folder / SIMULATED_FOLDER, item.name) if SIMULATED_FOLDER in policies else None
        data.append(TouchObject.of(item, explored, simulated))
        if progress:
            progress(done + 1, len(items))
    return data


@dataclass(frozen=True, eq=False)
class Example:
    """Touched and visited (2, 32, 32, 32) bool, and the solid's counts (64, 64, 64) uint8, 0 to 8."""

    grids: NDArray[np.bool_]
    counts: NDArray[np.uint8]


def draw_example(item: TouchObject, mixture: ExampleMixture, generator: np.random.Generator) -> Example:
    """Draws what some exploration of an object may have felt; at least one voxel is touched."""
    for _ in range(_FAR_FROM_EMPTY):
        kind = generator.random()
        if kind < mixture.whole_surface or not (item.explored or item.simulated):
            grids, counts = _whole_surface(item, generator), item.counts
        elif item.simulated is not None and (kind < mixture.whole_surface + mixture.simulated or not item.explored):
            chosen = int(generator.integers(len(item.simulated.scales)))
            grids = np.stack([unpack(bits) for bits in item.simulated.grids[chosen]])
            counts = item.scaled(float(item.simulated.scales[chosen]))
        else:
            grids, counts = _explored(item, mixture, generator), item.counts
        if grids[0].any():
            break
    else:
        grids, counts = _whole_surface(item, generator), item.counts
    symmetry = random_symmetry(generator)
    return Example(turn(grids, symmetry), turn(counts, symmetry))


def _whole_surface(item: TouchObject, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Every voxel of the surface touched and all free space swept, or, in half of the draws, neither quite."""
    touched, visited = item.surface.copy(), ~item.solid
    if generator.random() < 0.5:
        touched &= generator.random(touched.shape) < generator.uniform(0.5, 1)
        visited &= generator.random(visited.shape) < generator.uniform(0.8, 1)
    return np.stack([touched, visited])


def _explored(item: TouchObject, mixture: ExampleMixture, generator: np.random.Generator) -> NDArray[np.bool_]:
    count = 1 + int(generator.choice(NUM_POSES, p=mixture.poses))
    poses = generator.permutation(NUM_POSES)[:count]
    one = generator.random() < mixture.one_policy
    policy = int(generator.integers(len(item.explored)))
    until = int(generator.integers(1, HORIZON)) if generator.random() < mixture.cut else HORIZON
    grids = np.zeros((2, *(GRID_SIZE,) * 3), dtype=bool)
    for pose in poses:
        episodes = item.explored[policy if one else int(generator.integers(len(item.explored)))]
        fitting = np.flatnonzero(episodes.poses == pose)
        if len(fitting):
            grids |= episodes.first[fitting[int(generator.integers(len(fitting)))]] < until
    return grids


def random_symmetry(generator: np.random.Generator) -> NDArray[np.int64]:
    """One of the 48 signed permutations (3, 3)."""
    matrix = np.zeros((3, 3), dtype=np.int64)
    matrix[range(3), generator.permutation(3)] = generator.choice((-1, 1), 3)
    return matrix
