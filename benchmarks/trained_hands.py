"""How deep do trained hands press? Learning finds whatever the physics lets through.

    python benchmarks/trained_hands.py --models runs/a runs/b --document docs/fidelity.md

Each model (a folder that ``tslam-bench baselines train`` wrote) explores *train* objects, sampled, in its own control mode;
the ruler is the second engine (``separation.py``). Hands without training stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from penetration import CONTACT_SEPARATION, statistics_of
from report import machine, markdown_table, print_table, replace_section
from rollouts import Hands, run_episode
from separation import SeparationRuler

from tslam_bench.constants import NUM_POSES
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.policy import Policy

TWELVE_OBJECTS = (
    *("mug-000", "bowl-000", "goblet-000", "frying-pan-000", "mallet-000", "teapot-000", "plate-000", "spoon-000"),
    *("spectacles-000", "toaster-000", "bangle-000", "candlestick-000"),
)
"""Train objects, half of them with thin walls."""


@dataclass(frozen=True)
class Config:
    """Measures the penetration of trained hands."""

    models: tuple[Path, ...] = ()
    """Folders of trained models."""
    objects: tuple[str, ...] = TWELVE_OBJECTS
    """Train objects."""
    poses: int = 2
    """Episodes per object, each in another pose."""
    document: Path | None = None
    """Page whose section ``trained`` is replaced by the table."""


def depths_of(explorer: Policy, objects: Sequence[str], poses: int) -> tuple[NDArray[np.float64], float]:
    """Depth (m) of every contact step, and touched voxels per episode."""
    names = list(objects)
    settings = BatchSettings(
        objects=tuple(names), split="train", control_mode=explorer.control_mode, reward_mode="none"
    )
    hands = Hands(len(names), settings)
    depths: list[float] = []
    touched: list[float] = []
    for episode in range(poses):
        turned = [(3 * episode + env) % NUM_POSES for env in range(len(names))]
        rulers = [SeparationRuler(name, pose, "train") for name, pose in zip(names, turned, strict=True)]
        explorer.reset(len(names), list(range(1000 * episode, 1000 * episode + len(names))))

        def act(_: int, qpos: NDArray) -> NDArray:
            return explorer.act({name: hands.arrays[name] for name in OBSERVATION_ARRAYS})

        def look(_: int, rulers: list[SeparationRuler] = rulers) -> None:
            for env, ruler in enumerate(rulers):
                nearest = ruler.measure(hands.arrays["qpos"][env])[1]
                if nearest < CONTACT_SEPARATION:
                    depths.append(max(0.0, -nearest))

        run_episode(hands, 1000 * episode, act, look, names, turned)
        touched.append(float(hands.arrays["occupancy"][:, 0].sum(axis=(1, 2, 3)).mean()))
    return np.array(depths), float(np.mean(touched))


def main(config: Config) -> None:
    """Prints one row per explorer."""
    tried: list[tuple[str, Callable[[], Policy]]] = [
        (f"`{name}`", lambda name=name: make_baseline(name)) for name in ("random_targets", "heuristic")
    ]
    tried += [(f"trained, {path.name}", lambda path=path: make_baseline("tslam", path)) for path in config.models]
    header = (
        "explorer",
        "control mode",
        "touched voxels",
        "contact steps",
        "median (mm)",
        "p95 (mm)",
        "p99 (mm)",
        "max (mm)",
    )
    rows: list[tuple[Any, ...]] = []
    for label, make in tried:
        explorer = make()
        depths, touched = depths_of(explorer, config.objects, config.poses)
        found = statistics_of(depths)
        numbers = (f"{found[key]:.2f}" for key in ("median", "p95", "p99", "max"))
        rows.append((label, f"`{explorer.control_mode}`", f"{touched:.0f}", f"{found['contact_steps']:.0f}", *numbers))
    print_table(header, rows)
    if config.document is not None:
        text = f"{machine()}; {len(config.objects)} train objects, {config.poses} episodes each.\n\n"
        replace_section(config.document, "trained", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
