"""Step 1b, without PhysX's GPU library: sensing and rewards on CUDA with recorded link poses, against the CPU.

python benchmarks/gpu/step1b_sensing.py
"""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import step as step_module
import torch
import tyro
from step import Report, Step, run, synchronise, tensor_device

from tslam_bench.constants import QUICK_OBJECTS, REWARD_MODES
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.sensing_torch import TorchSensing
from tslam_bench.engine.skin import build_skin
from tslam_bench.evaluation.gpu_check import Episodes
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import load_object


@dataclass(frozen=True)
class Settings(Step):
    """Compares and measures."""

    num_envs: int = 10
    """Recorded hands."""
    steps: int = 100
    """Recorded control steps."""
    sizes: tuple[int, ...] = (256, 1024, 4096, 8192)
    """Environments for the time per step."""


def recorded(settings: Settings) -> tuple[Episodes, np.ndarray]:
    """Episodes on the CPU engine and their link poses (T, E, L, 3, 4)."""
    episodes = Episodes.draw(QUICK_OBJECTS, (0, 2, 5), settings.num_envs)
    batch = HandBatch(settings.num_envs, BatchSettings(objects=QUICK_OBJECTS, reward_mode="none"))
    batch.reset(list(episodes.seeds), range(settings.num_envs), list(episodes.objects), list(episodes.poses))
    links = []
    for action in episodes.actions[: settings.steps]:
        batch.arrays["action"][:] = action
        batch.step()
        links.append(batch._links.copy())
    return episodes, np.stack(links)


def begun(episodes: Episodes, count: int, mode: str, device: str | None):
    """Sensing and rewards of ``count`` environments, the recorded episodes in turn; None is the CPU engine."""
    skin = build_skin(load_hand().shapes)
    sensing = CompiledSensing(count, skin) if device is None else TorchSensing(count, skin, device)
    rewards = Rewards(mode, count, sensing.backend)
    objects = {name: load_object(name) for name in set(episodes.objects)}
    for env in range(count):
        prepared, pose = (
            objects[episodes.objects[env % len(episodes.objects)]],
            episodes.poses[env % len(episodes.poses)],
        )
        sensing.set_object(env, prepared.name, prepared.field, pose)
        rewards.set_object(env, prepared, pose)
    sensing.begin(range(count))
    rewards.begin(range(count))
    return sensing, rewards


def work(settings: Settings, report: Report) -> None:
    """Bits of touch and grids, differences of rewards, and times with waiting forbidden."""
    device, count = tensor_device(settings), settings.num_envs
    episodes, links = recorded(settings)
    on_device = torch.from_numpy(links).to(device)
    for mode in REWARD_MODES:
        (host, host_rewards), (other, other_rewards) = (
            begun(episodes, count, mode, None),
            begun(episodes, count, mode, device),
        )
        bits, reward = 0, 0.0
        for step in range(settings.steps):
            a = host.step(links[step], np.full(count, step))
            b = other.step(on_device[step], torch.full((count,), step, device=device))
            bits += int((a.on != b.on.cpu().numpy()).sum())
            reward = max(reward, float(np.abs(host_rewards.step(a) - other_rewards.step(b).cpu().numpy()).max()))
        report.check(f"{mode}, probe bits that differ", bits, 0)
        report.check(f"{mode}, touched voxels that differ", int((host.touched != other.touched.cpu().numpy()).sum()), 0)
        report.check(f"{mode}, visited voxels that differ", int((host.visited != other.visited.cpu().numpy()).sum()), 0)
        report.check(f"{mode}, reward", reward, 1e-3)
    for size in settings.sizes:
        rows = torch.arange(size, device=device) % count
        sensing, rewards = begun(episodes, size, "tslam", device)
        targets = DriveTargets(CONTROL_MODES[0], sensing.backend)
        qpos = torch.zeros(size, 28, device=device)
        poses = [on_device[step][rows] for step in range(min(20, settings.steps))]
        steps = torch.zeros(size, dtype=torch.int32, device=device)
        for timed in (False, True):
            synchronise(settings)
            start = time.perf_counter()
            with _no_waiting(settings):
                for pose in poses:
                    targets(qpos, qpos)
                    rewards.step(sensing.step(pose, steps))
                    sensing.link_touch()
                    occupancy = sensing.occupancy
            synchronise(settings)
            if timed:
                report[f"milliseconds per step, {size}"] = 1e3 * (time.perf_counter() - start) / len(poses)
        report[f"MB, {size}"] = step_module.memory(settings)
        del sensing, rewards, targets, occupancy


class _NoWaiting:
    """Whatever waits for the device raises."""

    def __enter__(self) -> None:
        torch.cuda.set_sync_debug_mode("error")

    def __exit__(self, *_: object) -> None:
        torch.cuda.set_sync_debug_mode("default")


def _no_waiting(settings: Settings):
    return _NoWaiting() if settings.device == "cuda" else nullcontext()


if __name__ == "__main__":
    with patch.object(step_module, "physics_of", lambda device: nullcontext()):  # no GPU physics needed
        run(tyro.cli(Settings), work)
