"""A long random rollout through ``make_vec``: does it run to its end, at what speed, with what memory, and is all of it sound?

    python benchmarks/long_run.py --steps 1000000
    python benchmarks/long_run.py --steps 0 --resets 10000

Every observation and reward is checked: finite, of its type, in its range, and consistent from step to step. Memory is that of
this process and its workers (Linux: proportional set size, so that what they share counts once), sampled twenty times.
``--resets`` starts that many more episodes one after the other, a few steps each, and says what a reset costs. Ends with one
JSON line; exit code 1 if anything was wrong.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro
from numpy.typing import NDArray
from report import machine, write_json
from tqdm import tqdm

import tslam_bench
from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.errors import BenchmarkError
from tslam_bench.evaluation.observations import last_observation
from tslam_bench.objects.store import list_objects

SAMPLES: Final = 20
"""Memory samples over a run."""
SETTLED: Final = 0.25
"""Share of the run after which memory must not grow: by then every object has been cooked in every worker."""
GROWTH_LIMIT: Final = 0.05
"""Growth of memory after that, as a share, that counts as a leak."""
EPISODES_TO_JUDGE: Final = 2_000
"""Memory of shorter runs is not judged: they are still filling the caches of objects."""
SHORT_EPISODE: Final = 3
"""Control steps between resets in ``--resets``."""


@dataclass(frozen=True)
class Config:
    """Runs and watches."""

    steps: int = 1_000_000
    """Control steps of all environments together."""
    resets: int = 0
    """Episodes that are started in short succession after that."""
    num_envs: int = 32
    """Environments."""
    processes: int = len(os.sched_getaffinity(0))
    """Worker processes."""
    objects: tuple[str, ...] | None = None
    """Test objects; None means all that are prepared."""
    reward_mode: str = "tslam"
    """Reward mode."""
    seed: int = 0
    """Of environments and actions."""
    output: Path | None = None
    """JSON file for the figures."""


@dataclass
class Watch:
    """Checks what a vector environment returns, and counts what is wrong by kind.

    Attributes:
        anomalies: kinds of anomaly and how often each was seen.
        episodes: episodes that came to their end.
    """

    anomalies: Counter[str] = field(default_factory=Counter)
    episodes: int = 0
    _occupied: NDArray | None = None

    def see(self, observation: dict[str, NDArray], info: dict[str, Any], reward: NDArray | None = None) -> None:
        """Takes in a step (or a reset, without reward)."""
        note = self._note
        for name in ("qpos", "qvel"):
            note(f"{name} not finite", ~np.isfinite(observation[name]).all(axis=1))
        note("time outside 0..1", (observation["time"] < 0) | (observation["time"] > 1))
        note("touch not 0 or 1", (observation["touch"] > 1).any(axis=1))
        occupied = observation["occupancy"].reshape(len(observation["time"]), 2, -1)
        note("occupancy not 0 or 1", occupied.max(axis=(1, 2)) > 1)
        count = np.count_nonzero(occupied, axis=2)
        if reward is not None:
            note("reward not finite", ~np.isfinite(reward))
            running = info["elapsed_steps"] > 0
            assert self._occupied is not None
            added = np.stack([info["new_touched"], info["new_visited"]], axis=1)
            # An ended episode's counts belong to its last observation.
            note("new voxels do not add up", running & (count != self._occupied + added).any(axis=1))
            ended = info.get("_final_obs")
            if ended is not None:
                self.episodes += int(ended.sum())
                last = last_observation(observation, info)
                note("final observation not finite", ended & ~np.isfinite(last["qpos"]).all(axis=1))
                note("episode ended early", ended & (info["final_info"]["elapsed_steps"] != HORIZON))
                note("grids not empty after a reset", ended & (count != 0).any(axis=1))
        self._occupied = count

    def see_tslam_reward(self, reward: NDArray, info: dict[str, Any], weight: float) -> None:
        """Checks the default mode's reward against its definition."""
        counts = [info[name] + info.get("final_info", {}).get(name, 0) for name in ("new_touched", "new_visited")]
        expected = counts[0] + weight * counts[1]
        self._note("reward is not its definition", np.abs(reward - expected) > 1e-3)

    def _note(self, kind: str, wrong: NDArray) -> None:
        count = int(np.count_nonzero(wrong))
        if count:
            self.anomalies[kind] += count


