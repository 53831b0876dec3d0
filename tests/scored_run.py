"""A small run made of primitives: an asset cache, submissions and their scores; and scores with chosen figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from prepared_shapes import surface_grid

from tslam_bench import __version__, grids
from tslam_bench.objects import store
from tslam_bench.objects.store import PreparedObject
from tslam_bench.reconstruction.grid import GridReconstructor
from tslam_bench.reconstruction.hull import HullReconstructor
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.scoring.aggregate import Estimate
from tslam_bench.scoring.info import SubmissionInfo, Training
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.score_file import ObjectScore, SubmissionScore
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, SubmissionWriter
from tslam_bench.scoring.untrusted_scores import write_score

NAMES = ("mug", "toruslarge")


def info(explorer: str, reconstructor: str, **changes) -> SubmissionInfo:
    values = {
        "method": f"{explorer} + {reconstructor}",
        "explorer": explorer,
        "reconstructor": reconstructor,
        "authors": ("A. Author",),
        "asset_manifest_sha256": "0" * 64,
        "seeds": (0,),
        "object_set": "quick",
        "privileged": False,
        "package_version": __version__,
    }
    return SubmissionInfo(**(values | changes))


def write_cache(folder: Path, box: PreparedObject, torus: PreparedObject) -> None:
    """An asset cache in which a box passes for the mug and a torus for the large torus."""
    for name, prepared in zip(NAMES, (box, torus), strict=True):
        mesh = trimesh.Trimesh(prepared.vertices, prepared.faces, process=False)
        _, _, faces = trimesh.proximity.closest_point(mesh, prepared.surface_points[:1])
        store.write(replace(prepared, name=name), np.full(100_000, faces[0]), folder)


def write_submission(
    folder: Path, about: SubmissionInfo, reconstructor: Reconstructor, share: float, objects: dict[str, PreparedObject]
) -> Path:
    """Real reconstructions of a random share of the surface voxels."""
    with SubmissionWriter(folder, about) as writer:
        for name, prepared in objects.items():
            touched = {}
            for pose in range(8):
                generator = np.random.default_rng([pose, len(name)])
                world = grids.object_to_world(surface_grid(prepared), pose)
                found = world & (generator.random(world.shape) < share)
                steps = np.where(found, generator.integers(0, 200, world.shape), -1).astype(np.int16)
                actions = generator.uniform(-1, 1, (200, 28)).astype(np.float32)
                writer.add_rollout(
                    Rollout(name, pose, 0, actions, found, ~world, steps, np.zeros((21, 28), np.float32))
                )
                touched[pose] = grids.world_to_object(found, pose)
            for count, poses in RECONSTRUCTED_POSES.items():
                merged = grids.merge(touched[pose] for pose in poses)
                writer.add_reconstruction(name, count, 0, reconstructor.reconstruct(merged, ~merged))
    return folder


def write_run(folder: Path, box: PreparedObject, torus: PreparedObject, cache: Path) -> None:
    """A run's folder: four submissions, one of them with a hostile label, scored."""
    objects = dict(zip(NAMES, (box, torus), strict=True))
    hostile = info(
        "mine", "hull", method="<b>Mine</b>", label='"><script>alert(1)</script>', link="https://example.org/a?b=1&c"
    )
    cases: list[tuple[str, SubmissionInfo, Reconstructor, float]] = [
        ("heuristic-hull", info("heuristic", "hull"), HullReconstructor(32), 0.01),
        ("random-grid", info("random", "grid"), GridReconstructor(), 0.005),
        ("mine-hull", replace(hostile, training=Training(12_345, 0.5, "a toaster")), HullReconstructor(32), 0.1),
        ("tslam_chamfer-hull", info("tslam_chamfer", "hull", privileged=True), HullReconstructor(32), 0.3),
    ]
    for name, about, reconstructor, share in cases:
        path = write_submission(folder / "submissions" / name, about, reconstructor, share, objects)
        write_score(folder / "scores" / f"{name}.json", score_submission(path, NAMES, cache=cache))


def fake_score(
    explorer: str, iou: list[float] | np.ndarray, chamfer: float = 0.1, area: float = 0.3, iou_8=None, **changes
) -> SubmissionScore:
    """A score with chosen figures: ranking reads nothing else.

    Args:
        iou: IoU area of each object, or (objects, seeds).
        iou_8: mean IoU at 8 poses; by default that of ``iou``.
    """
    matrix = np.array(iou, dtype=float).reshape(len(iou), -1)
    objects = tuple(f"object{k}" for k in range(len(matrix)))
    seeds = tuple(range(matrix.shape[1]))
    values: dict[str, float | None] = {"chamfer_l2": chamfer, "touched_surface_recall": 0.5, "surface_iou": 0.5}
    results = tuple(
        ObjectScore(
            object=name,
            seed=seed,
            poses={n: {**values, "iou": float(matrix[k, seed])} for n in ("1", "2", "4", "8")},
            reasons=dict.fromkeys(("1", "2", "4", "8")),
            areas={"iou_area": float(matrix[k, seed]), "exploration_area": area},
            recall_curve=[0.0, area],
            surface_iou_curve=[0.0, area],
            implausible_touches=0.0,
            missing=[],
        )
        for k, name in enumerate(objects)
        for seed in seeds
    )

    def same(value: float) -> Estimate:
        return Estimate(value, value, value, value, value, value)

    mean = float(matrix.mean())
    at = {"iou": same(mean if iou_8 is None else iou_8), "chamfer_l2": same(chamfer)}
    aggregate = {"areas": {"iou_area": same(mean), "exploration_area": same(area)}, **dict.fromkeys("1248", at)}
    reconstructor = changes.pop("reconstructor", "hull")
    own_run = changes.pop("own_run", True)
    about = info(explorer, reconstructor, **({"seeds": seeds} | changes))
    key = f"{explorer}-{reconstructor}" + ("" if own_run else "-claimed")
    return SubmissionScore(about, key, objects, "0" * 64, results, aggregate, (), own_run=own_run)
