"""How far honest ten-step segments end from their checkpoints when they are replayed from there, and what a replay costs.

Episodes of two explorers, all poses, replayed on the machine that made them. Each checkpoint is moved by a relative error, which
stands for what another processor would have stored: ``python benchmarks/verify_segments.py --objects mug knife``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from scipy.ndimage import binary_dilation

from tslam_bench.constants import HORIZON, NUM_POSES, QUICK_OBJECTS
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.evaluation.verify import judge, replay
from tslam_bench.registration import make_vec
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.verification import Tolerances


@dataclass(frozen=True)
class Arguments:
    """Measures segments of honest episodes."""

    objects: tuple[str, ...] = QUICK_OBJECTS
    """Test objects."""
    errors: tuple[float, ...] = (0.0, 1e-7, 1e-5)
    """Relative errors (standard deviation) of the checkpoints."""


def moved(rollout: Rollout, error: float, generator: np.random.Generator) -> Rollout:
    """The rollout with checkpoints that are off by a relative error."""
    noise = 1 + error * generator.standard_normal(rollout.joint_checkpoints.shape)
    return replace(rollout, joint_checkpoints=(rollout.joint_checkpoints * noise).astype(np.float32))


def main(arguments: Arguments) -> None:
    """Prints one line for each object, explorer and error."""
    limits, generator = Tolerances(), np.random.default_rng(0)
    for name in arguments.objects:
        for explorer in ("heuristic", "random_targets"):
            policy = make_baseline(explorer)
            mode = policy.control_mode
            envs = make_vec(num_envs=NUM_POSES, device="cpu", split="test", object=name, control_mode=mode, processes=0)
            rollouts = roll_out_batch(envs, policy, [(name, pose, 0) for pose in range(NUM_POSES)], "2021")
            envs.close()
            start = time.process_time()
            found = replay(rollouts, mode)
            each = 1e6 * (time.process_time() - start) / (NUM_POSES * HORIZON)
            same = sum(judge(rollout, found, row, None).departed is None for row, rollout in enumerate(rollouts))
            print(f"{name}, {explorer}: {same} of {NUM_POSES} bit for bit, {each:.0f} us of CPU for a step")
            for error in arguments.errors:
                off = [moved(rollout, error, generator) for rollout in rollouts]
                found = replay(off, mode, segments=True)
                away = np.abs(found.joints - np.stack([rollout.joint_checkpoints for rollout in off]))[:, 1:]
                arm, rest = away[..., :3].max(axis=-1), away[..., 3:].max(axis=-1)
                beyond = ((arm > limits.arm) | (rest > limits.joints)).sum(axis=1)
                felt = [binary_dilation(steps >= 0, np.ones((3, 3, 3))) for steps in found.touched_step]
                unfelt = [(r.touched & ~f).sum() / max(r.touched.sum(), 1) for r, f in zip(rollouts, felt, strict=True)]
                arm_text, rest_text = (
                    " / ".join(f"{x:.3f}" for x in np.quantile(values, [0.5, 0.9, 0.99, 1]))
                    for values in (1e3 * arm, rest)
                )
                print(
                    f"  error {error:g}: arm {arm_text} mm, joints {rest_text} rad (median, 90 %, 99 %, largest); "
                    f"beyond: at most {beyond.max()} of {arm.shape[1]} segments; unfelt: at most {max(unfelt):.3f}"
                )


if __name__ == "__main__":
    main(tyro.cli(Arguments))
