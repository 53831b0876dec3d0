"""What every explorer is: a policy that is reset with one seed per episode and maps observations to actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.errors import InvalidInputError


class Baseline(Protocol):
    """A policy that explores ``num_envs`` objects side by side.

    All random numbers of an episode come from that episode's seed, so the actions do not depend on which other episodes
    share the batch. Nothing that it is given names the object: seeds come from a salt it does not know, and an
    evaluation plays its episodes in shuffled order (:mod:`tslam_bench.episodes`).

    Attributes:
        control_mode: one of ``CONTROL_MODES``: what its actions mean. Evaluation makes the environment accordingly.
    """

    control_mode: str

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """Begins ``num_envs`` episodes.

        Args:
            num_envs: number of episodes in the batch, at least 1.
            seed: one non-negative seed per episode, or one number from which they are spawned.

        Raises:
            InvalidInputError: ``num_envs`` or ``seed`` is unusable.
        """

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """Chooses the next actions.

        Args:
            observation: the entries of protocol section 6 as arrays with a leading ``num_envs`` axis.

        Returns:
            (num_envs, 28) float32 in [-1, 1], in the joint order of protocol section 2.
        """


def episode_generators(num_envs: int, seed: int | Sequence[int]) -> list[np.random.Generator]:
    """One independent generator per episode: seed ``s`` of a sequence gives the same generator in every batch.

    Raises:
        InvalidInputError: ``num_envs`` is below 1, a seed is negative, or the number of seeds is not ``num_envs``.
    """
    if num_envs < 1:
        raise InvalidInputError(f"num_envs {num_envs}: must be at least 1")
    single = isinstance(seed, int | np.integer)
    seeds = [int(seed)] if single else [int(s) for s in seed]  # type: ignore[arg-type, union-attr]
    if any(s < 0 for s in seeds):
        raise InvalidInputError(f"seed {min(seeds)}: must not be negative")
    if not single and len(seeds) != num_envs:
        raise InvalidInputError(f"seed: {len(seeds)} seeds for {num_envs} episodes; give one per episode, or a number")
    sequences = [np.random.SeedSequence(s) for s in seeds]
    if single and num_envs > 1:
        sequences = sequences[0].spawn(num_envs)
    return [np.random.Generator(np.random.PCG64(sequence)) for sequence in sequences]


def check_observation(observation: Mapping[str, NDArray], num_envs: int) -> NDArray:
    """Returns ``observation["qpos"]`` (num_envs, 28).

    Raises:
        InvalidInputError: ``qpos`` is missing, or is not of that shape.
    """
    qpos = observation.get("qpos")
    if qpos is None or np.shape(qpos) != (num_envs, NUM_JOINTS):
        shape = None if qpos is None else np.shape(qpos)
        raise InvalidInputError(
            f"observation: qpos has shape {shape}, expected ({num_envs}, {NUM_JOINTS}); call reset first"
        )
    return qpos
