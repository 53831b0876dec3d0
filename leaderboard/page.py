"""The leaderboard as one static HTML page: no external request, no framework, readable without scripts."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any, Final

from tslam_bench.constants import (
    ENVIRONMENT_ID,
    GRID_SIZE,
    HORIZON,
    IOU_INSIDE_POINTS,
    NUM_POSES,
    PROTOCOL_VERSION,
    SURFACE_SAMPLES,
    VOXEL_EDGE,
)
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

from .charts import Axis, Line, line_chart
from .pictures import TOUCHED_AS_THEY_ARE

_TEMPLATES = Path(__file__).parent / "templates"

Images = Mapping[tuple[str, str, str], bytes]
"""(kind, content hash, object) -> WebP; the hash is empty for the true mesh."""

OPEN_OBJECTS: Final = 2
"""Objects of the gallery that are unfolded when the page opens."""


@dataclass(frozen=True)
class Column:
    """One column of figures in the ranking.

    Attributes:
        group, metric: where the estimate is in ``aggregate``.
        title, subtitle: head of the column.
        digits: decimals shown.
        factor: the figure shown is the value times this.
        ascending: lower is better.
    """

    group: str
    metric: str
    title: str
    subtitle: str
    digits: int = 3
    factor: float = 1.0
    ascending: bool = False


COLUMNS: Final = (
    Column("1", "iou", "IoU", "1 pose"),
    Column("2", "iou", "IoU", "2 poses"),
    Column("4", "iou", "IoU", "4 poses"),
    Column("8", "iou", "IoU", "8 poses"),
    Column("8", "calibration_error", "ECE", "calibration error", ascending=True),
    Column("8", "chamfer_l2", "Chamfer-L2", "&times;10<sup>&minus;2</sup>", 4, 100, True),
    Column("8", "chamfer_l1", "Chamfer-L1", "", 4, 1, True),
    Column("8", "normal_consistency", "Normal", "consistency"),
    Column("8", "f_score_1", "F-score", "at 1 %"),
    Column("8", "f_score_2", "F-score", "at 2 %"),
    Column("8", "surface_iou", "Surface IoU", "touched voxels"),
    Column("8", "touched_surface_recall", "Recall", "touched surface"),
    Column("areas", "exploration_area", "Exploration", "area under curve"),
)


@dataclass
class Explorer:
    """Entries that share their rollouts: one row of the gallery, one line of the charts."""

    label: str
    privileged: bool
    colour: int
    entries: list[dict[str, Any]] = field(default_factory=list)

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
    tables = leaderboard["tables"]
    content = []
    links = []
    for number, table in enumerate(tables):
        suffix = "" if number == 0 else f"-{number + 1}"
        explorers = group_explorers(table["entries"])
        name = f" ({_set_name(table)})" if len(tables) > 1 else ""
        sections = [
            ("ranking", f"Ranking{name}", _ranking(table, number)),
            ("exploration", f"Exploration{name}", _exploration(explorers, leaderboard["curve_spacing"])),
            ("objects", f"Objects{name}", _per_object(table)),
            ("gallery", f"Gallery{name}", _gallery(table, explorers, images)),
        ]
        for identifier, title, body in sections:
            if body:
                content.append(_section(identifier + suffix, title, body))
                links.append((identifier + suffix, title))
    links += [("protocol", "How to read this"), ("reproduce", "Reproduce")]
    navigation = "".join(f'<a href="#{identifier}">{escape(title)}</a>' for identifier, title in links)
    page = Template((_TEMPLATES / "page.html").read_text(encoding="utf-8"))
    return page.substitute(
        style=(_TEMPLATES / "page.css").read_text(encoding="utf-8").strip(),
        hero=_hero(tables, images),
        navigation=navigation,
        content="\n".join(content),
        version=escape(leaderboard["package_version"]),
        horizon=HORIZON,
        total_steps=f"{HORIZON * NUM_POSES:,}",
        inside_points=f"{IOU_INSIDE_POINTS:,}",
        surface_samples=f"{SURFACE_SAMPLES:,}",
    )


def group_explorers(entries: Sequence[dict[str, Any]]) -> list[Explorer]:
    """Explorers in the order of their best entry; entries of one explorer name and one exploration curve belong together."""
    explorers: dict[tuple[str, tuple[float, ...]], Explorer] = {}
    for entry in entries:
        name = entry["submission"]["explorer"]
        key = (name, tuple(entry["recall_curve"]))
        if key not in explorers:
            taken = any(known == name for known, _ in explorers)
            label = f"{name} ({entry['submission']['method']})" if taken else name
            explorers[key] = Explorer(label, entry["submission"]["privileged"], len(explorers))
        explorers[key].entries.append(entry)
    return list(explorers.values())


# --- Sections --------------------------------------------------------------------------------------------------


def _section(identifier: str, title: str, body: str) -> str:
    return f'<section id="{identifier}" aria-labelledby="{identifier}-title">\n' + (
        f'<h2 id="{identifier}-title">{escape(title)}</h2>\n{body}\n</section>'
    )


def _hero(tables: Sequence[Mapping[str, Any]], images: Images) -> str:
    facts = [
        f"<b>{ENVIRONMENT_ID}</b>, protocol {PROTOCOL_VERSION}",
        f"<b>8 poses</b> of {HORIZON} steps each",
        f"<b>{GRID_SIZE}&sup3;</b> voxels of {1000 * VOXEL_EDGE:.1f} mm",
    ]
    for table in tables:
        count = len(table["entries"])
        plural = "y" if count == 1 else "ies"
        facts.insert(0, f"<b>{count} entr{plural}</b> on {_set_name(table)}")
    items = "".join(f"<li>{fact}</li>" for fact in facts)
    return f"""<header class="hero">
