"""How a learned reconstructor is trained. Imports no torch, so that command lines start fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tslam_bench.errors import InvalidInputError


@dataclass(frozen=True)
class TrainingConfig:
    """How a reconstructor is trained."""

    architecture: Literal["ifnet", "convonet"] = "ifnet"
    """Network: ifnet (the paper's) or convonet."""
    size: Literal["small", "paper"] = "small"
    """Size of the network; paper is for ifnet on a large machine."""
    steps: int = 300
    """Optimiser steps: the whole budget. The learning rate falls to zero at the last one."""
    batch_size: int = 8
    """Examples per step, each a shape in a new pose with new touches."""
    points: int = 512
    """Labelled query points per example."""
    learning_rate: float = 2e-3
    """Adam's learning rate at its peak; it rises over the first 5 % of the steps and falls as a half cosine."""
    scale_range: tuple[float, float] = (0.8, 1.2)
    """Every example scales its shape by a factor from this range."""
    continuous_rotation: bool = False
    """Turn shapes by any rotation instead of one of the 24 that map axes to axes."""
    seed: int = 0
    """Seed of the initial weights and of all examples."""
    threads: int = 1
    """Torch threads; another number may change the last bits."""
    threshold_examples: int = 48
    """Fresh examples, after training, on which the threshold with the best mean IoU is chosen."""
    save_every: int = 50
    """Steps between the checkpoints that a killed run resumes from."""

    def check(self) -> None:
        """Raises InvalidInputError if a value is out of range. (Not at construction: tyro would catch it.)"""
        for name in ("steps", "batch_size", "points", "threads", "threshold_examples", "save_every"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name} {getattr(self, name)}: choose at least 1")
        if not 0 < self.learning_rate < 1:
            raise InvalidInputError(f"learning_rate {self.learning_rate}: choose a number between 0 and 1")
        low, high = self.scale_range
        if not 0 < low <= high:
            raise InvalidInputError(f"scale_range {self.scale_range}: choose two positive numbers, the smaller first")
