"""What the page can show: entries, each with objects that a hand explored and a reconstructor completed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from tslam_bench.errors import InvalidInputError
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import EXPLORATION_ORDER, RECONSTRUCTED_POSES, Reconstruction, Submission

COUNTS: Final = tuple(RECONSTRUCTED_POSES)
"""Numbers of merged poses after which shapes are shown."""


@dataclass(frozen=True, eq=False)
class Explored:
    """One object as it was explored and rebuilt.

    Attributes:
        object, split: which one.
        control_mode: of the rollouts' actions.
        rollouts: pose -> episode, in the order in which they are merged.
        played: poses whose episodes can be watched, in that order.
        members: number of merged poses -> these poses.
        reconstructions: number of merged poses -> shape in the object frame, None if there is none.
    """

    object: str
    split: str
    control_mode: str
    rollouts: Mapping[int, Rollout]
    played: tuple[int, ...]
    members: Mapping[int, tuple[int, ...]]
    reconstructions: Mapping[int, Reconstruction | None]


@dataclass(frozen=True, eq=False)
class Entry:
    """An explorer with a reconstructor.

    Attributes:
        key: names its files: letters and digits.
        explorer, reconstructor, remark: shown as they are; strangers may have written them.
        objects: names of the objects that it has.
        stored: what it reads is always the same, so its files need not be written again.
        episodes: name of an object -> key of its episodes; entries of one exploration share it. Empty: it has none.
        read: name of an object -> what there is; called when its files are written.
    """

    key: str
    explorer: str
    reconstructor: str
    remark: str
    objects: tuple[str, ...]
    stored: bool
    episodes: Callable[[str], str]
    read: Callable[[str], Explored]


def submission_entry(
    submission: Submission,
    objects: Sequence[str] = (),
    poses: Sequence[int] = (),
    seed: int | None = None,
) -> Entry:
    """A submission's entry.

    Args:
        objects: those to show; empty: all that it holds.
        poses: those to play; empty: all. Shapes are those of the submission, whatever is played.
        seed: repetition; None: its first.

    Raises:
        InvalidInputError: it does not hold them.
    """
    about = submission.info
    seed = about.seeds[0] if seed is None else seed
    if seed not in about.seeds:
        raise InvalidInputError(f"{submission.location}: has no seed {seed}; choose of {list(about.seeds)}")
    held = submission.objects()
    missing = [name for name in objects if name not in held]
    if missing:
        known = ", ".join(held[:8]) + (", ..." if len(held) > 8 else "")
        raise InvalidInputError(f"{submission.location}: holds nothing of {missing[0]}; it has {known or 'no object'}")

    def read(name: str) -> Explored:
        found = {pose: submission.rollout(name, pose, seed) for pose in EXPLORATION_ORDER}
        rollouts = {pose: rollout for pose, rollout in found.items() if rollout is not None}
        played = tuple(pose for pose in rollouts if not poses or pose in poses)
        shapes = {count: submission.reconstruction(name, count, seed) for count in COUNTS}
        return Explored(name, submission.split, about.control_mode, rollouts, played, RECONSTRUCTED_POSES, shapes)

    def episodes(name: str) -> str:
        digest = submission.rollouts_hash(name, seed)
        return digest and f"{digest[:16]}-{''.join(map(str, sorted(set(poses))))}"

    return Entry(
        key=f"{submission.content_hash[:16]}-{seed}",
        explorer=about.explorer,
        reconstructor=about.reconstructor,
        remark="; ".join([*([about.label] if about.label else []), *(["privileged"] if about.privileged else [])]),
        objects=tuple(objects) or held,
        stored=True,
        episodes=episodes,
        read=read,
    )


def members_of(poses: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """Numbers of merged poses, and which these are, of an exploration of ``poses`` alone."""
    order = tuple(pose for pose in EXPLORATION_ORDER if pose in poses)
    counts = sorted({count for count in COUNTS if count < len(order)} | {len(order)}) if order else []
    return {count: order[:count] for count in counts}
