"""IF-Net: implicit functions in feature space, written from the paper.

Chibane, Alldieck and Pons-Moll, "Implicit Functions in Feature Space for 3D Shape Reconstruction and Completion",
CVPR 2020. Section 3.2: an encoder of 3D convolutions and pooling turns the input grid into feature grids of falling
resolution. Section 3.3: at a query point every grid, the input included, is sampled trilinearly, also at neighbours a
distance ``d`` away along each axis; a point-wise decoder turns the features, and not the point's coordinates, into
occupancy. Section 3.4: cross-entropy over points sampled around the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import nn

from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.feature_sampling import normalization, sample_features

INPUT_CHANNELS: Final = 2
"""Touched and visited. (The paper's input has one channel: occupied.)"""


@dataclass(frozen=True)
class IFNetConfig:
    """Size of an IF-Net. The default is the small one, for CPUs."""

    level_channels: tuple[tuple[int, ...], ...] = ((16,), (32,), (32,), (32,), (32,))
    """Output channels of the 3x3x3 convolutions of each level; each level halves the resolution of the one before."""
    decoder_channels: tuple[int, ...] = (128, 128)
    """Hidden layers of the point-wise decoder."""
    displacement: float = 1.0
    """Distance of the six neighbours from the query point, in input voxels."""
    normalization: Literal["batch", "group"] = "group"
    """Group normalisation works with the small batches of a CPU; the published networks use batch normalisation."""
    resolutions: tuple[int, ...] = (16, 32)
    """Lattices of the reconstruction, from coarse to fine. 64 costs the small network four times as much for no gain in IoU."""


SMALL: Final = IFNetConfig()
PAPER: Final = IFNetConfig(
    level_channels=((32, 64), (128, 128), (128, 128)),
    decoder_channels=(512, 256, 256),
    displacement=0.56,  # 0.035 of the half-edge of the input, which is 16 voxels
    normalization="batch",
    resolutions=(32, 64),
)
"""The published network for 32^3 input."""


class IFNet(nn.Module):
    """Touched and visited grids and query points -> occupancy logits."""

    def __init__(self, config: IFNetConfig = SMALL) -> None:
        super().__init__()
        levels = config.level_channels
        if not levels or not all(levels) or GRID_SIZE % 2 ** (len(levels) - 1):
            raise InvalidInputError(f"level_channels {levels}: give one to six levels of one convolution or more each")
        self.config = config
        self.neighbours: torch.Tensor
        self.levels = nn.ModuleList()
        channels, sampled = INPUT_CHANNELS, INPUT_CHANNELS
        for level, widths in enumerate(levels):
            layers: list[nn.Module] = [nn.MaxPool3d(2)] if level else []
            for width in widths:
                layers += [nn.Conv3d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            layers.append(normalization(config.normalization, channels))
            self.levels.append(nn.Sequential(*layers))
            sampled += channels
        layers = []
        width = 7 * sampled
        for hidden in config.decoder_channels:
            layers += [nn.Conv1d(width, hidden, 1), nn.ReLU()]
            width = hidden
        layers.append(nn.Conv1d(width, 1, 1))
        self.decoder = nn.Sequential(*layers)
        steps = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])
        self.register_buffer("neighbours", config.displacement * VOXEL_EDGE * steps, persistent=False)
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def encode(self, grids: torch.Tensor) -> list[torch.Tensor]:
        """Input (B, 2, 32, 32, 32) of 0 and 1 -> the input and one feature grid (B, C, N, N, N) per level."""
        features = [grids.contiguous(memory_format=torch.channels_last_3d)]
        for level in self.levels:
            features.append(level(features[-1]))
        return features

    def decode(self, features: list[torch.Tensor], points: torch.Tensor) -> torch.Tensor:
        """Occupancy logits (B, P) at ``points`` (B, P, 3), metres in W."""
        batch, count, _ = points.shape
        around = (points[:, None] + self.neighbours[:, None]).reshape(batch, 7 * count, 3)
        sampled = [sample_features(grid, around).reshape(batch, -1, count) for grid in features]  # (B, 7 C, P) each
        stacked = torch.cat(sampled, dim=1)
        return self.decoder(stacked).squeeze(1)

    def forward(self, grids: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Logits (B, P) of occupancy at ``points`` (B, P, 3) for ``grids`` (B, 2, 32, 32, 32)."""
        return self.decode(self.encode(grids), points)
