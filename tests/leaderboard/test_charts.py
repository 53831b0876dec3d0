"""Where charts put lines and labels."""

from __future__ import annotations

import numpy as np
import pytest

from tslam_bench.leaderboard.charts import Axis, Line, line_chart


def test_lines_are_drawn_where_the_data_are() -> None:
    lines = [Line("up", 0, [(0, 0), (10, 1)]), Line("flat", 1, [(0, 0.5), (10, 0.5)])]
    chart = line_chart("t", lines, Axis("x", 0, 10, []), Axis("y", 0, 1, [(0.5, "half")]), (400, 200), end_labels=False)
    (x0, y0), (x1, y1) = chart.lines[0].points
    (a0, b0), (_, b1) = chart.lines[1].points
    assert x0 == a0 == chart.left < x1 == chart.right <= 400
    assert 0 <= chart.top == y1 < y0 == chart.bottom <= 200
    assert b0 == b1 == chart.y_ticks[0][0] == pytest.approx((y0 + y1) / 2)


def test_end_labels_do_not_overlap() -> None:
    lines = [Line(f"line{k}", k, [(0, 0), (1, 0.5 + 0.001 * k)]) for k in range(12)]
    chart = line_chart("t", lines, Axis("x", 0, 1, []), Axis("y", 0, 1, []))
    heights = [drawn.label_y for drawn in chart.lines]
    assert min(-np.diff(heights)) >= 13.9  # the highest line has the highest label
    assert min(heights) > 0 and max(heights) < chart.height


def test_line_13_takes_the_first_colour_dashed() -> None:
    lines = [Line("a", k, [(0, 0), (1, 1)]) for k in (0, 12)]
    chart = line_chart("t", lines, Axis("x", 0, 1, []), Axis("y", 0, 1, []))
    assert [drawn.style for drawn in chart.lines] == ["c0", "c0 dashed"]
