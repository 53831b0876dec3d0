"""The points of the IoU: unbiased, one in each cell, enough of them inside."""

import numpy as np
import pytest

from tslam_bench.constants import IOU_BOX_MARGIN, IOU_INSIDE_POINTS, WORKSPACE_EDGE
from tslam_bench.geometry.sampling import iou_cells, iou_points

LOW, HIGH = np.array([-0.06, -0.03, -0.02]), np.array([0.06, 0.03, 0.02])


def test_weights_add_up_to_the_workspace():
    volumes = [iou_points(LOW, HIGH, (60, 30, 20), seed).weights.sum() for seed in range(20)]
    assert np.mean(volumes) == pytest.approx(WORKSPACE_EDGE**3, rel=1e-3)
    assert np.std(volumes) < 2e-3 * WORKSPACE_EDGE**3


def test_the_first_points_lie_one_in_each_cell_of_the_grown_box():
    cells = (7, 5, 3)
    sample = iou_points(LOW, HIGH, cells)
    low, high = LOW - IOU_BOX_MARGIN, HIGH + IOU_BOX_MARGIN
    near = sample.points[: 7 * 5 * 3]
    index = np.floor((near - low) / ((high - low) / cells)).astype(int)
    np.testing.assert_array_equal(index, np.indices(cells).reshape(3, -1).T)
    rest = sample.points[7 * 5 * 3 :]
    assert not ((rest >= low) & (rest < high)).all(axis=1).any()
    assert np.abs(rest).max() <= WORKSPACE_EDGE / 2


def test_a_solid_has_the_wanted_points_inside_and_its_volume_in_weights():
    volume = float((HIGH - LOW).prod())
    sample = iou_points(LOW, HIGH, iou_cells(LOW, HIGH, volume / 8))  # asks for eight times as many
    inside = ((sample.points >= LOW) & (sample.points < HIGH)).all(axis=1)
    assert inside.sum() == pytest.approx(8 * IOU_INSIDE_POINTS, rel=0.15)
    assert sample.weights[inside].sum() == pytest.approx(volume, rel=5e-3)


def test_the_box_is_cut_at_the_workspace():
    sample = iou_points(np.full(3, -0.12), np.full(3, 0.12), (20, 20, 20))
    assert np.abs(sample.points).max() <= WORKSPACE_EDGE / 2
    assert len(sample.points) == 20**3
    assert sample.weights.sum() == pytest.approx(WORKSPACE_EDGE**3)
