"""Trilinear sampling of feature grids over W, in the benchmark's frame and index order."""

from __future__ import annotations

import torch
import torch.nn.functional as functional

from tslam_bench.constants import WORKSPACE_EDGE


def sample_features(grid: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Samples feature grids at points, trilinear between cell centres, constant beyond the outermost ones.

    ``grid_sample`` is told ``align_corners=False``: -1 and 1 are then the faces of W rather than the outermost centres,
    so that grids of every resolution share one coordinate. It reads a point as (last, middle, first) grid axis, hence
    the flip.

    Args:
        grid: (B, C, N, N, N) features of N^3 equal cells of W, index ``[ix, iy, iz]``.
        points: (B, P, 3) metres.

    Returns:
        (B, C, P).
    """
    coordinates = (points * (2 / WORKSPACE_EDGE)).flip(-1)[:, :, None, None, :]
    sampled = functional.grid_sample(grid, coordinates, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled[:, :, :, 0, 0]


def normalization(kind: str, channels: int) -> torch.nn.Module:
    """``"batch"`` normalisation, or ``"group"`` with groups of 8 channels, which does not depend on the batch."""
    if kind == "batch":
        return torch.nn.BatchNorm3d(channels)
    return torch.nn.GroupNorm(max(1, channels // 8), channels)
