"""Makes the shapes of a submission again with its own reconstructor, and shapes of fresh, swapped and turned touches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import NUM_POSES, OCCUPANCY_THRESHOLD
from tslam_bench.episodes import Episode, policy_seed
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.evaluate import merged_grids
from tslam_bench.grids import object_to_world, pose_rotation
from tslam_bench.objects.store import load_object
from tslam_bench.reconstruction.volume import Reconstructor, Volume
from tslam_bench.scoring.metrics import iou
from tslam_bench.scoring.prediction import prepare
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, Reconstruction, Submission, reconstruction_name

PROBABILITY_TOLERANCE: Final = 0.02
MOST_OTHER_CELLS: Final = 0.005
"""Share of a volume's cells that may be further apart than ``PROBABILITY_TOLERANCE``."""
LEAST_AGREEMENT: Final = 0.98
"""IoU of stored and computed shape, where one of them is a mesh."""
_LAST: Final = max(RECONSTRUCTED_POSES)
Grids = tuple[NDArray[np.bool_], NDArray[np.bool_]]


class Shapes:
    """Computes shapes again and compares them.

    Args:
        submission: its rollouts reproduce.
        objects: those that it holds.
        fresh: rollouts of the repetition ``fresh_seed``.
        salt: hexadecimal digits that the order follows from.

    Attributes:
        count: reconstructions that were compared; departed: files of those that are others.
    """

    def __init__(
        self,
        submission: Submission,
        objects: Sequence[str],
        fresh: Mapping[Episode, Rollout],
        fresh_seed: int,
        salt: str,
    ) -> None:
        self._submission, self._objects, self._fresh = submission, objects, fresh
        self._fresh_seed, self._salt = fresh_seed, salt
        self._prepared = {name: load_object(name, submission.split) for name in objects}
        self._points = {name: prepared.iou_points() for name, prepared in self._prepared.items()}
        self._values: dict[str, dict[str, list[float]]] = {
            kind: {} for kind in ("claimed", "fresh", "own", "swapped", "turned")
        }
        self.count = 0
        self.departed: list[str] = []

    def means(self, kind: str) -> dict[str, float]:
        """Object -> mean IoU."""
        return {name: float(np.mean(values)) for name, values in sorted(self._values[kind].items())}

    def compare(self, reconstructor: Reconstructor, report: Callable[[int, int], None]) -> None:
        """Makes every shape and compares it with what is stored, or with the truth."""
        seeds = self._submission.info.seeds
        jobs = [(name, count, seed) for name in self._objects for count in RECONSTRUCTED_POSES for seed in seeds]
        jobs += [(name, count, -1) for name in self._objects for count in RECONSTRUCTED_POSES]  # fresh
        jobs += [(name, kind, 0) for name in self._objects for kind in (-1, -2)]  # swapped, turned
        order = np.random.default_rng([int(self._salt, 16), len(jobs)]).permutation(len(jobs))
        for done, index in enumerate(order):
            name, count, seed = jobs[index]
            if count == -1:
                self._swapped(reconstructor, name)
            elif count == -2:
                self._turned(reconstructor, name)
            elif seed == -1:
                self._add("fresh", name, reconstructor.reconstruct(*self._grids(name, count, self._fresh_seed)))
            else:
                self._stored(reconstructor, name, count, seed)
            report(done + 1, len(jobs))

    def _stored(self, reconstructor: Reconstructor, name: str, count: int, seed: int) -> None:
        """Compares a shape of the submission with the one that the code makes."""
        stored = self._submission.reconstruction(name, count, seed)
        self._add("claimed", name, stored)
        made = reconstructor.reconstruct(*self._grids(name, count, seed))
        if stored is not None:  # else it counts as empty
            self.count += 1
            if not same_shape(stored, made, self._points[name].points, self._points[name].weights):
                suffix = "npz" if isinstance(stored, Volume) else "ply"
                self.departed.append(reconstruction_name(name, count, seed, suffix))
        if count == _LAST and seed == self._submission.info.seeds[0]:
            self._add("own", name, made)

    def _swapped(self, reconstructor: Reconstructor, name: str) -> None:
        """The shape made of the touches of the object that is least like this one, against this one."""
        others = [other for other in self._objects if other != name]
        if others:
            own = self._prepared[name].solid
            other = min(others, key=lambda each: iou(self._prepared[each].solid, own))
            grids = self._grids(other, _LAST, self._submission.info.seeds[0])
            self._add("swapped", name, reconstructor.reconstruct(*grids))

    def _turned(self, reconstructor: Reconstructor, name: str) -> None:
        """The shape made of turned touches, against the turned truth."""
        pose = 1 + policy_seed(self._salt, (name, 0, 0)) % (NUM_POSES - 1)
        touched, visited = (
            object_to_world(grid, pose) for grid in self._grids(name, _LAST, self._submission.info.seeds[0])
        )
        self._add("turned", name, reconstructor.reconstruct(touched, visited), pose_rotation(pose))

    def _add(self, kind: str, name: str, shape: Reconstruction | None, rotation: NDArray | None = None) -> None:
        points = self._points[name]
        asked = points.points if rotation is None else points.points @ rotation.T
        value = iou(_solid(shape, asked), self._prepared[name].solid_at_iou_points, points.weights)
        self._values[kind].setdefault(name, []).append(value)

    def _grids(self, name: str, count: int, seed: int) -> Grids:
        poses = RECONSTRUCTED_POSES[count]
        if seed == self._fresh_seed:
            return merged_grids([self._fresh[name, pose, seed] for pose in poses])
        rollouts = [self._submission.rollout(name, pose, seed) for pose in poses]
        known = [rollout for rollout in rollouts if rollout is not None]
        if not known:
            raise InvalidInputError(f"{self._submission.location}: {name}, seed {seed}: no rollouts to make a shape of")
        return merged_grids(known)


def same_shape(stored: Reconstruction, made: Volume, points: NDArray, weights: NDArray) -> bool:
    """Whether a stored reconstruction is the one that was computed again: cell by cell, or for a mesh by their IoU."""
    if isinstance(stored, Volume):
        if stored.interpolation != made.interpolation or stored.resolution != made.resolution:
            return False
        apart = np.abs(stored.probability - made.probability) > PROBABILITY_TOLERANCE
        return float(apart.mean()) <= MOST_OTHER_CELLS
    return iou(_solid(stored, points), _solid(made, points), weights) >= LEAST_AGREEMENT


def _solid(shape: Reconstruction | None, points: NDArray) -> NDArray[np.bool_]:
    if isinstance(shape, Volume):
        return shape.query(points) >= OCCUPANCY_THRESHOLD
    return prepare(shape, points, samples=1).solid
