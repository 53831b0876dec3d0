"""Where an evaluation's random numbers come from, and in which order it plays (protocol sections 3 and 12).

Two streams that know nothing of each other. The *start* of an episode follows from pose and repetition alone, so it is the
same for every object. A *policy's* own numbers follow from a salt that whoever evaluates draws, so that neither its seed
nor the order of the episodes tells it which object it holds. Needs no simulator: scoring reads this too.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Iterable

from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import check_pose

Episode = tuple[str, int, int]
"""Object, pose, repetition."""
_SALT = re.compile(r"[0-9a-f]{1,64}")


def episode_seed(pose: int, seed: int) -> int:
    """Seed of the environment's episode in ``pose`` as repetition ``seed``, whatever the object.

    The first 31 bits of the SHA-256 of ``"pose<k>/seed<s>"``: episodes of different poses and repetitions start
    differently, and whoever replays one needs only its file name.

    Raises:
        InvalidInputError: unknown pose.
    """
    text = f"pose{check_pose(pose)}/seed{int(seed)}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1


def new_salt() -> str:
    """A fresh salt: 32 random hexadecimal digits."""
    return secrets.token_hex(16)


def check_salt(salt: str) -> str:
    """Returns ``salt``. Raises InvalidInputError unless it is 1 to 64 lower-case hexadecimal digits."""
    if not isinstance(salt, str) or not _SALT.fullmatch(salt):
        raise InvalidInputError(f"policy salt {salt!r}: give 1 to 64 hexadecimal digits (0-9, a-f)")
    return salt


def policy_seed(salt: str, episode: Episode) -> int:
    """Seed (63 bits) of a policy's own random numbers in one episode: HMAC-SHA256 under the salt, which no policy is told.

    Raises:
        InvalidInputError: unknown pose, or not a salt.
    """
    return int.from_bytes(_digest(salt, "policy", episode)[:8], "big") >> 1


def shuffled(salt: str, episodes: Iterable[Episode]) -> list[Episode]:
    """The order in which episodes are played. That of two episodes does not depend on which others there are."""
    return sorted(episodes, key=lambda episode: _digest(salt, "order", episode))


def _digest(salt: str, purpose: str, episode: Episode) -> bytes:
    name, pose, seed = episode
    text = f"{purpose}/{name}/pose{check_pose(pose)}/seed{int(seed)}"
    return hmac.digest(check_salt(salt).encode(), text.encode(), "sha256")
