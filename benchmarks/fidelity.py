"""How true the simulation is: touch, penetration, thin walls, energy, drives. Writes the tables of docs/fidelity.md.

    python benchmarks/fidelity.py --document docs/fidelity.md

Takes a few minutes; most of it are the 100,000 control steps at thin walls.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import mujoco
import numpy as np
import torch
import tyro
from mujoco_peer import MujocoSettings, build_model
from numpy.typing import NDArray
from penetration import pressing_audits, statistics_of
from report import machine, markdown_table, print_table, replace_section, write_json
from rollouts import HEIGHT, KINDS, TEN_OBJECTS, THIN_OBJECTS, Hands, exploring_actions
from touch_audit import audit
from tqdm import tqdm
from tunnelling import WallCounts, crossings

from tslam_bench.constants import CONTROL_STEP_SECONDS, HORIZON, NUM_JOINTS, QUICK_OBJECTS
from tslam_bench.engine.arrays import NumpyBackend
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.physics import PROTOCOL, PhysicsSettings
from tslam_bench.hand_constants import DAMPING, DELTA_STEP, JOINT_LIMITS, JOINT_NAMES, STIFFNESS, WRIST_JOINTS
from tslam_bench.objects.hand import load_hand

JOINT_GROUPS: Final = {
    "arm (m)": slice(0, 3),
    "roll (rad)": slice(3, 4),
    "wrist (rad)": slice(4, 4 + len(WRIST_JOINTS)),
    "fingers (rad)": slice(4 + len(WRIST_JOINTS), NUM_JOINTS),
}
"""Joints of one kind, as slices of ``JOINT_NAMES``."""
SPEED_MARGIN: Final = 2.0
"""999 of 1,000 speeds may be this many times what the joint's own drive makes of it: neighbours and contacts push too."""
SPEED_LIMIT: Final = np.array([5.0] * 3 + [50.0] * (NUM_JOINTS - 3))
"""(28,) no joint is ever faster (m/s or rad/s); one that explodes reaches PhysX's own limit of 100."""
HOLD_STEPS: Final = round(4.0 / CONTROL_STEP_SECONDS)
"""Control steps of four seconds: the arm crosses its range in 2.5."""


def drive_speed(control_mode: str) -> NDArray[np.float64]:
    """(28,) speed (m/s or rad/s) at which a drive's damper cancels its spring at the largest target error."""
    reach = DELTA_STEP if control_mode == "pd_joint_delta_pos" else JOINT_LIMITS[:, 1] - JOINT_LIMITS[:, 0]
    return STIFFNESS * reach / DAMPING


@dataclass(frozen=True)
class Motion:
    """Violent motion in one control mode.

    Attributes:
        speed: (steps, E, 28) absolute joint velocities.
        energy: (steps, E) kinetic energy (J).
    """

    speed: NDArray
    energy: NDArray


class KineticEnergy:
    """Kinetic energy of the hand from joint positions and velocities, by MuJoCo's mass matrix (armature included)."""

    def __init__(self) -> None:
        self._model = build_model(load_hand().urdf, MujocoSettings(), None)
        self._data = mujoco.MjData(self._model)
        self._joints = np.array([self._model.joint(name).qposadr[0] for name in JOINT_NAMES])

    def __call__(self, qpos: NDArray, qvel: NDArray) -> float:
        """Joules at (28,) positions and velocities."""
        self._data.qpos[self._joints], self._data.qvel[self._joints] = qpos, qvel
        mujoco.mj_fwdPosition(self._model, self._data)
        mujoco.mj_energyVel(self._model, self._data)
        return float(self._data.energy[1])


def violent_motion(objects: tuple[str, ...], control_mode: str, steps: int, num_envs: int = 8) -> Motion:
    """Random actions in every control step, half of them at the limits; raises FloatingPointError on NaN."""
    hands = Hands(num_envs, BatchSettings(objects=objects, control_mode=control_mode, reward_mode="none"))
    hands.reset(0)
    kinetic = KineticEnergy()
    generator = np.random.Generator(np.random.PCG64(0))
    speed, energy = [], []
    for step in range(steps):
        action = exploring_actions(generator, num_envs, step)
        extreme = generator.uniform(size=action.shape) < 0.5
        hands.step(np.where(extreme, np.sign(action), action))
        if not all(np.isfinite(hands.arrays[name]).all() for name in ("qpos", "qvel", "reward")):
            raise FloatingPointError(f"{control_mode}: not finite in step {step}")
        speed.append(np.abs(hands.arrays["qvel"]))
        energy.append([kinetic(*state) for state in zip(hands.arrays["qpos"], hands.arrays["qvel"], strict=True)])
    return Motion(np.array(speed), np.array(energy))