class Memory:
    """Memory of this process and its workers (MiB), over a run."""

    def __init__(self) -> None:
        self.samples: list[float] = []

    def sample(self) -> None:
        """Looks now."""
        family = [os.getpid(), *(process.pid for process in multiprocessing.active_children() if process.pid)]
        self.samples.append(sum(_proportional_set_size(pid) for pid in family) / 2**20)

    def growth(self) -> float:
        """Share by which the last samples exceed those at ``SETTLED``: medians of three."""
        first = int(SETTLED * len(self.samples))
        early, late = self.samples[first : first + 3], self.samples[-3:]
        return float(np.median(late) / np.median(early) - 1)


def _proportional_set_size(pid: int) -> int:
    """Bytes."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
        if line.startswith("Pss:"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"/proc/{pid}/smaps_rollup: no line 'Pss:'; this needs Linux 4.14 or newer")


def random_rollout(envs: Any, config: Config, watch: Watch, memory: Memory) -> float:
    """Random actions for ``config.steps``; returns seconds of wall time."""
    from tslam_bench.engine.rewards import COVERAGE_WEIGHT

    generator = np.random.Generator(np.random.PCG64(config.seed))
    rounds = -(-config.steps // config.num_envs)
    watch.see(*envs.reset(seed=config.seed))
    started = time.perf_counter()
    for index in tqdm(range(rounds), desc="steps", mininterval=5):
        action = generator.uniform(-1, 1, (config.num_envs, NUM_JOINTS)).astype(np.float32)
        observation, reward, _, _, info = envs.step(action)
        watch.see(observation, info, reward)
        if config.reward_mode == "tslam":
            watch.see_tslam_reward(reward, info, COVERAGE_WEIGHT)
        if (index + 1) % max(1, rounds // SAMPLES) == 0:
            memory.sample()
    return time.perf_counter() - started


def many_resets(envs: Any, config: Config, watch: Watch, memory: Memory) -> float:
    """Short episodes, ``config.resets`` in all; returns milliseconds of wall time per environment and reset."""
    generator = np.random.Generator(np.random.PCG64(config.seed + 1))
    rounds, spent = -(-config.resets // config.num_envs), 0.0
    for index in tqdm(range(rounds), desc="resets", mininterval=5):
        started = time.perf_counter()
        result = envs.reset(seed=None if index else config.seed)
        spent += time.perf_counter() - started
        watch.see(*result)
        for _ in range(SHORT_EPISODE):
            action = generator.uniform(-1, 1, (config.num_envs, NUM_JOINTS)).astype(np.float32)
            observation, reward, _, _, info = envs.step(action)
            watch.see(observation, info, reward)
        if (index + 1) % max(1, rounds // SAMPLES) == 0:
            memory.sample()
    return 1000 * spent / (rounds * config.num_envs)


def rounded(samples: Sequence[float]) -> list[int]:
    """Whole MiB."""
    return [round(sample) for sample in samples]


def main(config: Config) -> int:
    """Prints one JSON line; returns the exit code."""
    names = config.objects or tuple(record["name"] for record in list_objects("test"))
    result: dict[str, Any] = {"machine": machine(), "objects": len(names), "num_envs": config.num_envs}
    watch = Watch()

    def judge(memory: Memory, episodes: int) -> None:
        if episodes >= EPISODES_TO_JUDGE and memory.growth() > GROWTH_LIMIT:
            watch.anomalies[f"memory grew by more than {GROWTH_LIMIT:.0%}"] += 1

    try:
        envs = tslam_bench.make_vec(
            num_envs=config.num_envs,
            device="cpu",
            objects=names,
            reward_mode=config.reward_mode,
            processes=config.processes,
        )
        if config.steps:
            memory = Memory()
            seconds = random_rollout(envs, config, watch, memory)
            steps = -(-config.steps // config.num_envs) * config.num_envs
            judge(memory, steps // HORIZON)
            result |= {"steps": steps, "seconds": round(seconds, 1), "steps_per_second": round(steps / seconds, 1)}
            result |= {"memory_mib": rounded(memory.samples), "memory_growth": round(memory.growth(), 4)}
        if config.resets:
            memory = Memory()
            cost = many_resets(envs, config, watch, memory)
            resets = -(-config.resets // config.num_envs) * config.num_envs
            judge(memory, resets)
            result |= {"resets": resets}
            result |= {"reset_milliseconds_per_environment": round(cost, 3)}
            result |= {"reset_memory_mib": rounded(memory.samples), "reset_memory_growth": round(memory.growth(), 4)}
        envs.close()
    except BenchmarkError as error:
        watch.anomalies[f"{type(error).__name__}: {error}"] += 1
    result |= {"episodes_ended": watch.episodes, "anomalies": dict(watch.anomalies)}
    write_json(config.output, result)
    print(json.dumps(result))
    return 1 if watch.anomalies else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config)))
