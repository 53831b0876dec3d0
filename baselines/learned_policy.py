"""Learned explorers: a trained PPO policy behind the interface of every baseline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policy import check_observation, episode_generators
from tslam_bench.evaluation.weights import shipped_weights

from .model_files import read_model
from .network import PolicyNetwork


class LearnedBaseline:
    """Samples from (or acts by the mean of) a trained Gaussian policy; actions are clipped to [-1, 1].

    It decides every ``action_repeat`` control steps and holds its action. The noise comes from each episode's seed. The paper
    acts by the mean; the mean explores badly, so sampling, which is also what was optimised, is the default.

    Args:
        network: the policy.
        control_mode: what its actions mean.
        action_repeat: control steps that each action is held for.
        deterministic: act by the mean.
        noise_correlation: correlation of the noise in one decision with that in the next.
    """

    def __init__(
        self,
        network: PolicyNetwork,
        control_mode: str,
        action_repeat: int = 1,
        deterministic: bool = False,
        noise_correlation: float = 0.0,
    ) -> None:
        self.control_mode = control_mode
        self._network = network.eval().requires_grad_(False)
        self._repeat = action_repeat
        self._deterministic = deterministic
        self._correlation = noise_correlation
        self._noise: NDArray[np.float32] | None = None
        self._generators: list[np.random.Generator] = []
        self._step = 0

    @classmethod
    def load(
        cls, baseline: str, model: Path | None = None, seed: int | None = None, deterministic: bool = False
    ) -> LearnedBaseline:
        """The policy of a learned baseline.

        Args:
            baseline: its id.
            model: directory that ``tslam-bench baselines train`` wrote, or a file of weights; None loads shipped weights.
            seed: of the training whose shipped weights are loaded; None is 0.
            deterministic: act by the mean.

        Raises:
            InvalidInputError: both model and seed, an unfinished or unreadable model, or no weights of this seed; the message
                gives the training command.
        """
        if model is not None and seed is not None:
            raise InvalidInputError(
                f"policy {baseline!r}: training seed {seed} names shipped weights; leave out {model}"
            )
        path = shipped_weights(baseline, seed or 0) if model is None else Path(model)
        try:
            network, acting = read_model(path)
        except InvalidInputError as error:
            remedy = f"train it: tslam-bench baselines train {baseline} --output {path}"
            raise InvalidInputError(
                f"{error}; {remedy if model is not None else 'install the package again'}"
            ) from error
        repeat, correlation = acting["action_repeat"], float(acting["noise_correlation"])
        return cls(network, acting["control_mode"], repeat, deterministic, correlation)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        self._generators = episode_generators(num_envs, seed)
        self._step = 0
        self._noise = None

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        check_observation(observation, len(self._generators))
        if self._step % self._repeat == 0:
            self._held = self._decide(observation)
        self._step += 1
        return self._held.copy()

    def distribution(self, observation: dict[str, torch.Tensor]) -> tuple[NDArray, NDArray]:
        """Means (n, 28) and standard deviations (n, 28) of the policy's actions."""
        encoded = self._network.encode(observation)
        # One at a time: the bits of a batched product depend on the batch, an episode must not.
        rows = [
            torch.cat(self._network.distribution(encoded.rows(slice(row, row + 1)))).numpy()
            for row in range(len(self._generators))
        ]
        mean, log_std = np.stack(rows, axis=1)
        return mean, np.exp(log_std)

    def _decide(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """(n, 28) new actions."""
        with torch.inference_mode():
            tensors = {key: torch.from_numpy(np.ascontiguousarray(value)) for key, value in observation.items()}
            mean, std = self.distribution(tensors)
        if self._deterministic:
            return np.clip(mean, -1, 1)
        noise = np.stack([generator.standard_normal(NUM_JOINTS, dtype=np.float32) for generator in self._generators])
        if self._noise is not None:
            correlation = np.float32(self._correlation)
            noise = correlation * self._noise + np.sqrt(1 - correlation**2) * noise
        self._noise = noise
        return np.clip(mean + std * noise, -1, 1)
