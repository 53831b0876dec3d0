"""Does a trained policy explore by its mean or by its noise? Val objects, with the noise scaled down step by step.

    python benchmarks/noise_scale.py --models runs/recipe_search/start-256000-0 --document docs/baselines.md

Beside the touched voxels stands how far the policy's mean moves from one decision to the next, in units of its noise: a mean
that stands still explores nothing by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from report import machine, markdown_table, print_table, replace_section
from rollouts import Hands

from tslam_bench.baselines.learned_policy import LearnedBaseline
from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.objects.store import prepared_names


@dataclass(frozen=True)
class Config:
    """Scales the noise of trained policies."""

    models: tuple[Path, ...]
    """Folders that ``tslam-bench baselines train`` wrote."""
    scales: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0)
    """Factors on the policy's standard deviations."""
    objects: int = 24
    """Val objects, spread evenly over the names of those that are prepared."""
    poses: tuple[int, ...] = (0, 5)
    """Poses in which each is explored."""
    document: Path | None = None
    """Page whose section ``noise`` is replaced by the table."""


class Scaled(LearnedBaseline):
    """A learned explorer whose noise is scaled, and which keeps its means.

    Attributes:
        scale: factor on the standard deviations.
        means: (n, 28) of each decision.
    """

    scale = 1.0

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """Begins an episode."""
        super().reset(num_envs, seed)
        self.means: list[NDArray[np.float32]] = []

    def distribution(self, observation: dict[str, torch.Tensor]) -> tuple[NDArray, NDArray]:
        """Means and scaled standard deviations."""
        mean, std = super().distribution(observation)
        self.means.append(mean)
        return mean, self.scale * std


def measure(model: Path, config: Config, objects: Sequence[str]) -> list[tuple[str, ...]]:
    """One row per scale."""
    explorer = Scaled.load("tslam", model)
    settings = BatchSettings(
        objects=tuple(objects), split="val", control_mode=explorer.control_mode, reward_mode="none"
    )
    hands = Hands(len(objects), settings)
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    rows = []
    for scale in config.scales:
        explorer.scale = scale
        halves, ends, moves = [], [], []
        for pose in config.poses:
            explorer.reset(len(objects), list(range(len(objects))))
            hands.reset(1000 * pose, objects, [pose] * len(objects))
            for step in range(HORIZON):
                hands.step(explorer.act(seen))
                if step == HORIZON // 2 - 1:
                    halves.append(hands.arrays["occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64))
            ends.append(hands.arrays["final_occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64))
            moves.append(np.abs(np.diff(np.stack(explorer.means), axis=0)))
        moved = np.stack(moves)
        rows.append(
            (
                model.name,
                f"{scale:g}",
                f"{np.mean(halves):.0f}",
                f"{np.mean(ends):.0f}",
                f"{moved[..., :3].mean():.3f}",
                f"{moved[..., 6:].mean():.3f}",
            )
        )
        print(*rows[-1], sep=" | ", flush=True)
    return rows


def main(config: Config) -> None:
    """Prints one row per model and scale."""
    torch.set_num_threads(1)
    names = prepared_names("val")
    objects = [names[index] for index in np.linspace(0, len(names) - 1, config.objects).round().astype(int)]
    header = (
        *("policy", "noise times", "touched voxels after 100 steps", "after 200"),
        *("the mean's move per decision, arm", "fingers"),
    )
    rows = [row for model in config.models for row in measure(model, config, objects)]
    print_table(header, rows)
    if config.document is not None:
        text = f"{machine()}; {len(objects)} val objects in poses {', '.join(map(str, config.poses))}.\n\n"
        replace_section(config.document, "noise", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
