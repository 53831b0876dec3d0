"""Control steps per second of one ManiSkill environment on one core, sensing and reward included.

    python benchmarks/single_environment.py --steps 4000

Ends with one JSON line. The hand presses on the object for most of the time; resting hands would be faster.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import asdict, dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from touch_audit import pressing_action

import tslam_bench  # noqa: F401  (registers the environment)
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, NUM_POSES


@dataclass(frozen=True)
class Config:
    """Measures episodes, resets included."""

    object: str = "mug"
    """Test object."""
    steps: int = 4000
    """Control steps in all."""
    reward_mode: str = "tslam"
    """Reward mode."""


def main(config: Config) -> None:
    """Prints the median and the spread over episodes."""
    torch.set_num_threads(1)
    environment = gym.make(ENVIRONMENT_ID, object=config.object, reward_mode=config.reward_mode)
    rates, resets, contact_steps, done = [], [], 0, 0
    while done < config.steps:
        episode = done // HORIZON
        generator = np.random.Generator(np.random.PCG64(episode))
        start = time.perf_counter()
        observation, _ = environment.reset(seed=episode, options={"pose": episode % NUM_POSES})
        reset = time.perf_counter() - start
        held = np.zeros(NUM_JOINTS)
        for step in range(HORIZON):
            action = pressing_action(generator, held, step, observation["qpos"][0].numpy())
            observation, *_ = environment.step(action)
            contact_steps += bool(observation["touch"].any())
        elapsed = time.perf_counter() - start
        if done:  # the first episode cooks hulls and warms caches
            rates.append(HORIZON / elapsed)
            resets.append(1000 * reset)
        done += HORIZON
    result = {
        **asdict(config),
        "steps_per_second_median": round(statistics.median(rates), 1),
        "steps_per_second_min": round(min(rates), 1),
        "steps_per_second_max": round(max(rates), 1),
        "reset_milliseconds_median": round(statistics.median(resets), 2),
        "share_of_steps_in_contact": round(contact_steps / done, 3),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main(tyro.cli(Config))
