"""Trained reconstructors by file: a checkpoint of one's own training, or weights that were exported."""

from __future__ import annotations

from pathlib import Path

from tslam_bench.errors import InvalidInputError
from tslam_bench.reconstruction.dense import DenseReconstructor
from tslam_bench.reconstruction.learned import LearnedReconstructor, load_network
from tslam_bench.reconstruction.weights import SUFFIX, Weights, read_weights


def load_reconstructor(
    model: Path, name: str | None = None, threads: int = 1
) -> LearnedReconstructor | DenseReconstructor:
    """The reconstructor of a checkpoint, or of a file of weights (``.safetensors``).

    Raises:
        InvalidInputError: the file cannot be read, or holds another architecture than ``name``.
    """
    model = Path(model)
    if model.suffix == SUFFIX:
        weights = read_weights(model)
    else:
        architecture, network, threshold, training = load_network(model)
        weights = Weights(architecture, [network], [training], {"threshold": threshold})
    if name is not None and weights.architecture != name:
        raise InvalidInputError(
            f"{model}: holds a network of {weights.architecture!r}, not {name!r}; choose that reconstructor"
        )
    settings = dict(weights.settings)
    threshold = settings.pop("threshold")
    if weights.architecture == "unet":
        return DenseReconstructor(weights.architecture, weights.networks, weights.training, threads=threads, **settings)
    return LearnedReconstructor(
        weights.architecture, weights.networks[0], weights.training[0], threshold, threads=threads
    )
