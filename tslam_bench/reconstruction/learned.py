"""Learned reconstructors: networks by name, checkpoint files, and the reconstructor that queries a network."""

from __future__ import annotations

import dataclasses
import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, zoom

from tslam_bench.constants import GRID_SIZE, OCCUPANCY_THRESHOLD
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction import convonet, ifnet, unet
from tslam_bench.reconstruction.inputs import check_grids, empty_volume
from tslam_bench.reconstruction.levels import LOWEST, volume_at_level
from tslam_bench.reconstruction.torch_threads import torch_threads
from tslam_bench.reconstruction.volume import Volume

CHECKPOINT_FORMAT: Final = "tslam-bench reconstruction network, version 1"
NETWORKS: Final[dict[str, dict[str, Any]]] = {
    "ifnet": {"small": ifnet.SMALL, "paper": ifnet.PAPER},
    "convonet": {"small": convonet.SMALL},
    "unet": {"small": unet.SMALL},
}
"""Architectures and their named sizes."""
NETWORK_CLASSES: Final[dict[str, tuple[type, type]]] = {
    "ifnet": (ifnet.IFNet, ifnet.IFNetConfig),
    "convonet": (convonet.ConvONet, convonet.ConvONetConfig),
    "unet": (unet.UNet, unet.UNetConfig),
}
_REMEDY: Final = "train it again with `tslam-bench reconstruct train`"


def network_config(architecture: str, size: str) -> Any:
    """The configuration of a named size. Raises InvalidInputError for an unknown architecture or size."""
    if architecture not in NETWORKS:
        raise InvalidInputError(f"architecture {architecture!r}: unknown; choose one of {', '.join(NETWORKS)}")
    sizes = NETWORKS[architecture]
    if size not in sizes:
        raise InvalidInputError(f"{architecture} size {size!r}: unknown; choose one of {', '.join(sizes)}")
    return sizes[size]


def build_network(architecture: str, config: Any, seed: int = 0) -> torch.nn.Module:
    """A freshly initialised network; the same seed gives the same weights and leaves torch's own generator alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return NETWORK_CLASSES[architecture][0](config)


def _plain(value: Any) -> Any:
    """Tuples as lists, all the way down: the types that a safe checkpoint holds."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def tuples(value: Any) -> Any:
    """Lists as tuples, all the way down: what configurations hold."""
    return tuple(tuples(item) for item in value) if isinstance(value, list) else value


def save_checkpoint(
    path: Path,
    architecture: str,
    network: torch.nn.Module,
    training: dict[str, Any],
    threshold: float | None = OCCUPANCY_THRESHOLD,
    extra: dict[str, Any] | None = None,
) -> None:
    """Writes architecture, configuration, weights and the training record to ``path``, atomically.

    Args:
        path: file to write.
        architecture: name in :data:`NETWORKS`.
        network: the network.
        training: what it was trained on and for how long; numbers, strings, lists and dicts only.
        threshold: probability at which the network's output counts as solid; None: see :class:`LearnedReconstructor`.
        extra: further entries, such as the optimiser's state.
    """
    content = {
        "format": CHECKPOINT_FORMAT,
        "architecture": architecture,
        "config": _plain(dataclasses.asdict(network.config)),  # type: ignore[call-overload]
        "training": _plain(training),
        "threshold": threshold,
        "weights": {name: tensor.detach().clone().contiguous() for name, tensor in network.state_dict().items()},
        **(extra or {}),
    }
    data = io.BytesIO()  # torch's own writing of a file ends in a library error on a full disk
    torch.save(content, data)
    with atomic_file(path) as temporary:
        temporary.write_bytes(data.getbuffer())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, read without executing anything in it.

    Raises:
        InvalidInputError: no such file, or not a checkpoint of this package.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidInputError(f"{path}: no such model; train one with `tslam-bench reconstruct train`")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise InvalidInputError(f"{path}: corrupt, or not a reconstruction model; {_REMEDY}") from error
    if not isinstance(content, dict) or content.get("format") != CHECKPOINT_FORMAT:
        raise InvalidInputError(f"{path}: not a {CHECKPOINT_FORMAT}; {_REMEDY}")
    return content


