"""What does noise alone touch? Random absolute targets around a fixed mean, on train objects, without any learning.

    python benchmarks/open_loop.py --document docs/baselines.md

Where an untrained policy should begin: its mean, its standard deviations and how long it holds an action. The hands know
nothing and see nothing. Every setting plays the same episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import tyro
from report import machine, markdown_table, print_table, replace_section
from rollouts import Hands

from tslam_bench.constants import HORIZON, NUM_JOINTS, NUM_POSES
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.objects.store import prepared_names

HEIGHT: Final = 1
ARM: Final = slice(0, 3)
TURNS: Final = slice(3, 6)
"""Roll and wrist."""
FINGERS: Final = slice(6, NUM_JOINTS)


@dataclass(frozen=True)
class Noise:
    """Normal targets; an action of 1 is a joint's limit.

    Attributes:
        aim: means of the arm's translations (sideways, up, forward); the other joints' are 0, the middle of their ranges.
        arm: standard deviation of the arm's translations.
        height: that of ARTy; None means ``arm``.
        turns: that of roll and wrist.
        fingers: that of the fingers.
        hold: control steps that a target is held for.
        correlation: of the arm's noise with that of the target before.
        swing: amplitude of a slow swing of the arm, sideways in 60 steps and forwards in 90.
    """

    aim: tuple[float, float, float] = (0.0, 0.0, 0.0)
    arm: float = 0.6
    height: float | None = None
    turns: float = 0.6
    fingers: float = 0.6
    hold: int = 4
    correlation: float = 0.0
    swing: float = 0.0


DOWN: Final = (0.0, -0.4, 0.2)
SETTINGS: Final = (
    Noise(),
    Noise(DOWN),
    Noise((0.0, -0.4, 0.0)),
    Noise((0.0, -0.4, 0.4)),
    Noise(DOWN, hold=2),
    Noise(DOWN, hold=8),
    Noise(DOWN, correlation=0.7),
    Noise(DOWN, arm=0.3),
    Noise(DOWN, arm=1.0),
    Noise(DOWN, fingers=0.3),
    Noise(DOWN, fingers=1.0),
    Noise(DOWN, turns=0.2),
    Noise(DOWN, arm=0.3, fingers=1.0),
    Noise(DOWN, arm=0.3, turns=1.0, fingers=1.0),
    Noise(DOWN, arm=0.15, fingers=1.0),
    Noise(DOWN, arm=0.3, fingers=1.5),
    Noise(DOWN, arm=0.1, height=0.3, fingers=1.0, swing=0.3),
    Noise(arm=0.3, fingers=1.0),
)


@dataclass(frozen=True)
class Config:
    """Plays noise."""

    objects: int = 32
    """Train objects, spread evenly over the names of those that are prepared."""
    episodes: int = 2
    """Episodes per object."""
    document: Path | None = None
    """Page whose section ``open loop`` is replaced by the table."""


def touched(noise: Noise, hands: Hands, objects: Sequence[str], episodes: int) -> np.ndarray:
    """(episodes * objects,) touched voxels."""
    mean, std = np.zeros(NUM_JOINTS), np.full(NUM_JOINTS, noise.fingers)
    mean[ARM], std[ARM], std[TURNS] = noise.aim, noise.arm, noise.turns
    std[HEIGHT] = noise.arm if noise.height is None else noise.height
    correlation = np.zeros(NUM_JOINTS)
    correlation[ARM] = noise.correlation
    counts = []
    for episode in range(episodes):
        generator = np.random.default_rng(episode)
        hands.reset(1000 * episode, objects, generator.integers(0, NUM_POSES, len(objects)).tolist())
        phases = generator.uniform(0, 2 * np.pi, (2, len(objects)))
        drawn = generator.standard_normal((len(objects), NUM_JOINTS))
        for step in range(HORIZON):
            if step % noise.hold == 0:
                if step:
                    fresh = generator.standard_normal(drawn.shape)
                    drawn = correlation * drawn + np.sqrt(1 - correlation**2) * fresh
                target = mean + std * drawn
                target[:, 0] += noise.swing * np.sin(2 * np.pi * step / 60 + phases[0])
                target[:, 2] += noise.swing * np.sin(2 * np.pi * step / 90 + phases[1])
            hands.step(target.astype(np.float32))
        counts.append(hands.arrays["final_occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64))
    return np.concatenate(counts)


def main(config: Config) -> None:
    """Prints one row per setting."""
    names = prepared_names("train")
    objects = [names[index] for index in np.linspace(0, len(names) - 1, config.objects).round().astype(int)]
    settings = BatchSettings(objects=tuple(objects), split="train", control_mode="pd_joint_pos", reward_mode="none")
    hands = Hands(len(objects), settings)
    header = ("aim", "arm", "roll, wrist", "fingers", "held", "correlation", "swing", "touched voxels")
    rows = []
    for noise in SETTINGS:
        counts = touched(noise, hands, objects, config.episodes)
        error = counts.std(ddof=1) / np.sqrt(len(counts))
        arm = f"{noise.arm}" + (f", height {noise.height}" if noise.height is not None else "")
        aim = ", ".join(f"{value:g}" for value in noise.aim)
        row = (aim, arm, noise.turns, noise.fingers, noise.hold, noise.correlation, noise.swing)
        rows.append((*row, f"{counts.mean():.0f} +- {error:.0f}"))
        print(*rows[-1], sep=" | ", flush=True)
    print_table(header, rows)
    if config.document is not None:
        text = f"{machine()}; {len(objects)} train objects, {config.episodes} episodes each.\n\n"
        replace_section(config.document, "open loop", text + markdown_table(header, rows))


if __name__ == "__main__":
    main(tyro.cli(Config))
