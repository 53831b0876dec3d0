"""Pictures of touched grid, reconstruction and true mesh, from one camera per object, as small WebP files.

A picture that was made is kept in a folder under a name that depends on all that is in it, so a page is rebuilt in seconds
and a run that was killed goes on.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from tslam_bench.constants import GRID_SIZE, NUM_POSES, OCCUPANCY_THRESHOLD
from tslam_bench.errors import AssetError, BenchmarkError, InvalidInputError
from tslam_bench.files import atomic_file
from tslam_bench.geometry.render import Camera, Colour, fit_camera, render, voxels_to_mesh
from tslam_bench.grids import voxel_centres
from tslam_bench.objects.store import PreparedObject, asset_sha256, load_object
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.measure import merge_touched_steps
from tslam_bench.scoring.prediction import invalid_mesh, solid_in_mesh
from tslam_bench.scoring.scoring import WorkerDied, worker_pool
from tslam_bench.scoring.submission import EXPLORATION_ORDER, Reconstruction, Submission

PICTURE_SIZE: Final = 232
"""Pixels across a picture; its height depends on the object."""
PICTURE_VERSION: Final = 5
"""Part of a stored picture's name: raise it when pictures of the same content look different."""

TOUCHED_AS_THEY_ARE: Final = "grid"
"""The reconstructor whose pictures would repeat the touched voxels."""

Kind = Literal["truth", "touched", "reconstruction"]
COLOURS: Final[dict[Kind, Colour]] = {
    "truth": (0.70, 0.72, 0.76),
    "touched": (0.91, 0.50, 0.20),
    "reconstruction": (0.29, 0.53, 0.86),
}
MAX_DRAWN: Final = 1_000_000
"""Triangles of a surface that is drawn as it is; of a larger one its voxels are drawn: 5 s and 1 GB on one core."""
MAX_OVERLAP: Final = 1000.0
""":func:`overlap` of a mesh that is drawn as it is: 7 s on one core. Ordinary meshes have less than 10."""
_QUALITY: Final = 82


@dataclass(frozen=True)
class Picture:
    """What to show.

    Attributes:
        kind: the true mesh, the voxels touched after 8 poses, or the reconstruction from them.
        object: name in the test split.
        submission: what it is of; None for the true mesh.
        content_hash: of the submission, or of the rollouts shown; empty for the true mesh.
        seed: of the submission.

    Two pictures are equal if they show the same; the submission is not compared.
    """

    kind: Kind
    object: str
    submission: Submission | None = field(default=None, compare=False)
    content_hash: str = ""
    seed: int = 0

    def file_name(self, asset: str) -> str:
        """Name of the stored picture; ``asset`` identifies the object's geometry."""
        key = repr((PICTURE_VERSION, PICTURE_SIZE, self.kind, self.object, self.content_hash, self.seed, asset))
        return f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.webp"


def make_pictures(
    pictures: Sequence[Picture],
    folder: Path,
    workers: int = 1,
    on_progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
) -> dict[Picture, bytes]:
    """WebP bytes (transparent background) of every picture that has something to show.

    Args:
        folder: where pictures are kept; those that are there are not made again.
        workers: processes that draw.
        on_progress: called with (done, all).
        cache: asset cache.
    """
    paths: dict[Picture, Path] = {}
    for picture in pictures:
        with contextlib.suppress(AssetError):  # its object is not prepared here
            paths[picture] = folder / picture.file_name(_asset(picture.object, cache))
    missing = [picture for picture in paths if not paths[picture].is_file()]
    done = len(paths) - len(missing)
    if on_progress:
        on_progress(done, len(paths))
    # One process draws all of one object: its mesh is loaded once.
    groups = [[p for p in missing if p.object == name] for name in dict.fromkeys(p.object for p in missing)]
    arguments = [([(picture, paths[picture]) for picture in group], cache) for group in groups]
    # A process that dies leaves its pictures out, and those of the others that wait.
    with contextlib.suppress(WorkerDied), worker_pool(min(workers, len(groups))) as pool:
        for drawn in (pool.map if pool else map)(_draw_group, arguments):
            done += drawn
            if on_progress:
                on_progress(done, len(paths))
    content = {picture: path.read_bytes() for picture, path in paths.items() if path.is_file()}
    return {picture: data for picture, data in content.items() if data}


def _draw_group(arguments: tuple[list[tuple[Picture, Path]], Path | None]) -> int:
    pictures, cache = arguments
    for picture, path in pictures:
        try:
            data = draw(picture, load_object(picture.object, cache=cache))
        except BenchmarkError:  # the submission has changed since it was read, or its object is not prepared: left out
            continue
        with atomic_file(path) as temporary:
            temporary.write_bytes(data)
    return len(pictures)