<div>
<p class="kicker">tslam-bench leaderboard</p>
<h1>Who feels best in the dark?</h1>
<p>A blind robot hand with 28 joints explores an unknown object by touch alone. Touched voxels accumulate over eight poses, a
reconstructor completes the shape, and this leaderboard compares the result with the true solid.</p>
<ul class="facts">{items}</ul>
</div>
{_teaser(tables, images)}
</header>"""


def _teaser(tables: Sequence[Mapping[str, Any]], images: Images) -> str:
    """What was felt, rebuilt and true, of the best ranked entry and the object it rebuilt best among those pictured."""
    for table in tables:
        for entry in sorted(table["entries"], key=lambda e: e["rank"] or 10**6):
            key = entry["content_hash"]
            pictured = [
                name
                for name in table["objects"]
                if ("touched", key, name) in images
                and ("reconstruction", key, name) in images
                and ("truth", "", name) in images
            ]
            if not pictured:
                continue
            name = max(pictured, key=lambda n: entry["per_object"][n]["8"]["iou"])
            method = entry["submission"]["method"]
            figures = "".join(
                f"<figure>{_image(images[k], f'{caption}: {name}, {method}')}<figcaption>{caption}</figcaption></figure>"
                for k, caption in (
                    (("touched", key, name), "felt"),
                    (("reconstruction", key, name), "rebuilt"),
                    (("truth", "", name), "true"),
                )
            )
            score = entry["per_object"][name]["8"]["iou"]
            below = f"{escape(method)} on the {escape(name)}, IoU {score:.2f}"
            return f'<div class="teaser">{figures}<div class="below">{below}</div></div>'
    return ""


def _ranking(table: Mapping[str, Any], number: int) -> str:
    entries = table["entries"]
    reconstructors = list(dict.fromkeys(entry["submission"]["reconstructor"] for entry in entries))
    buttons = '<button type="button" value="" aria-pressed="true">all</button>' + "".join(
        f'<button type="button" value="{escape(name)}" aria-pressed="false">{escape(name)}</button>'
        for name in sorted(reconstructors)
    )
    controls = (
        f'<div class="controls" data-for="ranking{number}" role="group" aria-label="Filter">'
        f"<span>Reconstructor</span>{buttons}"
        '<label><input type="checkbox" checked> show unranked entries</label></div>'
    )
    heads = [
        '<th scope="col" class="rank" data-sort="ascending">#</th>',
        '<th scope="col" class="first" data-sort="ascending">Explorer</th>',
        '<th scope="col" class="left" data-sort="ascending">Reconstructor</th>',
        '<th scope="col" data-sort="descending" aria-sort="descending">IoU area<small>95 %</small></th>',
    ]
    for column in COLUMNS:
        order = "ascending" if column.ascending else "descending"
        heads.append(f'<th scope="col" data-sort="{order}">{column.title}<small>{column.subtitle}</small></th>')
    heads += [
        '<th scope="col" data-sort="descending">P(better)<small>than heuristic</small></th>',
        '<th scope="col" data-sort="ascending">Training<small>steps, hours</small></th>',
        '<th scope="col" class="left" data-sort="ascending">Hardware</th>',
        '<th scope="col" data-sort="descending">Seeds</th>',
        '<th scope="col" data-sort="descending">Verified</th>',
    ]
    rows = "\n".join(_ranking_row(entry, number) for entry in entries)
    return f"""{_callouts(table)}
