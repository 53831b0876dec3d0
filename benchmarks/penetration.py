"""How deep a pressing hand sinks into the object, in the engine and in its MuJoCo peer, by one ruler.

    python benchmarks/penetration.py

The ruler is MuJoCo's collision detection on the hand's joint positions at the end of each control step (``separation.py``),
for PhysX's own contact list misses part of the depth: its manifolds are kept while the shapes move a little. The
peer is tried with ever more substeps until its depth is no greater than the engine's at the 95th and 99th percentiles:
``mujoco_peer.EQUAL_PENETRATION`` is what this finds. Prints one table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from mujoco_peer import STIFF, MujocoSettings, with_mujoco
from numpy.typing import NDArray
from report import machine, markdown_table, print_table, replace_section, write_json
from rollouts import KINDS, TEN_OBJECTS, Hands, make_actor, run_episode
from separation import SeparationRuler
from touch_audit import Audit

from tslam_bench.constants import NUM_POSES, SUBSTEPS
from tslam_bench.engine.hand_batch import BatchSettings

CONTACT_SEPARATION = 0.5e-3
"""A hand closer to the object than this (m) is in contact."""


@dataclass(frozen=True)
class Config:
    """Measures penetration."""

    objects: tuple[str, ...] = TEN_OBJECTS
    """Test objects."""
    poses: int = 4
    """Episodes per object, each in another pose."""
    substeps: tuple[int, ...] = (4, 5, 6, 8, 10)
    """Physics steps per control step that the stiff peer is tried with."""
    output: Path | None = None
    """JSON file for the figures."""
    document: Path | None = None
    """Page whose section ``penetration`` is replaced by the table."""


def pressing_audits(
    objects: Sequence[str], poses: int, settings: BatchSettings | None = None, kind: str = "pressing"
) -> dict[str, Audit]:
    """The skin against the ruler's contacts, and the depth of every contact step, of hands that press on each object.

    Args:
        objects: names.
        poses: episodes per object, each in another pose.
        settings: split and physics; None means the test split and the protocol's.
        kind: how the hands act, one of ``rollouts.KINDS``; it decides the control mode.
    """
    names = list(objects)
    settings = replace(settings or BatchSettings(split="test"), objects=tuple(names), control_mode=KINDS[kind])
    hands = Hands(len(names), settings)
    counts = {name: np.zeros(3, dtype=np.int64) for name in names}  # both, skin only, ruler only
    depths: dict[str, list[float]] = {name: [] for name in names}
    for episode in range(poses):
        turned = [(episode + env) % NUM_POSES for env in range(len(names))]
        rulers = [SeparationRuler(name, pose, settings.split) for name, pose in zip(names, turned, strict=True)]

        def look(_: int, rulers: list[SeparationRuler] = rulers) -> None:
            for env, (name, ruler) in enumerate(zip(names, rulers, strict=True)):
                links, nearest = ruler.measure(hands.arrays["qpos"][env])
                felt, truth = hands.arrays["touch"][env].astype(bool), links < CONTACT_SEPARATION
                counts[name] += ((felt & truth).sum(), (felt & ~truth).sum(), (truth & ~felt).sum())
                if nearest < CONTACT_SEPARATION:
                    depths[name].append(max(0.0, -nearest))

        run_episode(hands, 1000 * episode, make_actor(kind, len(names), episode), look, names, turned)
    return {name: Audit(*(int(count) for count in counts[name]), np.array(depths[name])) for name in names}


def statistics_of(depths: NDArray[np.float64]) -> dict[str, float]:
    """Number of contact steps, and median, percentiles and maximum of their depth in millimetres."""
    if len(depths) == 0:
        return {"contact_steps": 0, "median": 0.0, "p95": 0.0, "p99": 0.0, "max": 0.0}
    values = 1e3 * depths
    median, p95, p99 = (float(value) for value in np.percentile(values, [50, 95, 99]))
    return {"contact_steps": len(values), "median": median, "p95": p95, "p99": p99, "max": float(values.max())}


def measure(config: Config, settings: MujocoSettings | None) -> dict[str, float]:
    """Statistics of the engine (None) or of a peer, all objects together."""
    engine = BatchSettings(split="test")
    audits = pressing_audits(
        config.objects, config.poses, engine if settings is None else with_mujoco(engine, settings)
    )
    return statistics_of(np.concatenate([audit.depths for audit in audits.values()]))


def main(config: Config) -> None:
    """Prints one row per engine and setting."""
    tried: list[tuple[str, MujocoSettings | None]] = [(f"engine (PhysX, {SUBSTEPS} substeps)", None)]
    tried.append((f"MuJoCo, its own softness, {SUBSTEPS} substeps", MujocoSettings()))
    tried.append(("MuJoCo, its own softness, 15 substeps", MujocoSettings(substeps=15)))
    for substeps in config.substeps:
        tried.append((f"MuJoCo, stiff, {substeps} substeps", replace(STIFF, substeps=substeps)))
    tried.append((f"MuJoCo, stiff and speculative, {SUBSTEPS} substeps", replace(STIFF, speculative=True)))
    header = ("engine", "contact steps", "median (mm)", "p95 (mm)", "p99 (mm)", "max (mm)")
    rows: list[tuple[str, ...]] = []
    result: list[dict[str, Any]] = []
    for label, settings in tried:
        figures = measure(config, settings)
        result.append({"engine": label, "settings": None if settings is None else asdict(settings), **figures})
        numbers = (f"{figures[key]:.2f}" for key in ("median", "p95", "p99", "max"))
        rows.append((label, f"{figures['contact_steps']:.0f}", *numbers))
    print_table(header, rows)
    if config.document is not None:
        text = f"{machine()}; {config.poses} episodes on each of {len(config.objects)} objects.\n\n"
        replace_section(config.document, "penetration", text + markdown_table(header, rows))
    write_json(config.output, result)


if __name__ == "__main__":
    main(tyro.cli(Config))
