"""What honest methods give the flags to look at: figures of docs/verification.md, on val objects.

python benchmarks/flags.py --objects 12 --reconstructors hull carve mean_shape retrieval
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import tyro

from tslam_bench import make_vec
from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.evaluation.evaluate import make_reconstructors, merged_grids
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.objects.splits import prepared_names
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.flags import grid_ceiling, outline, right_where_unfelt, unfelt_surface
from tslam_bench.scoring.measure import Truth, _compare
from tslam_bench.scoring.rollout import Rollout


@dataclass(frozen=True)
class Settings:
    """What is measured."""

    objects: int = 12
    """Val objects, spread over what is prepared."""
    explorers: tuple[str, ...] = ("heuristic", "random_targets")
    reconstructors: tuple[str, ...] = ("hull", "carve", "mean_shape", "retrieval")
    """ID or ID=MODEL."""
    learning_spacing: int = 1
    """Every how many train objects mean_shape and retrieval are built from."""
    seeds: tuple[int, ...] = (0, 1)
    """Repetitions of pose 0."""


def main(settings: Settings) -> None:
    """Prints a line per reconstructor, the ceilings, and how far actions are apart."""
    names = prepared_names("val")
    names = [names[index] for index in np.linspace(0, len(names) - 1, settings.objects).astype(int)]
    rollouts: list[tuple[str, Rollout]] = []
    for explorer in settings.explorers:
        policy = make_baseline(explorer)
        envs = make_vec(
            ENVIRONMENT_ID, 8, "cpu", objects=names, split="val", control_mode=policy.control_mode, processes=1
        )
        episodes = [(name, 0, seed) for name in names for seed in settings.seeds]
        for first in range(0, len(episodes), 8):
            rollouts += [(explorer, r) for r in roll_out_batch(envs, policy, episodes[first : first + 8], "ab")]
        envs.close()
        own = [outline(r.actions) for e, r in rollouts if e == explorer]
        apart = [float(np.abs(a - b).mean()) for a, b in combinations(own, 2)]
        print(f"{explorer}: actions of {len(own)} episodes are at least {min(apart):.4f} apart")
    from tslam_bench.objects.store import load_object

    truths = {name: Truth.of(load_object(name, "val")) for name in names}
    for name, truth in truths.items():
        solid = Volume(truth.prepared.solid.astype(np.float32))
        reached = _compare(solid, truth)[0]["iou"]
        print(
            f"{name}: a grid holds {truth.ceiling:.3f}, at 16^3 {ceiling(truth, 16):.3f}, the solid cells alone {reached:.3f}"
        )
    learning = prepared_names("train")[:: settings.learning_spacing]
    print(f"mean_shape and retrieval: of {len(learning)} train objects")
    for label, chosen in make_reconstructors(settings.reconstructors, learning).items():
        right, excess = [], []
        for _, rollout in rollouts:
            if rollout.seed != settings.seeds[0]:
                continue
            truth = truths[rollout.object]
            touched, visited = merged_grids([rollout])
            values, _, completeness = _compare(chosen.made.reconstruct(touched, visited), truth)
            if completeness is not None:
                right.append(right_where_unfelt(unfelt_surface(touched, truth.prepared.surface_points), completeness))
            excess.append((values["iou"] or 0.0) - truth.ceiling)
        known = [share for share in right if share is not None]
        print(
            f"{label}: right where unfelt {np.mean(known):.3f} (most {max(known):.2f}, {len(known)} shapes); "
            f"IoU less ceiling {np.mean(excess):.3f} (most {max(excess):.3f})"
        )


def ceiling(truth: Truth, cells: int) -> float:
    """What a grid of ``cells``^3 holds."""
    return grid_ceiling(truth.prepared.solid_at_iou_points, truth.iou_points, cells)


if __name__ == "__main__":
    main(tyro.cli(Settings))
