"""Step 1: a few environments in detail, each figure against the CPU engine with the same seeds.

python benchmarks/gpu/step1_details.py
python benchmarks/gpu/step1_details.py --nan     # in a process of its own: it may end the CUDA context
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from step import Report, Step, run

from tslam_bench.constants import CONTROL_STEP_SECONDS, HORIZON, NUM_JOINTS, QUICK_OBJECTS
from tslam_bench.engine.hand_agent import matrices_from_poses
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.physics import PROTOCOL, pose_quaternion
from tslam_bench.registration import make_vec

DOWN = 1
"""Index of the joint that lowers the hand."""


@dataclass(frozen=True)
class Settings(Step):
    """Checks a few environments."""

    num_envs: int = 4
    """Environments."""
    nan: bool = False
    """Only hand one NaN over, and see whether the others go on."""


def actions(settings: Settings, value: float = 0.0) -> np.ndarray:
    """(E, 28) equal actions."""
    return np.full((settings.num_envs, NUM_JOINTS), value, dtype=np.float32)


def work(settings: Settings, report: Report) -> None:
    """All checks in turn."""
    envs: Any = make_vec(num_envs=settings.num_envs, device="cuda", objects=QUICK_OBJECTS)
    base = envs.environment.unwrapped
    seeds = list(range(settings.num_envs))
    poses = [env % 8 for env in seeds]
    if settings.nan:
        _one_nan(settings, report, envs, seeds)
        return
    report.check("timestep", abs(base.scene.px.timestep - CONTROL_STEP_SECONDS / PROTOCOL.substeps), 1e-9)
    observation, _ = envs.reset(seed=seeds, options={"pose": poses})
    names = list(base.object_name)
    batch = HandBatch(settings.num_envs, BatchSettings(objects=QUICK_OBJECTS))
    batch.reset(seeds, seeds, names, poses)
    report.check("qpos at reset", np.abs(observation["qpos"].cpu().numpy() - batch.arrays["qpos"]).max(), 1e-6)
    links = base.agent.device_skin_matrices().cpu().numpy()
    report.check("link matrices at reset", np.abs(links - batch._links).max(), 1e-5)
    found = base.scene.actors["object"].pose.raw_pose.cpu().numpy()
    expected = np.array([[0, 0, 0, *pose_quaternion(pose)] for pose in poses])
    report.check("object poses", np.abs(found - expected).max(), 1e-6)

    for _ in range(20):
        observation, *_ = envs.step(actions(settings))
        batch.arrays["action"][:] = 0
        batch.step()
    report.check("hold still, qvel", float(observation["qvel"].abs().max()), 0.1)
    report.check("hold still, CPU", np.abs(observation["qpos"].cpu().numpy() - batch.arrays["qpos"]).max(), 5e-3)
    press = actions(settings)
    press[:, DOWN] = -1
    for _ in range(60):
        observation, *_ = envs.step(press)
    report["press, hands that touch"] = int(observation["touch"].any(1).sum())
    report["press, deepest probe (m)"] = _deepest(base)

    before = {name: value.clone() for name, value in observation.items()}
    mask = np.arange(settings.num_envs) == 1
    observation, _ = envs.reset(options={"reset_mask": mask, "pose": [(pose + 1) % 8 for pose in poses]})
    others = torch.as_tensor(~mask, device=envs.device)
    changed = max(float((before[n][others].float() - observation[n][others].float()).abs().max()) for n in before)
    report.check("partial reset, others", changed, 0.0)
    found = base.scene.actors["object"].pose.raw_pose.cpu().numpy()
    expected[1, 3:] = pose_quaternion((poses[1] + 1) % 8)
    report.check("turned object", np.abs(found - expected).max(), 1e-6)

    envs.reset(seed=seeds)
    generator = np.random.default_rng(0)
    for _ in range(HORIZON):
        observation, _, _, truncated, _ = envs.step(generator.uniform(-1, 1, press.shape).astype(np.float32))
    report["all ended at the horizon"] = bool(truncated.all()) and bool((observation["time"] == 0).all())
    report.check("faults", float(envs.faults.sum()), 0)
    envs.close()


def _deepest(base: Any) -> float:
    """How far the deepest link's origin is from where the field's surface would stop it; negative is inside (m)."""
    poses = base.scene.px.cuda_rigid_body_data.torch()[base.agent._skin_rows, :7]
    sensing = base._sensing
    placed = sensing._probes.place(matrices_from_poses(poses).permute(2, 3, 0, 1).contiguous())
    from tslam_bench.engine.sensing_torch import _interpolate

    turn = sensing._fields.turn  # world to object: the transpose
    local = torch.einsum("eji,jep->iep", turn, placed)
    return float((_interpolate(sensing._fields, local)[0] - sensing._reach).min())


def _one_nan(settings: Settings, report: Report, envs: Any, seeds: list[int]) -> None:
    envs.reset(seed=seeds)
    expected = [envs.step(actions(settings, -0.3))[0] for _ in range(5)][-1]
    expected = {name: value.clone() for name, value in expected.items()}
    envs.reset(seed=seeds)
    bad = actions(settings, -0.3)
    bad[0, 3] = np.nan
    for step in range(5):
        observation, *_ = envs.step(bad if step == 1 else actions(settings, -0.3))
    report["faults"] = envs.faults.tolist()
    for name in ("qpos", "occupancy"):
        difference = (observation[name][1:].float() - expected[name][1:].float()).abs().max()
        report.check(f"others, {name}", float(difference), 1e-6)
    report["finite"] = all(bool(torch.isfinite(value.float()).all()) for value in observation.values())
    envs.close()


if __name__ == "__main__":
    chosen = tyro.cli(Settings)
    if chosen.nan and chosen.output is None:
        chosen = replace(chosen, output=Path("gpu_results") / "step1_nan.json")
    run(chosen, work)
