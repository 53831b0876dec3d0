"""The seed of an evaluation episode (protocol section 12). Needs no simulator: scoring reads it too."""

from __future__ import annotations

import hashlib

from tslam_bench.grids import check_pose


def episode_seed(object_name: str, pose: int, seed: int) -> int:
    """Seed of the episode that explores ``object_name`` in ``pose`` as repetition ``seed``.

    The first 31 bits of the SHA-256 of ``"<object>/pose<k>/seed<s>"``: episodes of different objects and poses start
    differently, and whoever replays one needs only its file name.

    Raises:
        InvalidInputError: unknown pose.
    """
    text = f"{object_name}/pose{check_pose(pose)}/seed{int(seed)}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1