<p>Ordered by IoU area, the mean of the IoU after 1, 2, 4 and 8 poses, over {_set_name(table)}; ties by IoU after 8 poses, then by
Chamfer-L2. Entries share a rank with the first of their group if the 95 % interval of their paired difference holds 0. Entries
that saw or were rewarded with the true shape stand where their score puts them, without a rank.</p>
{controls}
<div class="scroll" tabindex="0" role="region" aria-label="Ranking table, scrolls sideways">
<table class="ranking sortable" data-table="ranking{number}">
<caption hidden>Ranking of {len(entries)} entries</caption>
<thead><tr>{"".join(heads)}</tr></thead>
<tbody>
{rows}
</tbody></table></div>
<p class="note">Columns that name no number of poses are after 8; distances are in units of the workspace edge (0.25 m). The range
below IoU area and the marks on its bar are the 95 % bootstrap interval. &ldquo;Not replayed&rdquo;: the stored actions were not
simulated again, so the touches are the submitter&rsquo;s word.</p>
{_remarks(entries, number)}"""


def _ranking_row(entry: Mapping[str, Any], number: int) -> str:
    info = entry["submission"]
    rank = entry["rank"]
    badge = (
        ' <span class="badge" title="saw or was rewarded with the true shape">privileged</span>' if rank is None else ""
    )
    remarks = [info["label"]]
    if info["method"] not in (info["explorer"], f"{info['explorer']} + {info['reconstructor']}"):
        link = escape(info["link"], quote=True)
        name = escape(info["method"])
        remarks.insert(0, f'<a href="{link}" rel="nofollow">{name}</a>' if link else name)
        remarks[1] = escape(remarks[1])
        remarks.append(escape(", ".join(info["authors"])))
    else:
        remarks[0] = escape(remarks[0])
    small = "".join(f"<small>{remark}</small>" for remark in remarks if remark)
    if entry["notes"]:
        small += f'<small><a href="#remarks-{number}">see remarks</a></small>'
    area = entry["aggregate"]["areas"]["iou_area"]
    cells = [
        f'<td class="rank" data-value="{rank or ""}">{rank or "&ndash;"}</td>',
        f'<th scope="row" data-value="{escape(info["explorer"])}">{_name(info["explorer"])}{badge}{small}</th>',
        f'<td class="left" data-value="{escape(info["reconstructor"])}">{escape(info["reconstructor"])}</td>',
        f'<td class="key" data-value="{area["mean"]:.6f}">{area["mean"]:.3f}'
        f"<small>{area['low']:.3f}&ndash;{area['high']:.3f}</small>{_bar(area)}</td>",
    ]
    for column in COLUMNS:
        mean = _mean_of(entry, column.group, column.metric)
        cells.append(_figure(None if mean is None else column.factor * mean, column.digits))
    cells.append(_figure(entry["improvement"], 2))
    training = info["training"]
    steps, hours = training["steps"], training["wall_time_hours"]
    budget = f"{steps:,}<small>{_hours(hours)}</small>" if steps else "none"
    verified = "replayed" if entry["verified"] else "not replayed"
    cells += [
        f'<td data-value="{steps}">{budget}</td>',
        f'<td class="left" data-value="{escape(training["hardware"])}">{escape(training["hardware"]) or "&ndash;"}</td>',
        f'<td data-value="{len(info["seeds"])}">{len(info["seeds"])}</td>',
        f'<td data-value="{int(entry["verified"])}">{verified}</td>',
    ]
    ranked = "no" if rank is None else "yes"
    return (
        f'<tr data-reconstructor="{escape(info["reconstructor"])}" data-ranked="{ranked}">' + "".join(cells) + "</tr>"
    )


def _remarks(entries: Sequence[Mapping[str, Any]], number: int) -> str:
    """What scoring noted, entry by entry."""
    items = [
        f"<li><b>{escape(entry['submission']['method'])}</b>: {escape(note)}</li>"
        for entry in entries
        for note in entry["notes"]
    ]
    if not items:
        return ""
    return (
        f'<details id="remarks-{number}"><summary>Remarks on entries</summary>'
        f'<div class="body"><ul class="plain">{"".join(items)}</ul></div></details>'
    )


def _callouts(table: Mapping[str, Any]) -> str:
    remarks = []
    if table["object_set"] == "quick":
        remarks.append(
            "<strong>Quick set.</strong> Five objects are too few to tell close methods apart: look at the intervals. Learned "
            "explorers carry their training budget; a short one proves that the path works, not what the method can do."
        )
    if table["object_set"] == "custom":
        remarks.append(
            "<strong>Chosen objects.</strong> These entries were scored on a selection, not on a set of the protocol."
        )
    if not any(entry["verified"] for entry in table["entries"]):
        remarks.append("No entry was replayed: this version stores actions and seeds but does not simulate them again.")
    return f'<p class="callout">{" ".join(remarks)}</p>' if remarks else ""


def _exploration(explorers: Sequence[Explorer], spacing: int) -> str:
    drawn = [explorer for explorer in explorers if explorer.curve]
    if not drawn:
        return ""
    total = spacing * (len(drawn[0].curve) - 1)
    lines = [
        Line(e.label, e.colour, [(spacing * k, v) for k, v in enumerate(e.curve)], dashed=e.privileged) for e in drawn
    ]
    chart = line_chart(
        "Touched-surface recall against control steps",
        lines,
        Axis("control steps; a new pose every 200", 0, total, [(s, str(s)) for s in range(0, total + 1, HORIZON)]),
        Axis("touched-surface recall", 0, 1, _tenths()),
    )
    counts = list(RECONSTRUCTED_POSES)
    panels = []
    values = [entry["aggregate"][str(n)]["iou"]["mean"] for e in explorers for entry in e.entries for n in counts]
    top = max(0.2, math.ceil(5 * max(values) - 1e-9) / 5)
    entries = [(explorer, entry) for explorer in explorers for entry in explorer.entries]
    for reconstructor in sorted({entry["submission"]["reconstructor"] for _, entry in entries}):
        chosen = []
        for explorer, entry in entries:
            if entry["submission"]["reconstructor"] == reconstructor:
                found = enumerate(entry["aggregate"][str(n)]["iou"]["mean"] for n in counts)
                points = [(float(position), value) for position, value in found]
                chosen.append(Line(explorer.label, explorer.colour, points, dashed=explorer.privileged))
        if len(chosen) > 1:
            panel = line_chart(
                f"IoU after 1, 2, 4 and 8 poses, reconstructor {reconstructor}",
                chosen,
                Axis("poses", -0.15, len(counts) - 0.85, [(k, str(n)) for k, n in enumerate(counts)]),
                Axis("IoU", 0, top, [tick for tick in _tenths() if tick[0] <= top + 1e-9]),
                size=(340, 250),
                end_labels=False,
                markers=True,
            )
            panels.append(f"<div><h4>{escape(reconstructor)}</h4>{panel}</div>")
    legend = "".join(
        f'<li><span class="swatch c{e.colour % 12}"></span>{escape(e.label)}{" (unranked)" if e.privileged else ""}</li>'
        for e in explorers
    )
    below = ""
    if panels:
        below = (
            "<h3>IoU against poses</h3><p>How much of the solid is right when the first 1, 2, 4 and 8 poses are merged, for each "
            f'reconstructor.</p><ul class="legend">{legend}</ul><div class="panels">{"".join(panels)}</div>'
        )
    return f"""<p>Share of the true surface that has a touched voxel within one voxel edge, while the hand explores pose after
