"""``TactileSLAM-Tabletop-v0``: the object stands on a table (protocol section 3)."""

from __future__ import annotations

from mani_skill.utils.registration import register

from tslam_bench.constants import HORIZON
from tslam_bench.variants import TABLETOP

from .tactile_slam import TactileSLAMEnv


class TactileSLAMTabletopEnv(TactileSLAMEnv):
    """The same task with the object standing on a table: poses 0..3 only.

    **Description.** As in ``TactileSLAM-v0``, but a table (``TABLE_SIZE``, its top at the object's lowest point) blocks the
    hand from below. The object stays at the workspace centre and stays fixed. Where the table is, is known, so contact
    with it is discounted: ``touch`` and the touched voxels are those of the object alone, as its signed distance says.
    The table's top follows from the object's height, which no observation states; the hand finds it by being stopped.

    **Actions, observations, rewards, starting state, episode end.** As in ``TactileSLAM-v0``.

    Args:
        pose: 0..3 for every episode; None draws one per episode. All other arguments as in ``TactileSLAM-v0``.

    Raises:
        InvalidInputError: a pose that is not 0..3, or what ``TactileSLAM-v0`` refuses.

    **Version history.** v0: first version. Not part of the ranking: submissions are for ``TactileSLAM-v0``.
    """

    VARIANT = TABLETOP


register(TABLETOP.id, TactileSLAMTabletopEnv, max_episode_steps=HORIZON)