def rest_drift(steps: int = HORIZON - 1, num_envs: int = 8) -> tuple[float, float]:
    """Largest change of a joint's position and largest joint speed of hands that start and are told not to move."""
    hands = Hands(num_envs, BatchSettings(object="mug", reward_mode="none"))
    hands.reset(0)
    start, fastest = hands.arrays["qpos"].copy(), 0.0
    for _ in range(steps):
        hands.step(np.zeros((num_envs, NUM_JOINTS), np.float32))
        fastest = max(fastest, float(np.abs(hands.arrays["qvel"]).max()))
    return float(np.abs(hands.arrays["qpos"] - start).max()), fastest


def tracking_errors(
    targets: int, num_envs: int = 8, physics: PhysicsSettings = PROTOCOL, steps: int = HOLD_STEPS
) -> NDArray[np.float64]:
    """(n, 28) absolute distance from the target after ``steps`` in free space; random targets that the tendons allow.

    There are ``targets`` per hand. Hands that touch the object on their way to a target are left out for that target.
    """
    settings = BatchSettings(
        object="cubesmall", split="test", control_mode="pd_joint_pos", reward_mode="none", physics=physics
    )
    hands, generator = Hands(num_envs, settings), np.random.Generator(np.random.PCG64(0))
    goal = DriveTargets(settings.control_mode, NumpyBackend(), step_limit=np.full(NUM_JOINTS, np.inf))
    errors = []
    hands.reset(0)
    up = np.zeros((num_envs, NUM_JOINTS), np.float32)
    up[:, HEIGHT] = 1.0
    for _ in range(steps):
        hands.step(up)
    for _ in range(targets):
        action = generator.uniform(-1, 1, (num_envs, NUM_JOINTS)).astype(np.float32)
        action[:, HEIGHT] = generator.uniform(0.9, 1.0, num_envs)  # above the object
        wanted = goal(action, hands.arrays["qpos"])
        action = ((wanted - JOINT_LIMITS.mean(axis=1)) / (np.ptp(JOINT_LIMITS, axis=1) / 2)).astype(np.float32)
        free = np.ones(num_envs, dtype=bool)
        for _ in range(steps):
            hands.step(action)
            free &= ~hands.arrays["touch"].any(axis=1)
        errors.append(np.abs(hands.arrays["qpos"] - wanted)[free])
    return np.concatenate(errors).astype(np.float64)


@dataclass(frozen=True)
class Config:
    """Measures all of it, or some sections."""

    sections: tuple[Literal["audit", "penetration", "walls", "energy", "drives"], ...] = (
        *("audit", "penetration", "energy", "drives", "walls"),
    )
    """What to measure, in this order."""

    audit_objects: tuple[str, ...] = QUICK_OBJECTS
    """Objects on which the skin is compared with PhysX's contacts."""
    audit_episodes: int = 4
    """Episodes per object of that comparison."""
    objects: tuple[str, ...] = tuple(dict.fromkeys((*TEN_OBJECTS, *THIN_OBJECTS)))
    """Objects that are pressed on."""
    poses: int = 4
    """Pressing episodes per object, each in another pose."""
    thin_objects: tuple[str, ...] = THIN_OBJECTS
    """Objects whose walls are watched."""
    wall_steps: int = 100_000
    """Control steps of random hands at thin walls, over all of them."""
    pressing_wall_steps: int = 40_000
    """Control steps of pressing hands there."""
    violent_steps: int = 1_000
    """Control steps of violent motion, in each of 8 hands and each control mode."""
    targets: int = 25
    """Random drive targets of each of 8 hands."""
    document: Path | None = None
    """Page whose sections are replaced by what was measured."""
    output: Path | None = None
    """JSON file for the figures."""


Found = tuple[list[dict[str, Any]], str]
"""Rows for the JSON file, and a paragraph below the table."""


def audit_rows(config: Config) -> Found:
    """The skin against PhysX's own contacts."""
    rows = []
    for name in config.audit_objects:
        result = audit(name, config.audit_episodes)
        figures = {"precision": result.precision, "recall": result.recall}
        rows.append({"object": name, "link touches": result.both + result.oracle_only, **figures})
    return rows, "What PhysX says is no yardstick here: see below."