pose (mean over objects and seeds). It does not depend on the reconstructor.</p>
<div class="frame">{chart}</div>
{below}
{_curve_table(drawn, counts)}"""


def _curve_table(explorers: Sequence[Explorer], counts: Sequence[int]) -> str:
    head = "".join(f'<th scope="col">{n} pose{"s" if n > 1 else ""}</th>' for n in counts)
    rows = "".join(
        f'<tr><th scope="row">{escape(e.label)}</th>'
        + "".join(_figure(_mean_of(e.entries[0], str(n), "touched_surface_recall"), 3) for n in counts)
        + _figure(_mean_of(e.entries[0], "areas", "exploration_area"), 3)
        + "</tr>"
        for e in explorers
    )
    return (
        '<details><summary>Recall as numbers</summary><div class="body"><div class="scroll"><table>'
        f'<thead><tr><th scope="col" class="left">Explorer</th>{head}<th scope="col">Area under curve</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div></div></details>"
    )


def _per_object(table: Mapping[str, Any]) -> str:
    objects = table["objects"]
    head = "".join(f'<th scope="col" data-sort="descending">{escape(name)}</th>' for name in objects)
    rows = []
    for entry in table["entries"]:
        info = entry["submission"]
        cells = "".join(
            f'<td class="cell" style="--v:{value:.3f}" data-value="{value:.6f}">{value:.2f}</td>'
            for value in (entry["per_object"][name]["areas"]["iou_area"] for name in objects)
        )
        label = f"{_name(info['explorer'])} <small>+ {escape(info['reconstructor'])}</small>"
        rows.append(
            f'<tr><td class="rank" data-value="{entry["rank"] or ""}">{entry["rank"] or "&ndash;"}</td>'
            f'<th scope="row" data-value="{escape(info["explorer"])}">{label}</th>{cells}</tr>'
        )
    return f"""<p>IoU area for every object (mean over seeds).</p>
