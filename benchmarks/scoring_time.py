"""What scoring costs: CPU time per object and seed, by stage, on submissions made up from the true surfaces.

Each pose touches a random twentieth of the surface voxels; the reconstructions are those of ``hull`` (a linear volume of 96^3),
``grid`` (a nearest one of 32^3), and the true solid blurred by a voxel (a linear one of 32^3, as a network's). One process; the
first object warms up and is left out.

    python benchmarks/scoring_time.py
    python benchmarks/scoring_time.py --objects hand mug teapot --seeds 3
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table
from scipy.ndimage import gaussian_filter

from tslam_bench import grids
from tslam_bench.cli.ending import one_line_errors
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.reconstruction.registry import make_reconstructor
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring import measure, metrics, prediction
from tslam_bench.scoring.info import SubmissionInfo
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, Submission, SubmissionWriter, read_submission
from tslam_bench.version import __version__

KINDS = ("hull", "grid", "blurred")
"""Reconstructors."""


@dataclass(frozen=True)
class Arguments:
    """CPU time of scoring."""

    objects: tuple[str, ...] = ("cubesmall", "mug", "stanfordbunny", "toruslarge", "wineglass", "hammer")
    """Test objects; the first only warms up."""
    seeds: int = 2
    """Repetitions in each submission."""


def write_submission(folder: Path, kind: str, items: list[PreparedObject], seeds: int) -> Path:
    """A whole submission of made-up rollouts."""
    info = SubmissionInfo(
        method=kind,
        explorer="made-up",
        reconstructor=kind,
        authors=("Nobody",),
        asset_manifest_sha256="0" * 64,
        seeds=tuple(range(seeds)),
        object_set="test",
        privileged=False,
        package_version=__version__,
    )
    with SubmissionWriter(folder / kind, info) as writer:
        for item in items:
            for seed in range(seeds):
                touched = {}
                for pose in range(8):
                    generator = np.random.default_rng([pose, seed])
                    found = item.surface & (generator.random(item.surface.shape) < 0.05)
                    world = grids.object_to_world(found, pose)
                    steps = np.where(world, generator.integers(0, 200, world.shape), -1).astype(np.int16)
                    actions = generator.uniform(-1, 1, (200, 28)).astype(np.float32)
                    joints = np.zeros((21, 28), np.float32)
                    writer.add_rollout(Rollout(item.name, pose, seed, actions, world, ~world, steps, joints))
                    touched[pose] = found
                for count, poses in RECONSTRUCTED_POSES.items():
                    merged = grids.merge(touched[pose] for pose in poses)
                    writer.add_reconstruction(item.name, count, seed, reconstruct(kind, item, merged, seed + count))
    return folder / kind


def reconstruct(kind: str, item: PreparedObject, touched: NDArray[np.bool_], seed: int) -> Volume:
    """One reconstruction; the blurred ones differ, as those of a network would."""
    if kind != "blurred":
        return make_reconstructor(kind).reconstruct(touched, ~item.solid)
    noise = np.random.default_rng(seed).normal(0, 0.05, item.solid.shape)
    return Volume(np.clip(gaussian_filter(item.solid.astype(np.float32), 1) + gaussian_filter(noise, 1), 0, 1))


class Stages:
    """CPU seconds spent in functions that are replaced by timed ones; time in an inner stage is not the outer one's."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self._inner = [0.0]

    def time(self, owner: Any, name: str, stage: str) -> None:
        """Times ``owner.name`` from now on as ``stage``."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            start = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                whole = time.process_time() - start
                self.spent[stage] = self.spent.get(stage, 0.0) + whole - self._inner.pop()
                self._inner[-1] += whole

        setattr(owner, name, timed)


def main() -> None:
    """Command line."""
    arguments = tyro.cli(Arguments, description=__doc__)
    with one_line_errors("scoring_time"):
        items = [load_object(name) for name in arguments.objects]
    print(machine())
    stages = Stages()
    stages.time(Submission, "rollout", "reading rollouts")
    stages.time(Submission, "reconstruction", "reading volumes")
    stages.time(measure, "load_truth", "ground truth, once per object")
    stages.time(Volume, "query", "probability at the points")
    stages.time(Volume, "triangles", "surface")
    stages.time(prediction, "sample_surface", "samples of the surface")
    stages.time(metrics, "match_surfaces", "nearest neighbours")
    stages.time(metrics, "calibration_error", "calibration error")
    for name in ("merge_touched_steps", "implausible_touches"):
        stages.time(measure, name, "touches")
    stages.time(metrics, "surface_iou_curve", "touches")
    stages.time(metrics.TouchCoverage, "recall_curve", "touches")
    rows: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:
            path = write_submission(Path(folder), kind, items, arguments.seeds)
            measure.load_truth.cache_clear() if hasattr(measure.load_truth, "cache_clear") else None
            submission = read_submission(path)
            measure.score_object(submission, measure.load_truth(items[0].name))
            stages.spent.clear()
            start = time.process_time()
            read_submission(path)
            stages.spent["opening: hashes, checks"] = time.process_time() - start - sum(stages.spent.values())
            for item in items[1:]:
                measure.score_object(submission, measure.load_truth(item.name))
            total = time.process_time() - start
            count = (len(items) - 1) * arguments.seeds
            figures = {**stages.spent, "rest": total - sum(stages.spent.values()), "all": total}
            for stage, seconds in figures.items():
                rows.setdefault(stage, []).append(f"{1000 * seconds / count:.0f}")
    print(markdown_table(("ms per object and seed", *KINDS), ((stage, *values) for stage, values in rows.items())))


if __name__ == "__main__":
    main()
