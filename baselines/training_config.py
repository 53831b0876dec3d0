"""Settings of a training run; free of torch and simulators, so that ``--help`` is quick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final, Literal, get_args

import tyro

from tslam_bench.constants import HORIZON
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import get_baseline

PAPER_STEPS: Final = 10_000_000
"""Training budget of the paper, in environment steps."""


NetworkName = Literal["fast", "hand", "paper"]
ControlMode = Literal["pd_joint_pos", "pd_joint_delta_pos"]


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe of one training run. *Steps* are control steps over all environments."""

    baseline: Annotated[str, tyro.conf.Positional]
    """Id of a learned baseline; it decides the reward."""
    steps: int = PAPER_STEPS
    """Control steps; rounded up to whole iterations (num_envs * rollout_steps)."""
    seed: int = 0
    """Seeds weights, exploration, minibatches, and the objects and poses that are drawn."""
    split: str = "train"
    """Objects to train on; the test split is refused."""
    objects: tuple[str, ...] = ()
    """Restricts training to these objects of the split; empty: all of it."""
    control_mode: ControlMode = "pd_joint_pos"
    """What actions mean: absolute joint targets, or differences to the joint positions."""
    action_repeat: int = 4
    """Control steps that each action is held for; a divisor of the episode's 200."""
    network: NetworkName = "fast"
    """Policy network; fast: matrix products for a CPU; hand: the same, and again around the hand; paper: six 3D convolutions."""
    clock: int = 5
    """Sine and cosine pairs of the time among the network's inputs, turning once, twice, 4, 8, ... times per episode."""
    initial_std: float = 0.6
    """Standard deviation of the untrained policy in fingers, wrist and roll; an action of 1 is a joint's limit."""
    initial_arm_std: float = 0.3
    """The same of the arm's three translations."""
    initial_aim: tuple[float, float, float] = (0.0, -0.4, 0.2)
    """Mean action of the untrained policy for the arm: sideways, up, forward; of ``pd_joint_pos`` only."""
    state_std: bool = False
    """The standard deviations depend on the observation; else on the joint alone."""
    noise_correlation: float = 0.0
    """Correlation of the policy's noise in one decision with that in the next of an episode; 0: independent."""
    num_envs: int = 32
    """Environments that are stepped side by side."""
    rollout_steps: int = HORIZON
    """Control steps per environment and iteration: one episode; a multiple of action_repeat."""
    batch_size: int = 400
    """Minibatch size (decisions)."""
    epochs: int = 6
    """Passes over each iteration's decisions, at most."""
    target_kl: float = 0.1
    """No further pass once the approximate KL divergence from the policy that acted exceeds this."""
    learning_rate: float = 3e-4
    """Adam's step size."""
    final_learning_rate: float = 1.0
    """Share of the step size that is left at the end, reached linearly."""
    std_learning_rate: float = 10.0
    """Factor on the step size of the standard deviations that depend on the joint alone."""
    gamma: float = 0.9
    """Discount per decision; 0.9 per 4 control steps is 0.974 per control step (paper: 0.99)."""
    gae_lambda: float = 0.8
    """Decay of generalised advantage estimation."""
    clip_range: float = 0.2
    """PPO's clip of the probability ratio."""
    clip_each_joint: bool = False
    """Each joint's probability ratio is clipped by itself, not their product."""
    coverage_bonus: float = 0.0
    """Added to the reward for each newly visited voxel while learning, beside what the baseline's reward pays."""
    value_coefficient: float = 0.5
    """Weight of the value's squared error."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    max_gradient: float = 0.5
    """Gradients with a larger norm are scaled down to it."""
    checkpoint_every: int = 64_000
    """Control steps between checkpoints; rounded up to whole iterations."""
    reconfigure_every: int = 20
    """Iterations between new objects for a GPU scene, which is built anew for them; the CPU draws one per episode."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to simulate and learn; auto: on a CUDA GPU where gpu-check has passed (not run on a GPU yet)."""
    processes: int | None = None
    """Worker processes that simulate on the CPU; default: the cores; 0: none but the trainer. Results do not depend on it."""
    torch_threads: int = 2
    """Threads that share each minibatch out while a CPU learns; the simulation waits then."""

    def check(self) -> None:
        """Raises InvalidInputError unless every setting is usable. Not done on creation: tyro would box the message."""
        spec = get_baseline(self.baseline)
        if spec.kind != "learned":
            raise InvalidInputError(f"baseline {self.baseline!r}: is {spec.kind}, there is nothing to train")
        if spec.id != self.baseline:
            raise InvalidInputError(
                f"baseline {self.baseline!r}: give the id alone; --seed is the seed of the training"
            )
        for name in (
            *("steps", "num_envs", "rollout_steps", "action_repeat", "batch_size", "epochs"),
            *("checkpoint_every", "reconfigure_every", "torch_threads"),
        ):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} {getattr(self, name)}: must be at least 1")
        for name in ("initial_std", "initial_arm_std", "target_kl", "learning_rate", "clip_range", "max_gradient"):
            if not 0 < getattr(self, name) < math.inf:
                raise InvalidInputError(f"{name} {getattr(self, name)}: must be a number above 0")
        if not all(-1 <= value <= 1 for value in self.initial_aim):
            raise InvalidInputError(f"initial_aim {self.initial_aim}: actions must lie in [-1, 1]")
        if not 0 <= self.clock <= 6:
            raise InvalidInputError(f"clock {self.clock}: must lie in [0, 6]")  # the next turns faster than a step
        for name in ("value_coefficient", "entropy_coefficient", "std_learning_rate", "coverage_bonus"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidInputError(f"{name} {getattr(self, name)}: must not be negative")
        for name in ("noise_correlation", "final_learning_rate"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidInputError(f"{name} {getattr(self, name)}: must lie in [0, 1]")
        if self.processes is not None and self.processes < 0:
            raise InvalidInputError(f"processes {self.processes}: must not be negative")
        if self.seed < 0:
            raise InvalidInputError(f"seed {self.seed}: must not be negative")
        if HORIZON % self.action_repeat:
            raise InvalidInputError(
                f"action_repeat {self.action_repeat}: must divide the {HORIZON} steps of an episode"
            )
        if self.rollout_steps % self.action_repeat:
            raise InvalidInputError(
                f"rollout_steps {self.rollout_steps}: must be a multiple of action_repeat {self.action_repeat}"
            )
        if self.num_envs * self.decisions < 2:
            raise InvalidInputError("rollout_steps: an iteration needs at least two decisions")
        if not 0 < self.gamma <= 1 or not 0 <= self.gae_lambda <= 1:
            raise InvalidInputError("gamma and gae_lambda must lie in (0, 1] and [0, 1]")
        if self.split == "test":
            raise InvalidInputError("split 'test': baselines are trained on the train split only; choose 'train'")
        for name, known in (("network", get_args(NetworkName)), ("control_mode", get_args(ControlMode))):
            if getattr(self, name) not in known:
                raise InvalidInputError(f"{name} {getattr(self, name)!r}: unknown; choose one of {', '.join(known)}")

    @property
    def decisions(self) -> int:
        """Decisions per environment and iteration."""
        return self.rollout_steps // self.action_repeat

    @property
    def iteration_steps(self) -> int:
        """Control steps of one iteration."""
        return self.num_envs * self.rollout_steps

    @property
    def total_steps(self) -> int:
        """``steps`` rounded up to whole iterations."""
        return -(-self.steps // self.iteration_steps) * self.iteration_steps

    @property
    def chunk_steps(self) -> int:
        """``checkpoint_every`` rounded up to whole iterations."""
        return -(-self.checkpoint_every // self.iteration_steps) * self.iteration_steps

    @property
    def scene_steps(self) -> int:
        """Control steps between new scenes on a GPU."""
        return self.reconfigure_every * self.iteration_steps
