"""Which physics? Tries settings and says of each what it costs, how deep hands sink in, and what they get through.

    python benchmarks/physics_settings.py --document docs/fidelity.md

Every measurement is a line of the journal: a run that was stopped goes on where it stopped, and further settings add to what is
there. A setting that sinks in too deep or lets too many hands through is given up after ``screen_steps``. Speeds are
compared last, all settings in turn, so that whatever else the machine does hits all of them: measure them on a quiet one.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import tyro
from fidelity import JOINT_GROUPS, tracking_errors
from numpy.typing import NDArray
from penetration import pressing_audits, statistics_of
from report import machine, markdown_table, print_table, replace_section
from rollouts import KINDS, THIN_OBJECTS, Hands, TargetHands
from stages import stage_costs
from tqdm import tqdm
from tunnelling import WallCounts, crossings

from tslam_bench.baselines.heuristic import GraspConfig, HeuristicBaseline
from tslam_bench.constants import HORIZON, NUM_POSES
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.physics import PhysicsSettings
from tslam_bench.grids import merge, world_to_object
from tslam_bench.hand_constants import DELTA_STEP
from tslam_bench.objects.store import load_object
from tslam_bench.scoring.metrics import TouchCoverage

TRAIN_OBJECTS: Final = (
    *("mug-000", "bowl-000", "goblet-000", "frying-pan-000", "mallet-000", "teapot-000", "plate-000"),
    *("scissors-blendswap-cc-0-011", "deer-blendswap-cc-0-014", "coffee-cup-blendswap-cc-0-009"),
    *("headphones-blendswap-cc-0-069", "desk-lamp-blendswap-cc-0-015"),
)
"""Train objects: thin walls, thin rods, solids, legs and ears."""
DEPTH_LIMIT: Final = 1.0
"""95th percentile of penetration of pressing hands (mm) that a setting has to stay below."""
GIVE_UP: Final = 3
"""Incidents of random hands within the screen after which a setting is given up."""
TODAY: Final = PhysicsSettings(4, 4, 0.04, 60.0, 2e-3, persistent_contacts=True)
"""What the settings are compared with: the first version of the benchmark."""


def _grid() -> tuple[PhysicsSettings, ...]:
    solvers, steps = ((4, 4), (3, 5), (2, 8), (2, 6)), (0.04, 0.02, 0.013)
    grid = (PhysicsSettings(s, i, step, 60.0, 2e-3) for s, i in solvers for step in steps)
    return TODAY, *grid


@dataclass(frozen=True)
class Config:
    """Measures settings of the physics."""

    settings: tuple[str, ...] = ()
    """Settings as substeps x iterations x arm step (mm) x arm force (N) [x contact offset (mm)], such as ``2x8x20x60``, and
    ``+`` behind it for persistent contact manifolds; none: the grid of 4x4, 3x5, 2x8, 2x6 with 40, 20 and 13 mm."""
    journal: Path = Path("physics_settings.jsonl")
    """File with a line per measurement; what is there is not measured again."""
    objects: tuple[str, ...] = TRAIN_OBJECTS
    """Train objects that are pressed on and explored."""
    poses: int = 8
    """Pressing episodes per object and control mode."""
    thin_objects: tuple[str, ...] = THIN_OBJECTS
    """Test objects whose walls are watched."""
    screen_steps: int = 25_000
    """Control steps at thin walls, per kind of hands, that every setting gets."""
    wall_steps: int = 100_000
    """Control steps at thin walls, per kind of hands, of settings that are not given up."""
    rounds: int = 3
    """Rounds of the speed comparison; 0 leaves it out."""
    document: Path | None = None
    """Page whose section ``settings`` is replaced by the tables."""


def parse_setting(text: str) -> PhysicsSettings:
    """A setting as on the command line. Raises ValueError."""
    substeps, iterations, step, force, *more = text.rstrip("+").split("x")
    offset = 1e-3 * float(more[0]) if more else TODAY.contact_offset
    return PhysicsSettings(int(substeps), int(iterations), 1e-3 * float(step), float(force), offset, text.endswith("+"))


def label(setting: PhysicsSettings) -> tuple[str, ...]:
    """First cells of a setting's row."""
    solver = f"{setting.substeps} x {setting.position_iterations}"
    if setting.contact_offset != TODAY.contact_offset:
        solver += f", offset {1e3 * setting.contact_offset:g} mm"
    if setting.persistent_contacts:
        solver += ", persistent"
    return solver, f"{1e3 * setting.arm_step:g}", f"{setting.arm_force:g}"


