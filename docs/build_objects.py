"""Writes the tables of docs/objects.md from the manifests in assets/, and the contact sheets from the asset cache.

python docs/build_objects.py             # tables, and contact sheets of what is prepared
python docs/build_objects.py --check     # fail if a table is out of date
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from sections import filled, table, write_or_check

from tslam_bench.objects import splits, store
from tslam_bench.preparation import manifest
from tslam_bench.preparation.decompose import EXCEPTIONS, STANDARD, settings_for
from tslam_bench.preparation.pipeline import HULL_IOU_EXCEPTIONS
from tslam_bench.sources import contactdb, sweethome3d
from tslam_bench.sources.generator import generate, household

DOCS = Path(__file__).parent
PAGE = DOCS / "objects.md"
PICTURES = DOCS / "objects"
MANIFESTS = DOCS.parent / "assets"
GATES = {
    "hull IoU below 0.85": r"IoU\(hull union",
    "more than one part": r"largest part",
    "a part lost in repair": r"of the longest edge",
    "flat as a sheet": r"flat as a sheet",
    "copy of a test object": r"a copy of test object",
    "copy of another object of train or val": r"a copy of (train|val)/",
}
"""What a rejection is called in the table -> pattern of its reason."""

CAPTION = 15
"""Characters of a caption that fit under a panel."""

Manifests = dict[str, dict[str, Any]]
"""Split -> its manifest."""


@dataclass(frozen=True)
class Config:
    """Writes or checks docs/objects.md."""

    check: bool = False
    """Only compare the tables; exit with status 1 if one is out of date."""
    sheets: bool = True
    """Also draw the contact sheets."""


def objects_table(manifests: Manifests) -> str:
    """Every test object with its gate figures."""
    records = manifests["test"]["objects"]
    rows = [
        [
            f"`{r['name']}`",
            r["details"]["official_name"],
            ", ".join(f"`{alias}`" for alias in r["aliases"]),
            r["category"],
            " x ".join(f"{100 * x:.1f}" for x in r["extents_m"]),
            f"{1e6 * r['volume_m3']:.0f}",
            {"kept": "", "winding": "rebuilt", "ball": "ball", "closed": "closed"}[r["repair"]]
            + (" filled" if r["differs_from_raw"] else ""),
            r["gates"]["genus"],
            r["hull_count"],
            f"{r['gates']['hull_iou']:.3f}",
            f"{1e3 * r['gates']['field_error_m']:.2f}",
        ]
        for r in records
    ]
    heading = [
        "name",
        "in ContactDB",
        "aliases",
        "category",
        "extents (cm)",
        "volume (cm3)",
        "repair",
        "genus",
        "hulls",
    ]
    return table([*heading, "hull IoU", "field error (mm)"], rows)


def excluded_table(manifests: Manifests) -> str:
    """Names of the paper's list that the split leaves out."""
    return table(["name", "why"], [[f"`{name}`", why] for name, why in splits.EXCLUDED.items()])


def filled_table(manifests: Manifests) -> str:
    """Objects with voids that are filled."""
    records = manifests["test"]["objects"]
    return table(
        ["name", "volume filled (cm3)", "volume with it (cm3)"],
        [
            [f"`{r['name']}`", f"{1e6 * r['filled_volume_m3']:.1f}", f"{1e6 * r['volume_m3']:.1f}"]
            for r in records
            if r["differs_from_raw"]
        ],
    )


def thin_table(manifests: Manifests) -> str:
    """Objects with settings of their own."""
    records = manifests["test"]["objects"]
    rows = []
    for r in records:
        settings = settings_for("test", r["name"])
        if f"test/{r['name']}" in EXCEPTIONS:
            rows.append(
                [
                    f"`{r['name']}`",
                    settings.threshold,
                    settings.max_hulls,
                    r["hull_count"],
                    f"{r['gates']['hull_iou']:.3f}",
                ]
            )
    rows.append(["all others", STANDARD.threshold, STANDARD.max_hulls, "", ""])
    return table(["name", "concavity threshold", "most hulls", "hulls", "hull IoU"], rows)


