"""Cooks every prepared hull in the format that a GPU needs, and names those of which PhysX complains. Needs no GPU.

    python benchmarks/gpu_hulls.py --split test
    python benchmarks/gpu_hulls.py --split train --output gpu_hulls.json

PhysX says that a hull is too oblong and SAPIEN goes on without its GPU data: contacts with it are then found on the host or
missed. Objects are only read, whatever is found: their hashes are part of the protocol.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from report import print_table, write_json
from sapien import physx
from sapien.pysapien.physx import _enable_gpu
from tqdm import tqdm

from tslam_bench.engine.native_output import captured_output
from tslam_bench.engine.physics import collision_shapes
from tslam_bench.objects.splits import check_split, prepared_names
from tslam_bench.objects.store import PreparedObject, load_object


@dataclass(frozen=True)
class Config:
    """Cooks hulls."""

    split: str = "test"
    """Split; what is prepared of it, unless --objects names some."""
    objects: tuple[str, ...] = ()
    """Objects."""
    output: Path | None = None
    """JSON file for the report."""


def complaints(prepared: PreparedObject) -> list[str]:
    """What PhysX prints while an object's hulls are cooked for a GPU; :func:`main` has switched that on."""
    with captured_output(echo=False) as output:
        collision_shapes(prepared)
    return output.complaints()


def refused_hulls(prepared: PreparedObject) -> list[dict[str, Any]]:
    """Hulls of which PhysX complains: number, edges of the bounding box (m), PhysX's line."""
    if not complaints(prepared):
        return []
    found = []
    for index, (vertices, _) in enumerate(prepared.hulls):
        lines = complaints(replace(prepared, hulls=prepared.hulls[index : index + 1]))
        if lines:
            edges = sorted(float(edge) for edge in np.ptp(vertices, axis=0))
            found.append({"object": prepared.name, "hull": index, "edges": edges, "message": lines[0]})
    return found


def check(split: str, names: Sequence[str]) -> dict[str, Any]:
    """Cooks the hulls of objects; counts, and one entry per hull that was refused."""
    hulls, refused = 0, []
    for name in tqdm(names, desc=f"cooking {split}"):
        prepared = load_object(name, split)
        hulls += len(prepared.hulls)
        refused += refused_hulls(prepared)
    return {"split": split, "objects": len(names), "hulls": hulls, "physx": physx.version(), "refused": refused}


def main(config: Config) -> None:
    """Prints the refused hulls, and one JSON line of counts."""
    _enable_gpu()  # the cooking format alone: needs neither the library nor a card, but an engine that is not alive yet
    split = check_split(config.split)
    report = check(split, config.objects or prepared_names(split))
    if report["refused"]:
        rows = [(r["object"], r["hull"], " x ".join(f"{1e3 * e:.1f}" for e in r["edges"])) for r in report["refused"]]
        print_table(("object", "hull", "bounding box (mm)"), rows)
    write_json(config.output, report)
    print(json.dumps(report | {"refused": len(report["refused"])}))


if __name__ == "__main__":
    main(tyro.cli(Config))
