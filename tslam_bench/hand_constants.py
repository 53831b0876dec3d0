"""The hand's constants (protocol section 2): joint order, limits, drives, step limits, where its base stands.

Numbers only (numpy), no simulator: baselines and documentation read them too. ``JOINT_LIMITS`` of wrist and fingers are
the model's; a test compares them with the compiled model.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import WORKSPACE_EDGE

ARM_JOINTS: Final = ("ARTx", "ARTy", "ARTz", "ARRz")
"""Translation along the forearm frame's x (sideways), y (up), z (along the fingers), and roll about z."""
WRIST_JOINTS: Final = ("WRJ1", "WRJ0")
FINGER_JOINTS: Final = (
    *("FFJ3", "FFJ2", "FFJ1", "FFJ0"),
    *("MFJ3", "MFJ2", "MFJ1", "MFJ0"),
    *("RFJ3", "RFJ2", "RFJ1", "RFJ0"),
    *("LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0"),
    *("THJ4", "THJ3", "THJ2", "THJ1", "THJ0"),
)
JOINT_NAMES: Final = (*ARM_JOINTS, *WRIST_JOINTS, *FINGER_JOINTS)
"""The 28 actuated joints; the order of qpos, qvel and actions everywhere in the benchmark."""

COUPLED_JOINTS: Final = (("FFJ1", "FFJ0"), ("MFJ1", "MFJ0"), ("RFJ1", "RFJ0"), ("LFJ1", "LFJ0"))
"""Middle and end joint of each finger, coupled by a tendon."""
COUPLING_MIDDLE: Final = 0.00805
COUPLING_END: Final = 0.00705
COUPLING_SLACK: Final = 0.001
"""The tendon allows ``|COUPLING_END * end - COUPLING_MIDDLE * middle| <= COUPLING_SLACK`` (m; radii of the model's pulleys)."""

BASE_POSITION: Final = (0.0, -0.53, 0.0)
"""Origin of the forearm frame in the world at arm qpos 0 (m): the palm's grasp centre is then near the workspace centre."""
BASE_QUATERNION: Final = (0.0, 0.0, 0.5**0.5, 0.5**0.5)
"""Forearm frame in the world (w, x, y, z): fingers point along world +y, the palm faces down."""

_FINGER = (0.0, 1.571)
_SPREAD = (-0.436, 0.436)
JOINT_LIMITS: Final[NDArray[np.float64]] = np.array(
    [
        *((-0.25, 0.25), (-0.2, 0.25), (-0.3, 0.25), (-0.75, 0.75)),  # arm: reaches W with margin
        *((-0.524, 0.175), (-0.785, 0.611)),
        *((_SPREAD, _FINGER, _FINGER, _FINGER) * 3),
        *((0.0, 0.698), _SPREAD, _FINGER, _FINGER, _FINGER),
        *((-1.047, 1.047), (0.0, 1.309), (-0.262, 0.262), (-0.524, 0.524), (-1.571, 0.0)),
    ]
)
"""(28, 2) lower and upper limits, m for ARTx, ARTy, ARTz and rad for the rest."""
JOINT_LIMITS.setflags(write=False)


def _per_joint(translation: float, roll: float, wrist: float, finger: float) -> NDArray[np.float64]:
    values = np.array([translation] * 3 + [roll] + [wrist] * 2 + [finger] * len(FINGER_JOINTS))
    values.setflags(write=False)
    return values


STIFFNESS: Final = _per_joint(2000.0, 50.0, 10.0, 1.0)
"""(28,) drive stiffness, N/m or N m/rad."""
DAMPING: Final = _per_joint(200.0, 5.0, 0.8, 0.08)
"""(28,) drive damping, N s/m or N m s/rad."""
FORCE_LIMIT: Final = _per_joint(30.0, 5.0, 5.0, 1.0)
"""(28,) largest drive force, N or N m."""
ARMATURE: Final = _per_joint(0.001, 0.001, 0.005, 0.001)
"""(28,) rotor inertia of the model, kg or kg m^2."""
DELTA_STEP: Final = _per_joint(0.02, 0.2, 0.25, 0.4)
"""(28,) change of the target, relative to the current position, at action 1 in ``pd_joint_delta_pos`` (m or rad)."""

CONTROL_MODES: Final = ("pd_joint_delta_pos", "pd_joint_pos")

START_CLEARANCE: Final = 0.045
"""An open hand is clear of an object this far (m) below ARTy: room for the palm, the noise of the fingers and the roll."""
_START_HEIGHT = WORKSPACE_EDGE / 2 + START_CLEARANCE
START_ARM_LOW: Final = (-0.04, _START_HEIGHT, -0.06, -0.2)
START_ARM_HIGH: Final = (0.04, _START_HEIGHT + 0.02, 0.02, 0.2)
"""Box from which an episode's arm qpos (ARTx, ARTy, ARTz, ARRz) is drawn. The open hand lies above the workspace, hence
above the tallest object that the gates allow: one box for all objects, so that the start tells nothing of them."""
START_FINGER_NOISE: Final = 0.05
"""Finger and wrist joints start at their open value plus uniform noise in +-this (rad), clipped to the limits."""

SKIN_LINKS: Final = (
    "wrist",
    "palm",
    *("ffproximal", "ffmiddle", "ffdistal"),
    *("mfproximal", "mfmiddle", "mfdistal"),
    *("rfproximal", "rfmiddle", "rfdistal"),
    *("lfmetacarpal", "lfproximal", "lfmiddle", "lfdistal"),
    *("thproximal", "thmiddle", "thdistal"),
)
"""Links that wear skin, in the order of the ``touch`` observation: all with collision shapes but the forearm."""