def gates_table(manifests: Manifests) -> str:
    """What the gates say about the test split as a whole."""
    records = manifests["test"]["objects"]
    iou = np.array([r["gates"]["hull_iou"] for r in records])
    hulls = np.array([r["hull_count"] for r in records])
    repaired = [r for r in records if r["repair"] != "kept"]
    rows = [
        ["objects", len(records)],
        ["hull IoU: median, lowest", f"{np.median(iou):.3f}, {iou.min():.3f} ({records[int(iou.argmin())]['name']})"],
        ["objects with hull IoU of at least 0.85", f"{(iou >= 0.85).sum()} ({(iou >= 0.85).mean():.0%})"],
        ["hulls per object: mean, most", f"{hulls.mean():.1f}, {hulls.max()}"],
        ["largest field error at the surface", f"{1e3 * max(r['gates']['field_error_m'] for r in records):.2f} mm"],
        ["rebuilt meshes", f"{len(repaired)} ({', '.join(r['name'] for r in repaired)})"],
        [
            "their surface within (99 % of area-uniform samples)",
            f"{1e3 * max(r['gates']['repair_error_p99_m'] for r in repaired):.2f} mm of the original",
        ],
        ["on disk", f"{sum(r['bytes'] for r in records) / 1e6:.0f} MB"],
    ]
    return table(["", "test split"], rows)


def exceptions_table(manifests: Manifests) -> str:
    """Objects below the gate, with the reason why they are in."""
    records = manifests["test"]["objects"]
    rows = [
        [f"`{r['name']}`", f"{r['gates']['hull_iou']:.3f}", HULL_IOU_EXCEPTIONS[f"test/{r['name']}"]]
        for r in records
        if not r["gates"]["hull_iou_passes"]
    ]
    return table(["name", "hull IoU", "reason"], rows) if rows else "None."


def license_table(manifests: Manifests) -> str:
    """Where the objects come from and under which licences."""
    rows = [["test", contactdb.SOURCE, contactdb.LICENSE, "", len(manifests["test"]["objects"])]]
    for split in ("train", "val"):
        records = manifests[split]["objects"]
        for name, text in sweethome3d.LICENSES.items():
            of_catalogue = [r for r in records if f": {name}: " in r["source"]]
            creators = {r["details"]["creator"] for r in of_catalogue}
            rows.append(
                [split, f"Sweet Home 3D furniture 1.8, catalogue {name}", text, len(creators), len(of_catalogue)]
            )
        generated = [r for r in records if _is_generated(r)]
        rows.append([split, "generated", "Apache-2.0", "", len(generated)])
    return table(["split", "source", "licence", "creators", "objects"], rows)


def creators_table(manifests: Manifests) -> str:
    """Who made the furniture models, by licence."""
    count: dict[str, Counter[str]] = {}
    for record in (r for split in ("train", "val") for r in manifests[split]["objects"] if not _is_generated(r)):
        count.setdefault(record["license"], Counter())[record["details"]["creator"] or "(not named)"] += 1
    rows = [
        [text, ", ".join(f"{name} ({number})" if number > 1 else name for name, number in sorted(creators.items()))]
        for text, creators in sorted(count.items())
    ]
    return table(["licence", "creators (number of objects in train and val, if more than one)"], rows)


def _is_generated(record: dict[str, Any]) -> bool:
    return bool(record["source"].startswith("generated"))


def categories_table(manifests: Manifests) -> str:
    """Objects per category and source."""
    rows = []
    for split in ("train", "val"):
        real, drawn = (
            Counter(r["category"] for r in manifests[split]["objects"] if _is_generated(r) == generated)
            for generated in (False, True)
        )
        rows += [
            [split, name, real[name] or "", drawn[name] or "", real[name] + drawn[name]]
            for name in sorted(real | drawn)
        ]
        names = f"**{len(real | drawn)} categories**"
        rows.append([split, names, real.total(), drawn.total(), real.total() + drawn.total()])
    return table(["split", "category", "furniture", "generated", "objects"], rows)


