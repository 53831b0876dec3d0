"""The policy network of protocol section 11: six 3D convolutions on the grids, joined by the joint angles, then an MLP.

Full-resolution 3D convolutions cost tens of milliseconds per sample on a CPU (87 ms forward and backward for 8
channels), so the first layer strides: by 4 in ``small`` (0.5 ms) and by 2 in ``paper`` (3.4 ms).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from tslam_bench.errors import InvalidInputError

GRID_KEY: Final = "occupancy"
"""The observation entry that goes through the convolutions; all others are concatenated behind them."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the policy network.

    Attributes:
        channels: output channels of the six convolutions.
        kernels: kernel edge of each, in voxels of its input.
        strides: stride of each.
        hidden: width of the MLP's hidden layers, for the policy and again for the value; with its output layer the MLP
            has four layers.
        log_std: initial log standard deviation of the Gaussian policy.
    """

    channels: tuple[int, ...]
    kernels: tuple[int, ...]
    strides: tuple[int, ...]
    hidden: tuple[int, ...]
    log_std: float = -0.5

    def __post_init__(self) -> None:
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise InvalidInputError("network: channels, kernels and strides must have one entry per convolution")


NETWORKS: Final[dict[str, NetworkConfig]] = {
    "small": NetworkConfig((8, 8, 16, 16, 32, 32), (4, 3, 3, 3, 3, 3), (4, 1, 2, 1, 2, 1), (128, 128, 128)),
    "paper": NetworkConfig((8, 8, 16, 16, 32, 32), (3, 3, 3, 3, 3, 3), (2, 1, 2, 1, 2, 1), (256, 256, 256)),
}
"""``small``: for trials on a laptop; ``paper``: for full budgets."""


class GridAndJointsExtractor(BaseFeaturesExtractor):
    """Six 3D convolutions on the grids, concatenated with every other entry of the observation.

    Entries are brought to the order of 1: joint positions by their limits to [-1, 1], joint velocities by
    ``velocity_scale``.

    Args:
        observation_space: dict with ``occupancy`` (2, 32, 32, 32) and flat entries of shape (k,).
        channels, kernels, strides: see :class:`NetworkConfig`.
        joint_limits: (28, 2) lower and upper limits of ``qpos`` (rad or m).
        velocity_scale: velocities are divided by it (rad/s or m/s).
    """

    joint_middle: Tensor
    joint_half_range: Tensor

    def __init__(
        self,
        observation_space: spaces.Dict,
        channels: tuple[int, ...],
        kernels: tuple[int, ...],
        strides: tuple[int, ...],
        joint_limits: tuple[tuple[float, float], ...],
        velocity_scale: float = 5.0,
    ) -> None:
        if GRID_KEY not in observation_space.spaces:
            raise InvalidInputError(f"observation space: has no {GRID_KEY!r}; use obs_mode='state_dict'")
        grid_shape = observation_space[GRID_KEY].shape
        assert grid_shape is not None
        layers: list[nn.Module] = []
        width = grid_shape[0]
        for out, kernel, stride in zip(channels, kernels, strides, strict=True):
            padding = (kernel - 1) // 2 if kernel % 2 else 0
            convolution = nn.Conv3d(width, out, kernel, stride, padding)
            # stable-baselines3 leaves 3D convolutions at torch's default, whose gain below 1 lets a sparse grid fade
            # to nothing over six layers.
            nn.init.orthogonal_(convolution.weight, 2**0.5)
            nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
            layers += [convolution, nn.ReLU()]
            width = out
        convolutions = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            grid_features = convolutions(torch.zeros(1, *grid_shape)).shape[1]
        flat_keys = [key for key in sorted(observation_space.spaces) if key != GRID_KEY]
        flat_features = sum(int(np.prod(observation_space[key].shape or ())) for key in flat_keys)
        super().__init__(observation_space, grid_features + flat_features)
        self.convolutions = convolutions
        self.flat_keys = flat_keys
        self.velocity_scale = velocity_scale
        limits = torch.as_tensor(np.asarray(joint_limits, dtype=np.float32))
        self.register_buffer("joint_middle", limits.mean(dim=1))
        self.register_buffer("joint_half_range", (limits[:, 1] - limits[:, 0]) / 2)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Entries of shape (n, ...), grids as bytes or floats -> (n, features)."""
        parts = [self.convolutions(observations[GRID_KEY].float())]
        for key in self.flat_keys:
            value = observations[key].float()
            if key == "qpos":
                value = (value - self.joint_middle) / self.joint_half_range
            elif key == "qvel":
                value = value / self.velocity_scale
            parts.append(value.flatten(start_dim=1))
        return torch.cat(parts, dim=1)


def policy_arguments(network: NetworkConfig, joint_limits: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    """``policy_kwargs`` for ``MultiInputPolicy``: the extractor, a 4-layer MLP each for policy and value, Adam."""
    return {
        "features_extractor_class": GridAndJointsExtractor,
        "features_extractor_kwargs": {
            "channels": network.channels,
            "kernels": network.kernels,
            "strides": network.strides,
            "joint_limits": joint_limits,
        },
        "net_arch": {"pi": list(network.hidden), "vf": list(network.hidden)},
        "activation_fn": nn.ReLU,
        "log_std_init": network.log_std,
        "optimizer_class": torch.optim.Adam,
    }
