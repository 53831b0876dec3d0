"""The simulation keeps its promises: rest, bounded speeds, shallow contacts, drives that arrive, a wall watch that sees."""

from __future__ import annotations

import numpy as np
import pytest
from fidelity import SPEED_LIMIT, SPEED_MARGIN, drive_speed, rest_drift, tracking_errors, violent_motion
from penetration import pressing_audits, statistics_of
from prepared_shapes import prepared_box
from tunnelling import AxisWatch, HullUnion, WallCounts

from tslam_bench.hand_constants import SKIN_LINKS


def test_a_resting_hand_stays():
    drift, fastest = rest_drift(60, 2)
    assert drift < 1e-4 and fastest < 1e-4


@pytest.mark.parametrize("control_mode", ["pd_joint_delta_pos", "pd_joint_pos"])
def test_violent_motion_stays_bounded(control_mode):
    motion = violent_motion(("mug", "wineglass"), control_mode, 300, 2)
    assert (motion.speed.max(axis=(0, 1)) < SPEED_LIMIT).all()
    typical = np.percentile(motion.speed, 99, axis=(0, 1))
    assert (typical < SPEED_MARGIN * drive_speed(control_mode)).all()
    # 5.3 kg at the arm's own top speed on three axes; with fingers and contacts, energy stays of that order.
    assert motion.energy.max() < 4 * 0.5 * 5.3 * (drive_speed(control_mode)[:3] ** 2).sum()


def test_a_pressing_hand_sinks_in_less_than_a_millimetre():
    audit = pressing_audits(("hammer",), 2)["hammer"]
    assert audit.both > 100 and audit.recall > 0.9 and audit.precision > 0.8
    assert statistics_of(audit.depths)["p95"] < 1.0


def test_drives_arrive_in_free_space():
    errors = tracking_errors(3, 2)
    assert np.median(errors) < 1e-3 and errors.max() < 0.02


def test_wall_watch_sees_a_finger_that_passes_a_wall():
    """All links carried by hand through a wall of 3 mm: slowly, so that axes are seen inside, or in one jump."""
    union = HullUnion(prepared_box((0.2, 0.003, 0.2)))

    def carry(heights) -> WallCounts:
        watch, counts = AxisWatch(union, [0]), WallCounts()
        for height in heights:
            links = np.tile(np.eye(3, 4), (len(SKIN_LINKS), 1, 1))
            links[:, 1, 3] = height
            watch.count(links[None, None], counts)
        return counts

    slow = carry(np.arange(0.2, -0.2, -1e-3))
    assert slow.inside > 0 and slow.incidents >= 1
    assert carry([0.2, -0.2]).jumps == 1
    assert carry([0.2, 0.15]) == WallCounts(), "nothing is near the wall there"


def test_clipping_agrees_with_samples_on_the_segment(torus):
    union = HullUnion(torus)
    generator = np.random.default_rng(0)
    start = generator.uniform(-1, 1, (300, 3)) * (0.07, 0.07, 0.03)
    end = start + generator.normal(scale=0.02, size=(300, 3))
    along = np.linspace(0, 1, 100)[None, :, None]
    samples = start[:, None] + along * (end - start)[:, None]
    sampled = union.contains(samples.reshape(-1, 3)).reshape(300, -1).any(axis=1)
    # Independently of planes: inside the solid torus, or not; sectors are chords, so a shell of doubt is left out.
    ring = np.hypot(samples[..., 0], samples[..., 1]) - 0.045
    depth = 0.018 - np.hypot(ring, samples[..., 2])
    surely, never = (depth > 1.5e-3).any(axis=1), (depth < 0).all(axis=1)
    crossed = union.crossed(start, end)
    assert (crossed[surely]).all() and not crossed[never].any()
    assert (crossed | ~sampled).all() and surely.sum() > 5 and never.sum() > 5