def load_network(path: Path) -> tuple[str, torch.nn.Module, float | None, dict[str, Any]]:
    """Architecture name, network in evaluation mode, threshold and training record of a checkpoint.

    Raises:
        InvalidInputError: see :func:`read_checkpoint`; also weights that do not fit the configuration.
    """
    content = read_checkpoint(path)
    try:
        architecture = content["architecture"]
        config = NETWORK_CLASSES[architecture][1](**{key: tuples(value) for key, value in content["config"].items()})
        network = build_network(architecture, config)
        network.load_state_dict(content["weights"])
        training = dict(content["training"])
        threshold = content["threshold"]
        if threshold is not None and not 0 < float(threshold) < 1:
            raise ValueError("threshold")
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise InvalidInputError(f"{path}: weights and configuration do not fit together; {_REMEDY}") from error
    return architecture, network.eval(), threshold, training


class LearnedReconstructor:
    """A trained network, queried over W.

    The volume's 0.5 level is the network's ``threshold`` level: the difference of their logits is taken off. (Where a
    network is unsure, the level that gives the best IoU lies below 0.5.)

    The network is evaluated on a coarse lattice first. On each finer one it is evaluated in cells whose parents' 3^3
    neighbourhood leaves the 0.5 level in reach (values between 0.25 and 0.75, or on both sides) or holds a touched
    voxel; the other cells interpolate the coarser values.

    Nothing touched: empty, whatever was visited, since no training example is without a touch and the network's guess
    would be arbitrary.

    Args:
        name: registered name.
        network: network with ``encode`` and ``decode``, in evaluation mode.
        training: its training record, for the reports.
        threshold: probability at which the network's output counts as solid; None: the level of the best expected IoU
            (:mod:`tslam_bench.reconstruction.levels`) of each volume.
        resolutions: cells per axis of the lattices, each twice the one before; the last is the volume's. Default: the
            network's configuration.
        batch_points: query points per pass.
        threads: torch threads.
    """

    def __init__(
        self,
        name: str,
        network: torch.nn.Module,
        training: dict[str, Any] | None = None,
        threshold: float | None = OCCUPANCY_THRESHOLD,
        resolutions: Sequence[int] | None = None,
        batch_points: int = 8192,
        threads: int = 1,
    ) -> None:
        self.name = name
        self.network = network
        self.training = training or {}
        self.threshold = threshold
        config: Any = network.config
        self.resolutions: tuple[int, ...] = tuple(resolutions or config.resolutions)
        self.batch_points = batch_points
        self.threads = threads

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Touched and visited grids (32, 32, 32) bool, object frame -> volume with linear interpolation."""
        touched, visited = check_grids(touched, visited)
        if not touched.any():
            return empty_volume()
        grids = torch.from_numpy(np.stack([touched, visited])[None].astype(np.float32))
        with torch_threads(self.threads), torch.inference_mode():
            features = self.network.encode(grids)  # type: ignore[operator]
            size = self.resolutions[0]
            probability = self._query(features, voxel_centres(size).reshape(-1, 3)).reshape((size,) * 3)
            for size in self.resolutions[1:]:
                wanted = _twice(self._level_in_reach(probability) | maximum_filter(_holds_touch(touched, size // 2), 3))
                probability = zoom(probability, 2, order=1, mode="nearest", grid_mode=True)
                probability[wanted] = self._query(features, voxel_centres(size)[wanted])
        probability = np.clip(probability, 0, 1)
        return Volume(probability, "linear") if self.threshold is not None else volume_at_level(probability)

    def _query(self, features: list[torch.Tensor], points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Probabilities (M,) at points (M, 3), the threshold's at 0.5."""
        batches = torch.from_numpy(points.astype(np.float32)).split(self.batch_points)
        logits = [self.network.decode(features, batch[None])[0] for batch in batches]  # type: ignore[operator]
        if not logits:
            return np.zeros(0, dtype=np.float32)
        offset = 0.0 if self.threshold is None else float(np.log(self.threshold / (1 - self.threshold)))
        return torch.sigmoid(torch.cat(logits) - offset).numpy()

    def _level_in_reach(self, probability: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Cells whose 3^3 neighbourhood has values above half the lowest level that there may be, and values below 0.75."""
        lowest = LOWEST if self.threshold is None else OCCUPANCY_THRESHOLD
        high, low = maximum_filter(probability, 3), minimum_filter(probability, 3)
        return np.asarray((high > lowest / 2) & (low < 1 - OCCUPANCY_THRESHOLD / 2))


def _holds_touch(touched: NDArray[np.bool_], size: int) -> NDArray[np.bool_]:
    """Cells of a size^3 lattice, no finer than the grid, that hold a touched voxel."""
    blocks = GRID_SIZE // size
    return np.asarray(touched.reshape(size, blocks, size, blocks, size, blocks).any(axis=(1, 3, 5)))


def _twice(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Every cell as its 2^3 children."""
    return cells.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
