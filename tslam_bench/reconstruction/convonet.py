"""A small convolutional occupancy network: a 3D U-Net makes one feature grid, a point-wise decoder reads it.

After Peng, Niemeyer, Mescheder, Pollefeys and Geiger, "Convolutional Occupancy Networks", ECCV 2020, volume encoding
(section 3): here the input is a grid already, so there is no point encoder.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import torch
import torch.nn.functional as functional
from torch import nn

from tslam_bench.constants import GRID_SIZE
from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.feature_sampling import normalization, sample_features

INPUT_CHANNELS: Final = 2


@dataclass(frozen=True)
class ConvONetConfig:
    """Size of a convolutional occupancy network. The default is the small one, for CPUs."""

    level_channels: tuple[int, ...] = (16, 32, 64, 64, 64)
    """Channels at 32^3, 16^3, ... down to the U-Net's bottom."""
    decoder_channels: tuple[int, ...] = (64, 64)
    """Hidden layers of the point-wise decoder."""
    normalization: Literal["batch", "group"] = "group"
    """Normalisation after each convolution."""
    resolutions: tuple[int, ...] = (32, 64)
    """Lattices of the reconstruction, from coarse to fine."""


SMALL: Final = ConvONetConfig()


def _convolution(inputs: int, outputs: int, kind: str) -> nn.Module:
    return nn.Sequential(nn.Conv3d(inputs, outputs, 3, padding=1), nn.ReLU(), normalization(kind, outputs))


class ConvONet(nn.Module):
    """Touched and visited grids and query points -> occupancy logits."""

    def __init__(self, config: ConvONetConfig = SMALL) -> None:
        super().__init__()
        widths = config.level_channels
        if not widths or GRID_SIZE % 2 ** (len(widths) - 1):
            raise InvalidInputError(f"level_channels {widths}: give one to six levels")
        self.config = config
        kind = config.normalization
        self.down = nn.ModuleList(
            [_convolution(a, b, kind) for a, b in zip((INPUT_CHANNELS, *widths), widths, strict=False)]
        )
        upwards = zip(widths[:0:-1], widths[-2::-1], strict=True)
        self.up = nn.ModuleList([_convolution(a + b, b, kind) for a, b in upwards])
        layers: list[nn.Module] = []
        width = widths[0] + INPUT_CHANNELS
        for hidden in config.decoder_channels:
            layers += [nn.Conv1d(width, hidden, 1), nn.ReLU()]
            width = hidden
        layers.append(nn.Conv1d(width, 1, 1))
        self.decoder = nn.Sequential(*layers)
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def encode(self, grids: torch.Tensor) -> list[torch.Tensor]:
        """Input (B, 2, 32, 32, 32) of 0 and 1 -> the input and the U-Net's feature grid (B, C, 32, 32, 32)."""
        grids = grids.contiguous(memory_format=torch.channels_last_3d)
        skips = [self.down[0](grids)]
        for level in self.down[1:]:
            skips.append(level(functional.max_pool3d(skips[-1], 2)))
        features = skips.pop()
        for level in self.up:
            features = functional.interpolate(features, scale_factor=2, mode="nearest")
            features = level(torch.cat([features, skips.pop()], dim=1))
        return [grids, features]

    def decode(self, features: list[torch.Tensor], points: torch.Tensor) -> torch.Tensor:
        """Occupancy logits (B, P) at ``points`` (B, P, 3), metres in W."""
        return self.decoder(torch.cat([sample_features(grid, points) for grid in features], dim=1)).squeeze(1)

    def forward(self, grids: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Logits (B, P) of occupancy at ``points`` (B, P, 3) for ``grids`` (B, 2, 32, 32, 32)."""
        return self.decode(self.encode(grids), points)
