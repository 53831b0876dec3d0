"""Touched voxels and surface of explorers on val objects, as the recipe search judges them.

    python benchmarks/explorers.py heuristic tslam=runs/models/tslam --output explorers.jsonl

One line of JSON per explorer: touched voxels per pose with the standard error over objects, share of the surface after one pose
and after all. Learned explorers act twice: by samples of the policy, and by its mean.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from recipe_search import explore, spread

from tslam_bench.cli.ending import one_line_errors
from tslam_bench.evaluation.policies import get_baseline, make_baseline
from tslam_bench.objects.splits import prepared_names


@dataclass(frozen=True)
class Config:
    """Touched voxels and surface of explorers on val objects."""

    explorers: tyro.conf.Positional[tuple[str, ...]]
    """Ids, or ID=MODEL of a trained one."""
    output: Path | None = None
    """File that the lines are appended to."""
    objects: int = 24
    """Val objects, evenly spread over the names."""
    poses: tuple[int, ...] = (0, 2, 5, 7)
    """Poses."""
    mean: bool = False
    """Let learned explorers act by the mean too, in the first two poses."""


def main(config: Config) -> None:
    """Prints and appends a line per explorer."""
    objects = spread(prepared_names("val"), config.objects)
    for text in config.explorers:
        name, _, path = text.partition("=")
        model = Path(path) if path else None
        line: dict[str, object] = {"explorer": text, "objects": len(objects), "poses": config.poses}
        line["sampled"] = explore(make_baseline(name, model), objects, config.poses)
        if config.mean and get_baseline(name).kind == "learned":
            line["mean"] = explore(make_baseline(name, model, deterministic=True), objects, config.poses[:2])
        print(json.dumps(line), flush=True)
        if config.output is not None:
            with config.output.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    with one_line_errors("explorers.py"):
        main(tyro.cli(Config, description=__doc__))