<div class="scroll" tabindex="0" role="region" aria-label="Results per object, scrolls sideways">
<table class="ranking heat sortable">
<thead><tr><th scope="col" class="rank" data-sort="ascending">#</th>
<th scope="col" class="first" data-sort="ascending">Explorer</th>{head}
</tr></thead><tbody>{"".join(rows)}</tbody></table></div>"""


def _gallery(table: Mapping[str, Any], explorers: Sequence[Explorer], images: Images) -> str:
    pictured = [name for name in table["objects"] if ("truth", "", name) in images]
    if not pictured:
        return ""
    reconstructors = sorted(
        {entry["submission"]["reconstructor"] for entry in table["entries"]} - {TOUCHED_AS_THEY_ARE}
    )
    parts = [
        "<p>Touched voxels and reconstruction after 8 poses beside the true mesh, all from one camera per object (first seed). "
        f"The reconstructor <code>{TOUCHED_AS_THEY_ARE}</code> is left out: it is the touched voxels. "
        f"Pictured: {len(pictured)} of {len(table['objects'])} objects.</p>"
    ]
    for number, name in enumerate(pictured):
        head = "".join(f'<th scope="col">{escape(r)}</th>' for r in reconstructors)
        rows = "".join(_gallery_row(explorer, name, reconstructors, images) for explorer in explorers)
        opened = " open" if number < OPEN_OBJECTS else ""
        best = max(table["entries"], key=lambda e: (e["rank"] is not None, e["per_object"][name]["8"]["iou"]))
        remark = f"best ranked IoU {best['per_object'][name]['8']['iou']:.2f}, {best['submission']['method']}"
        parts.append(
            f'<details{opened}><summary>{escape(name)} <span class="note">{escape(remark)}</span></summary>'
            f'<div class="body gallery">'
            f'<figure class="truth">{_image(images["truth", "", name], f"True mesh of {name}")}<figcaption>true mesh</figcaption>'
            f'</figure><div class="scroll"><table><thead><tr>'
            f'<th scope="col" class="left">Explorer</th><th scope="col">touched</th>'
            f"{head}</tr></thead><tbody>{rows}</tbody></table></div></div></details>"
        )
    return "\n".join(parts)


def _gallery_row(explorer: Explorer, name: str, reconstructors: Sequence[str], images: Images) -> str:
    keys = [("touched", entry["content_hash"], name) for entry in explorer.entries]
    touched = next((images[key] for key in keys if key in images), None)
    recall = explorer.entries[0]["per_object"][name]["8"]["touched_surface_recall"]
    if touched is None:
        first = '<div class="empty">nothing</div>'
    else:
        first = _captioned(touched, f"Voxels that {explorer.label} touched on {name}", "recall", recall)
    cells = [f"<td>{first}</td>"]
    for reconstructor in reconstructors:
        figures = []
        for entry in explorer.entries:
            if entry["submission"]["reconstructor"] != reconstructor:
                continue
            value = entry["per_object"][name]["8"]["iou"]
            image = images.get(("reconstruction", entry["content_hash"], name))
            if image is None:
                figures.append(f'<div class="empty">empty</div><div class="note">IoU {value:.2f}</div>')
            else:
                alternative = f"Reconstruction of {name} by {reconstructor} from the touches of {explorer.label}"
                figures.append(_captioned(image, alternative, "IoU", value))
        cells.append(f"<td>{''.join(figures)}</td>")
    badge = ' <span class="badge">privileged</span>' if explorer.privileged else ""
    return f'<tr><th scope="row">{_name(explorer.label)}{badge}</th>{"".join(cells)}</tr>'


# --- Pieces ----------------------------------------------------------------------------------------------------


def _name(identifier: str) -> str:
    """An identifier that may be broken after an underscore."""
    return escape(identifier).replace("_", "_<wbr>")


def _set_name(table: Mapping[str, Any]) -> str:
    count = len(table["objects"])
    plural = "" if count == 1 else "s"
    kind = {"quick": "quick ", "test": "test "}.get(table["object_set"], "chosen ")
    return f"{count} {kind}object{plural}"


def _figure(value: float | None, digits: int) -> str:
    if value is None:
        return '<td data-value="">&ndash;</td>'
    return f'<td data-value="{value:.8f}">{value:.{digits}f}</td>'


def _mean_of(entry: Mapping[str, Any], group: str, metric: str) -> float | None:
    estimate = entry["aggregate"][group].get(metric)
    return None if estimate is None else estimate["mean"]


def _bar(estimate: Mapping[str, float]) -> str:
    marks = "".join(f'<b style="left:{100 * estimate[end]:.1f}%"></b>' for end in ("low", "high"))
    return f'<span class="bar" aria-hidden="true"><i style="width:{100 * estimate["mean"]:.1f}%"></i>{marks}</span>'


def _hours(hours: float) -> str:
    return f"{60 * hours:.0f} min" if hours < 1 else f"{hours:.1f} h"


def _tenths() -> list[tuple[float, str]]:
    return [(k / 5, f"{k / 5:.1f}") for k in range(6)]


def _captioned(image: bytes, alternative: str, name: str, value: float | None) -> str:
    text = "" if value is None else f"<figcaption>{name} <b>{value:.2f}</b></figcaption>"
    return f"<figure>{_image(image, alternative)}{text}</figure>"


def _image(data: bytes, alternative: str) -> str:
    encoded = base64.b64encode(data).decode("ascii")
    return f'<img src="data:image/webp;base64,{encoded}" alt="{escape(alternative)}" decoding="async">'