@dataclass
class Journal:
    """Measurements that are done, one JSON line each."""

    path: Path
    _done: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path.exists():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                entry = json.loads(line)
                self._done[self._key(entry["of"])] = entry["found"]

    @staticmethod
    def _key(of: dict[str, Any]) -> str:
        return json.dumps(of, sort_keys=True)

    def get(self, of: dict[str, Any], measure: Callable[[], Any]) -> Any:
        """What was found before, or what ``measure`` finds now."""
        key = self._key(of)
        if key not in self._done:
            found = json.loads(json.dumps(measure()))
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"of": of, "found": found}) + "\n")
            self._done[key] = found
        return self._done[key]


def depths(physics: PhysicsSettings, kind: str, objects: Sequence[str], poses: int) -> dict[str, float]:
    """Penetration (mm) of pressing hands, and their touch against the ruler's."""
    settings = BatchSettings(split="train", reward_mode="none", physics=physics)
    audits = pressing_audits(objects, poses, settings, kind).values()
    both, skin_only, ruler_only = (sum(getattr(a, n) for a in audits) for n in ("both", "probes_only", "oracle_only"))
    return {
        **statistics_of(np.concatenate([audit.depths for audit in audits])),
        "precision": both / max(1, both + skin_only),
        "recall": both / max(1, both + ruler_only),
    }


def walls(physics: PhysicsSettings, kind: str, objects: Sequence[str], steps: int, seed: int) -> dict[str, int]:
    """Incidents at thin walls, all objects together."""
    settings = BatchSettings(split="test", physics=physics)
    return asdict(sum(crossings(objects, kind, steps, settings, seed).values(), WallCounts()))


def arrival(physics: PhysicsSettings) -> dict[str, float]:
    """95th percentile of the distance from a target after 4 s, per group of joints (m or rad)."""
    errors = tracking_errors(5, 8, physics)
    return {group: float(np.percentile(errors[:, joints], 95)) for group, joints in JOINT_GROUPS.items()}


def explored(physics: PhysicsSettings, who: str, objects: Sequence[str]) -> dict[str, float]:
    """Touched voxels per pose, and surface touched after 1 and 8 poses, of a scripted explorer; one episode per pose."""
    voxels, one, eight = [], [], []
    absolute = who == "random targets"
    mode = "pd_joint_pos" if absolute else "pd_joint_delta_pos"
    for index, name in enumerate(objects):
        hands = Hands(
            NUM_POSES, BatchSettings(name, split="train", reward_mode="none", control_mode=mode, physics=physics)
        )
        hands.reset(1000 * index, poses=range(NUM_POSES))
        act = _random_targets(index) if absolute else _heuristic(physics, index)
        for step in range(HORIZON - 1):  # the last step would start the next episode
            hands.step(act(step, hands.arrays))
        coverage = TouchCoverage(load_object(name, "train").surface_points)
        touched = hands.batch.state()["touched_step"] >= 0
        grids = [world_to_object(grid, pose) for pose, grid in enumerate(touched)]
        voxels += [int(grid.sum()) for grid in grids]
        one += [coverage.recall(grid) for grid in grids]
        eight.append(coverage.recall(merge(grids)))
    return {"voxels": float(np.mean(voxels)), "one pose": float(np.mean(one)), "eight poses": float(np.mean(eight))}


def _random_targets(seed: int) -> Callable[[int, dict[str, NDArray]], NDArray]:
    actor = TargetHands(NUM_POSES, seed)
    return lambda step, arrays: actor(step, arrays["qpos"])


def _heuristic(physics: PhysicsSettings, seed: int) -> Callable[[int, dict[str, NDArray]], NDArray]:
    slower = float(DELTA_STEP[0]) / physics.arm_step
    grasp = GraspConfig()
    grasp = replace(
        grasp,
        stall=grasp.stall / slower,
        travel_steps=round(grasp.travel_steps * slower),
        sink_steps=round(grasp.sink_steps * slower),
    )
    explorer = HeuristicBaseline(grasp, physics.step_limit)
    explorer.reset(NUM_POSES, seed)
    return lambda _, arrays: explorer.act(arrays)


@dataclass
class Row:
    """What was found of a setting."""

    setting: PhysicsSettings
    depth: dict[str, dict[str, float]]
    wall: dict[str, WallCounts]
    arrival: dict[str, float]
    heuristic: dict[str, float]
    targets: dict[str, float]
    cost: dict[str, float] = field(default_factory=dict)

    @property
    def shallow(self) -> bool:
        """Whether pressing hands stay out, in both control modes."""
        return all(found["p95"] < DEPTH_LIMIT for found in self.depth.values())


