"""Learned explorers: a trained PPO policy behind the interface of every baseline."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import MultiInputActorCriticPolicy

from tslam_bench.baselines.interface import check_observation, episode_generators
from tslam_bench.baselines.network import NETWORKS, policy_arguments
from tslam_bench.baselines.registry import BaselineSpec
from tslam_bench.baselines.training_config import METADATA_FILE, MODEL_FILE
from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import CONTROL_MODES, JOINT_LIMITS


def build_policy(metadata: Mapping[str, Any]) -> MultiInputActorCriticPolicy:
    """An untrained policy of the sizes that a model's metadata states."""
    entries: dict[str, spaces.Space] = {
        key: spaces.Box(-np.inf, np.inf, tuple(shape), np.float32) for key, shape in metadata["observations"].items()
    }
    limits = tuple((float(low), float(high)) for low, high in JOINT_LIMITS)
    return MultiInputActorCriticPolicy(
        spaces.Dict(entries),
        spaces.Box(-1, 1, (NUM_JOINTS,), np.float32),
        lr_schedule=lambda _: 0.0,
        **policy_arguments(NETWORKS[metadata["config"]["network"]], limits),
    )


def read_policy(directory: Path) -> MultiInputActorCriticPolicy:
    """The policy in a finished model's directory. Reads its weights only: a stranger's model cannot run code."""
    policy = build_policy(json.loads((directory / METADATA_FILE).read_text(encoding="utf-8")))
    with zipfile.ZipFile(directory / MODEL_FILE) as archive:
        weights = torch.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
    policy.load_state_dict(weights)
    return policy


class LearnedBaseline:
    """Samples from (or acts by the mean of) a trained Gaussian policy; actions are clipped to [-1, 1].

    The noise comes from each episode's seed. The paper acts by the mean; early in training the mean is close to
    standing still, so sampling, which is also what was optimised, is the default.
    """

    control_mode = CONTROL_MODES[0]

    def __init__(self, policy: MultiInputActorCriticPolicy, deterministic: bool = False) -> None:
        self._policy = policy
        self._policy.set_training_mode(False)
        self._deterministic = deterministic
        self._generators: list[np.random.Generator] = []
        self._noise = np.zeros((0, HORIZON, NUM_JOINTS), dtype=np.float32)
        self._step = 0
        self._deviation = np.exp(self._policy.log_std.detach().numpy())

    @classmethod
    def load(cls, spec: BaselineSpec, directory: Path | None, deterministic: bool = False) -> LearnedBaseline:
        """Loads the model that ``tslam-bench baselines train`` wrote to ``directory``.

        Raises:
            InvalidInputError: no directory, an unfinished or unreadable model; the message gives the training command.
        """
        command = f"tslam-bench baselines train {spec.id} --output {directory or 'DIRECTORY'}"
        if directory is None:
            raise InvalidInputError(
                f"baseline {spec.id!r}: needs a trained model; pass its directory, or train one: {command}"
            )
        directory = Path(directory)
        if not (directory / METADATA_FILE).is_file() or not (directory / MODEL_FILE).is_file():
            raise InvalidInputError(f"{directory}: holds no finished model of {spec.id!r}; train it: {command}")
        try:
            policy = read_policy(directory)
        except Exception as error:  # damaged files fail in json, zipfile, pickle or torch
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InvalidInputError(
                f"{directory / MODEL_FILE}: cannot be read ({reason}); train it again: {command}"
            ) from error
        return cls(policy, deterministic)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        self._generators = episode_generators(num_envs, seed)
        self._draw()

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.baselines.interface.Baseline`."""
        check_observation(observation, len(self._generators))
        with torch.inference_mode():
            # One at a time: the bits of a batched product depend on the batch, an episode must not.
            rows = [self._mean_action(observation, row) for row in range(len(self._generators))]
            actions = np.concatenate(rows)
        if not self._deterministic:
            if self._step == HORIZON:
                self._draw()
            actions = actions + self._deviation * self._noise[:, self._step]
            self._step += 1
        return np.clip(actions, -1, 1).astype(np.float32)

    def _mean_action(self, observation: Mapping[str, NDArray], row: int) -> NDArray[np.float32]:
        """(1, 28) mean of the policy for one episode's observation."""
        tensors = {key: torch.from_numpy(np.ascontiguousarray(observation[key][row : row + 1])) for key in self._keys}
        features = self._policy.pi_features_extractor(tensors)
        return self._policy.action_net(self._policy.mlp_extractor.forward_actor(features)).numpy()

    @property
    def _keys(self) -> list[str]:
        space = self._policy.observation_space
        assert isinstance(space, spaces.Dict)
        return list(space.spaces)

    def _draw(self) -> None:
        blocks = [generator.standard_normal((HORIZON, NUM_JOINTS)) for generator in self._generators]
        self._noise = np.stack(blocks).astype(np.float32)
        self._step = 0
