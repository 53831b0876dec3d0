"""Training of the learned reconstructors on simulated touches.

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

from tslam_bench.constants import GRID_SIZE
from tslam_bench.curves import Curves
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import ensure_writable_directory
from tslam_bench.grids import voxel_centres
from tslam_bench.reconstruction.learned import (
    LearnedReconstructor,
    build_network,
    load_reconstructor,
    network_config,
    read_checkpoint,
    save_checkpoint,
    torch_threads,
)
from tslam_bench.reconstruction.touch_simulation import TouchSimulation, simulate_touches
from tslam_bench.reconstruction.training_config import TrainingConfig
from tslam_bench.reconstruction.training_shapes import TrainingShape, place

THRESHOLDS: Final = tuple(round(0.02 * k, 2) for k in range(5, 36))
"""Candidate thresholds: 0.10 to 0.70."""
_EXAMPLE_STREAM, _THRESHOLD_STREAM = 1, 2  # keep the generators of the two uses of the seed apart


@dataclass(frozen=True, eq=False)
class Batch:
    """Training examples: grids (B, 2, 32, 32, 32), points (B, P, 3) in metres, labels (B, P); all float32."""

    grids: NDArray[np.float32]
    points: NDArray[np.float32]
    labels: NDArray[np.float32]


def draw_batch(
    shapes: Sequence[TrainingShape],
    config: TrainingConfig,
    generator: np.random.Generator,
    simulation: TouchSimulation | None = None,
) -> Batch:
    """Draws ``config.batch_size`` examples."""
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
    shapes: Sequence[TrainingShape],
    config: TrainingConfig,
    output: Path,
    log_directory: Path | None = None,
    threshold_shapes: Sequence[TrainingShape] | None = None,
    progress: Callable[[int, float], None] | None = None,
    stop: Callable[[int], bool] | None = None,
) -> LearnedReconstructor | None:
    """Trains a network and writes it to ``output``.

    While it trains, ``<output>.progress`` holds a checkpoint every ``save_every`` steps; a killed run continues from it
    and ends with the weights of an uninterrupted one. A finished ``output`` of the same configuration and shapes is
    loaded, not trained again.

    Args:
        shapes: shapes to learn from.
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
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    start = 0
    if partial.exists():
        _check_same_run(partial, record)
        content = read_checkpoint(partial)
        network.load_state_dict(content["weights"])
        optimizer.load_state_dict(content["optimizer"])
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
                if writer is not None:
                    writer.add("loss/cross_entropy", loss, done)
                if progress:
                    progress(done, loss)
                stopped = stop is not None and done < config.steps and stop(done)
                if stopped or (done % config.save_every == 0 and done < config.steps):
                    state = {"optimizer": optimizer.state_dict(), "steps_done": done}
                    save_checkpoint(partial, config.architecture, network, record, extra=state)
                if stopped:
                    return None
    finally:
        if writer is not None:
            writer.close()
    network.eval()
    with torch_threads(config.threads):
        threshold = best_threshold(network, threshold_shapes or shapes, config)
    save_checkpoint(output, config.architecture, network, record, threshold)
    partial.unlink(missing_ok=True)
    return LearnedReconstructor(config.architecture, network, record, threshold, threads=config.threads)


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
    logits = network(torch.from_numpy(batch.grids), torch.from_numpy(batch.points))
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
