"""The protocol's constants that more than one part reads; those of hand, physics, skin and rewards stand beside what they rule.

Section numbers refer to the protocol definition (``docs/protocol.md``). Units are metres, radians and seconds.
This module imports nothing, so that scoring can read it without a simulator.
"""

from typing import Final

PROTOCOL_VERSION: Final = 1
"""Bumped whenever an observation, a reward, a metric or a split changes."""

ENVIRONMENT_ID: Final = "TactileSLAM-v0"
"""Gymnasium id of the default task."""
TABLETOP_ID: Final = "TactileSLAM-Tabletop-v0"
"""Gymnasium id of the task whose object stands on a table."""

# --- Section 1: workspace and grid -----------------------------------------------------------------------------
WORKSPACE_EDGE: Final = 0.25
"""Edge of the cubic workspace W (m), centred on the object's bounding-box centre. Also the metric unit."""
GRID_SIZE: Final = 32
"""Voxels per axis of every occupancy grid."""
VOXEL_EDGE: Final = WORKSPACE_EDGE / GRID_SIZE
"""Edge of one voxel (m): 7.8125 mm."""
WORKSPACE_LOW: Final = -WORKSPACE_EDGE / 2
"""Lower corner of W on every axis (m): the workspace centre is the world origin and the object-frame origin."""

# --- Section 2: hand -------------------------------------------------------------------------------------------
NUM_JOINTS: Final = 28
"""Actuated joints of the hand on its arm; also the length of an action."""

# --- Section 3: poses ------------------------------------------------------------------------------------------
NUM_POSES: Final = 8
PROTOCOL_POSES: Final[dict[int, tuple[int, ...]]] = {4: (0, 2, 5, 7), 8: (0, 1, 2, 3, 4, 5, 6, 7)}
"""Pose indices of the 4-pose and the 8-pose protocol."""
TABLE_SIZE: Final = (0.30, 0.30, 0.05)
"""Edges (m) of the tabletop variant's table, a box below the object: wider than W, and short enough towards the arm that the
forearm (50 mm thick) can hang in front of its edge while the fingers reach down to it."""

# --- Section 4: time -------------------------------------------------------------------------------------------
CONTROL_STEP_SECONDS: Final = 4 / 133
"""Duration of a control step (s): 30.1 ms."""
SUBSTEPS: Final = 3
"""Physics steps per control step (10.0 ms each)."""
HORIZON: Final = 200
"""Control steps per episode (6.0 s)."""

# --- Section 5: touch ------------------------------------------------------------------------------------------
TOUCH_DISTANCE: Final = 1e-3
"""A probe is on when signed distance minus probe radius is at most this (m)."""
SIGNED_DISTANCE_TOLERANCE: Final = 0.5e-3
"""Largest error of a signed-distance field at the surface (m)."""

# --- Section 8: objects ----------------------------------------------------------------------------------------
DEFAULT_SPLIT: Final = "train"
"""Split that environments draw from when none is asked for: who trains with the defaults does not train on the test set."""
TRAIN_OBJECTS: Final = 626
"""Objects of the default train split, as ``assets/manifest_train.json`` lists them."""
QUICK_OBJECTS: Final = ("mug", "stanfordbunny", "toruslarge", "wineglass", "hammer")
"""Test objects of the quick run."""
QUICK_TRAIN_OBJECTS: Final = (
    "bottle-000",
    "bowl-000",
    "tumbler-000",
    "goblet-000",
    "mug-000",
    "frying-pan-000",
    "cooking-pot-000",
    "teapot-000",
    "plate-000",
    "padlock-000",
    "candlestick-000",
    "mallet-000",
    "screwdriver-000",
    "spoon-000",
    "wrench-000",
    "paint-brush-000",
    "key-000",
    "comb-000",
    "carton-000",
    "spectacles-000",
    "toaster-000",
    "book-000",
    "bangle-000",
    "picture-frame-000",
)
"""Generated train objects of the quick set-up, by name: what else is prepared must not change its results."""
QUICK_VAL_OBJECTS: Final = (
    "bucket-000",
    "mushroom-000",
    "rocket-000",
    "cogwheel-000",
    "trophy-000",
    "bench-000",
)
"""Generated val objects on which the quick run fixes thresholds."""
REACHABLE_BALL_RADIUS: Final = 4e-3
"""Inner voids that a ball of this radius (m) cannot enter from outside count as solid. The thinnest fingertip has a radius of
7 mm; the teapot's spout lets through balls of up to 3.8 mm."""
SURFACE_SAMPLES: Final = 100_000
"""Area-uniform samples per true surface, and per predicted one."""

# --- Section 10: metrics ---------------------------------------------------------------------------------------
IOU_BOX_MARGIN: Final = 16e-3
"""The fine lattice of IoU points covers the object's bounding box grown by this (m)."""
IOU_INSIDE_POINTS: Final = 8_000
"""IoU points wanted inside an object: the standard deviation over point sets of an IoU is then at most .005."""
IOU_BOX_POINTS: Final = 80_000
"""Fewest IoU points in an object's grown box."""
IOU_MOST_BOX_POINTS: Final = 1_000_000
"""Most IoU points in an object's grown box. Of the test objects only the eyeglasses meet this bound."""
IOU_OUTER_CELLS: Final = 40
"""Cells per axis of the coarse lattice of IoU points, which covers what is left of W."""
OCCUPANCY_THRESHOLD: Final = 0.5
"""A reconstruction is solid where its probability is at least this."""
F_SCORE_DISTANCES: Final = (0.01, 0.02)
"""F-score thresholds in metric units (1 % and 2 % of the workspace edge)."""

# --- Section 7: rewards ----------------------------------------------------------------------------------------
REWARD_MODES: Final = (
    "tslam",
    "no_coverage",
    "no_discovery",
    "points",
    "contact",
    "knn",
    "disagreement",
    "chamfer",
)
PRIVILEGED_REWARD_MODES: Final = ("chamfer",)
"""Reward modes that read the true surface."""
PRIVILEGED_EXPLORERS: Final = ("tslam_chamfer", "oracle", "nothing")
"""Explorers of the benchmark that hold no rank: rewarded with the true surface, or references that do not explore."""
