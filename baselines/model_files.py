"""Trained models on disk.

A *model* is a directory with ``model.safetensors`` (the weights) and ``model.json`` (everything else): the recipe (``config``),
the budget (``steps``, ``seconds``), machine, versions and command. *Weights* are one file in half precision, which says in its
header what is needed to act with it. None of them can carry code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save

from tslam_bench.constants import HORIZON
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.weights import METADATA_FILE, MODEL_FILE
from tslam_bench.files import atomic_file, write_json
from tslam_bench.hand_constants import CONTROL_MODES

from .network import NETWORKS, PolicyNetwork

ACTING: Final = ("network", "clock", "state_std", "control_mode", "action_repeat", "noise_correlation")
"""Settings of the recipe that a policy acts by; weights hold them in their header."""
_HEADER: Final = "acting"
_DEFAULTS: Final[dict[str, Any]] = {"clock": 0, "state_std": False, "noise_correlation": 0.0}
"""Of settings that older recipes did not have."""


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


def weights_bytes(network: PolicyNetwork, acting: Mapping[str, Any]) -> bytes:
    """A file of weights in half precision; equal arguments give equal bytes.

    Args:
        network: the policy.
        acting: its :data:`ACTING`.
    """
    weights = {name: value.detach().cpu().half().contiguous() for name, value in network.state_dict().items()}
    return save(weights, {_HEADER: json.dumps({name: acting[name] for name in ACTING}, sort_keys=True)})


def read_model(path: Path) -> tuple[PolicyNetwork, dict[str, Any]]:
    """A policy and what it acts by.

    Args:
        path: directory of a finished model, or a file of weights.

    Returns:
        The network, in float32, and its :data:`ACTING`.

    Raises:
        InvalidInputError: a file is missing or damaged, the weights are not those of the network it names, or a setting is
            unusable.
    """
    path = Path(path)
    for name in () if path.is_file() else (MODEL_FILE, METADATA_FILE):
        if not (path / name).is_file():
            raise InvalidInputError(f"{path}: holds no finished model ({name} is missing)")
    try:
        file = path if path.is_file() else path / MODEL_FILE
        recipe = _header(path) if path.is_file() else json.loads((path / METADATA_FILE).read_text("utf-8"))["config"]
        acting = {name: recipe[name] if name in recipe else _DEFAULTS[name] for name in ACTING}
        network = make_network(acting["network"], state_std=acting["state_std"], clock=acting["clock"])
        network.load_state_dict(load_file(file, device="cpu"))  # half precision becomes float32 without rounding
    except Exception as error:  # damaged files fail in json, safetensors or torch
        reason = str(error).strip().splitlines()[0] if str(error).strip() else ""
        raise InvalidInputError(f"{path}: cannot be read ({type(error).__name__}: {reason})") from error
    _check_finite(file, network.state_dict())
    mode, repeat, correlation = (acting[name] for name in ("control_mode", "action_repeat", "noise_correlation"))
    if mode not in CONTROL_MODES or not isinstance(repeat, int) or not 1 <= repeat <= HORIZON:
        raise InvalidInputError(f"{path}: control_mode {mode!r} or action_repeat {repeat!r} is unusable")
    if not isinstance(correlation, int | float) or not 0 <= correlation <= 1:
        raise InvalidInputError(f"{path}: noise_correlation {correlation!r} is unusable")
    return network, acting


def _header(path: Path) -> dict[str, Any]:
    """What a file of weights says about itself."""
    with safe_open(path, "pt") as file:
        found = (file.metadata() or {}).get(_HEADER)
    if found is None:
        raise InvalidInputError("its header names no network; give the model's directory, or export it again")
    return json.loads(found)


def _check_finite(path: Path, weights: Mapping[str, torch.Tensor]) -> None:
    if not all(torch.isfinite(value).all() for value in weights.values()):
        raise InvalidInputError(f"{path}: holds weights that are not finite")
