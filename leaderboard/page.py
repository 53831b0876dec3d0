"""The leaderboard as a static page in one folder: no external request, readable without scripts.

This module picks and groups what the page shows; ``templates/`` write it, and its script draws :mod:`chart_data` with
Observable Plot, which lies in ``vendor/``. Everything that a template prints is escaped (Jinja2 with autoescape), and what is
no text is made visible, so nothing here needs to be.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import jinja2
from markupsafe import Markup

from tslam_bench import constants
from tslam_bench.scoring.figures import EXPLORATION_AREA, FIGURES, IOU_AREA, interval, means, number
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES
from tslam_bench.text import visible

from .chart_data import chart_data
from .explorers import Explorer, group_explorers
from .pictures import TOUCHED_AS_THEY_ARE
from .shown import Key, Links, Shown

OPEN_OBJECTS: Final = 2
"""Objects of the gallery that are unfolded when the page opens."""
MOST_AUTHORS: Final = 4
"""Authors of an entry that are named."""
COUNTS: Final = tuple(RECONSTRUCTED_POSES)
"""Numbers of poses that are reported."""
TIERS: Final = {
    "reported": "nothing was replayed: touches are the submitter's word",
    "replayed": "the actions were simulated again: touches and exploration figures are the replay's",
    "attested": "policy and reconstructor ran at the organiser's: they give these actions and shapes, and hold in fresh episodes",
    "hidden": "attested, on objects that nobody had seen",
}
"""Tier of an entry -> what it means, from the least to the most trustworthy."""
VIEWS: Final = {
    "main": (*(figure for figure in FIGURES if figure.metric == "iou"), EXPLORATION_AREA),
    "surface": tuple(f for f in FIGURES if f.metric.startswith(("calibration", "chamfer", "normal", "f_score"))),
    "touch": tuple(f for f in FIGURES if f.metric in ("surface_iou", "touched_surface_recall")),
}
"""Sets of columns -> figures: all that every table has."""
HEAT_FIGURES: Final = (IOU_AREA, *VIEWS["main"])
"""What the map of objects can show; the first one at the start."""
_SCRIPTS: Final = ("vendor/d3.min.js", "vendor/plot.umd.min.js", "templates/tables.js", "templates/charts.js")


def build_page(
    leaderboard: Mapping[str, Any], pictures: Mapping[Key, Shown], viewer: Links = MappingProxyType({})
) -> str:
    """The page's HTML.

    Args:
        leaderboard: what :func:`tslam_bench.leaderboard.ranking.rank` returned.
        pictures: those beside the page; what is missing is shown as missing.
        viewer: where the viewer beside the page shows shapes; its episodes are a view of the same.
    """
    boards = leaderboard["tables"]
    tables = [_table_view(number, table, leaderboard, pictures, viewer) for number, table in enumerate(boards, start=1)]
    return _page_template().render(
        board=leaderboard,
        tables=tables,
        training=leaderboard["training"],
        scripts=[_script(name) for name in _SCRIPTS],
        charts=_visible(chart_data(leaderboard, [table["explorers"] for table in tables], HEAT_FIGURES)),
        teaser=_teaser(boards, pictures),
        constants=constants,
        counts=COUNTS,
        seconds={count: round(count * constants.HORIZON * constants.CONTROL_STEP_SECONDS) for count in COUNTS},
        views=VIEWS,
        heat_figures=HEAT_FIGURES,
        tiers=TIERS,
        iou_area=IOU_AREA,
        exploration_area=EXPLORATION_AREA,
        touched_as_they_are=TOUCHED_AS_THEY_ARE,
        open_objects=OPEN_OBJECTS,
    )


def row_names(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """What each entry is called in its row: its method, or its explorer where the method only joins explorer and reconstructor.

    Rows that would read alike get the beginning of their content hash.
    """
    names = []
    for entry in entries:
        info = entry["submission"]
        joined = info["method"] in (info["explorer"], f"{info['explorer']} + {info['reconstructor']}")
        names.append(info["explorer"] if joined else info["method"])
    rows = [(name, entry["submission"]["reconstructor"]) for name, entry in zip(names, entries, strict=True)]
    count = Counter(rows)
    return [
        f"{row[0]} ({entry['content_hash'][:6]})" if count[row] > 1 else row[0]
        for row, entry in zip(rows, entries, strict=True)
    ]


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
        "sha256": lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii"),
        "people": lambda names: (
            ", ".join(names[:MOST_AUTHORS])
            + (f" and {len(names) - MOST_AUTHORS} more" if len(names) > MOST_AUTHORS else "")
        ),
        "web_address": lambda link: link if re.match("https?://", link) else "",
    }
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "ensure_ascii": True}
    return environment.get_template("page.html.jinja")


def _script(name: str) -> Markup:
    """A script of this package as it stands; the policy of the page holds its hash."""
    return Markup((Path(__file__).parent / name).read_text(encoding="utf-8"))


def _visible(value: Any) -> Any:
    """The same plain value with :func:`visible` texts: a script shows them without the templates' help."""
    if isinstance(value, str):
        return visible(value)
    if isinstance(value, dict):
        return {key: _visible(item) for key, item in value.items()}
    return [_visible(item) for item in value] if isinstance(value, list | tuple) else value


