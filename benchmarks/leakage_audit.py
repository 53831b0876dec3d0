"""Asks whether the shortlist of the leakage gate loses copies: aligns training objects with test objects that it leaves out.

The gate aligns an object of train or val with those test objects only whose rotation-invariant descriptors are close. Here the
descriptors of every prepared object are compared with those of all 50 test objects, and pairs *beyond* the shortlist are aligned
all the same, nearest bins first. A pair with an aligned IoU above the gate's would be a copy that the gate cannot see.

    python benchmarks/leakage_audit.py --splits train val --pairs 400
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import tyro
from report import machine, print_table, write_json
from tqdm import tqdm

from tslam_bench.files import cache_directory
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.objects import splits, store
from tslam_bench.preparation import leakage
from tslam_bench.sources.fetch import fetch
from tslam_bench.sources.wheels import CONTACTDB_WHEEL

BINS = (0.0, 0.15, 0.20, 0.25, 0.30, 0.40)
"""Bounds of the descriptor distances; the first bin is the shortlist itself."""


@dataclass(frozen=True)
class Config:
    """Aligns pairs within and beyond the shortlist."""

    splits: tuple[str, ...] = ("train", "val")
    """Splits whose prepared objects are compared with the test objects."""
    pairs: int = 400
    """Pairs that are aligned in each bin of descriptor distances, drawn without replacement (all, if a bin has fewer)."""
    seed: int = 0
    """Seed of that draw."""
    output: Path | None = None
    """JSON file for every aligned pair."""


def main(config: Config) -> None:
    """Prints one row per bin."""
    cache = cache_directory()
    references = leakage.references(fetch(CONTACTDB_WHEEL, cache), cache)
    shapes = []
    for split in config.splits:
        for name in tqdm(splits.prepared_names(split, cache), unit="object", desc=f"describing {split}"):
            vertices, faces = store.load_surface(name, split, cache)
            mesh = TriangleMesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64))
            shapes.append(leakage.normalise(f"{split}/{name}", mesh))
    distance = np.array([[leakage.descriptor_distance(shape, other) for other in references] for shape in shapes])
    generator = np.random.default_rng(config.seed)
    rows, aligned = [], []
    for low, high in pairwise(BINS):
        found = np.argwhere((distance > low) & (distance <= high))
        drawn = found[np.sort(generator.permutation(len(found))[: config.pairs])]
        overlaps = []
        for i, j in tqdm(drawn, unit="pair", desc=f"distance {low:.2f} to {high:.2f}"):
            value = leakage.overlap(shapes[i], references[j])
            overlaps.append((value, shapes[i].name, references[j].name, float(distance[i, j])))
        aligned += overlaps
        best = max(overlaps, default=(0.0, "", "", 0.0))
        above = sum(value > leakage.MAX_OVERLAP for value, *_ in overlaps)
        median = f"{np.median([value for value, *_ in overlaps]):.3f}" if overlaps else ""
        rows.append(
            [
                f"{low:.2f} to {high:.2f}",
                len(found),
                len(drawn),
                median,
                f"{best[0]:.3f}",
                " and ".join(best[1:3]),
                above,
            ]
        )
    header = ["descriptor distance", "pairs", "aligned", "median IoU", "largest", "of", f"above {leakage.MAX_OVERLAP}"]
    print_table(header, rows, f"{len(shapes)} objects, {len(references)} test objects; {machine()}")
    keys = ("overlap", "object", "test_object", "descriptor_distance")
    write_json(config.output, [dict(zip(keys, pair, strict=True)) for pair in aligned])


if __name__ == "__main__":
    main(tyro.cli(Config))
