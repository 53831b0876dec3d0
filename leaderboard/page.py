"""The leaderboard as one static HTML page: no external request, no framework, readable without scripts.

This module picks and groups what the page shows; ``templates/`` write it. Everything that a template prints is escaped
(Jinja2 with autoescape), and what is no text is made visible, so nothing here needs to be.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import jinja2

from tslam_bench import constants
from tslam_bench.scoring.figures import EXPLORATION_AREA, FIGURES, IOU_AREA, interval, means, number
from tslam_bench.scoring.info import OBJECT_SETS
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES
from tslam_bench.text import visible

from .charts import Axis, Chart, Line, line_chart, line_style
from .pictures import TOUCHED_AS_THEY_ARE

Images = Mapping[tuple[str, str, str], bytes]
"""(kind, content hash, object) -> WebP; the hash is empty for the true mesh."""

OPEN_OBJECTS: Final = 2
"""Objects of the gallery that are unfolded when the page opens."""
MOST_AUTHORS: Final = 4
"""Authors of an entry that are named."""
COUNTS: Final = tuple(RECONSTRUCTED_POSES)
"""Numbers of poses that are reported."""


@dataclass
class Explorer:
    """Entries that share their rollouts: one row of the gallery, one line of the charts."""

    label: str
    privileged: bool
    colour: int = 0
    entries: list[dict[str, Any]] = field(default_factory=list)

    @property
    def style(self) -> str:
        """Classes of the style sheet for its lines."""
        return line_style(self.colour, self.privileged)

    @property
    def curve(self) -> list[float]:
        """Mean touched-surface recall every few steps; empty for a reference without rollouts."""
        return self.entries[0]["recall_curve"]


def build_page(leaderboard: Mapping[str, Any], images: Images) -> str:
    """The page's HTML.

    Args:
        leaderboard: what :func:`tslam_bench.leaderboard.ranking.rank` returned.
        images: pictures by kind, submission and object; what is missing is shown as missing.
    """
    boards = leaderboard["tables"]
    return _page_template().render(
        board=leaderboard,
        tables=[_table_view(number, table, leaderboard, images) for number, table in enumerate(boards, start=1)],
        teaser=_teaser(boards, images),
        constants=constants,
        counts=COUNTS,
        seconds={count: round(count * constants.HORIZON * constants.CONTROL_STEP_SECONDS) for count in COUNTS},
        figures=FIGURES,
        iou_area=IOU_AREA,
        exploration_area=EXPLORATION_AREA,
        touched_as_they_are=TOUCHED_AS_THEY_ARE,
        open_objects=OPEN_OBJECTS,
    )


def group_explorers(entries: Sequence[dict[str, Any]]) -> list[Explorer]:
    """Explorers in the order of their best entry; entries of one explorer name and one exploration curve belong together.

    One that only claims the name of a baseline is another, whatever its curve.
    """
    explorers: dict[tuple[str, bool, tuple[float, ...]], Explorer] = {}
    for entry in entries:
        name = entry["submission"]["explorer"]
        key = (name, entry["claimed"], tuple(entry["recall_curve"]))
        if key not in explorers:
            taken = any(known == name and not claimed for known, claimed, _ in explorers)
            label = f"{name} ({entry['submission']['method']})" if taken or entry["claimed"] else name
            explorers[key] = Explorer(label, entry["submission"]["privileged"])
        explorers[key].entries.append(entry)
    found = list(explorers.values())
    # Ranked explorers first: where colours run out, a dashed line shares the colour of a plain one.
    for colour, explorer in enumerate(sorted(found, key=lambda e: e.privileged)):
        explorer.colour = colour
    return found


# --- What the templates are given ------------------------------------------------------------------------------


def _page_template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        finalize=lambda value: visible(value) if type(value) is str else value,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "interval": interval,
        "means": means,
        "hours": lambda hours: f"{60 * hours:.0f} min" if hours < 1 else f"{hours:.1f} h",
        "thousands": "{:,}".format,
        "listed": lambda values: f"{', '.join(map(str, values[:-1]))} and {values[-1]}",
        "data_uri": lambda image: f"data:image/webp;base64,{base64.b64encode(image).decode('ascii')}",
        "sha256": lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii"),
        "people": lambda names: (
            ", ".join(names[:MOST_AUTHORS])
            + (f" and {len(names) - MOST_AUTHORS} more" if len(names) > MOST_AUTHORS else "")
        ),
        "web_address": lambda link: link if re.match("https?://", link) else "",
    }
    return environment.get_template("page.html.jinja")


def _table_view(
    number: int, table: Mapping[str, Any], leaderboard: Mapping[str, Any], images: Images
) -> dict[str, Any]:
    """One ranking with its charts and its gallery."""
    entries = table["entries"]
    explorers = group_explorers(entries)
    reconstructors = sorted({entry["submission"]["reconstructor"] for entry in entries})
    kind = table["object_set"] if table["object_set"] in OBJECT_SETS else "chosen"
    count = len(table["objects"])
    set_name = f"{count} {kind} object{'' if count == 1 else 's'}"
    recall_chart = _recall_chart([e for e in explorers if e.curve], leaderboard["curve_spacing"])
    pictured = [name for name in table["objects"] if ("truth", "", name) in images]
    present = {"ranking": True, "exploration": recall_chart is not None, "objects": True, "gallery": bool(pictured)}
    return {
        "number": number,
        "set_name": set_name,
        "sections": [
            {
                "identifier": name if number == 1 else f"{name}-{number}",
                "title": name.capitalize() + (f" ({set_name})" if len(leaderboard["tables"]) > 1 else ""),
                "template": f"{name}.html.jinja",
            }
            for name, shown in present.items()
            if shown
        ],
        "object_set": table["object_set"],
        "objects": table["objects"],
        "entries": entries,
        "explorers": explorers,
        "reconstructors": reconstructors,
        "recall_chart": recall_chart,
        "iou_charts": _iou_charts(explorers, reconstructors),
        "gallery": [_gallery_object(name, entries, explorers, reconstructors, images) for name in pictured],
    }


def _teaser(tables: Sequence[Mapping[str, Any]], images: Images) -> dict[str, Any] | None:
    """What was felt, rebuilt and true, of the best ranked entry and the object it rebuilt best among those pictured."""
    for table in tables:
        for entry in sorted(table["entries"], key=lambda e: e["rank"] or math.inf):
            key = entry["content_hash"]
            shown = {}
            for name in table["objects"]:
                wanted = (("touched", key, name), ("reconstruction", key, name), ("truth", "", name))
                if all(picture in images for picture in wanted):
                    shown[name] = [images[picture] for picture in wanted]
            if shown:
                name = max(shown, key=lambda name: _iou_at_8(entry, name))
                return {"name": name, "entry": entry, "iou": _iou_at_8(entry, name), "pictures": shown[name]}
    return None


def _recall_chart(explorers: Sequence[Explorer], spacing: int) -> Chart | None:
    """Recall against control steps of the explorers that have rollouts."""
    if not explorers:
        return None
    total = spacing * (len(explorers[0].curve) - 1)
    steps = range(0, total + 1, constants.HORIZON)
    return line_chart(
        "Touched-surface recall against control steps",
        [
            Line(e.label, e.colour, [(spacing * k, v) for k, v in enumerate(e.curve)], dashed=e.privileged)
            for e in explorers
        ],
        Axis(f"control steps; a new pose every {constants.HORIZON}", 0, total, [(step, str(step)) for step in steps]),
        Axis("touched-surface recall", 0, 1, _fifths(1)),
    )


def _iou_charts(explorers: Sequence[Explorer], reconstructors: Sequence[str]) -> dict[str, Chart]:
    """IoU against the number of poses: a chart for each reconstructor of more than one entry, all on one scale."""
    lines: dict[str, list[Line]] = {name: [] for name in reconstructors}
    for explorer in explorers:
        for entry in explorer.entries:
            points = [(float(k), entry["aggregate"][str(n)]["iou"]["mean"]) for k, n in enumerate(COUNTS)]
            line = Line(explorer.label, explorer.colour, points, dashed=explorer.privileged)
            lines[entry["submission"]["reconstructor"]].append(line)
    highest = max(iou for drawn in lines.values() for line in drawn for _, iou in line.points)
    top = max(0.2, math.ceil(5 * highest - 1e-9) / 5)
    x = Axis("poses", -0.15, len(COUNTS) - 0.85, [(k, str(n)) for k, n in enumerate(COUNTS)])
    y = Axis("IoU", 0, top, _fifths(top))
    return {
        name: line_chart(f"IoU against poses, reconstructor {name}", drawn, x, y, (340, 250), False, True)
        for name, drawn in lines.items()
        if len(drawn) > 1
    }


def _gallery_object(
    name: str, entries: Sequence[Any], explorers: Sequence[Explorer], reconstructors: Sequence[str], images: Images
) -> dict[str, Any]:
    """Pictures of one object: a row for each explorer, with the reconstructions of its touches."""
    ranked = [entry for entry in entries if entry["rank"] is not None]
    best = max(ranked or entries, key=lambda entry: _iou_at_8(entry, name))
    rows = []
    for explorer in explorers:
        touched = (images.get(("touched", entry["content_hash"], name)) for entry in explorer.entries)
        cells: dict[str, list[dict[str, Any]]] = {r: [] for r in reconstructors if r != TOUCHED_AS_THEY_ARE}
        for entry in explorer.entries:
            if entry["submission"]["reconstructor"] in cells:
                image = images.get(("reconstruction", entry["content_hash"], name))
                cells[entry["submission"]["reconstructor"]].append({"image": image, "iou": _iou_at_8(entry, name)})
        rows.append(
            {
                "explorer": explorer,
                "touched": next((image for image in touched if image is not None), None),
                "recall": explorer.entries[0]["per_object"][name]["8"]["touched_surface_recall"],
                "cells": cells,
            }
        )
    return {
        "name": name,
        "truth": images["truth", "", name],
        "best": best,
        "best_iou": _iou_at_8(best, name),
        "rows": rows,
    }


def _iou_at_8(entry: Mapping[str, Any], name: str) -> float:
    return entry["per_object"][name]["8"]["iou"]


def _fifths(top: float) -> list[tuple[float, str]]:
    """Ticks at 0, 0.2, ... up to ``top``."""
    return [(k / 5, f"{k / 5:.1f}") for k in range(round(5 * top) + 1)]
