"""Weights that are shipped: networks in half precision with the record of their training, in one safetensors file.

The file is the thing of record: whoever loads it computes with its half-precision numbers, in single precision.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import atomic_file
from tslam_bench.reconstruction.learned import NETWORK_CLASSES, build_network, load_network, tuples

WEIGHTS_FORMAT: Final = "tslam-bench reconstruction weights, version 1"
SUFFIX: Final = ".safetensors"


@dataclass(frozen=True, eq=False)
class Weights:
    """What a file of weights holds.

    Attributes:
        architecture: of all networks.
        networks: in evaluation mode.
        training: their training records.
        settings: of the reconstructor: threshold of networks for points, views and temperature of dense ones.
    """

    architecture: str
    networks: list[torch.nn.Module]
    training: list[dict[str, Any]]
    settings: dict[str, Any]


def save_weights(path: Path, checkpoints: Sequence[Path], settings: dict[str, Any]) -> None:
    """Writes the networks of trained checkpoints into one file, atomically.

    Raises:
        InvalidInputError: no checkpoint, one that cannot be read, or checkpoints of different architectures.
    """
    loaded = [load_network(checkpoint) for checkpoint in checkpoints]
    architectures = {architecture for architecture, *_ in loaded}
    if len(architectures) != 1:
        raise InvalidInputError(
            f"checkpoints: of {len(architectures)} architectures; give one or more of one architecture"
        )
    tensors, members = {}, []
    for index, (_, network, threshold, training) in enumerate(loaded):
        for name, tensor in network.state_dict().items():
            tensors[f"{index}.{name}"] = tensor.detach().to(torch.float16).contiguous()
        config = dataclasses.asdict(network.config)  # type: ignore[call-overload]
        training = {**training, "objects": len(training.get("objects", ()))}
        members.append({"config": config, "training": training, "threshold": threshold})
    (architecture,) = architectures
    content = {"format": WEIGHTS_FORMAT, "architecture": architecture, "members": members, "settings": settings}
    with atomic_file(path) as temporary:
        save_file(tensors, str(temporary), {"tslam_bench": json.dumps(content, sort_keys=True)})


def read_weights(path: Path) -> Weights:
    """Reads what :func:`save_weights` wrote; nothing in the file is executed.

    Raises:
        InvalidInputError: missing, damaged, or not such a file.
    """
    if not path.is_file():
        raise InvalidInputError(f"{path}: no such file of weights")
    try:
        with safe_open(str(path), "pt") as file:
            content = json.loads((file.metadata() or {})["tslam_bench"])
            if content["format"] != WEIGHTS_FORMAT:
                raise ValueError(content["format"])
            networks = []
            for index, member in enumerate(content["members"]):
                config = NETWORK_CLASSES[content["architecture"]][1](
                    **{key: tuples(value) for key, value in member["config"].items()}
                )
                network = build_network(content["architecture"], config)
                prefix = f"{index}."
                state = {k[len(prefix) :]: file.get_tensor(k).float() for k in file.keys() if k.startswith(prefix)}  # noqa: SIM118
                network.load_state_dict(state)
                networks.append(network.eval())
        training = [dict(member["training"]) for member in content["members"]]
        settings = {"threshold": content["members"][0]["threshold"], **content["settings"]}
        if not networks:
            raise ValueError("no network")
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise InvalidInputError(
            f"{path}: damaged, or no weights of a reconstructor; fetch or export it again"
        ) from error
    return Weights(content["architecture"], networks, training, settings)
