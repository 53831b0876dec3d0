"""The registered environments and what tells them apart; the ManiSkill task and the CPU engine both read this.

Needs no simulator: registration and command lines read it too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from tslam_bench import grids
from tslam_bench.constants import ENVIRONMENT_ID, NUM_POSES, TABLETOP_ID
from tslam_bench.errors import InvalidInputError


@dataclass(frozen=True)
class Variant:
    """One registered environment.

    Attributes:
        id: Gymnasium id.
        summary: one line for listings.
        poses: pose indices of protocol section 3 that it draws and accepts.
        table: whether the object stands on a table.
    """

    id: str
    summary: str
    poses: tuple[int, ...]
    table: bool = False

    def check_pose(self, pose: Any) -> int:
        """Returns ``pose`` as an int. Raises InvalidInputError unless it is one of ``poses``."""
        checked = grids.check_pose(pose)
        if checked not in self.poses:
            raise InvalidInputError(
                f"pose {checked}: not in {self.id}, whose object stands upright; choose one of "
                + ", ".join(str(index) for index in self.poses)
            )
        return checked


FREE: Final = Variant(
    ENVIRONMENT_ID, "the object hangs in the workspace, nothing else is there", tuple(range(NUM_POSES))
)
TABLETOP: Final = Variant(TABLETOP_ID, "the object stands upright on a table", tuple(range(4)), table=True)
VARIANTS: Final = {variant.id: variant for variant in (FREE, TABLETOP)}
ENVIRONMENT_IDS: Final = tuple(VARIANTS)
"""Every id that the package registers."""


def get_variant(environment_id: str) -> Variant:
    """The variant with this id. Raises InvalidInputError for an unknown one."""
    if environment_id not in ENVIRONMENT_IDS:
        raise InvalidInputError(f"environment {environment_id!r}: unknown; choose one of {', '.join(ENVIRONMENT_IDS)}")
    return VARIANTS[environment_id]
