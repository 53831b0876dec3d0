"""How scores are shown: which figures every table has, in their order, and how a number and an interval are written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

MISSING: Final = "\u2013"
"""Stands for a figure that an entry does not have."""

Values = Mapping[str, Mapping[str, float | None]]
"""``"areas"``, ``"1"``, ``"2"``, ``"4"``, ``"8"`` (poses) -> metric -> value."""


@dataclass(frozen=True)
class Figure:
    """One column of figures.

    Attributes:
        group, metric: where the value is in ``Values``.
        short: head of the column in a terminal and in the documents.
        title, subtitle: head of the column on the page.
        digits: decimals shown.
        factor: the figure shown is the value times this.
        ascending: lower is better.
    """

    group: str
    metric: str
    short: str
    title: str
    subtitle: str = ""
    digits: int = 3
    factor: float = 1.0
    ascending: bool = False

    def of(self, values: Values) -> float | None:
        """The figure, or None where ``values`` lack it."""
        value = values[self.group].get(self.metric)
        return None if value is None else self.factor * value

    def text(self, values: Values) -> str:
        """The figure as it is shown."""
        return number(self.of(values), self.digits)


IOU_AREA: Final = Figure("areas", "iou_area", "IoU area", "IoU area", "95 %")
"""What entries are ranked by; shown with its interval."""
EXPLORATION_AREA: Final = Figure("areas", "exploration_area", "touch area", "Exploration", "area under curve")
FIGURES: Final = (
    *(
        Figure(str(count), "iou", f"IoU {count}", "IoU", f"{count} pose{'s' if count > 1 else ''}")
        for count in RECONSTRUCTED_POSES
    ),
    Figure("8", "calibration_error", "ECE", "ECE", "calibration error", ascending=True),
    Figure("8", "chamfer_l2", "CD-L2 x100", "Chamfer-L2", "\u00d7 100", 4, 100, True),
    Figure("8", "chamfer_l1", "CD-L1", "Chamfer-L1", "", 4, 1, True),
    Figure("8", "normal_consistency", "NC", "Normal", "consistency"),
    Figure("8", "f_score_1", "F 1%", "F-score", "at 1 %"),
    Figure("8", "f_score_2", "F 2%", "F-score", "at 2 %"),
    Figure("8", "surface_iou", "surf. IoU", "Surface IoU", "touched voxels"),
    Figure("8", "touched_surface_recall", "recall", "Recall", "touched surface"),
    EXPLORATION_AREA,
)
"""The other figures of an entry; those that name no number of poses are after 8."""


def means(aggregate: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float | None]]:
    """The means of the aggregate in a score file or in leaderboard.json."""
    return {group: {name: value["mean"] for name, value in row.items()} for group, row in aggregate.items()}


def number(value: float | None, digits: int = 3) -> str:
    """A figure as it is shown."""
    return MISSING if value is None else f"{value:.{digits}f}"


def interval(estimate: Mapping[str, Any], digits: int = 3) -> str:
    """The 95 % interval of an estimate as it is shown."""
    return f"{estimate['low']:.{digits}f} to {estimate['high']:.{digits}f}"


def rounded(value: Any, digits: int) -> Any:
    """The same plain value, its numbers with so many significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    return [rounded(item, digits) for item in value] if isinstance(value, list | tuple) else value
