"""IoU of reconstructors on collected touches of held-out objects: what is chosen is chosen here.

    python benchmarks/reconstruction.py --data runs/touches/val --reconstructors carve unet=runs/unet.pt --output val.jsonl

One line of JSON per reconstructor: mean IoU after 1, 2, 4 and 8 poses for each explorer whose episodes were collected, for the
whole surface (`oracle`), calibration error, and seconds of CPU per reconstruction. The test split is refused. `--document`
replaces the section `val` of a page by the table of all lines of `--output`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table, replace_section

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.constants import OCCUPANCY_THRESHOLD
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.touch_data import NEVER, SIMULATED_FOLDER, ExploredObject
from tslam_bench.reconstruction.training_objects import training_names
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.scoring.metrics import calibration_error, iou
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES

Grids = tuple[NDArray[np.bool_], NDArray[np.bool_]]


@dataclass(frozen=True)
class Config:
    """IoU of reconstructors on collected touches."""

    data: Path
    """Folder of `tslam-bench reconstruct collect`."""
    reconstructors: tuple[str, ...] = ()
    """Ids, or ID=FILE for those that need a model."""
    output: Path | None = None
    """File that the lines are appended to."""
    document: Path | None = None
    """Page whose section `val` is replaced by the table."""
    split: str = "val"
    """Split of the objects: val or train."""
    objects: tuple[str, ...] = ()
    """These objects; all prepared ones if not given."""
    every: int = 1
    """Every so manieth of them."""


def touches(data: Path, item: PreparedObject) -> dict[tuple[str, int], Grids]:
    """Merged grids by (explorer, poses); the whole surface as ("oracle", 8)."""
    grids = {("oracle", 8): (item.surface, ~item.solid)}
    for folder in sorted(p for p in data.iterdir() if p.is_dir() and p.name != SIMULATED_FOLDER):
        explored = ExploredObject.load(folder, item.name)
        for count, poses in RECONSTRUCTED_POSES.items():
            felt = (explored.first[np.isin(explored.poses, poses)] != NEVER).any(axis=0)
            grids[folder.name, count] = (felt[0], felt[1])
    return grids


def measure(made: Reconstructor, data: Path, items: list[PreparedObject]) -> dict[str, Any]:
    """Means over objects."""
    scores: dict[tuple[str, int], list[float]] = {}
    errors: dict[tuple[str, int], list[float]] = {}
    seconds, count = 0.0, 0
    for item in items:
        sample = item.iou_points()
        for key, (touched, visited) in touches(data, item).items():
            start = time.process_time()
            volume = made.reconstruct(touched, visited)
            seconds, count = seconds + time.process_time() - start, count + 1
            probability = volume.query(sample.points)
            true = item.solid_at_iou_points
            scores.setdefault(key, []).append(iou(probability >= OCCUPANCY_THRESHOLD, true, sample.weights))
            errors.setdefault(key, []).append(calibration_error(probability, true, sample.weights))
    explorers = sorted({name for name, _ in scores if name != "oracle"})
    by_count = {name: [round(float(np.mean(scores[name, n])), 4) for n in (1, 2, 4, 8)] for name in explorers}
    return {
        "objects": len(items),
        "iou": by_count,
        "area": {name: round(float(np.mean(values)), 4) for name, values in by_count.items()},
        "oracle": round(float(np.mean(scores["oracle", 8])), 4),
        "calibration_error": {f"{name} {n}": round(float(np.mean(values)), 5) for (name, n), values in errors.items()},
        "standard_error": round(
            float(np.std([np.mean([scores[explorers[0], n][k] for n in (1, 2, 4, 8)]) for k in range(len(items))]))
            / len(items) ** 0.5
            if explorers
            else 0.0,
            4,
        ),
        "cpu_seconds": round(seconds / count, 3),
    }


def section(lines: list[dict[str, Any]]) -> str:
    """Markdown of all lines, the best first."""
    explorers = sorted({name for line in lines for name in line["iou"]})
    header = ("reconstructor", "objects")
    for name in explorers:
        header += (f"`{name}`: area", "1 / 2 / 4 / 8 poses")  # type: ignore[assignment]
    rows = []
    for line in sorted(lines, key=lambda line: -line["area"][explorers[0]]):
        row = [line["label"], line["objects"]]
        for name in explorers:
            row += [f"{line['area'][name]:.3f}", " / ".join(f"{value:.3f}"[1:] for value in line["iou"][name])]
        worst = max(line["calibration_error"].values())
        rows.append((*row, f"{line['oracle']:.3f}", f"{worst:.3f}", f"{line['cpu_seconds']:.2f}"))
    return f"{machine()}.\n\n" + markdown_table((*header, "all touched", "worst ECE", "CPU s"), rows)


def main() -> None:
    """Prints and appends a line per reconstructor."""
    config = tyro.cli(Config, description=__doc__)
    items = [load_object(n, config.split) for n in training_names(config.split, None, config.objects)[:: config.every]]
    for text in config.reconstructors:
        name, _, path = text.partition("=")
        made = make_reconstructor(name, Path(path) if path else None)
        label = f"`{name}`" + (f" ({Path(path).stem})" if path else "")
        line = json.dumps(
            {"reconstructor": text, "label": label, "split": config.split, **measure(made, config.data, items)}
        )
        print(line, flush=True)
        if config.output is not None:
            with config.output.open("a", encoding="utf-8") as stream:
                stream.write(line + "\n")
    if config.document is not None and config.output is not None:
        lines = [json.loads(text) for text in config.output.read_text(encoding="utf-8").splitlines()]
        replace_section(config.document, "val", section(lines))


if __name__ == "__main__":
    with one_line_errors("reconstruction.py"):
        main()