def penetration_rows(config: Config) -> Found:
    """The skin against MuJoCo's collision detection, and depth by the same ruler."""
    audits = pressing_audits(config.objects, config.poses)

    def row(name: str, both: int, skin_only: int, oracle_only: int, depths: NDArray) -> dict[str, Any]:
        depth = statistics_of(depths)
        return {
            "object": name,
            "link touches": both + oracle_only,
            "precision": both / max(1, both + skin_only),
            "recall": both / max(1, both + oracle_only),
            **{f"depth {key} (mm)": depth[key] for key in ("median", "p95", "p99", "max")},
        }

    rows = [row(name, a.both, a.probes_only, a.oracle_only, a.depths) for name, a in audits.items()]
    sums = [sum(getattr(a, key) for a in audits.values()) for key in ("both", "probes_only", "oracle_only")]
    rows.append(row("**all**", *sums, np.concatenate([a.depths for a in audits.values()])))
    return rows, "The 95th percentile over all objects has to be below 1 mm, precision and recall at least 0.8."


def wall_rows(config: Config) -> Found:
    """Fingers at thin walls."""
    rows = []
    for label in KINDS:
        steps = config.wall_steps if label.startswith("random") else config.pressing_wall_steps
        counts = {name: asdict(count) for name, count in crossings(config.thin_objects, label, steps).items()}
        counts["**all**"] = {key: sum(count[key] for count in counts.values()) for key in asdict(WallCounts())}
        for name, count in counts.items():
            rows.append(
                {
                    "actions": label,
                    "object": name,
                    "control steps": count["control_steps"],
                    "with contact": count["contact_steps"],
                    "axis inside": count["inside"],
                    "jumps": count["jumps"],
                    "incidents": count["incidents"],
                }
            )
    return rows, "Random hands may have one incident in 100,000 steps."


def energy_rows(config: Config) -> Found:
    """Speeds and energies of violent motion, and the hand at rest."""
    rows, energies = [], []
    for mode in ("pd_joint_delta_pos", "pd_joint_pos"):
        motion = violent_motion(config.thin_objects, mode, config.violent_steps)
        own = drive_speed(mode)
        for group, joints in JOINT_GROUPS.items():
            speed = motion.speed[:, :, joints]
            rows.append(
                {
                    "control mode": f"`{mode}`",
                    "joints": group,
                    "speed p99.9 (1/s)": float(np.percentile(speed, 99.9)),
                    "p99.9 / drive's own": float((np.percentile(speed, 99.9, axis=(0, 1)) / own[joints]).max()),
                    "speed max (1/s)": float(speed.max()),
                    "limit (1/s)": float(SPEED_LIMIT[joints].min()),
                }
            )
        median, high = np.median(motion.energy), motion.energy.max()
        energies.append(f"{median:.2f} J in the median and {high:.2f} J at most in `{mode}`")
    drift, fastest = rest_drift()
    text = "A drive's own speed is where its damper cancels its spring at the largest target error. "
    text += f"99.9 % of a joint's speeds have to be below {SPEED_MARGIN:.0f} times that, all below the limit. "
    text += f"Kinetic energy: {', '.join(energies)}. "
    text += f"A hand told not to move drifts by {drift:.1e} (m or rad) in 6 s, at {fastest:.1e} per second at most."
    return rows, text


def drive_rows(config: Config) -> Found:
    """Distance from random targets after four seconds in free space."""
    errors = tracking_errors(config.targets)
    rows = []
    for group, joints in JOINT_GROUPS.items():
        error = errors[:, joints]
        figures = {"median": np.median(error), "p95": np.percentile(error, 95), "max": error.max()}
        rows.append({"joints": group, **{key: f"{value:.1e}" for key, value in figures.items()}})
    return rows, ""


SECTIONS: Final[dict[str, Callable[[Config], Found]]] = {
    "audit": audit_rows,
    "penetration": penetration_rows,
    "walls": wall_rows,
    "energy": energy_rows,
    "drives": drive_rows,
}
"""Sections of the page."""


def _cell(key: str, value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3f}" if key in ("precision", "recall") else f"{value:.2f}"


def main(config: Config) -> None:
    """Prints the tables, and writes them where asked to."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {"machine": machine()}
    for name in tqdm(config.sections, desc="fidelity"):
        rows, text = SECTIONS[name](config)
        result[name] = {"rows": rows, "text": text}
        cells = [[_cell(key, value) for key, value in row.items()] for row in rows]
        print_table(list(rows[0]), cells, name)
        print(text)
        if config.document is not None:
            replace_section(config.document, name, f"{markdown_table(list(rows[0]), cells)}\n{text}")
    write_json(config.output, result)


if __name__ == "__main__":
    main(tyro.cli(Config))
