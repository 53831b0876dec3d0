"""Policy networks (protocol section 11): convolutions on the two grids, joined by joints, touch and time, then an MLP.

Two are registered in :data:`NETWORKS`. ``paper`` has the published shape: six 3D convolutions, then four linear layers.
``fast`` is what a CPU trains: the grids are counted in blocks of 2^3 voxels, and three convolutions whose kernels do not
overlap (kernel 2, stride 2) are plain matrix products, because the blocks are stored patch by patch.

Every network first *encodes* observations into what a rollout buffer keeps, 8 KB of bytes for both grids, and computes
policy and value from that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from tslam_bench.constants import GRID_SIZE, NUM_JOINTS, VOXEL_EDGE
from tslam_bench.hand_constants import JOINT_LIMITS, SKIN_LINKS

GRIDS: Final = 2
"""Touched and visited."""
FLAT_SIZE: Final = 2 * NUM_JOINTS + 1 + len(SKIN_LINKS)
"""Numbers beside the grids: joint positions and velocities, time, touch."""
VELOCITY_SCALE: Final = 5.0
"""Joint velocities (rad/s or m/s) are divided by it, which brings them to the order of 1."""
COUNT_SCALE: Final = 0.25
"""Factor on the number of voxels (0 to 8) that are set in a block."""


LOG_STD_RANGE: Final = (-4.0, 1.0)
"""Logarithms of standard deviations are kept within."""


@dataclass(frozen=True, eq=False)
class Encoded:
    """Observations as a rollout buffer keeps them.

    Attributes:
        grid: (n, 8192 or more) uint8, both grids.
        flat: (n, FLAT_SIZE or more) float32, of the order of 1.
    """

    grid: Tensor
    flat: Tensor

    def rows(self, index: Tensor | slice) -> Encoded:
        """Some of the observations."""
        return Encoded(self.grid[index], self.flat[index])


class PatchTrunk(nn.Module):
    """Three convolutions with kernel 2 and stride 2 on the grids, counted in 16^3 blocks, as matrix products.

    A block's place on an axis is four bits, the highest saying in which half it lies. The blocks are stored by (x, y, z)'s
    highest bits first, then by the next ones, and so on: the eight blocks under a kernel lie side by side, and so do the
    eight outputs that the next layer's kernel covers.

    Args:
        channels: outputs of the three layers.
    """

    _order: Tensor

    def __init__(self, channels: tuple[int, int, int] = (8, 32, 32)) -> None:
        super().__init__()
        self.out_features = 8 * channels[2]
        self._widths = (8 * GRIDS, 8 * channels[0], 8 * channels[1])
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip(self._widths, channels, strict=True))
        self.register_buffer("_order", _patch_order(), persistent=False)

    def encode(self, occupancy: Tensor, qpos: Tensor) -> Tensor:
        """(n, 2, 32, 32, 32) uint8 -> (n, 8192) uint8, voxels set in each block, patch by patch."""
        pairs = occupancy[:, :, 0::2] + occupancy[:, :, 1::2]
        pairs = (pairs[:, :, :, 0::2] + pairs[:, :, :, 1::2]).view(torch.int16)  # two neighbours along z per number
        counts = (pairs + (pairs >> 8)).to(torch.uint8).flatten(1)
        return torch.gather(counts, 1, self._order.expand(len(counts), -1))

    def forward(self, grid: Tensor) -> Tensor:
        """(n, 8192) uint8 -> (n, out_features)."""
        features = grid.float().mul_(COUNT_SCALE)
        for layer, width in zip(self.layers, self._widths, strict=True):
            features = layer(features.view(-1, width)).relu_()
        return features.view(len(grid), -1)


class HandTrunk(nn.Module):
    """Two :class:`PatchTrunk`: on the grids as they are, and on the grids moved so that the palm is in their middle.

    What lies left of the index finger is then always in the same place, wherever the hand is. Turns are not undone.
    """

    def __init__(self) -> None:
        super().__init__()
        self.world, self.hand = PatchTrunk(), PatchTrunk()
        self.out_features = self.world.out_features + self.hand.out_features

    def encode(self, occupancy: Tensor, qpos: Tensor) -> Tensor:
        """(n, 2, 32, 32, 32) uint8 and (n, 28) m and rad -> (n, 16384) uint8."""
        grids = (self.world.encode(occupancy, qpos), self.hand.encode(around_hand(occupancy, qpos), qpos))
        return torch.cat(grids, dim=1)

    def forward(self, grid: Tensor) -> Tensor:
        """(n, 16384) uint8 -> (n, out_features)."""
        world, hand = grid.chunk(2, dim=1)
        return torch.cat([self.world(world.contiguous()), self.hand(hand.contiguous())], dim=1)


def around_hand(occupancy: Tensor, qpos: Tensor) -> Tensor:
    """Grids (n, 2, 32, 32, 32) moved by whole voxels so that their middle is where the arm (n, 28) has the palm; else 0."""
    arm = qpos[:, :3].float() / VOXEL_EDGE
    moves = torch.stack([-arm[:, 0], arm[:, 2], arm[:, 1]], dim=1).round().long().clamp(-GRID_SIZE, GRID_SIZE)
    moved = torch.zeros_like(occupancy)
    for source, target, move in zip(occupancy, moved, moves.tolist(), strict=True):
        x, y, z = (slice(max(0, by), GRID_SIZE + min(0, by)) for by in move)
        u, v, w = (slice(max(0, -by), GRID_SIZE + min(0, -by)) for by in move)
        target[:, u, v, w] = source[:, x, y, z]
    return moved


class ConvolutionTrunk(nn.Module):
    """3D convolutions on the full grids.

    Args:
        channels: outputs of each convolution.
        kernels: edge of each kernel, in voxels of its input.
        strides: stride of each.
    """

    _bit: Tensor

    def __init__(
        self,
        channels: tuple[int, ...] = (8, 8, 16, 16, 32, 32),
        kernels: tuple[int, ...] = (3, 3, 3, 3, 3, 3),
        strides: tuple[int, ...] = (2, 1, 2, 1, 2, 1),
    ) -> None:
        super().__init__()
        inputs = (GRIDS, *channels)
        self.layers = nn.ModuleList(
            nn.Conv3d(i, o, kernel, stride, (kernel - 1) // 2)
            for i, o, kernel, stride in zip(inputs, channels, kernels, strides, strict=False)
        )
        self.register_buffer("_bit", torch.arange(8, dtype=torch.uint8), persistent=False)
        with torch.no_grad():
            self.out_features = self.convolve(torch.zeros(1, GRIDS, *(GRID_SIZE,) * 3)).shape[1]

    def encode(self, occupancy: Tensor, qpos: Tensor) -> Tensor:
        """(n, 2, 32, 32, 32) uint8 -> (n, 8192) uint8, eight voxels along z in a byte."""
        bits = occupancy.flatten(1).view(len(occupancy), -1, 8) << self._bit
        return bits.sum(2, dtype=torch.uint8)

    def forward(self, grid: Tensor) -> Tensor:
        """(n, 8192) uint8 -> (n, out_features)."""
        voxels = (grid[:, :, None] >> self._bit) & 1
        return self.convolve(voxels.view(-1, GRIDS, *(GRID_SIZE,) * 3).float())

    def convolve(self, voxels: Tensor) -> Tensor:
        """(n, 2, 32, 32, 32) float32 -> (n, out_features)."""
        for layer in self.layers:
            voxels = layer(voxels).relu_()
        return voxels.flatten(1)


class PolicyNetwork(nn.Module):
    """A Gaussian policy and a value: one trunk for the grids, then an MLP each.

    Args:
        trunk: features of the grids.
        hidden: widths of each MLP's hidden layers.
        initial_std: standard deviation of the untrained policy, one for all joints or (28,).
        generator: draws the weights; None leaves torch's own.
        state_std: the standard deviations depend on the observation, not on the joint alone.
        clock: so many sine and cosine pairs of the time are inputs too; they turn once, twice, 4, 8, ... times per episode.
        initial_mean: mean action of the untrained policy, one for all joints or (28,).
    """

    _middle: Tensor
    _half_range: Tensor
    _turns: Tensor

    def __init__(
        self,
        trunk: PatchTrunk | HandTrunk | ConvolutionTrunk,
        hidden: tuple[int, ...],
        initial_std: float | Sequence[float] = 0.6,
        generator: torch.Generator | None = None,
        state_std: bool = False,
        clock: int = 0,
        initial_mean: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__()
        self.trunk = trunk
        features = trunk.out_features + FLAT_SIZE + 2 * clock
        self.policy = _mlp(features, hidden, NUM_JOINTS * (2 if state_std else 1))
        self.value = _mlp(features, hidden, 1)
        self.register_buffer("_turns", 2 * torch.pi * 2.0 ** torch.arange(clock), persistent=False)
        self.log_std = nn.Parameter(torch.tensor(initial_std).log() + torch.zeros(NUM_JOINTS))
        limits = torch.as_tensor(np.asarray(JOINT_LIMITS, dtype=np.float32))
        self.register_buffer("_middle", limits.mean(dim=1), persistent=False)
        self.register_buffer("_half_range", (limits[:, 1] - limits[:, 0]) / 2, persistent=False)
        if generator is not None:
            self._initialise(generator)
        output = self.policy[-1]
        assert isinstance(output, nn.Linear)
        with torch.no_grad():
            output.bias[:NUM_JOINTS] += torch.tensor(initial_mean)

    def _initialise(self, generator: torch.Generator) -> None:
        """Orthogonal weights. With torch's default a few touched voxels are lost on their way through six layers."""
        layers = [module for module in self.modules() if isinstance(module, nn.Linear | nn.Conv3d)]
        for layer in layers:
            gain = 0.01 if layer is self.policy[-1] else 1.0 if layer is self.value[-1] else 2**0.5
            nn.init.orthogonal_(layer.weight, gain, generator=generator)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def encode(self, observation: Mapping[str, Tensor]) -> Encoded:
        """Entries of protocol section 6, each (n, ...) -> what the other methods take."""
        with torch.no_grad():
            angles = observation["time"].float() * self._turns
            parts = (
                (observation["qpos"].float() - self._middle) / self._half_range,
                observation["qvel"].float() / VELOCITY_SCALE,
                observation["time"].float(),
                observation["touch"].float(),
                angles.sin(),
                angles.cos(),
            )
            return Encoded(self.trunk.encode(observation["occupancy"], observation["qpos"]), torch.cat(parts, dim=1))

    def forward(self, inputs: Encoded) -> tuple[Tensor, Tensor, Tensor]:
        """Means (n, 28) and logarithms of standard deviations (n, 28) of actions, and values (n,)."""
        features = self._features(inputs)
        return *self._distribution(features), self.value(features)[:, 0]

    def distribution(self, inputs: Encoded) -> tuple[Tensor, Tensor]:
        """Means (n, 28) and logarithms of standard deviations (n, 28) of actions."""
        return self._distribution(self._features(inputs))

    def _distribution(self, features: Tensor) -> tuple[Tensor, Tensor]:
        mean, *change = self.policy(features).split(NUM_JOINTS, dim=1)
        log_std = self.log_std.expand_as(mean) if not change else self.log_std + change[0]
        return mean, log_std.clamp(*LOG_STD_RANGE)

    def _features(self, inputs: Encoded) -> Tensor:
        return torch.cat([self.trunk(inputs.grid), inputs.flat], dim=1)


def _mlp(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU(inplace=True)]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def _patch_order() -> Tensor:
    """(8192,) where in a (2, 16, 16, 16) array each number lies that :class:`PatchTrunk` stores."""
    bits = torch.arange(GRIDS * 16**3).view(GRIDS, *(2,) * 12)  # grid, x's four bits, y's, z's
    return bits.permute(1, 5, 9, 2, 6, 10, 3, 7, 11, 4, 8, 12, 0).flatten()


NETWORKS: Final[dict[str, Callable[..., PolicyNetwork]]] = {
    "fast": lambda *arguments: PolicyNetwork(PatchTrunk(), (256, 256), *arguments),
    "hand": lambda *arguments: PolicyNetwork(HandTrunk(), (256, 256), *arguments),
    "paper": lambda *arguments: PolicyNetwork(ConvolutionTrunk(), (256, 256, 256), *arguments),
}
"""Id -> makes the network from :class:`PolicyNetwork`'s arguments after ``hidden``."""
