"""Settings of a training run; free of torch and simulators, so that ``--help`` is quick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal, get_args

import tyro

from tslam_bench.baselines.registry import get_baseline
from tslam_bench.constants import HORIZON
from tslam_bench.errors import InvalidInputError

PAPER_STEPS: Final = 10_000_000
"""Training budget of the paper, in environment steps."""


MODEL_FILE: Final = "model.zip"
"""stable-baselines3's archive of a finished model. ``PPO.load`` runs code in it; our own reader does not."""
METADATA_FILE: Final = "model.json"
"""Written last: a model directory without it is unfinished."""
NetworkName = Literal["small", "paper"]


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of one training run."""

    baseline: Annotated[str, tyro.conf.Positional]
    """Id of a learned baseline; it decides the reward."""
    steps: int = PAPER_STEPS
    """Environment steps over all environments; rounded up to whole PPO iterations (num_envs * rollout_steps)."""
    seed: int = 0
    """Seeds weights, exploration, minibatches, and the objects and poses that are drawn."""
    num_envs: int = 8
    """Environments that are stepped side by side."""
    split: str = "train"
    """Objects to train on; the test split is refused."""
    objects: tuple[str, ...] = ()
    """Restricts training to these objects of the split; empty: all of it."""
    network: NetworkName = "paper"
    """Size of the policy network."""
    rollout_steps: int = 2 * HORIZON
    """Steps per environment and PPO iteration."""
    batch_size: int = 400
    """Minibatch size (samples)."""
    epochs: int = 5
    """Passes over each iteration's samples."""
    learning_rate: float = 3e-4
    """Adam's step size."""
    gamma: float = 0.99
    """Discount (paper: 0.99)."""
    gae_lambda: float = 0.95
    """Decay of generalised advantage estimation."""
    clip_range: float = 0.2
    """PPO's clip of the probability ratio."""
    entropy_coefficient: float = 0.0
    """Weight of the entropy bonus."""
    checkpoint_every: int = 64_000
    """Steps between checkpoints; rounded up to whole PPO iterations."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to simulate and learn; auto: on a CUDA GPU where there is one (not run on a GPU yet)."""
    processes: int | None = None
    """Worker processes that simulate on the CPU; default: the cores. Results do not depend on it."""
    torch_threads: int = 1
    """Threads of torch. One is fastest on CPUs: with two, the learner was measured more than ten times slower."""

    def check(self) -> None:
        """Raises InvalidInputError unless every setting is usable. Not done on creation: tyro would box the message."""
        spec = get_baseline(self.baseline)
        if spec.kind != "learned":
            raise InvalidInputError(f"baseline {self.baseline!r}: is {spec.kind}, there is nothing to train")
        for name in ("steps", "num_envs", "rollout_steps", "batch_size", "epochs", "checkpoint_every", "torch_threads"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} {getattr(self, name)}: must be at least 1")
        if self.processes is not None and self.processes < 1:
            raise InvalidInputError(f"processes {self.processes}: must be at least 1")
        if self.seed < 0:
            raise InvalidInputError(f"seed {self.seed}: must not be negative")
        if self.num_envs * self.rollout_steps < 2:
            raise InvalidInputError("rollout_steps: num_envs * rollout_steps must be at least 2")
        if not 0 < self.gamma <= 1 or not 0 <= self.gae_lambda <= 1 or self.learning_rate <= 0:
            raise InvalidInputError("gamma and gae_lambda must lie in (0, 1] and [0, 1], learning_rate above 0")
        if self.split == "test":
            raise InvalidInputError("split 'test': baselines are trained on the train split only; choose 'train'")
        if self.network not in get_args(NetworkName):
            names = ", ".join(get_args(NetworkName))
            raise InvalidInputError(f"network {self.network!r}: unknown; choose one of {names}")

    @property
    def iteration_steps(self) -> int:
        """Environment steps of one PPO iteration."""
        return self.num_envs * self.rollout_steps

    @property
    def total_steps(self) -> int:
        """``steps`` rounded up to whole iterations."""
        return -(-self.steps // self.iteration_steps) * self.iteration_steps

    @property
    def chunk_steps(self) -> int:
        """``checkpoint_every`` rounded up to whole iterations."""
        return -(-self.checkpoint_every // self.iteration_steps) * self.iteration_steps
