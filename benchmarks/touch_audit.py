"""Compares the touch definition (signed distance at skin probes) with PhysX's own contacts, on the CPU (protocol section 5).

A link touches for PhysX when one of its contacts with the object has a separation below 0.5 mm after the control step's last
substep. The rollouts press: random targets drawn for ten steps at a time, with a pull towards the object, so that there
are contacts to compare.

    python benchmarks/touch_audit.py --episodes 4
"""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

import tslam_bench  # noqa: F401  (registers the environment)
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, NUM_POSES, QUICK_OBJECTS
from tslam_bench.hand_constants import SKIN_LINKS

PHYSX_TOUCH_SEPARATION = 0.5e-3
"""A PhysX contact closer than this (m) is a touch."""


@dataclass(frozen=True)
class Config:
    """Rolls out and compares."""

    objects: tuple[str, ...] = QUICK_OBJECTS
    """Test objects."""
    episodes: int = 4
    """Episodes per object; episode k uses pose k % 8 and seed k."""


@dataclass(frozen=True)
class Audit:
    """The skin against an oracle: (link, step) pairs felt by both or by one only, and depths (m) per contact step."""

    both: int
    probes_only: int
    oracle_only: int
    depths: np.ndarray

    @property
    def precision(self) -> float:
        """Share of the probes' touches that the oracle confirms."""
        return self.both / max(1, self.both + self.probes_only)

    @property
    def recall(self) -> float:
        """Share of the oracle's touches that the probes feel."""
        return self.both / max(1, self.both + self.oracle_only)


def pressing_action(generator: np.random.Generator, held: np.ndarray, step: int, qpos: np.ndarray) -> np.ndarray:
    """(28,) action of a hand that presses on what lies at the workspace centre; ``held`` is redrawn every ten steps."""
    if step % 10 == 0:
        held[:] = generator.uniform(-1, 1, NUM_JOINTS)
        held[1] = generator.uniform(-1, 0.3)  # mostly downwards
    action = held.copy()
    action[[0, 2]] = np.clip(-10 * qpos[[0, 2]] + 0.5 * held[[0, 2]], -1, 1)
    return action.astype(np.float32)


def physx_touch(environment: gym.Env) -> np.ndarray:
    """(L,) bool, skin links that PhysX reports closer to the object than ``PHYSX_TOUCH_SEPARATION``."""
    index = {name: row for row, name in enumerate(SKIN_LINKS)}
    touch = np.zeros(len(SKIN_LINKS), dtype=bool)
    for contact in environment.unwrapped.scene.px.get_contacts():
        names = [body.entity.name for body in contact.bodies]
        for name in names:
            if name in index and min(point.separation for point in contact.points) < PHYSX_TOUCH_SEPARATION:
                touch[index[name]] = True
    return touch


def audit(name: str, episodes: int) -> Audit:
    """Rolls out ``episodes`` pressing episodes on one object."""
    environment = gym.make(ENVIRONMENT_ID, object=name)
    base = environment.unwrapped
    both = probes_only = oracle_only = 0
    depths = []
    for episode in range(episodes):
        generator = np.random.Generator(np.random.PCG64(episode))
        observation, _ = environment.reset(seed=episode, options={"pose": episode % NUM_POSES})
        held = np.zeros(NUM_JOINTS)
        for step in range(HORIZON):
            action = pressing_action(generator, held, step, observation["qpos"][0].numpy())
            observation, *_ = environment.step(action)
            felt, truth = observation["touch"][0].numpy().astype(bool), physx_touch(environment)
            both += int((felt & truth).sum())
            probes_only += int((felt & ~truth).sum())
            oracle_only += int((truth & ~felt).sum())
            separations = [point.separation for contact in base.scene.px.get_contacts() for point in contact.points]
            if separations and min(separations) < PHYSX_TOUCH_SEPARATION:
                depths.append(max(0.0, -min(separations)))
    environment.close()
    return Audit(both, probes_only, oracle_only, np.array(depths))


def main(config: Config) -> None:
    """Prints one row per object."""
    torch.set_num_threads(1)
    table = Table("object", "link touches", "precision", "recall", "depth p95 (mm)", "worst (mm)")
    for name in config.objects:
        result = audit(name, config.episodes)
        p95 = np.percentile(result.depths, 95) if len(result.depths) else 0.0
        worst = result.depths.max(initial=0.0)
        numbers = (f"{result.precision:.3f}", f"{result.recall:.3f}", f"{1e3 * p95:.2f}", f"{1e3 * worst:.2f}")
        table.add_row(name, str(result.both + result.oracle_only), *numbers)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Config))
