"""Which object, in which pose, under which hand: the start of an episode, drawn from its seed (protocol sections 3 and 8).

One class for the ManiSkill task and the batched CPU engine, so that equal seeds give equal episodes in both. No torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import DEFAULT_SPLIT, NUM_JOINTS, TRAIN_OBJECTS
from tslam_bench.engine.requests import check_name, check_names
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.hand_constants import JOINT_LIMITS, START_ARM_HIGH, START_ARM_LOW, START_FINGER_NOISE
from tslam_bench.objects.splits import SPLITS, find_split, known_names, resolve_name
from tslam_bench.objects.store import PreparedObject, list_objects, load_object, read_record
from tslam_bench.variants import FREE, Variant

LOADED_OBJECTS: Final = 64
"""Objects kept in memory, about 10 MB each."""
_OPEN_QPOS = np.clip(0.0, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1])


@dataclass(frozen=True, eq=False)
class Start:
    """How an episode starts.

    Attributes:
        prepared: the object.
        pose: 0..7.
        qpos: (28,) float32, hand open above the workspace, in the order of ``JOINT_NAMES``; the object has no part in it.
    """

    prepared: PreparedObject
    pose: int
    qpos: NDArray[np.float32]


class StartSampler:
    """Draws starts.

    Args:
        object: one object for every episode, or None.
        objects: names to draw from, or None for the whole split.
        split: split of the objects. None: named objects are found in whatever split has them; without names, what is
            prepared of ``train`` is drawn from, with a warning if that is not all of it.
        pose: one pose for every episode, or None to draw.
        variant: the environment; it says which poses there are.

    Raises:
        InvalidInputError: unknown object, split or pose, or nothing to draw from.
        AssetError: an object is not prepared.
    """

    def __init__(
        self,
        object: str | None,
        objects: Sequence[str] | None,
        split: str | None = None,
        pose: int | None = None,
        variant: Variant = FREE,
    ) -> None:
        if object is not None and objects is not None:
            raise InvalidInputError("object and objects: give one or the other, not both")
        if split is not None and not isinstance(split, str):
            raise InvalidInputError(f"split {split!r}: must be a name, a text")
        self.split = split
        self.variant = variant
        self._pose = None if pose is None else variant.check_pose(pose)
        self._load = lru_cache(maxsize=LOADED_OBJECTS)(load_object)
        self._keys: dict[str, tuple[str, str]] = {}
        if object is not None:
            self.names: tuple[str, ...] = (self.load(object).name,)
        elif objects is not None:
            self.names = check_names(objects)
            known = {name for one in (SPLITS if split is None else (split,)) for name in known_names(one)}
            for name in self.names:
                if name not in known:  # an alias; or an error, now and not in a later episode that draws it
                    self.check_name(name)
        else:
            self.names = _prepared(split)
        if not self.names:
            raise InvalidInputError("objects: an empty list; name at least one, or leave the argument out")

    def most_hulls(self) -> int:
        """Hulls of the object that has the most of them."""
        records = (read_record(*self._key(name)) for name in self.names)
        return max(record.get("hull_count") or len(self.load(record["name"]).hulls) for record in records)

    def load(self, name: str) -> PreparedObject:
        """An object that :meth:`check_name` accepts; the latest ``LOADED_OBJECTS`` stay in memory."""
        return self._load(*self._key(name))

    def check_name(self, name: str) -> None:
        """Raises InvalidInputError for an object that is unknown in the split (None: in every split)."""
        self._key(name)

    def canonical(self, name: str) -> str:
        """The name without alias of an object that :meth:`check_name` accepts; nothing is loaded."""
        return self._key(name)[0]

    def _key(self, name: str) -> tuple[str, str]:
        """Name without alias, and split; looked up once, as it reads the cache's folders."""
        if check_name(name) not in self._keys:
            split = find_split(name) if self.split is None else self.split
            self._keys[name] = resolve_name(name, split), split
        return self._keys[name]

    def draw_object(self, rng: np.random.RandomState, name: str | None = None) -> PreparedObject:
        """Draws an object; ``name`` overrides the draw, which is made all the same so that the rest does not depend on it."""
        draw = rng.uniform()
        return self.load(self.names[int(draw * len(self.names))] if name is None else name)

    def skip_object(self, rng: np.random.RandomState) -> None:
        """Takes from the generator what :meth:`draw_object` takes, where the object is there already."""
        rng.uniform()

    def draw(
        self,
        rng: np.random.RandomState,
        name: str | None = None,
        pose: int | None = None,
        prepared: PreparedObject | None = None,
    ) -> Start:
        """Draws an episode's start; ``name`` and ``pose`` override the draws, ``prepared`` is an object drawn before."""
        chosen = self.draw_object(rng, name) if prepared is None else prepared
        drawn_pose = self.variant.poses[int(rng.uniform() * len(self.variant.poses))]
        if pose is not None:
            drawn_pose = self.variant.check_pose(pose)
        elif self._pose is not None:
            drawn_pose = self._pose
        uniform = rng.uniform(size=NUM_JOINTS)
        qpos = _OPEN_QPOS + START_FINGER_NOISE * (2 * uniform - 1)
        low, high = np.array(START_ARM_LOW), np.array(START_ARM_HIGH)
        qpos[: len(low)] = low + (high - low) * uniform[: len(low)]
        clipped = np.clip(qpos, JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1]).astype(np.float32)
        return Start(chosen, drawn_pose, clipped)


def _prepared(split: str | None) -> tuple[str, ...]:
    """Names of what is prepared of a split; None means the default one."""
    chosen = DEFAULT_SPLIT if split is None else split
    names = tuple(record["name"] for record in list_objects(chosen))
    if not names:
        raise AssetError(
            f"split {chosen!r}: no object is prepared; run 'tslam-bench assets prepare --split {chosen}'"
            + (", or --quick for a few, or name an object" if split is None else "")
        )
    if split is None and len(names) < TRAIN_OBJECTS:
        warnings.warn(
            f"episodes draw from the {len(names)} prepared objects of {TRAIN_OBJECTS} in split {chosen!r}; "
            f"'tslam-bench assets prepare --split {chosen}' prepares the rest",
            stacklevel=3,
        )
    return names
