"""Where a control step's time goes: CPU time per stage of a batch of hands in this process."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from rollouts import Hands, exploring_actions

from tslam_bench.constants import HORIZON
from tslam_bench.engine.hand_batch import BatchSettings

STAGES = ("drive targets", "physics", "reading state", "sensing", "rewards", "resets", "rest")
"""Stages of a control step; ``rest`` is what the others leave: control law, writing observations, the loop itself."""


def stage_costs(num_envs: int, settings: BatchSettings, steps: int = HORIZON) -> dict[str, float]:
    """Microseconds of CPU time per hand and control step, by stage and in ``all``.

    The first episode warms up; ``steps`` control steps of every hand are measured after it.
    """
    hands = Hands(num_envs, settings)
    spent = dict.fromkeys(STAGES, 0.0)
    inside_reset = False

    def timed(owner: Any, name: str, stage: str) -> None:
        inner = getattr(owner, name)

        def outer(*arguments: Any, **named: Any) -> Any:
            nonlocal inside_reset
            if inside_reset:
                return inner(*arguments, **named)
            inside_reset = stage == "resets"
            start = time.thread_time()
            try:
                return inner(*arguments, **named)
            finally:
                spent[stage] += time.thread_time() - start
                if stage == "resets":
                    inside_reset = False

        setattr(owner, name, outer)

    batch = hands.batch
    for scene in batch._scenes:
        timed(scene, "set_targets", "drive targets")
        timed(scene, "step", "physics")
        timed(scene, "read", "reading state")
    timed(batch, "_gather", "reading state")
    timed(batch._sensing, "step", "sensing")
    timed(batch._sensing, "link_touch", "sensing")
    timed(batch._rewards, "step", "rewards")
    timed(batch, "_start_anew", "resets")

    generator = np.random.Generator(np.random.PCG64(0))
    hands.reset(0)
    for step in range(HORIZON):
        hands.step(exploring_actions(generator, num_envs, step))
    spent.update(dict.fromkeys(STAGES, 0.0))
    start = time.thread_time()
    for step in range(steps):
        hands.step(exploring_actions(generator, num_envs, step))
    total = time.thread_time() - start
    spent["rest"] = total - sum(spent.values())
    return {stage: 1e6 * seconds / (steps * num_envs) for stage, seconds in {**spent, "all": total}.items()}
