"""``unet``: a dense network whose output is finer than its input.

Touched and visited, 32^3, are folded into 16^3 cells of 2^3 voxels each; a U-Net with residual blocks (after Ronneberger,
Fischer and Brox, MICCAI 2015, and He et al., CVPR 2016) works on these; each cell's features give the occupancy of its 4^3
parts, so that the output has 64^3 cells. Folding makes it fast on a CPU: there is no convolution at full resolution. The place
in the workspace is an input too, since objects are centred in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as functional
from torch import nn

from tslam_bench.constants import GRID_SIZE
from tslam_bench.errors import InvalidInputError

FOLD: Final = 2
"""Voxels per axis of one cell."""
CELLS: Final = GRID_SIZE // FOLD
INPUT_CHANNELS: Final = 2 * FOLD**3 + 3
"""Touched and visited of each of a cell's voxels, and the cell's place."""

_EMPTY_LOGIT: Final = -3.0
"""Where the untrained output begins: most of W is empty."""


@dataclass(frozen=True)
class UNetConfig:
    """Size of the network."""

    level_channels: tuple[int, ...] = (64, 96, 128)
    """Channels at 16^3, 8^3 and 4^3 cells; multiples of 8."""
    resolution: int = 64
    """Cells per axis of the output; a multiple of 16."""


SMALL: Final = UNetConfig()


class _Block(nn.Module):
    """Two 3x3x3 convolutions, each after normalisation and activation, and a shortcut."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.shortcut = nn.Conv3d(inputs, outputs, 1, bias=False) if inputs != outputs else nn.Identity()
        self.first = nn.Sequential(
            nn.GroupNorm(8, inputs), nn.SiLU(), nn.Conv3d(inputs, outputs, 3, padding=1, bias=False)
        )
        self.second = nn.Sequential(
            nn.GroupNorm(8, outputs), nn.SiLU(), nn.Conv3d(outputs, outputs, 3, padding=1, bias=False)
        )

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.shortcut(features) + self.second(self.first(features))


class UNet(nn.Module):
    """Touched and visited grids -> occupancy logits of all cells."""

    place: torch.Tensor

    def __init__(self, config: UNetConfig = SMALL) -> None:
        super().__init__()
        widths = config.level_channels
        if not 1 <= len(widths) <= 5 or any(width < 8 or width % 8 for width in widths):
            raise InvalidInputError(f"level_channels {widths}: give one to five multiples of 8")
        if config.resolution < CELLS or config.resolution % CELLS:
            raise InvalidInputError(f"resolution {config.resolution}: give a multiple of {CELLS}")
        self.config = config
        self.parts = config.resolution // CELLS
        self.enter = nn.Conv3d(INPUT_CHANNELS, widths[0], 3, padding=1)
        self.down = nn.ModuleList([_Block(a, b) for a, b in zip((widths[0], *widths), widths, strict=False)])
        self.up = nn.ModuleList([_Block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True)])
        self.leave = nn.Sequential(nn.GroupNorm(8, widths[0]), nn.SiLU(), nn.Conv3d(widths[0], self.parts**3, 1))
        last = self.leave[-1]
        assert isinstance(last, nn.Conv3d) and last.bias is not None
        nn.init.constant_(last.bias, _EMPTY_LOGIT)
        axis = (torch.arange(CELLS) + 0.5) * (2 / CELLS) - 1
        self.register_buffer(
            "place", torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"))[None], persistent=False
        )
        self.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def forward(self, grids: torch.Tensor) -> torch.Tensor:
        """Touched and visited (B, 2, 32, 32, 32) of 0 and 1 -> logits (B, R, R, R)."""
        count = len(grids)
        folded = grids.reshape(count, 2, CELLS, FOLD, CELLS, FOLD, CELLS, FOLD)
        folded = folded.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(count, 2 * FOLD**3, CELLS, CELLS, CELLS)
        features = torch.cat([folded, self.place.expand(count, -1, -1, -1, -1)], dim=1)
        features = self.enter(features.contiguous(memory_format=torch.channels_last_3d))
        skips = []
        for level, block in enumerate(self.down):
            features = block(functional.max_pool3d(features, 2) if level else features)
            skips.append(features)
        features = skips.pop()
        for block in self.up:
            features = functional.interpolate(features, scale_factor=2, mode="nearest")
            features = block(torch.cat([features, skips.pop()], dim=1))
        parts = self.parts
        logits = self.leave(features).reshape(count, parts, parts, parts, CELLS, CELLS, CELLS)
        return logits.permute(0, 4, 1, 5, 2, 6, 3).reshape(count, *(self.config.resolution,) * 3)
