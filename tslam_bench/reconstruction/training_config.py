"""How a learned reconstructor is trained. Imports no torch, so that command lines start fast."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from tslam_bench.errors import InvalidInputError

COLLECTED_ONLY: Final = ("unet",)
"""Architectures that learn from collected touches only."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a reconstructor is trained."""

    architecture: Literal["ifnet", "convonet", "unet"] = "ifnet"
    """Network: ifnet (the paper's), convonet or unet. unet learns from collected touches (--data) only."""
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
    weight_decay: float = 0.0
    """Decoupled weight decay (AdamW)."""
    average: float = 0.0
    """The weights that are kept are a running mean with this factor per step, such as 0.999; 0: the last ones."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Number format of the network's products in training; bfloat16 takes two thirds of the time on processors that have it."""
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
        if not 0 <= self.weight_decay < 1 or not 0 <= self.average < 1:
            raise InvalidInputError("weight_decay and average: choose numbers from 0 to below 1")
        low, high = self.scale_range
        if not 0 < low <= high:
            raise InvalidInputError(f"scale_range {self.scale_range}: choose two positive numbers, the smaller first")