def _table_view(
    number: int,
    table: Mapping[str, Any],
    leaderboard: Mapping[str, Any],
    pictures: Mapping[Key, Shown],
    viewer: Links,
) -> dict[str, Any]:
    """One ranking with its charts and its gallery."""
    entries = table["entries"]
    explorers = group_explorers(entries)
    reconstructors = sorted({entry["submission"]["reconstructor"] for entry in entries})
    kind = "chosen" if table["object_set"] == "custom" else table["object_set"]
    count = len(table["objects"])
    set_name = f"{count} {kind} object{'' if count == 1 else 's'}"
    shown = [
        name
        for name in table["objects"]
        if ("truth", "", name) in pictures or any((entry["content_hash"], name) in viewer for entry in entries)
    ]
    present = {"ranking": True, "curves": True, "objects": True, "gallery": bool(shown)}
    return {
        "number": number,
        "set_name": set_name,
        "sections": [
            {
                "identifier": name if number == 1 else f"{name}-{number}",
                "title": name.capitalize() + (f" ({set_name})" if len(leaderboard["tables"]) > 1 else ""),
                "template": f"{name}.html.jinja",
            }
            for name, there in present.items()
            if there
        ],
        "object_set": table["object_set"],
        "objects": table["objects"],
        "rows": [
            {"name": name, "entry": entry, "explorer": next(e for e in explorers if entry in e.entries)}
            for name, entry in zip(row_names(entries), entries, strict=True)
        ],
        "explorers": explorers,
        "reconstructors": reconstructors,
        "charted": _charted(explorers),
        "tiers": [tier for tier in TIERS if any(entry["tier"] == tier for entry in entries)],
        "gallery": [_gallery_object(name, entries, explorers, reconstructors, pictures, viewer) for name in shown],
    }


def _charted(explorers: Sequence[Explorer]) -> list[str]:
    """Reconstructors of more than one explorer: their IoU is drawn."""
    count = Counter(entry["submission"]["reconstructor"] for explorer in explorers for entry in explorer.entries)
    return sorted(name for name, entries in count.items() if entries > 1)


def _teaser(tables: Sequence[Mapping[str, Any]], pictures: Mapping[Key, Shown]) -> dict[str, Any] | None:
    """What was felt, rebuilt and true, of the best ranked entry and the object it rebuilt best among those pictured."""
    for table in tables:
        for entry in sorted(table["entries"], key=lambda e: e["rank"] or math.inf):
            key = entry["content_hash"]
            shown = {}
            for name in table["objects"]:
                wanted = (("touched", key, name), ("reconstruction", key, name), ("truth", "", name))
                if all(picture in pictures for picture in wanted):
                    shown[name] = [pictures[picture] for picture in wanted]
            if shown:
                name = max(shown, key=lambda name: _iou_at_8(entry, name))
                return {"name": name, "entry": entry, "iou": _iou_at_8(entry, name), "pictures": shown[name]}
    return None


def _gallery_object(
    name: str,
    entries: Sequence[Any],
    explorers: Sequence[Explorer],
    reconstructors: Sequence[str],
    pictures: Mapping[Key, Shown],
    viewer: Links,
) -> dict[str, Any]:
    """Pictures of one object: a row for each explorer, with the reconstructions of its touches."""
    ranked = [entry for entry in entries if entry["rank"] is not None]
    best = max(ranked or entries, key=lambda entry: _iou_at_8(entry, name))
    rows = []
    for explorer in explorers:
        played = explorer.entries if explorer.curve else ()  # a reference has no episodes
        links = (viewer.get((entry["content_hash"], name), "") for entry in played)
        touched = (pictures.get(("touched", entry["content_hash"], name)) for entry in explorer.entries)
        cells: dict[str, list[dict[str, Any]]] = {r: [] for r in reconstructors if r != TOUCHED_AS_THEY_ARE}
        for entry in explorer.entries:
            if entry["submission"]["reconstructor"] in cells:
                cells[entry["submission"]["reconstructor"]].append(
                    {
                        "image": pictures.get(("reconstruction", entry["content_hash"], name)),
                        "iou": _iou_at_8(entry, name),
                        "link": viewer.get((entry["content_hash"], name), ""),
                    }
                )
        rows.append(
            {
                "explorer": explorer,
                "touched": next((image for image in touched if image is not None), None),
                "episodes": next((link.replace("view=shape", "view=episode") for link in links if link), ""),
                "recall": explorer.entries[0]["per_object"][name]["8"]["touched_surface_recall"],
                "cells": cells,
            }
        )
    return {
        "name": name,
        "truth": pictures.get(("truth", "", name)),
        "best": best,
        "best_iou": _iou_at_8(best, name),
        "rows": rows,
    }


def _iou_at_8(entry: Mapping[str, Any], name: str) -> float:
    return entry["per_object"][name]["8"]["iou"]
