"""Writes the tables of docs/objects.md from the manifests, and the contact sheets in docs/objects/ from the asset cache.

python docs/build_objects.py             # tables, and contact sheets of what is prepared
python docs/build_objects.py --check     # fail if a table is out of date
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from tslam_bench.assets import contactdb, furniture, household, store
from tslam_bench.assets.decompose import EXCEPTIONS, STANDARD, settings_for
from tslam_bench.assets.pipeline import HULL_IOU_EXCEPTIONS
from tslam_bench.files import atomic_file

DOCS = Path(__file__).parent
PAGE = DOCS / "objects.md"
PICTURES = DOCS / "objects"
MANIFEST = DOCS.parent / "assets" / "manifest_test.json"


@dataclass(frozen=True)
class Config:
    """Writes or checks docs/objects.md."""

    check: bool = False
    """Only compare the tables; exit with status 1 if one is out of date."""
    sheets: bool = True
    """Also draw the contact sheets."""


def table(heading: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(heading) + " |", "|" + "---|" * len(heading)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def objects_table(records: list[dict[str, Any]]) -> str:
    """Every test object with its gate figures."""
    rows = [
        [
            f"`{r['name']}`",
            r["details"]["official_name"],
            ", ".join(f"`{alias}`" for alias in r["aliases"]),
            r["category"],
            " x ".join(f"{100 * x:.1f}" for x in r["extents_m"]),
            f"{1e6 * r['volume_m3']:.0f}",
            {"kept": "", "winding": "rebuilt", "ball": "ball"}[r["repair"]]
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


def excluded_table(records: list[dict[str, Any]]) -> str:
    """Names of the paper's list that the split leaves out."""
    return table(["name", "why"], [[f"`{name}`", why] for name, why in contactdb.EXCLUDED.items()])


def filled_table(records: list[dict[str, Any]]) -> str:
    """Objects with voids that are filled."""
    return table(
        ["name", "volume filled (cm3)", "volume with it (cm3)"],
        [
            [f"`{r['name']}`", f"{1e6 * r['filled_volume_m3']:.1f}", f"{1e6 * r['volume_m3']:.1f}"]
            for r in records
            if r["differs_from_raw"]
        ],
    )


def thin_table(records: list[dict[str, Any]]) -> str:
    """Objects with settings of their own."""
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


def gates_table(records: list[dict[str, Any]]) -> str:
    """What the gates say about the test split as a whole."""
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
        ["on disk", f"{sum(p['bytes'] for r in records for p in r['products'].values()) / 1e6:.0f} MB"],
    ]
    return table(["", "test split"], rows)


def exceptions_table(records: list[dict[str, Any]]) -> str:
    """Objects below the gate, with the reason why they are in."""
    rows = [
        [f"`{r['name']}`", f"{r['gates']['hull_iou']:.3f}", HULL_IOU_EXCEPTIONS[f"test/{r['name']}"]]
        for r in records
        if not r["gates"]["hull_iou_passes"]
    ]
    return table(["name", "hull IoU", "reason"], rows) if rows else "None."


def license_table(records: list[dict[str, Any]]) -> str:
    """Where the objects come from and under which licences."""
    rows = [["test", contactdb.SOURCE, contactdb.LICENSE]]
    rows += [
        ["train, val", f"Sweet Home 3D furniture 1.8, catalogue {name}", text]
        for name, text in furniture.LICENSES.items()
    ]
    rows += [["train, val", "generated", "Apache-2.0"]]
    return table(["split", "source", "licence"], rows)


def categories_table(records: list[dict[str, Any]]) -> str:
    """Categories of the generator and of the furniture package."""
    generated: dict[str, list[str]] = {"train": [], "val": []}
    for kind in household.CATEGORIES.values():
        generated[kind.split].append(kind.name)
    real: dict[str, list[str]] = {"train": [], "val": []}
    for category in furniture.categories():
        real["val" if category in furniture.VAL_CATEGORIES else "train"].append(category)
    rows = [
        [split, source, len(names), ", ".join(names)]
        for split in ("train", "val")
        for source, names in (("generated", generated[split]), ("furniture", real[split]))
    ]
    return table(["split", "source", "categories", ""], rows)


SECTIONS: dict[str, Callable[[list[dict[str, Any]]], str]] = {
    "objects": objects_table,
    "excluded": excluded_table,
    "filled": filled_table,
    "thin": thin_table,
    "gates": gates_table,
    "exceptions": exceptions_table,
    "licenses": license_table,
    "categories": categories_table,
}


def fill(text: str, records: list[dict[str, Any]]) -> str:
    """The page with every table between its markers renewed."""
    for name, make in SECTIONS.items():
        pattern = re.compile(rf"(<!-- {name}: written by docs/build_objects.py -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(text):
            raise SystemExit(f"{PAGE}: no place for table {name!r}")
        table_text = make(records)
        text = pattern.sub(lambda match, body=table_text: f"{match[1]}{body}\n{match[2]}", text)
    return text


def draw_sheets() -> None:
    """Contact sheets of the prepared objects of each split, and of the generator."""
    from tslam_bench.assets import generate
    from tslam_bench.assets.pictures import contact_sheet

    PICTURES.mkdir(exist_ok=True)
    for split in store.SPLITS:
        names = store.prepared_names(split)
        if len(names) < 40:
            continue
        loaded = (store.load_object(name, split) for name in names[:: max(1, len(names) // 120)][:120])
        sheet = contact_sheet((o.name[:22], o.vertices, o.faces) for o in loaded)
        sheet.quantize(64).save(PICTURES / f"{split}.png", optimize=True)
        print(
            PICTURES / f"{split}.png",
            Counter(store.read_record(name, split)["category"] for name in names).most_common(5),
        )
    shapes = ((f"{kind}-{k:03d}", *generate.draw(kind, k)[0]) for kind in household.CATEGORIES for k in range(3))
    contact_sheet(shapes, columns=12, size=110).quantize(64).save(PICTURES / "generated.png", optimize=True)


def main(config: Config) -> None:
    """Writes or checks the page."""
    records = json.loads(MANIFEST.read_text(encoding="utf-8"))["objects"]
    old = PAGE.read_text(encoding="utf-8")
    new = fill(old, records)
    if config.check:
        sys.exit(f"{PAGE} is out of date; run python docs/build_objects.py" if old != new else 0)
    with atomic_file(PAGE) as temporary:
        temporary.write_text(new, encoding="utf-8")
    if config.sheets:
        draw_sheets()


if __name__ == "__main__":
    main(tyro.cli(Config))
