"""What the page's script draws: plain values, figures only where they are drawn; ``templates/charts.js`` reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tslam_bench import constants
from tslam_bench.scoring.figures import Figure
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

from .explorers import COLOURS, Explorer

Point = Sequence[float]
"""x, mean, and the ends of its interval."""


def chart_data(
    leaderboard: Mapping[str, Any], explorers: Sequence[Sequence[Explorer]], heat: Sequence[Figure]
) -> dict[str, Any]:
    """Data of all charts.

    Args:
        explorers: those of every table.
        heat: figures of the map of objects.

    Returns:
        ``tables``: for each, ``explorers`` (lines of the touch curve), ``iou`` (lines against poses) and ``heat`` (rows of
        figures per entry and object); ``training``: lines. A line has a ``label``, a ``colour``, whether it is ``dashed``, its
        ``points`` and the indices of the ``entries`` that it stands for.
    """
    return {
        "horizon": constants.HORIZON,
        "tables": [
            _table(table, drawn, leaderboard["curve_spacing"], heat)
            for table, drawn in zip(leaderboard["tables"], explorers, strict=True)
        ],
        "training": [
            {
                "label": record["explorer"],
                "colour": index % COLOURS,
                "dashed": index >= COLOURS,
                "points": list(zip(*(record[key] for key in ("steps", "mean", "low", "high")), strict=True)),
            }
            for index, record in enumerate(leaderboard["training"])
        ],
    }


def _table(
    table: Mapping[str, Any], explorers: Sequence[Explorer], spacing: int, heat: Sequence[Figure]
) -> dict[str, Any]:
    index = {id(entry): k for k, entry in enumerate(table["entries"])}
    touch, iou = [], []
    for number, explorer in enumerate(explorers):
        line = {"label": explorer.label, "colour": explorer.colour % COLOURS, "dashed": explorer.dashed}
        first = explorer.entries[0]
        band = first["recall_band"]
        touch.append(
            {
                **line,
                "entries": [index[id(entry)] for entry in explorer.entries],
                "points": _points(spacing, first["recall_curve"], band["low"], band["high"]),
            }
        )
        for entry in explorer.entries:
            estimates = [(count, entry["aggregate"][str(count)]["iou"]) for count in RECONSTRUCTED_POSES]
            points = [[count, _short(e["mean"]), _short(e["low"]), _short(e["high"])] for count, e in estimates]
            iou.append(
                {
                    **line,
                    "explorer": number,
                    "reconstructor": entry["submission"]["reconstructor"],
                    "entries": [index[id(entry)]],
                    "points": points,
                }
            )
    values = [
        [
            [
                None if (value := figure.of(entry["per_object"][name])) is None else _short(value)
                for name in table["objects"]
            ]
            for entry in table["entries"]
        ]
        for figure in heat
    ]
    return {"explorers": touch, "iou": iou, "heat": values}


def _points(spacing: int, mean: Sequence[float], low: Sequence[float], high: Sequence[float]) -> list[Point]:
    """Every second stored sample of a curve and its last one: as fine as a chart shows."""
    kept = sorted({*range(0, len(mean), 2), len(mean) - 1} - {-1})
    return [[spacing * k, _short(mean[k]), _short(low[k]), _short(high[k])] for k in kept]


def _short(value: float) -> float:
    return round(value, 6)
