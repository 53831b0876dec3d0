"""Your own policy: a class with reset and act, evaluated beside the benchmark's and scored.

python examples/2_your_own_policy.py --output runs/own_policy

The command line takes it too, without this file's last lines:

tslam-bench evaluate --policy examples/2_your_own_policy.py:Patter --reconstructor carve --output runs/own_policy
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

import tslam_bench
from tslam_bench.evaluation.policy import episode_generators
from tslam_bench.hand_constants import JOINT_NAMES
from tslam_bench.scoring.scoring import score_submission

FINGERS = [i for i, name in enumerate(JOINT_NAMES) if name[:2] in ("FF", "MF", "RF", "LF") and name[-1] in "012"]


class Patter:
    """Pats the workspace: every 8 steps the arm goes somewhere near its centre, and the fingers open or curl.

    Args:
        spread: standard deviation of the arm's targets, as a share of its range.
    """

    control_mode = "pd_joint_pos"  # an action of -1 and 1 is a joint's lower and upper limit

    def __init__(self, spread: float = 0.25) -> None:
        self.spread = spread

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """Begins episodes; each has random numbers of its own, so that it does not depend on the others."""
        self._generators = episode_generators(num_envs, seed)
        self._actions = np.zeros((num_envs, 28), dtype=np.float32)

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """(n, 28) actions for observations with a leading axis of n."""
        for row, rng in enumerate(self._generators):
            if round(float(observation["time"][row, 0]) * 200) % 8 == 0:
                self._actions[row, :4] = np.clip(rng.normal(0.0, self.spread, 4), -1, 1)
                self._actions[row, FINGERS] = rng.uniform(-1, 1)
        return self._actions.copy()


def main(objects: tuple[str, ...] = ("mug", "hammer"), output: Path = Path("runs/own_policy")) -> None:
    """Evaluates the policy and a baseline on test objects.

    Args:
        objects: objects of the test split.
        output: folder for rollouts and submissions.
    """
    for policy in (Patter, "random_targets"):
        (submission,) = tslam_bench.evaluate(policy, ("carve",), objects=objects, output=output)
        score = score_submission(submission, objects)
        print(f"{score.info.method}: IoU area {score.aggregate['areas']['iou_area'].mean:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
