"""Trained models on disk: a directory with ``model.safetensors`` (the weights) and ``model.json`` (everything else).

Neither file can carry code. ``model.json`` holds the recipe (``config``), the budget (``steps``, ``seconds``), machine, versions
and command.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.policies import METADATA_FILE, MODEL_FILE
from tslam_bench.files import atomic_file, write_json

from .network import NETWORKS, PolicyNetwork


def make_network(
    name: str,
    initial_std: float | Sequence[float] = 0.6,
    seed: int | None = None,
    state_std: bool = False,
    clock: int = 0,
    initial_mean: float | Sequence[float] = 0.0,
) -> PolicyNetwork:
    """A registered network; its weights are drawn from ``seed``.

    Raises:
        InvalidInputError: unknown name.
    """
    if name not in NETWORKS:
        raise InvalidInputError(f"network {name!r}: unknown; choose one of {', '.join(NETWORKS)}")
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return NETWORKS[name](initial_std, generator, state_std, clock, initial_mean)


def write_model(directory: Path, network: PolicyNetwork, metadata: Mapping[str, Any]) -> None:
    """Writes a finished model; ``model.json`` comes last."""
    weights = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    with atomic_file(directory / MODEL_FILE) as temporary:
        temporary.write_bytes(save(weights))
    write_json(directory / METADATA_FILE, metadata)


def read_model(directory: Path) -> tuple[PolicyNetwork, dict[str, Any]]:
    """The network, in float32, and ``model.json`` of a finished model.

    Raises:
        InvalidInputError: a file is missing or damaged, or the weights are not those of the network it names.
    """
    directory = Path(directory)
    for name in (MODEL_FILE, METADATA_FILE):
        if not (directory / name).is_file():
            raise InvalidInputError(f"{directory}: holds no finished model ({name} is missing)")
    try:
        metadata = json.loads((directory / METADATA_FILE).read_text(encoding="utf-8"))
        recipe = metadata["config"]
        extras = {"state_std": recipe.get("state_std", False), "clock": recipe.get("clock", 0)}
        network = make_network(recipe["network"], **extras)
        network.load_state_dict(load_file(directory / MODEL_FILE, device="cpu"))
    except Exception as error:  # damaged files fail in json, safetensors or torch
        reason = str(error).strip().splitlines()[0] if str(error).strip() else ""
        raise InvalidInputError(f"{directory}: cannot be read ({type(error).__name__}: {reason})") from error
    if not all(torch.isfinite(value).all() for value in network.state_dict().values()):
        raise InvalidInputError(f"{directory / MODEL_FILE}: holds weights that are not finite")
    return network, metadata
