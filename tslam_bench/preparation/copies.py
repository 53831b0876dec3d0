"""Finds prepared objects that are copies of each other, up to rotation, reflection and scale, by geometry alone.

Catalogues hold one model in several colours and sizes. Exact integrals over the solids (volume, principal variances and
surface, all normalised) shortlist the pairs; the overlap of the aligned solids decides, as for copies of test objects
(:mod:`tslam_bench.preparation.leakage`), but at a higher threshold: chairs may resemble each other, they may not be the same.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tslam_bench.files import cache_directory, write_json
from tslam_bench.geometry.meshes import TriangleMesh
from tslam_bench.geometry.moments import moments
from tslam_bench.objects import store
from tslam_bench.preparation import leakage

MAX_OVERLAP = 0.95
"""Two objects are copies when their aligned IoU is above this."""
MAX_DIFFERENCE = 0.04
"""Pairs are aligned when no normalised integral differs by more than this share."""
VERSION = 2
"""Bumped when the comparison changes."""

Key = tuple[str, str]
"""An object: (split, name)."""


@dataclass(frozen=True)
class Copy:
    """An object that repeats another one.

    Attributes:
        copy: the object to drop.
        original: the object that it repeats.
        overlap: aligned IoU of the two.
    """

    copy: Key
    original: Key
    overlap: float

    @property
    def reason(self) -> str:
        """One line that says why the object is dropped."""
        return f"{'/'.join(self.copy)}: gate: a copy of {'/'.join(self.original)} (aligned IoU {self.overlap:.3f})"


def find(
    examined: Sequence[Key], fixed: Sequence[Key] = (), cache: Path | None = None, only_fixed: bool = False
) -> list[Copy]:
    """The objects of ``examined`` that are copies of one in ``fixed``, or of one before them that is no copy itself.

    The answer depends on the objects and the order given, and on nothing else.

    Args:
        examined: objects that may be dropped, most wanted first.
        fixed: objects that stay whatever they resemble; they are not compared with each other.
        cache: cache directory (default: the user's).
        only_fixed: compare with ``fixed`` only.

    Raises:
        AssetError: an object is not prepared or is damaged.
    """
    objects = [_Object(key, cache) for key in [*fixed, *examined]]
    if not objects:
        return []
    measures = np.log(np.array([item.measures for item in objects]))
    kept = np.arange(len(objects)) < len(fixed)
    known = _Overlaps(cache)
    copies = []
    for number in range(len(fixed), len(objects)):
        difference = np.abs(measures[:number] - measures[number]).max(axis=1, initial=0.0)
        found = None
        for other in np.flatnonzero(kept[:number] & (difference <= MAX_DIFFERENCE)):
            value = known.overlap(objects[number], objects[int(other)])
            if value > MAX_OVERLAP and (found is None or value > found.overlap):
                found = Copy(objects[number].key, objects[int(other)].key, value)
        if found is None:
            kept[number] = not only_fixed
        else:
            copies.append(found)
    known.save()
    return copies


def measure(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normalised exact integrals of a closed mesh, and its principal axes.

    Returns:
        (5,) volume, surface and three principal standard deviations, of the solid whose root-mean-square radius is 1; and
        (3, 3) axes in columns, in order of rising deviation.
    """
    solid = moments(mesh)
    variances, axes = np.linalg.eigh(solid.covariance)
    radius = float(np.sqrt(variances.sum()))
    return np.array([solid.volume / radius**3, mesh.area() / radius**2, *np.sqrt(variances) / radius]), axes


def aligned_overlap(first: TriangleMesh, second: TriangleMesh) -> float:
    """Aligned IoU of two closed meshes, normalised; 0 where descriptors already tell them apart.

    Alignment starts from the principal axes and from the poses of a cube, besides random rotations. Each mesh is aligned with
    the other, as a search can miss the best pose one way only: which is named first makes no difference.
    """
    one, two = leakage.normalise("first", first), leakage.normalise("second", second)
    if leakage.descriptor_distance(one, two) > leakage.SHORTLIST_DISTANCE:
        return 0.0
    signs = np.array(list(np.ndindex(2, 2, 2)), dtype=float) * 2 - 1
    axes_one, axes_two = measure(first)[1], measure(second)[1]
    principal = np.einsum("ik,nk,jk->nij", axes_two, signs, axes_one)
    permutations = np.eye(3)[[[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]]
    poses = (permutations[:, None] * signs[None, :, None, :]).reshape(-1, 3, 3)
    there = leakage.overlap(one, two, guesses=np.concatenate([principal, poses]))
    back = leakage.overlap(two, one, guesses=np.concatenate([principal.transpose(0, 2, 1), poses]))
    return max(there, back)


class _Object:
    """A prepared object as far as this comparison needs it; its mesh is read again when it is compared."""

    def __init__(self, key: Key, cache: Path | None) -> None:
        self.key = key
        self._cache = cache
        split, name = key
        products = store.read_record(name, split, cache)["products"]
        self.sha256 = f"{products['vertices.npy']['sha256'][:32]}-{products['faces.npy']['sha256'][:32]}"
        self.measures = measure(self.mesh())[0]

    def mesh(self) -> TriangleMesh:
        """The ground-truth mesh."""
        split, name = self.key
        return TriangleMesh(*store.load_surface(name, split, self._cache))


class _Overlaps:
    """Overlaps that were computed before, kept in ``<cache>/leakage`` under the hashes of both meshes."""

    def __init__(self, cache: Path | None) -> None:
        self._path = (cache or cache_directory()) / "leakage" / f"overlaps-{VERSION}.json"
        self._new = False
        try:
            values = json.loads(self._path.read_text(encoding="utf-8"))
            self._values = {str(key): float(value) for key, value in values.items()}
        except (OSError, ValueError, TypeError, AttributeError):
            self._values = {}

    def overlap(self, first: _Object, second: _Object) -> float:
        """:func:`aligned_overlap` of two prepared objects."""
        key = ":".join(sorted((first.sha256, second.sha256)))
        if key not in self._values:
            self._values[key] = aligned_overlap(first.mesh(), second.mesh())
            self._new = True
        return self._values[key]

    def save(self) -> None:
        """Keeps what was computed."""
        if self._new:
            write_json(self._path, self._values)
