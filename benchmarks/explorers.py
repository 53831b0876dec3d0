"""Touched voxels and surface of explorers on val objects, as the recipe search judges them.

    python benchmarks/explorers.py heuristic tslam=runs/models/tslam --output explorers.jsonl

One line of JSON per explorer: touched voxels per pose with the standard error over objects, share of the surface after one pose
and after all. Learned explorers act twice: by samples of the policy, and by its mean. `--document` replaces the section `learned`
of a page by the table of all lines of `--output`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from recipe_search import explore, spread
from report import machine, markdown_table, replace_section

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.evaluation.policies import get_baseline, make_baseline
from tslam_bench.objects.splits import prepared_names


@dataclass(frozen=True)
class Config:
    """Touched voxels and surface of explorers on val objects."""

    explorers: tyro.conf.Positional[tuple[str, ...]] = ()
    """Ids, or ID=MODEL of a trained one."""
    output: Path | None = None
    """File that the lines are appended to."""
    objects: int = 24
    """Val objects, evenly spread over the names."""
    poses: tuple[int, ...] = (0, 2, 5, 7)
    """Poses."""
    document: Path | None = None
    """Page whose section `learned` is replaced by the table."""
    label: str | None = None
    """Name in the table, if there is one explorer."""
    mean: bool = False
    """Let learned explorers act by the mean too, in the first two poses."""


def section(lines: list[dict[str, Any]]) -> str:
    """Markdown of all lines, those that touch most first."""
    header = ("explorer", "touched voxels per pose", "by the mean action, 2 poses", "surface after 1 / 4 poses")
    rows = []
    for line in sorted(lines, key=lambda entry: -entry["sampled"]["touched"]):
        sampled, mean = line["sampled"], line.get("mean")
        acted = f"{mean['touched']:.0f} +- {mean['error']:.0f}" if mean else ""
        recall = " / ".join(f"{sampled[name]:.3f}"[1:] for name in ("recall_1", "recall_4"))
        rows.append((line["explorer"], f"{sampled['touched']:.0f} +- {sampled['error']:.0f}", acted, recall))
    return f"{machine()}; {lines[0]['objects']} val objects.\n\n" + markdown_table(header, rows)


def main(config: Config) -> None:
    """Prints and appends a line per explorer."""
    objects = spread(prepared_names("val"), config.objects)
    for text in config.explorers:
        name, _, path = text.partition("=")
        model = Path(path) if path else None
        line: dict[str, Any] = {"explorer": config.label or text, "objects": len(objects), "poses": config.poses}
        line["sampled"] = explore(make_baseline(name, model), objects, config.poses)
        if config.mean and get_baseline(name).kind == "learned":
            line["mean"] = explore(make_baseline(name, model, deterministic=True), objects, config.poses[:2])
        print(json.dumps(line), flush=True)
        if config.output is not None:
            with config.output.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
    if config.document is not None and config.output is not None:
        lines = [json.loads(text) for text in config.output.read_text(encoding="utf-8").splitlines()]
        replace_section(config.document, "learned", section(lines))


if __name__ == "__main__":
    with one_line_errors("explorers.py"):
        main(tyro.cli(Config, description=__doc__))
