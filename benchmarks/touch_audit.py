"""Compares the touch definition (signed distance at skin probes) with PhysX's own contacts, on the CPU (protocol section 5).

A link touches for PhysX when one of its contacts with the object has a separation below 0.5 mm. PhysX lists the contacts of the
poses that a physics step starts from, so the skin is asked at those poses: after the last but one substep of a control step.
The rollouts press: random targets drawn for ten steps at a time, with a pull towards the object, so that there are contacts to
compare.

    python benchmarks/touch_audit.py --episodes 4
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rollouts import Hands, PressingHands, run_episode

from tslam_bench.constants import NUM_POSES, QUICK_OBJECTS
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.skin import build_skin
from tslam_bench.hand_constants import SKIN_LINKS
from tslam_bench.objects.hand import load_hand

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


class LastSubstep:
    """Takes the place of a scene's ``step``: keeps the poses that the last substep starts from.

    Args:
        scene: a ``HandScene``.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self.links = np.zeros((1, len(SKIN_LINKS), 3, 4), dtype=np.float32)

    def __call__(self) -> None:
        """One control step."""
        for _ in range(self._scene.settings.substeps - 1):
            self._scene.substep()
        self.links[:] = self._scene.skin_matrices()
        self._scene.substep()

    def physx(self) -> tuple[NDArray[np.bool_], list[float]]:
        """(L,) skin links that PhysX saw closer to the object than ``PHYSX_TOUCH_SEPARATION``, and all separations (m)."""
        index = {name: row for row, name in enumerate(SKIN_LINKS)}
        touch, separations = np.zeros(len(SKIN_LINKS), dtype=bool), []
        for contact in self._scene.contacts():
            nearest = min(point.separation for point in contact.points)
            separations.append(nearest)
            for body in contact.bodies:
                if body.entity.name in index and nearest < PHYSX_TOUCH_SEPARATION:
                    touch[index[body.entity.name]] = True
        return touch, separations


def audit(name: str, episodes: int) -> Audit:
    """Rolls out ``episodes`` pressing episodes on one object."""
    hands = Hands(1, BatchSettings(object=name, reward_mode="none"))
    last = LastSubstep(hands.scenes[0])
    hands.scenes[0].step = last
    sensing, link_of_probe = hands.batch._sensing, build_skin(load_hand().shapes).probes.link
    counts, depths = np.zeros(3, dtype=np.int64), []

    def look(_: int) -> None:
        truth, separations = last.physx()
        felt = np.zeros(len(SKIN_LINKS), dtype=bool)
        felt[link_of_probe[sensing.touches(last.links)[0]]] = True
        counts[:] += ((felt & truth).sum(), (felt & ~truth).sum(), (truth & ~felt).sum())
        if separations and min(separations) < PHYSX_TOUCH_SEPARATION:
            depths.append(max(0.0, -min(separations)))

    for episode in range(episodes):
        run_episode(hands, episode, PressingHands(1, episode), look, poses=[episode % NUM_POSES])
    return Audit(*(int(count) for count in counts), np.array(depths))


def main(config: Config) -> None:
    """Prints one row per object."""
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