def training_gates_table(manifests: Manifests) -> str:
    """What the gates say about train and val."""
    columns = []
    kept = [split for split in ("train", "val") if manifests[split]["objects"]]
    for split in kept:
        records = manifests[split]["objects"]
        iou = np.array([r["gates"]["hull_iou"] for r in records])
        hulls = np.array([r["hull_count"] for r in records])
        closest = max(records, key=lambda r: r["gates"]["closest_test_overlap"])
        repair = Counter(r["repair"] for r in records)
        columns.append(
            [
                len(records),
                len({r["category"] for r in records}),
                ", ".join(f"{value:.3f}" for value in np.quantile(iou, [0, 0.05, 0.5, 0.95])),
                ", ".join(f"{value:.0f}" for value in np.quantile(hulls, [0.05, 0.5, 0.95, 1])),
                f"{1e3 * max(r['gates']['field_error_m'] for r in records):.2f} mm",
                ", ".join(str(repair[name]) for name in ("ball", "kept", "winding")),
                sum(r["differs_from_raw"] for r in records),
                f"{closest['gates']['closest_test_overlap']:.3f}"
                f" ({closest['name']}, {closest['gates']['closest_test_object']})",
                f"{sum(r['bytes'] for r in records) / 1e6:.0f} MB",
            ]
        )
    names = [
        "objects",
        "categories",
        "hull IoU: lowest, 5 %, median, 95 %",
        "hulls per object: 5 %, median, 95 %, most",
        "largest field error at the surface",
        "repair: rebuilt by the ball, kept as it is, rebuilt by winding numbers",
        "objects with filled voids",
        "largest overlap with a test object",
        "on disk",
    ]
    return table(["", *kept], [list(row) for row in zip(names, *columns, strict=True)])


def rejections_table(manifests: Manifests) -> str:
    """How many objects each gate rejected."""
    rows = []
    for split in ("train", "val"):
        generated = {source.name for source in generate.candidates(split, rounds=200)}
        for gate, pattern in GATES.items():
            names = [n for n, entry in manifests[split]["rejected"].items() if re.search(pattern, entry["reason"])]
            drawn = sum(name in generated for name in names)
            rows.append([split, gate, len(names) - drawn or "", drawn or ""])
    return table(["split", "gate", "furniture", "generated"], rows)


def copies_table(manifests: Manifests) -> str:
    """Objects that repeat another one of train or val."""
    rows = []
    for split in ("train", "val"):
        for name, entry in manifests[split]["rejected"].items():
            match = re.search(r"\(aligned IoU ([0-9.]+)\)", entry["reason"])
            if "original" in entry and match:
                rows.append([f"`{split}/{name}`", f"`{entry['original']}`", match[1]])
    return table(["dropped", "copy of", "aligned IoU"], rows) if rows else "None."


SECTIONS: dict[str, Callable[[Manifests], str]] = {
    "objects": objects_table,
    "excluded": excluded_table,
    "filled": filled_table,
    "thin": thin_table,
    "gates": gates_table,
    "exceptions": exceptions_table,
    "categories": categories_table,
    "training_gates": training_gates_table,
    "rejections": rejections_table,
    "copies": copies_table,
    "licenses": license_table,
    "creators": creators_table,
}


def _prepared_panels(split: str, names: Iterable[str]) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.int64]]]:
    """(caption, vertices, faces) of prepared objects."""
    for name in names:
        short = re.sub(r"-(?:(?:blendswap-cc-0|blendswap-cc-by|katorlegaz|scopia)-)?\d+$", "", name)
        yield short[:CAPTION], *store.load_surface(name, split)


def _one_of_each(split: str) -> list[str]:
    """The first object of each category of each source, by category."""
    first: dict[tuple[str, bool], str] = {}
    for record in store.list_objects(split):
        first.setdefault((record["category"], _is_generated(record)), record["name"])
    return [name for _, name in sorted(first.items())]


def draw_sheets() -> None:
    """Contact sheets of the prepared objects of each split, and of the generator."""
    from tslam_bench.preparation.sheets import contact_sheet

    PICTURES.mkdir(exist_ok=True)
    chosen = {split: splits.prepared_names(split) for split in splits.SPLITS}
    chosen["train"] = _one_of_each("train")
    sheets = {
        split: (_prepared_panels(split, names), 10 if split == "test" else 12)
        for split, names in chosen.items()
        if names
    }
    kinds = (
        (f"{kind[: CAPTION - 2]} {k}", *generate.draw(kind, k)[0]) for kind in household.CATEGORIES for k in range(2)
    )
    for name, (panels, columns) in {**sheets, "generated": (kinds, 12)}.items():
        path = PICTURES / f"{name}.png"
        contact_sheet(panels, columns, 150 if name == "test" else 100).quantize(48).save(path, optimize=True)
        print(path, f"{path.stat().st_size / 1e3:.0f} kB")


def main(config: Config) -> None:
    """Writes or checks the page."""
    manifests = {split: manifest.read(MANIFESTS / f"manifest_{split}.json") for split in splits.SPLITS}
    write_or_check({PAGE: filled(PAGE, {name: make(manifests) for name, make in SECTIONS.items()})}, config.check)
    if config.sheets and not config.check:
        draw_sheets()


if __name__ == "__main__":
    main(tyro.cli(Config))