def draw(picture: Picture, prepared: PreparedObject) -> bytes:
    """WebP bytes of one picture; empty bytes if there is nothing to show."""
    truth = trimesh.Trimesh(prepared.vertices, prepared.faces, process=False)
    mesh = truth if picture.submission is None else _subject(picture, picture.submission)
    if len(mesh.faces) == 0:
        return b""
    camera, size = object_camera(truth)
    pixels = render([(mesh, COLOURS[picture.kind])], camera, size, None, float(truth.bounds[0, 2]), sky_rays=8)
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, format="WEBP", quality=_QUALITY, alpha_quality=100, method=4)
    return stream.getvalue()


def object_camera(truth: trimesh.Trimesh) -> tuple[Camera, tuple[int, int]]:
    """Camera and (width, height) of all pictures of one object.

    They hold its true mesh with room for a reconstruction that is a little large; flat objects get flat pictures.
    """
    square = fit_camera([truth], azimuth=-60, elevation=25, margin=1.22)
    seen = np.ptp(truth.vertices @ square.axes().T, axis=0)
    height = round(PICTURE_SIZE * float(np.clip((seen[1] / seen[0]), 0.55, 1.0)))
    camera = fit_camera([truth], azimuth=-60, elevation=25, margin=1.22, aspect=PICTURE_SIZE / height)
    return camera, (PICTURE_SIZE, height)


def _subject(picture: Picture, submission: Submission) -> trimesh.Trimesh:
    nothing = trimesh.Trimesh()
    if picture.kind == "touched":
        rollouts = {pose: submission.rollout(picture.object, pose, picture.seed) for pose in EXPLORATION_ORDER}
        if any(rollouts.values()):
            return voxels_to_mesh(merge_touched_steps(rollouts) >= 0)
    reconstruction = submission.reconstruction(picture.object, NUM_POSES, picture.seed)
    if reconstruction is None or (isinstance(reconstruction, trimesh.Trimesh) and invalid_mesh(reconstruction)):
        return nothing
    if isinstance(reconstruction, trimesh.Trimesh):
        mesh = reconstruction
    elif reconstruction.interpolation == "nearest" and reconstruction.resolution == GRID_SIZE:
        return voxels_to_mesh(reconstruction.probability >= OCCUPANCY_THRESHOLD)
    else:
        try:
            mesh = reconstruction.to_mesh(most=MAX_DRAWN)
        except InvalidInputError:
            return _in_voxels(reconstruction)
    return mesh if overlap(mesh) <= MAX_OVERLAP else _in_voxels(reconstruction)


def overlap(mesh: trimesh.Trimesh) -> float:
    """How many boxes of faces a line through the mesh's box meets on average: what a ray costs."""
    if len(mesh.faces) == 0:
        return 0.0

    def surface(extents: NDArray) -> NDArray:
        return (extents * np.roll(extents, 1, axis=-1)).sum(axis=-1)

    whole = surface(np.maximum(np.asarray(mesh.extents, dtype=np.float64), 1e-12))
    return float(surface(np.ptp(np.asarray(mesh.triangles), axis=1)).sum() / whole)


def _in_voxels(reconstruction: Reconstruction) -> trimesh.Trimesh:
    """What is solid at the centres of the voxels: a picture of bounded cost."""
    centres = voxel_centres().reshape(-1, 3)
    try:
        if isinstance(reconstruction, Volume):
            solid = reconstruction.query(centres) >= OCCUPANCY_THRESHOLD
        else:
            solid = solid_in_mesh(reconstruction, centres)
    except InvalidInputError:
        return trimesh.Trimesh()
    return voxels_to_mesh(solid.reshape((GRID_SIZE,) * 3))


@lru_cache(maxsize=64)
def _asset(name: str, cache: Path | None) -> str:
    return asset_sha256([name], cache=cache)


def touched_picture(submission: Submission, name: str, seed: int) -> Picture | None:
    """The picture of what was touched after 8 poses, or None if the submission does not tell.

    Submissions that differ in the reconstructor only share it: it is keyed by the rollouts. A reference without rollouts
    shows its reconstruction by ``grid``, which is what it says it touched.
    """
    key = submission.rollouts_hash(name, seed)
    if not key and submission.info.privileged and submission.info.reconstructor == TOUCHED_AS_THEY_ARE:
        key = submission.content_hash
    return Picture("touched", name, submission.of_object(name), key, seed) if key else None
