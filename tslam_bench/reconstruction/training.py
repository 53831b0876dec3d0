"""Training of the learned reconstructors, on touches that are simulated as it goes or on collected ones.

Every step draws its own examples from a generator seeded by (seed, step): the run is the same whether it was
interrupted or not, and the same seed gives the same weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from tslam_bench.constants import GRID_SIZE, WORKSPACE_EDGE, WORKSPACE_LOW
from tslam_bench.curves import Curves
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import ensure_writable_directory
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction.dense import DenseReconstructor
from tslam_bench.reconstruction.learned import (
    LearnedReconstructor,
    build_network,
    network_config,
    read_checkpoint,
    save_checkpoint,
)
from tslam_bench.reconstruction.torch_threads import torch_threads
from tslam_bench.reconstruction.touch_data import COUNTS_SIZE, ExampleMixture, TouchObject, draw_example
from tslam_bench.reconstruction.touch_simulation import TouchSimulation, simulate_touches
from tslam_bench.reconstruction.trained import load_reconstructor
from tslam_bench.reconstruction.training_config import TrainingConfig
from tslam_bench.reconstruction.training_shapes import TrainingShape, place

THRESHOLDS: Final = tuple(round(0.02 * k, 2) for k in range(5, 36))
"""Candidate thresholds: 0.10 to 0.70."""
_EXAMPLE_STREAM, _THRESHOLD_STREAM = 1, 2  # keep the generators of the two uses of the seed apart


@dataclass(frozen=True, eq=False)
class Batch:
    """Training examples, all float32.

    Attributes:
        grids: (B, 2, 32, 32, 32).
        points: (B, P, 3) in metres; None for a network that answers for all cells.
        labels: (B, P) or (B, 64, 64, 64): share that is solid.
    """

    grids: NDArray[np.float32]
    points: NDArray[np.float32] | None
    labels: NDArray[np.float32]


Source = Sequence[TrainingShape] | Sequence[TouchObject]
"""What examples are drawn from: shapes whose touches are simulated as it goes, or objects with collected touches."""


def draw_batch(
    shapes: Source,
    config: TrainingConfig,
    generator: np.random.Generator,
    simulation: TouchSimulation | None = None,
) -> Batch:
    """Draws ``config.batch_size`` examples."""
    if isinstance(shapes[0], TouchObject):
        return _draw_collected(shapes, config, generator)  # type: ignore[arg-type]
    return _draw_simulated(shapes, config, generator, simulation)  # type: ignore[arg-type]


def _draw_collected(data: Sequence[TouchObject], config: TrainingConfig, generator: np.random.Generator) -> Batch:
    mixture = ExampleMixture()
    chosen = generator.integers(len(data), size=config.batch_size)
    examples = [draw_example(data[int(index)], mixture, generator) for index in chosen]
    grids = np.stack([example.grids for example in examples]).astype(np.float32)
    if config.architecture == "unet":
        return Batch(grids, None, (np.stack([example.counts for example in examples]) / 8).astype(np.float32))
    points, labels = zip(*[_points_of(example.counts, config.points, generator) for example in examples], strict=True)
    return Batch(grids, np.stack(points), np.stack(labels))


def _points_of(counts: NDArray[np.uint8], count: int, generator: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Points (count, 3) and the solid share of their cells: half in cells near the surface, half uniform in W."""
    near = np.flatnonzero((maximum_filter(counts, 5) > 0) & (minimum_filter(counts, 5) < 8))
    cells = np.concatenate(
        [generator.choice(near, count // 2), generator.integers(counts.size, size=count - count // 2)]
    )
    index = np.stack(np.unravel_index(cells, counts.shape), axis=1)
    points = WORKSPACE_LOW + WORKSPACE_EDGE / COUNTS_SIZE * (index + generator.random(index.shape))
    return points.astype(np.float32), (counts.reshape(-1)[cells] / 8).astype(np.float32)


def _draw_simulated(
    shapes: Sequence[TrainingShape],
    config: TrainingConfig,
    generator: np.random.Generator,
    simulation: TouchSimulation | None,
) -> Batch:
    grids, points, labels = [], [], []
    for _ in range(config.batch_size):
        shape = shapes[int(generator.integers(len(shapes)))]
        placed = place(shape, generator, config.scale_range, config.continuous_rotation)
        touches = simulate_touches(placed, generator, simulation)
        example_points, example_labels = placed.query_points(config.points, generator)
        grids.append(np.stack([touches.touched, touches.visited]).astype(np.float32))
        points.append(example_points)
        labels.append(example_labels)
    return Batch(np.stack(grids), np.stack(points), np.stack(labels))


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Learning rate of step 0, 1, ...: linear rise over the first 5 % of the steps, then a half cosine to zero."""
    rise = max(1, round(0.05 * config.steps))
    if step < rise:
        return config.learning_rate * (step + 1) / rise
    return config.learning_rate * 0.5 * (1 + float(np.cos(np.pi * (step - rise) / max(1, config.steps - rise))))


def train(
    shapes: Source,
    config: TrainingConfig,
    output: Path,
    log_directory: Path | None = None,
    threshold_shapes: Sequence[TrainingShape] | None = None,
    progress: Callable[[int, float], None] | None = None,
    stop: Callable[[int], bool] | None = None,
) -> LearnedReconstructor | DenseReconstructor | None:
    """Trains a network and writes it to ``output``.

    While it trains, ``<output>.progress`` holds a checkpoint every ``save_every`` steps; a killed run continues from it
    and ends with the weights of an uninterrupted one. A finished ``output`` of the same configuration and shapes is
    loaded, not trained again.

    Args:
        shapes: what to learn from.
        config: the training configuration.
        output: checkpoint to write.
        log_directory: TensorBoard log of the loss, optional.
        threshold_shapes: held-out shapes to fix the threshold on; the training shapes, newly touched, if None.
        progress: called after each step with the steps done and the loss (nan for those already done on resuming).
        stop: called after each step with the steps done; returning True saves the progress and ends the run there.

    Returns:
        The trained reconstructor, or None if ``stop`` ended the run.

    Raises:
        InvalidInputError: no shapes; a value of ``config`` out of range; or ``output`` or its progress file is of
            another training run.
        AssetError: the output folder cannot be written.
    """
    config.check()
    if not shapes:
        raise InvalidInputError("training shapes: none; prepare some with `tslam-bench assets prepare --split train`")
    output = Path(output)
    ensure_writable_directory(output.parent)
    record: dict[str, Any] = {
        **dataclasses.asdict(config),
        "scale_range": list(config.scale_range),
        "objects": [shape.name for shape in shapes],
        "threshold_objects": [shape.name for shape in threshold_shapes] if threshold_shapes else "training objects",
    }
    del record["save_every"]
    if output.exists():
        _check_same_run(output, record)
        return load_reconstructor(output, threads=config.threads)

    partial = output.with_name(output.name + ".progress")
    network = build_network(config.architecture, network_config(config.architecture, config.size), config.seed)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    mean = [parameter.detach().clone() for parameter in network.parameters()] if config.average else []
    start = 0
    if partial.exists():
        _check_same_run(partial, record)
        content = read_checkpoint(partial)
        network.load_state_dict(content["weights"])
        optimizer.load_state_dict(content["optimizer"])
        mean = content["mean"]
        start = int(content["steps_done"])
        if progress:
            progress(start, float("nan"))

    writer = None
    if log_directory is not None:
        writer = Curves(Path(log_directory), start)
    network.train()
    try:
        with torch_threads(config.threads):
            for step in range(start, config.steps):
                loss = _step(network, optimizer, shapes, config, step)
                done = step + 1
                if mean:
                    factor = min(config.average, done / (done + 10))  # forgets the first weights soon
                    torch._foreach_lerp_(mean, [p.detach() for p in network.parameters()], 1 - factor)
                if writer is not None:
                    writer.add("loss/cross_entropy", loss, done)
                if progress:
                    progress(done, loss)
                stopped = stop is not None and done < config.steps and stop(done)
                if stopped or (done % config.save_every == 0 and done < config.steps):
                    state = {"optimizer": optimizer.state_dict(), "steps_done": done, "mean": mean}
                    save_checkpoint(partial, config.architecture, network, record, extra=state)
                if stopped:
                    return None
    finally:
        if writer is not None:
            writer.close()
    network.eval()
    for parameter, value in zip(network.parameters(), mean, strict=False):
        parameter.data.copy_(value)
    threshold = None
    if not isinstance(shapes[0], TouchObject):
        with torch_threads(config.threads):
            threshold = best_threshold(network, threshold_shapes or shapes, config)  # type: ignore[arg-type]
    save_checkpoint(output, config.architecture, network, record, threshold)
    partial.unlink(missing_ok=True)
    return load_reconstructor(output, threads=config.threads)


def best_threshold(network: torch.nn.Module, shapes: Sequence[TrainingShape], config: TrainingConfig) -> float:
    """The candidate of :data:`THRESHOLDS` with the best mean IoU over fresh examples of ``shapes``, unscaled.

    IoU is that of the solid occupancies at a random quarter of the voxel centres.
    """
    generator = np.random.Generator(np.random.PCG64([config.seed, _THRESHOLD_STREAM]))
    centres = generator.permutation(voxel_centres().reshape(-1, 3))[: GRID_SIZE**3 // 4]
    points = torch.from_numpy(centres.astype(np.float32))
    thresholds = np.array(THRESHOLDS)
    total = np.zeros(len(thresholds))
    for example in range(config.threshold_examples):
        placed = place(shapes[example % len(shapes)], generator, (1.0, 1.0), config.continuous_rotation)
        touches = simulate_touches(placed, generator)
        grids = np.stack([touches.touched, touches.visited])[None].astype(np.float32)
        with torch.inference_mode():
            features = network.encode(torch.from_numpy(grids))  # type: ignore[operator]
            logits = [network.decode(features, batch[None])[0] for batch in points.split(8192)]  # type: ignore[operator]
        solid = torch.sigmoid(torch.cat(logits)).numpy() >= thresholds[:, None]
        true = placed.inside(centres)
        total += (solid & true).sum(axis=1) / np.maximum((solid | true).sum(axis=1), 1)
    return float(thresholds[int(total.argmax())])


def _step(network, optimizer, shapes, config: TrainingConfig, step: int) -> float:
    """One optimiser step on fresh examples; returns the loss."""
    generator = np.random.Generator(np.random.PCG64([config.seed, _EXAMPLE_STREAM, step]))
    batch = draw_batch(shapes, config, generator)
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(config, step)
    inputs = [torch.from_numpy(batch.grids)] + ([] if batch.points is None else [torch.from_numpy(batch.points)])
    with torch.autocast("cpu", torch.bfloat16, enabled=config.precision == "bfloat16"):
        logits = network(*inputs).float()
    loss = functional.binary_cross_entropy_with_logits(logits, torch.from_numpy(batch.labels))
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return float(loss.detach())


def _check_same_run(path: Path, record: dict[str, Any]) -> None:
    """Raises InvalidInputError unless the checkpoint at ``path`` belongs to the run that ``record`` describes."""
    found = read_checkpoint(path)["training"]
    for key, value in record.items():
        if found.get(key) != value:
            detail = "other objects" if key == "objects" else f"{key} {found.get(key)!r}, not {value!r}"
            raise InvalidInputError(f"{path}: is of another run ({detail}); delete it or choose another output")
