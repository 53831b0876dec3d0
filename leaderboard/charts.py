"""Line charts: where everything goes. ``templates/chart.html.jinja`` draws them as SVG, in the style sheet's colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

COLOURS: Final = 12
"""Number of line colours in the style sheet; a thirteenth line takes the first again, dashed."""
Point = tuple[float, float]


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    Attributes:
        label: written at its end and in its tooltip.
        colour: index of its colour.
        points: (x, y) in data units, x ascending.
        dashed: for entries without a rank.
    """

    label: str
    colour: int
    points: Sequence[Point]
    dashed: bool = False


@dataclass(frozen=True)
class Axis:
    """One axis: title, range and labelled ticks (value, text)."""

    title: str
    low: float
    high: float
    ticks: Sequence[tuple[float, str]]

    def share(self, value: float) -> float:
        """Where a value is between the ends of the axis: 0 to 1."""
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class DrawnLine:
    """A line in user units of the drawing, x to the right and y down.

    Attributes:
        line: what is drawn.
        points: (x, y) of its points.
        label_y: height of the label at its end, or None.
    """

    line: Line
    points: Sequence[Point]
    label_y: float | None

    @property
    def style(self) -> str:
        """Classes of the style sheet."""
        return line_style(self.line.colour, self.line.dashed)


@dataclass(frozen=True)
class Chart:
    """A chart in user units: size, frame of the plot, ticks (position, text) and lines."""

    title: str
    width: int
    height: int
    left: int
    right: int
    top: int
    bottom: int
    x_title: str
    y_title: str
    x_ticks: Sequence[tuple[float, str]]
    y_ticks: Sequence[tuple[float, str]]
    lines: Sequence[DrawnLine]
    markers: bool


def line_chart(
    title: str,
    lines: Sequence[Line],
    x: Axis,
    y: Axis,
    size: tuple[int, int] = (760, 360),
    end_labels: bool = True,
    markers: bool = False,
) -> Chart:
    """Places lines, ticks and labels.

    Args:
        title: for screen readers.
        size: width and height in user units; the drawing scales with its container.
        end_labels: write each line's label at its right end, moved apart where they would meet.
        markers: a dot at every point.
    """
    width, height = size
    left, right, top, bottom = 54, width - (150 if end_labels else 14), 14, height - 46

    def across(value: float) -> float:
        return round(left + x.share(value) * (right - left), 1)

    def down(value: float) -> float:
        return round(bottom - y.share(value) * (bottom - top), 1)

    placed = [[(across(a), down(b)) for a, b in line.points] for line in lines]
    heights: Sequence[float | None] = [None] * len(lines)
    if end_labels:
        heights = _spread([points[-1][1] for points in placed], 14, top + 6, bottom)
    return Chart(
        title=title,
        width=width,
        height=height,
        left=left,
        right=right,
        top=top,
        bottom=bottom,
        x_title=x.title,
        y_title=y.title,
        x_ticks=[(across(value), text) for value, text in x.ticks],
        y_ticks=[(down(value), text) for value, text in y.ticks],
        lines=[DrawnLine(*drawn) for drawn in zip(lines, placed, heights, strict=True)],
        markers=markers,
    )


def line_style(colour: int, dashed: bool) -> str:
    """Classes of the style sheet for a line, its dots, its label and its swatch."""
    return f"c{colour % COLOURS}" + (" dashed" if dashed or colour >= COLOURS else "")


def _spread(values: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Moves ``values`` apart to at least ``gap``, keeping their order and staying in [low, high] if there is room."""
    order = sorted(range(len(values)), key=lambda k: values[k])
    gap = min(gap, (high - low) / max(len(values) - 1, 1))
    rows = [values[k] for k in order]
    for k in range(len(rows)):
        rows[k] = max(rows[k], low if k == 0 else rows[k - 1] + gap)
    for k in reversed(range(len(rows))):
        rows[k] = min(rows[k], high if k == len(rows) - 1 else rows[k + 1] - gap)
    result = [0.0] * len(values)
    for k, row in zip(order, rows, strict=True):
        result[k] = round(row, 1)
    return result
