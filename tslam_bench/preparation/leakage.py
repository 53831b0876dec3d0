"""Finds copies of test objects, up to rotation, reflection and scale, by geometry alone (protocol section 8).

Both solids are normalised: the centroid of the volume goes to the origin, its root-mean-square radius becomes 1.
Rotation-invariant histograms shortlist the test objects that could match; each of these is aligned by trying many rotations
and refining the best, and the overlap of the aligned solids decides.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from tslam_bench.errors import AssetError
from tslam_bench.files import atomic_file
from tslam_bench.geometry.distance import InsideTest, contains
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, parse_stl
from tslam_bench.geometry.moments import moments
from tslam_bench.geometry.scanline import inside_grid
from tslam_bench.objects import splits
from tslam_bench.preparation import repair, voids
from tslam_bench.sources import contactdb

MAX_OVERLAP = 0.85
"""An object is a copy when its aligned IoU with a test object is above this."""
SHORTLIST_DISTANCE = 0.15
"""Test objects whose descriptors differ by at most this are aligned (copies of the test objects differ by at most 0.07)."""
VERSION = 2
"""Bumped when the comparison changes."""
FILLED = ("flute", "stapler", "teapot", "wristwatch")
"""Test objects with voids that are filled; the others are compared as their source has them."""
_POINTS = 6_000
_COARSE_POINTS = 500
_ROTATIONS = 1_500
_REFINED = 8
_GRID = 64
_SEED = 20211111


@dataclass(frozen=True)
class Shape:
    """A normalised solid.

    Attributes:
        name: of the object.
        mesh: its surface, normalised.
        points: (N, 3) uniform points of its volume.
        volume: normalised volume.
        descriptor: (D,) rotation-invariant histogram.
    """

    name: str
    mesh: TriangleMesh
    points: NDArray[np.float64]
    volume: float
    descriptor: NDArray[np.float64]


def normalise(name: str, mesh: TriangleMesh) -> Shape:
    """Normalises a watertight mesh and describes it.

    Raises:
        AssetError: the mesh holds next to no volume.
    """
    solid = moments(mesh)
    normalised = TriangleMesh((mesh.vertices - solid.centroid) / solid.radius, mesh.faces)
    generator = np.random.default_rng(_SEED)
    low, high = normalised.bounds
    inside = InsideTest(normalised)
    found: list[NDArray[np.float64]] = []
    for _ in range(100):
        batch = generator.uniform(low, high, (20_000, 3))
        found.append(batch[inside(batch)])
        if sum(map(len, found)) >= _POINTS:
            break
    else:
        raise AssetError("holds next to no volume in its bounding box")
    points = np.concatenate(found)[:_POINTS]
    return Shape(name, normalised, points, solid.volume / solid.radius**3, _descriptor(points, generator))


def _descriptor(points: NDArray[np.float64], generator: np.random.Generator) -> NDArray[np.float64]:
    """Histograms of distances to the centroid and between pairs, and the principal variances."""
    radial, _ = np.histogram(np.linalg.norm(points, axis=1), bins=24, range=(0, 3))
    first, second = points[generator.integers(len(points), size=(2, 30_000))]
    pairs, _ = np.histogram(np.linalg.norm(first - second, axis=1), bins=32, range=(0, 5))
    variances = np.sort(np.linalg.eigvalsh(np.cov(points.T)))
    return np.concatenate([0.5 * radial / radial.sum(), 0.5 * pairs / pairs.sum(), 0.25 * variances])


def descriptor_distance(first: Shape, second: Shape) -> float:
    """L1 distance of two descriptors."""
    return float(np.abs(first.descriptor - second.descriptor).sum())


def overlap(first: Shape, second: Shape, guesses: NDArray[np.float64] | None = None) -> float:
    """IoU of two normalised solids, aligned by the rotation or reflection found to be best.

    ``guesses`` (G, 3, 3) are rotations and reflections from first to second that are tried besides random ones.
    """
    low, high = second.mesh.bounds
    spacing = float((high - low).max()) / (_GRID - 3)
    size = np.ceil((high - low) / spacing).astype(int) + 3
    shape = (int(size[0]), int(size[1]), int(size[2]))
    origin = low - spacing
    inside = inside_grid(second.mesh, origin, spacing, shape)
    # A soft inside, so that walls thinner than a step of the search still pull: 1 inside, falling to 0 within three samples.
    soft = np.clip(1 - distance_transform_edt(~inside) / 3, 0, 1).astype(np.float32)
    hard = inside.astype(np.float32)

    def score(
        matrices: NDArray[np.float64], points: NDArray[np.float64], values: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        index = np.round((np.einsum("rij,nj->rni", matrices, points) - origin) / spacing).astype(np.int64)
        valid = ((index >= 0) & (index < size)).all(axis=-1)
        index = np.where(valid[..., None], index, 0)
        return np.where(valid, values[index[..., 0], index[..., 1], index[..., 2]], 0).mean(axis=1)

    generator = np.random.default_rng(_SEED)
    rotations = Rotation.random(_ROTATIONS, rng=generator).as_matrix()
    candidates = np.concatenate([rotations, rotations @ np.diag([1.0, 1.0, -1.0])])
    if guesses is not None:
        candidates = np.concatenate([candidates, guesses])
    coarse = score(candidates, first.points[:_COARSE_POINTS], soft)
    best = candidates[np.argsort(coarse)[-_REFINED:]]
    for angle in (0.15, 0.08, 0.04, 0.02, 0.01, 0.005, 0.003):
        turns = Rotation.from_rotvec(generator.normal(scale=angle, size=(24, 3))).as_matrix()
        turns[0] = np.eye(3)
        tried = np.einsum("tij,bjk->btik", turns, best)
        values = score(tried.reshape(-1, 3, 3), first.points[:2000], soft if angle > 0.03 else hard)
        best = tried[np.arange(len(best)), values.reshape(len(best), -1).argmax(axis=1)]
    final = best[score(best, first.points, hard).argmax()]
    common = first.volume * float(contains(first.points @ final.T, second.mesh).mean())
    return common / (first.volume + second.volume - common)


@dataclass(frozen=True)
class Match:
    """The test object that an object resembles most.

    Attributes:
        name: the test object, "" if none was on the shortlist.
        overlap: aligned IoU, 0 if none was on the shortlist.
    """

    name: str
    overlap: float

    @property
    def is_copy(self) -> bool:
        """Whether the object has to be dropped."""
        return self.overlap > MAX_OVERLAP


def closest(mesh: TriangleMesh, references: list[Shape]) -> Match:
    """The reference that ``mesh`` (watertight) overlaps most."""
    shape = normalise("candidate", mesh)
    best = Match("", 0.0)
    for reference in references:
        if descriptor_distance(shape, reference) <= SHORTLIST_DISTANCE:
            value = overlap(shape, reference)
            if value > best.overlap:
                best = Match(reference.name, value)
    return best


def references(wheel: Path, cache: Path) -> list[Shape]:
    """The test objects, normalised; kept in ``<cache>/leakage`` after the first call."""
    key = hashlib.sha256(json.dumps([VERSION, contactdb.SOURCE, _POINTS, _SEED]).encode()).hexdigest()[:16]
    path = cache / "leakage" / f"references-{key}.npz"
    names = list(splits.OBJECTS)
    if not path.exists():
        arrays: dict[str, Any] = {}
        for name in names:
            mesh = parse_stl(contactdb.read_mesh_file(name, wheel))
            if name in FILLED:
                mesh = from_manifold(voids.fill_voids(repair.repair(mesh).solid).solid)
            shape = normalise(name, mesh)
            arrays[f"{name}.vertices"], arrays[f"{name}.faces"] = shape.mesh
            arrays[f"{name}.points"], arrays[f"{name}.descriptor"] = shape.points, shape.descriptor
            arrays[f"{name}.volume"] = np.array(shape.volume)
        with atomic_file(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays)
    try:
        with np.load(path) as data:
            return [
                Shape(
                    name,
                    TriangleMesh(data[f"{name}.vertices"], data[f"{name}.faces"]),
                    data[f"{name}.points"],
                    float(data[f"{name}.volume"]),
                    data[f"{name}.descriptor"],
                )
                for name in names
            ]
    except Exception as error:
        path.unlink(missing_ok=True)
        raise AssetError(f"{path}: corrupt ({error}); it was removed, run the command again") from error
