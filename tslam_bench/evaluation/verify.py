"""Replays a submission's rollouts on the CPU engine and says which of them reproduce (protocol section 12).

Bit for bit, on the machine that the rollouts come from or one of its kind. Elsewhere bits may differ, and after the first contact
so does all that follows: there each ten steps are replayed from their joint checkpoint. Positions alone do not bring PhysX's
contact caches back (:mod:`tslam_bench.engine.whole_state`), so what such a segment ends in is compared within tolerances.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from tslam_bench.constants import HORIZON, NUM_POSES
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.hand_workers import WorkerError
from tslam_bench.episodes import Episode, episode_seed
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import JOINT_LIMITS
from tslam_bench.machine import processor_name
from tslam_bench.objects.splits import known_names
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.rollout import CHECKPOINT_SPACING, Rollout
from tslam_bench.scoring.scoring import WorkerDied, worker_pool
from tslam_bench.scoring.submission import Submission, read_submission
from tslam_bench.scoring.verification import Tolerances, Verdict, VerificationRecord, pack_steps, record_path
from tslam_bench.version import __version__

SIDE_BY_SIDE: Final = 3 * NUM_POSES
"""Hands of a process: the episodes of an object in a full entry."""
_NEIGHBOURS: Final = np.ones((3, 3, 3), dtype=bool)
_FEW: Final = 3
_TRANSLATIONS: Final = 3
_SLACK: Final = 0.05
"""How far (m or rad) beyond its limits a joint may be put: pressed ones are a little, and no simulator takes any number."""


@dataclass(frozen=True)
class Replay:
    """What replays of episodes gave: a row each.

    Attributes:
        joints: (E, 21, 28) float32, joint checkpoints.
        touched_step: (E, 32, 32, 32) int16; visited: (E, 32, 32, 32) bool.
    """

    joints: NDArray[np.float32]
    touched_step: NDArray[np.int16]
    visited: NDArray[np.bool_]


def verify(
    path: Path | str,
    output: Path | None = None,
    segments: Tolerances | None = None,
    processes: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
    split: str = "test",
) -> VerificationRecord:
    """Replays every rollout of a submission and writes a record, after each object; one that is there is gone on with.

    Args:
        path: folder or zip archive.
        output: the record's file; by default beside the submission (:func:`record_path`).
        segments: replay in segments within these tolerances; None: bit for bit.
        processes: that replay. The verdicts do not depend on it.
        on_progress: called with (done, all) episodes.
        split: of the submission's objects.

    Raises:
        InvalidInputError: the submission is refused, or holds no rollouts.
        AssetError: an object is not prepared, or the record cannot be written.
        WorkerError: a process died; what is finished is kept.
    """
    submission = read_submission(path, split=split)
    episodes = submission.episodes()
    if not episodes:
        raise InvalidInputError(f"{submission.location}: holds no rollouts, so there is nothing to replay")
    file = record_path(path) if output is None else output
    if file.resolve().is_relative_to(Path(path).resolve()):
        raise InvalidInputError(f"{file}: inside the submission, which it would change; choose another --output")
    objects = list(dict.fromkeys(name for name, _, _ in episodes))
    assets = {
        name: asset_sha256([name], submission.split) for name in objects
    }  # fails before the work if one is not prepared
    record = _begun(submission, file, segments)
    kept = {name for name, product in record.assets.items() if assets.get(name) == product}
    record = dataclasses.replace(
        record,
        assets={name: assets[name] for name in kept},
        verdicts=tuple(verdict for verdict in record.verdicts if verdict.object in kept),
        attestation=record.attestation if len(kept) == len(objects) else None,
    )
    report = on_progress or (lambda done, total: None)
    report(len(record.verdicts), len(episodes))
    waiting = [name for name in objects if name not in kept]
    record.write(file)  # before the work: is it writable?
    for name, verdicts in _replay_objects(submission, waiting, segments, min(processes, len(waiting))):
        record = dataclasses.replace(
            record, assets={**record.assets, name: assets[name]}, verdicts=(*record.verdicts, *verdicts)
        )
        record.write(file)
        report(len(record.verdicts), len(episodes))
    return record


def _begun(submission: Submission, file: Path, segments: Tolerances | None) -> VerificationRecord:
    """The record of an earlier call of this kind, or an empty one."""
    empty = VerificationRecord(
        content_hash=submission.content_hash,
        assets={},
        mode="bits" if segments is None else "segments",
        tolerances={} if segments is None else dataclasses.asdict(segments),
        package_version=__version__,
        processor=processor_name(),
        simulator=f"sapien {importlib.metadata.version('sapien')}",
        verdicts=(),
        split=submission.split,
    )
    if not file.is_file():
        return empty
    try:
        earlier = VerificationRecord.read(file)
    except InvalidInputError:
        return empty
    return earlier if earlier.same_replay(empty) else empty


def _replay_objects(
    submission: Submission, names: Sequence[str], segments: Tolerances | None, processes: int
) -> Iterator[tuple[str, list[Verdict]]]:
    parts = [submission.of_object(name) for name in names]
    most = max((len(part.episodes()) for part in parts), default=1)
    width = min(most, SIDE_BY_SIDE)
    with worker_pool(processes) as pool:
        replayed = (pool.map if pool else map)(_verify_part, parts, [segments] * len(parts), [width] * len(parts))
        try:
            yield from zip(names, replayed, strict=True)
        except WorkerDied as error:
            raise WorkerError("verify: a process died, perhaps of memory; run the command again to go on") from error


def _verify_part(part: Submission, segments: Tolerances | None, width: int) -> list[Verdict]:
    """Verdicts on all episodes of one object."""
    episodes, verdicts = part.episodes(), []
    for first in range(0, len(episodes), width):
        rollouts = [_stored(part, episode) for episode in episodes[first : first + width]]
        found = replay(rollouts, part.info.control_mode, segments is not None, width, part.split)
        verdicts += [judge(rollout, found, row, segments) for row, rollout in enumerate(rollouts)]
    return verdicts


def _stored(part: Submission, episode: Episode) -> Rollout:
    rollout = part.rollout(*episode)
    assert rollout is not None, "the submission listed it"
    return rollout


@lru_cache(maxsize=2)
def _hands(width: int, control_mode: str, split: str) -> HandBatch:
    names = tuple(known_names(split))
    settings = BatchSettings(objects=names, split=split, control_mode=control_mode, reward_mode="contact")
    return HandBatch(width, settings, autoreset=False)


def replay(
    rollouts: Sequence[Rollout],
    control_mode: str,
    segments: bool = False,
    width: int | None = None,
    split: str = "test",
) -> Replay:
    """Plays the actions of rollouts, of any objects and poses, side by side in this process.

    Args:
        rollouts: at most ``width`` of them; only their names, their actions and, for segments, their checkpoints are read.
        control_mode: of the actions.
        segments: put the joints where the rollout says they were after every ten steps.
        width: hands in the batch, by default as many as needed. One batch is kept and reused.
        split: of the objects.
    """
    width = width or len(rollouts)
    played = [*rollouts, *[rollouts[-1]] * (width - len(rollouts))]
    hands = _hands(width, control_mode, split)
    hands.reset(
        [episode_seed(rollout.pose, rollout.seed) for rollout in played],
        range(width),
        [rollout.object for rollout in played],
        [rollout.pose for rollout in played],
    )
    actions = np.stack([rollout.actions for rollout in played], axis=1)
    stored = np.stack([rollout.joint_checkpoints for rollout in played], axis=1)
    reachable = np.clip(stored, JOINT_LIMITS[:, 0] - _SLACK, JOINT_LIMITS[:, 1] + _SLACK).astype(np.float32)
    joints = np.zeros_like(stored)
    joints[0] = hands.arrays["qpos"]
    for step in range(HORIZON):
        hands.arrays["action"][:] = actions[step]
        hands.step()
        checkpoint, within = divmod(step + 1, CHECKPOINT_SPACING)
        if within == 0:
            joints[checkpoint] = hands.arrays["qpos"]
            if segments:
                hands.put_joints(reachable[checkpoint])
    touched_step = hands.state()["touched_step"].astype(np.int16)
    visited = hands.arrays["occupancy"][:, 1].astype(bool)
    return Replay(joints.swapaxes(0, 1), touched_step, visited)


def judge(rollout: Rollout, found: Replay, row: int, segments: Tolerances | None) -> Verdict:
    """Compares a rollout with row ``row`` of its replay."""
    joints, touched_step, visited = found.joints[row], found.touched_step[row], found.visited[row]
    if segments is None:
        departed, step = _first_difference(rollout, joints, touched_step, visited)
    else:
        departed, step = _beyond_tolerances(rollout, joints, touched_step, segments)
    return Verdict(rollout.object, rollout.pose, rollout.seed, departed, step, pack_steps(touched_step))


def _first_difference(
    rollout: Rollout, joints: NDArray, touched_step: NDArray, visited: NDArray
) -> tuple[str | None, int | None]:
    """What differs first, and the step by which it does."""
    checkpoints = np.flatnonzero((rollout.joint_checkpoints != joints).any(axis=1))
    if len(checkpoints) and checkpoints[0] == 0:
        return "start", None
    differences: list[tuple[int, str]] = []
    if len(checkpoints):
        differences.append((int(checkpoints[0]) * CHECKPOINT_SPACING - 1, "joints"))
    steps = np.stack([rollout.touched_step, touched_step])
    other = steps[:, steps[0] != steps[1]]
    if other.size:
        differences.append((int(other[other >= 0].min()), "touches"))
    if not differences and not np.array_equal(rollout.visited, visited):
        differences.append((HORIZON - 1, "visited"))
    if not differences:
        return None, None
    step, what = min(differences)
    return what, step


def _beyond_tolerances(
    rollout: Rollout, joints: NDArray, touched_step: NDArray, tolerances: Tolerances
) -> tuple[str | None, int | None]:
    """What is first further from the replay than honest segments are, and the step by which it is."""
    error = np.abs(rollout.joint_checkpoints.astype(np.float64) - joints)
    scaled = np.maximum(
        error[:, :_TRANSLATIONS].max(axis=1) / tolerances.arm, error[:, _TRANSLATIONS:].max(axis=1) / tolerances.joints
    )
    if scaled[0] > 1:
        return "start", None
    beyond = np.flatnonzero(scaled > 1)
    far = np.flatnonzero(scaled > tolerances.far)
    if len(far) or len(beyond) > tolerances.beyond * (len(scaled) - 1):
        return "joints", int((far if len(far) else beyond)[0]) * CHECKPOINT_SPACING - 1
    unfelt = rollout.touched & ~binary_dilation(touched_step >= 0, _NEIGHBOURS)
    if unfelt.sum() > max(tolerances.touches * rollout.touched.sum(), _FEW):
        return "touches", int(rollout.touched_step[unfelt].min())
    return None, None
