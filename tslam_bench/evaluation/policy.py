"""What every explorer is: a policy that is reset with one seed per episode and maps observations to actions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.episodes import Episode
from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.hand_constants import JOINT_NAMES
from tslam_bench.plugins import user_error


class Policy(Protocol):
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


class CheckedPolicy:
    """A policy whose answers are checked in every step, so that a mistake is named where it is made.

    Args:
        policy: what to check; it gives the same actions as without.
        label: what messages call it.

    Attributes:
        playing: the episodes of the batch, for messages; further ones of the batch repeat the last.
    """

    def __init__(self, policy: Policy, label: str) -> None:
        self.control_mode = policy.control_mode
        self.playing: Sequence[Episode] = ()
        self._policy, self._label = policy, label
        self._num_envs, self._step = 0, 0

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`Policy`. Raises UserCodeError if the policy raises anything that is not an error of the benchmark."""
        self._num_envs, self._step = num_envs, 0
        try:
            self._policy.reset(num_envs, seed)
        except BenchmarkError:
            raise
        except Exception as error:
            raise user_error(error, f"{self._label}: reset{self._where(None)}") from error

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`Policy`.

        Raises:
            InvalidInputError: the actions are not finite float32 numbers in [-1, 1], one row of 28 per environment.
            UserCodeError: the policy raised anything that is not an error of the benchmark.
        """
        try:
            actions = self._policy.act(observation)
        except BenchmarkError:
            raise
        except Exception as error:
            raise user_error(error, f"{self._label}: act, step {self._step}{self._where(None)},") from error
        expected = (self._num_envs, NUM_JOINTS)
        fits = isinstance(actions, np.ndarray) and actions.dtype == np.float32 and actions.shape == expected
        if not (fits and (np.abs(actions) <= 1).all()):  # NaN is not at most 1
            raise InvalidInputError(f"{self._label}: act returned {self._fault(actions, expected)}")
        self._step += 1
        return actions

    def _fault(self, actions: Any, expected: tuple[int, int]) -> str:
        """What is wrong with ``actions``, in which step of which episode."""
        place = f"in step {self._step}{self._where(None)}"
        if not isinstance(actions, np.ndarray):
            return f"a {type(actions).__name__} {place}, expected a numpy array"
        if actions.shape != expected:
            return f"an array of shape {actions.shape} {place}, expected {expected}"
        if actions.dtype != np.float32:
            return f"{actions.dtype} {place}, expected float32; use .astype(np.float32)"
        env, joint = np.argwhere(~(np.abs(actions) <= 1))[0]
        return (
            f"{actions[env, joint]} for {JOINT_NAMES[joint]} (action {joint}) in step {self._step}{self._where(env)}; "
            "actions have to be in [-1, 1]"
        )

    def _where(self, env: int | None) -> str:
        """The episode of an environment; of None the first of the batch, and how many play beside it."""
        if not self.playing:
            return "" if env is None else f" of environment {env}"
        name, pose, seed = self.playing[min(env or 0, len(self.playing) - 1)]
        beside = len(self.playing) - 1 if env is None else 0
        return f" of {name}, pose {pose}, seed {seed}" + (f" and {beside} beside it" if beside else "")


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
