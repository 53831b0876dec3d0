"""Line charts as inline SVG. Colours come from the page's style sheet (classes ``c0`` to ``c11``), so both modes work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

COLOURS: Final = 12
"""Number of line colours in the style sheet; a thirteenth line takes the first again, dashed."""


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
    points: Sequence[tuple[float, float]]
    dashed: bool = False


@dataclass(frozen=True)
class Axis:
    """One axis: title, range and labelled ticks (value, text)."""

    title: str
    low: float
    high: float
    ticks: Sequence[tuple[float, str]]


def line_chart(
    title: str,
    lines: Sequence[Line],
    x: Axis,
    y: Axis,
    size: tuple[int, int] = (760, 360),
    end_labels: bool = True,
    markers: bool = False,
) -> str:
    """An SVG element with a title for screen readers.

    Args:
        size: width and height in user units; the element scales with its container.
        end_labels: write each line's label at its right end, moved apart where they would meet.
        markers: a dot at every point.
    """
    width, height = size
    left, right, top, bottom = 54, (150 if end_labels else 14), 14, 46
    plot_width, plot_height = width - left - right, height - top - bottom

    def place(point: tuple[float, float]) -> tuple[float, float]:
        u = (point[0] - x.low) / (x.high - x.low)
        v = (point[1] - y.low) / (y.high - y.low)
        return left + u * plot_width, top + (1 - v) * plot_height

    parts = [f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(title)}">']
    parts.append(f"<title>{escape(title)}</title>")
    for value, text in y.ticks:
        _, at = place((x.low, value))
        parts.append(f'<line class="grid" x1="{left}" y1="{at:.1f}" x2="{width - right}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick" x="{left - 8}" y="{at + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    for value, text in x.ticks:
        at, _ = place((value, y.low))
        parts.append(f'<line class="grid" x1="{at:.1f}" y1="{top}" x2="{at:.1f}" y2="{top + plot_height}"/>')
        parts.append(
            f'<text class="tick" x="{at:.1f}" y="{top + plot_height + 18}" text-anchor="middle">{escape(text)}</text>'
        )
    middle = top + plot_height / 2
    parts.append(
        f'<text class="axis" x="{left + plot_width / 2:.0f}" y="{height - 8}" text-anchor="middle">'
        f"{escape(x.title)}</text>"
    )
    parts.append(
        f'<text class="axis" transform="rotate(-90 14 {middle:.0f})" x="14" y="{middle:.0f}" text-anchor="middle">'
        f"{escape(y.title)}</text>"
    )
    for line in lines:
        placed = [place(point) for point in line.points]
        path = " ".join(f"{a:.1f},{b:.1f}" for a, b in placed)
        style = f"line c{line.colour % COLOURS}" + (" dashed" if line.dashed or line.colour >= COLOURS else "")
        parts.append(f'<polyline class="{style}" points="{path}"><title>{escape(line.label)}</title></polyline>')
        if markers:
            parts += [
                f'<circle class="dot c{line.colour % COLOURS}" cx="{a:.1f}" cy="{b:.1f}" r="3">'
                f"<title>{escape(line.label)}: {value:.3f}</title></circle>"
                for (a, b), (_, value) in zip(placed, line.points, strict=True)
            ]
    if end_labels:
        ends = [place(line.points[-1])[1] for line in lines]
        rows = _spread(ends, 14, top + 6, top + plot_height)
        for line, end, row in zip(lines, ends, rows, strict=True):
            start = width - right
            style = f"c{line.colour % COLOURS}"
            parts.append(
                f'<polyline class="leader {style}" points="{start},{end:.1f} {start + 10},{row:.1f}"/>'
                f'<text class="end {style}" x="{start + 14}" y="{row + 4:.1f}">{escape(line.label)}</text>'
            )
    parts.append("</svg>")
    return "".join(parts)


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
        result[k] = row
    return result