def measure(setting: PhysicsSettings, config: Config, journal: Journal) -> Row:
    """All but the speed."""

    def of(what: str, **scope: Any) -> dict[str, Any]:
        return {"setting": asdict(setting), "what": what, **scope}

    scope = {"objects": list(config.objects)}
    depth = {
        kind: journal.get(
            of("depth", kind=kind, poses=config.poses, **scope),
            lambda kind=kind: depths(setting, kind, config.objects, config.poses),
        )
        for kind in ("pressing", "pressing targets")
    }
    found = {
        "arrival": journal.get(of("arrival"), lambda: arrival(setting)),
        "heuristic": journal.get(of("heuristic", **scope), lambda: explored(setting, "heuristic", config.objects)),
        "targets": journal.get(of("targets", **scope), lambda: explored(setting, "random targets", config.objects)),
    }
    row = Row(setting, depth, {kind: WallCounts() for kind in KINDS}, **found)
    for chunk in range(-(-config.wall_steps // config.screen_steps)):
        if chunk and (not row.shallow or max(row.wall[k].incidents for k in ("random", "random targets")) > GIVE_UP):
            break
        for kind in KINDS:
            counts = journal.get(
                of("walls", kind=kind, objects=list(config.thin_objects), steps=config.screen_steps, chunk=chunk),
                lambda kind=kind, chunk=chunk: walls(
                    setting, kind, config.thin_objects, config.screen_steps, seed=1000 * chunk
                ),
            )
            row.wall[kind] += WallCounts(**counts)
    return row


def compare_speeds(rows: Sequence[Row], config: Config) -> None:
    """CPU time per hand and control step (us), 16 hands in this process, medians of rounds in which all take turns."""
    costs: list[list[dict[str, float]]] = [[] for _ in rows]
    for _ in tqdm(range(config.rounds), desc="speed"):
        for row, cost in zip(rows, costs, strict=True):
            cost.append(stage_costs(16, BatchSettings(objects=config.objects, split="train", physics=row.setting)))
    for row, cost in zip(rows, costs, strict=True):
        row.cost = {stage: statistics.median(found[stage] for found in cost) for stage in ("physics", "all")}


def tables(rows: Sequence[Row]) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
    """Two tables: depth and walls; speed, touch, drives and reach."""
    first = ("substeps x iterations", "arm step (mm)", "arm force (N)")
    today = next((row.cost.get("all") for row in rows if row.setting == TODAY), None)

    def depth(found: dict[str, float]) -> str:
        return " / ".join(f"{found[key]:.2f}" for key in ("median", "p95", "p99", "max"))

    def incidents(found: WallCounts) -> str:
        return f"{found.incidents} in {found.control_steps / 1000:.0f}k"

    safe = [(*label(r.setting), *map(depth, r.depth.values()), *map(incidents, r.wall.values())) for r in rows]
    rest = []
    for row in rows:
        cost = ("", "", "")
        if row.cost:
            faster = "" if today is None else f"{today / row.cost['all']:.2f}"
            cost = (f"{row.cost['all']:.0f}", f"{row.cost['physics']:.0f}", faster)
        touch = row.depth["pressing"]
        drives = " / ".join(f"{value:.0e}" for value in row.arrival.values())
        reach = f"{row.heuristic['one pose']:.2f} / {row.heuristic['eight poses']:.2f}"
        voxels = f"{row.heuristic['voxels']:.0f} / {row.targets['voxels']:.0f}"
        ratios = f"{touch['precision']:.3f} / {touch['recall']:.3f}"
        rest.append((*label(row.setting), *cost, ratios, drives, reach, voxels))
    return [
        (
            (*first, *(f"depth, {kind}" for kind in ("pressing", "pressing targets")), *(f"walls, {k}" for k in KINDS)),
            safe,
        ),
        (
            (
                *first,
                *("CPU us", "of it physics", "times faster", "precision / recall"),
                *("drives", "surface after 1 / 8 poses", "voxels, heuristic / random targets"),
            ),
            rest,
        ),
    ]


def main(config: Config) -> None:
    """Prints the tables, and writes them where asked to."""
    torch.set_num_threads(1)
    journal = Journal(config.journal)
    settings = tuple(parse_setting(text) for text in config.settings) or _grid()
    rows = [measure(setting, config, journal) for setting in tqdm(settings, desc="settings")]
    if config.rounds:
        compare_speeds(rows, config)
    text = f"{machine()}.\n"
    for header, cells in tables(rows):
        print_table(header, cells)
        text += "\n" + markdown_table(header, cells)
    if config.document is not None:
        replace_section(config.document, "settings", text)


if __name__ == "__main__":
    main(tyro.cli(Config))
