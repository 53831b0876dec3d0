"""A folder that is a page: shapes to turn and episodes to play, without network, from ``file://`` as well.

Layout::

    index.html, *.js, viewer.css, three.min.js, three.LICENSE.txt
    catalogue.js                      what there is, and in which files
    data/hand.js
    data/<object>/truth.js
    data/<object>/shape-<entry>.js    reconstructions, with errors
    data/<object>/episodes-<key>.js   joint positions, touches and recall

The page loads a data file when it is looked at. Names of files tell what is in them, so what is there is not made again.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import CONTROL_STEP_SECONDS, GRID_SIZE, HORIZON, NUM_POSES, WORKSPACE_EDGE
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, ensure_writable_directory
from tslam_bench.hand_constants import JOINT_LIMITS
from tslam_bench.objects.store import PreparedObject, load_object
from tslam_bench.scoring import metrics
from tslam_bench.scoring.measure import merge_touched_steps
from tslam_bench.scoring.prediction import prepare
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.text import visible
from tslam_bench.viewing.entries import Entry, Explored
from tslam_bench.viewing.hand import LENGTH_STEP, hand_script, indices, lengths
from tslam_bench.viewing.motion import Motion, MotionSource, interpolation
from tslam_bench.viewing.packing import pack, script_json
from tslam_bench.viewing.surface import (
    ERROR_STEP,
    NODES,
    PLACES,
    fine_mesh,
    net,
    signed_distances,
    stored_errors,
)

PAGE: Final = "index.html"
CATALOGUE: Final = "catalogue.js"
DATA: Final = "data"
_WEB: Final = Path(__file__).parent / "web"
_WEB_FILES: Final = (
    *(PAGE, "viewer.css", "three.min.js", "three.LICENSE.txt"),
    *("data.js", "shapes.js", "stage.js", "hand.js", "player.js", "viewer.js"),
)
_FORMAT: Final = 1
"""Part of the names of data files: raise it when equal content is written differently."""
_SLACK: Final = 0.1
"""Joints are shown up to this far (m or rad) beyond their limits."""
_PARTS: Final = 10_000
"""Recall is stored in so many parts of 1."""


@dataclass(frozen=True)
class Written:
    """What :func:`write_viewer` wrote.

    Attributes:
        page: the page's file.
        links: (key of the entry, object) -> address relative to the page's folder, for links from elsewhere.
        sizes: file below the folder -> bytes, of all that the page may load.
    """

    page: Path
    links: Mapping[tuple[str, str], str]
    sizes: Mapping[str, int]


def write_viewer(
    folder: Path,
    entries: Sequence[Entry],
    motions: MotionSource | None = None,
    title: str = "Explorations",
    on_progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
) -> Written:
    """Writes the page of ``entries``; another call on the same folder replaces it and keeps the data that both have.

    Args:
        folder: a folder of its own, such as ``viewer/`` beside a leaderboard's page.
        entries: of submissions (:func:`tslam_bench.viewing.entries.submission_entry`) or of episodes played just now.
        motions: tells how the hand moved: :func:`tslam_bench.evaluation.playback.replays` where there is a simulator; None:
            between the checkpoints of the rollouts.
        on_progress: called with (done, all) objects of entries.
        cache: asset cache.

    Raises:
        InvalidInputError: the folder holds something else, or a submission is not readable any more.
        AssetError: the folder cannot be written. Objects that are not prepared are left out, and the page says so.
    """
    check_folder(folder)
    report = on_progress or (lambda done, total: None)
    writer = _Writer(folder, cache, motions or interpolation())
    files: list[dict[str, dict[str, str]]] = [{} for _ in entries]
    # Object by object, so that a true mesh is loaded once.
    jobs = sorted((name, number) for number, entry in enumerate(entries) for name in entry.objects)
    report(0, len(jobs))
    for done, (name, number) in enumerate(jobs):
        added = writer.add(entries[number], name)
        if added is not None:
            files[number][name] = added
        report(done + 1, len(jobs))
    catalogue = {
        "title": visible(title),
        "hand": writer.hand(),
        "missing": sorted(writer.missing),
        "truth": writer.truths,
        "constants": {
            "grid": GRID_SIZE,
            "edge": WORKSPACE_EDGE,
            "horizon": HORIZON,
            "seconds": CONTROL_STEP_SECONDS,
            "nodes": NODES,
            "places": PLACES,
            "lengthStep": LENGTH_STEP,
            "errorStep": ERROR_STEP,
            "recallParts": _PARTS,
            "joints": _joint_range().tolist(),
            "rotations": [grids.pose_rotation(pose).tolist() for pose in range(NUM_POSES)],
        },
        "entries": [
            {
                "key": entry.key,
                "explorer": visible(entry.explorer),
                "reconstructor": visible(entry.reconstructor),
                "remark": visible(entry.remark),
                "objects": files[number],
            }
            for number, entry in enumerate(entries)
        ],
    }
    for name in _WEB_FILES:
        with atomic_file(folder / name) as temporary:
            shutil.copyfile(_WEB / name, temporary)
    with atomic_file(folder / CATALOGUE) as temporary:
        temporary.write_text(f"tslam.catalogue={script_json(catalogue)};\n", encoding="utf-8")
    writer.remove_others()
    links = {(e.key, name): link(e.key, name) for e, own in zip(entries, files, strict=True) for name in own}
    sizes = {name: (folder / name).stat().st_size for name in (*_WEB_FILES, CATALOGUE, *sorted(writer.files))}
    return Written(folder / PAGE, links, sizes)


def link(entry: str, object_name: str, **settings: str | int) -> str:
    """Address of one object of one entry on the page, relative to its folder.

    Args:
        settings: ``view`` (shape or episode), ``pose``, ``step``, ``count``, ``colour`` (plain or error).
    """
    parts = {"object": object_name, "entry": entry, **settings}
    return f"{PAGE}#" + "&".join(f"{key}={quote(str(value), safe='')}" for key, value in parts.items())


def check_folder(folder: Path) -> None:
    """Raises a BenchmarkError unless a page can be written to ``folder`` without destroying anything but an older one."""
    ensure_writable_directory(folder)
    if any(folder.iterdir()) and not (folder / CATALOGUE).is_file():
        raise InvalidInputError(f"{folder}: holds something else, which stays; name another folder")


class _Writer:
    """Writes data files; one that is there is not made again."""

    def __init__(self, folder: Path, cache: Path | None, motions: MotionSource) -> None:
        self.truths: dict[str, str] = {}
        self.missing: set[str] = set()
        self.files: set[str] = set()
        self._folder, self._cache, self._motions = folder, cache, motions
        self._load = lru_cache(maxsize=1)(self._load_truth)

    def hand(self) -> str | None:
        """The hand's file, or None if it is not prepared."""
        try:
            return self._write("hand.js", lambda: hand_script(f"{DATA}/hand.js", self._cache))
        except AssetError:
            return None

    def add(self, entry: Entry, name: str) -> dict[str, str] | None:
        """Files of one object of one entry; None if the object is not prepared."""
        shape = f"{name}/shape-{_key(entry.key)}.js"
        episodes = f"{name}/episodes-{_key(entry.episodes(name), self._motions.name, str(self.hand() is None))}.js"
        read = lru_cache(maxsize=1)(lambda: entry.read(name))
        anew = not entry.stored
        try:
            if name not in self.truths:
                self.truths[name] = self._write(f"{name}/truth.js", lambda: self._truth(name, read().split), anew=True)
            files = {"shape": self._write(shape, lambda: self._shape(read(), f"{DATA}/{shape}"), anew)}
            if entry.episodes(name) and (self._has(episodes) or read().played):
                # Entries of one exploration share the file, whichever comes first.
                anew = anew and f"{DATA}/{episodes}" not in self.files
                files["episodes"] = self._write(episodes, lambda: self._episodes(read(), f"{DATA}/{episodes}"), anew)
        except AssetError:
            self.missing.add(name)
            return None
        return files

    def remove_others(self) -> None:
        """Removes data files that the page does not name any more."""
        for path in (self._folder / DATA).rglob("*.js"):
            if path.relative_to(self._folder).as_posix() not in self.files:
                path.unlink()

    def _has(self, name: str) -> bool:
        return (self._folder / DATA / name).is_file()

    def _write(self, name: str, make: Callable[[], str], anew: bool = False) -> str:
        path = self._folder / DATA / name
        if anew or not self._has(name):
            text = make()
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path) as temporary:
                temporary.write_text(text, encoding="ascii")
        self.files.add(f"{DATA}/{name}")
        return f"{DATA}/{name}"

    def _load_truth(self, name: str, split: str) -> tuple[PreparedObject, NDArray, NDArray, metrics.TouchCoverage]:
        prepared = load_object(name, split, self._cache)
        mesh = fine_mesh(prepared.vertices, prepared.faces)
        return prepared, *mesh, metrics.TouchCoverage(prepared.surface_points)

    def _truth(self, name: str, split: str) -> str:
        _, vertices, faces, _ = self._load(name, split)
        header = {"object": name, "split": split}
        return pack(f"{DATA}/{name}/truth.js", header, {"v": lengths(vertices), "f": indices(faces)})

    def _shape(self, explored: Explored, file: str) -> str:
        prepared, vertices, _, coverage = self._load(explored.object, explored.split)
        points = prepared.iou_points()
        arrays: dict[str, NDArray] = {}
        counts: list[dict[str, Any]] = []
        for count, reconstruction in explored.reconstructions.items():
            drawn = {pose: explored.rollouts.get(pose) for pose in explored.members[count]}
            touched = merge_touched_steps(drawn) >= 0
            prediction = prepare(reconstruction, points.points, samples=1)
            entry: dict[str, Any] = {
                "count": count,
                "poses": list(explored.members[count]),
                "iou": round(metrics.iou(prediction.solid, prepared.solid_at_iou_points, points.weights), 5),
                "recall": round(coverage.recall(touched), 5),
                "reason": visible(prediction.reason or ""),
            }
            arrays[f"t{count}"] = np.flatnonzero(touched).astype(np.uint16)
            if reconstruction is not None and not prediction.reason:
                found = net(reconstruction)
                corners, triangles = found.mesh()
                if len(triangles):
                    errors = signed_distances(corners, prepared.vertices, prepared.faces)
                    entry["nodes"] = len(found.solid)
                    entry["middle"] = round(float(np.median(np.abs(errors))), 6)
                    arrays[f"b{count}"] = np.packbits(found.solid.reshape(-1))
                    if found.places is not None:
                        arrays[f"p{count}"] = found.places
                        arrays[f"e{count}"] = stored_errors(errors)
                    else:
                        arrays[f"e{count}"] = stored_errors(_at_cells(found.solid, errors, corners))
                    arrays[f"m{count}"] = stored_errors(signed_distances(vertices, corners, triangles))
            counts.append(entry)
        return pack(file, {"object": explored.object, "counts": counts}, arrays)

    def _episodes(self, explored: Explored, file: str) -> str:
        coverage = self._load(explored.object, explored.split)[3]
        rollouts = {pose: explored.rollouts[pose] for pose in explored.played}
        motions = self._motions.make(list(rollouts.values()), explored.control_mode, explored.split)
        merged = coverage.recall_curve(merge_touched_steps({**rollouts}), HORIZON * len(rollouts))
        arrays: dict[str, NDArray] = {}
        poses = []
        for position, (rollout, motion) in enumerate(zip(rollouts.values(), motions, strict=True)):
            own = merge_touched_steps({rollout.pose: rollout})
            start = position * HORIZON
            parts = {
                "q": _joints(motion),
                **_voxels(own),
                "r": _parts(coverage.recall_curve(own, HORIZON)),
                "m": _parts(merged[start : start + HORIZON + 1]),
            }
            if motion.touch is not None:
                parts["t"] = np.packbits(motion.touch, axis=1)
            arrays |= {f"{key}{rollout.pose}": array for key, array in parts.items()}
            poses.append(
                {
                    "pose": rollout.pose,
                    "seed": rollout.seed,
                    "source": motion.source,
                    "note": visible(motion.note),
                    "touched": int(rollout.touched.sum()),
                }
            )
        return pack(file, {"object": explored.object, "poses": poses}, arrays)


def episodes_key(rollouts: Mapping[int, Rollout]) -> str:
    """Key of episodes that are in no submission."""
    digest = hashlib.sha256()
    for rollout in rollouts.values():
        digest.update(rollout.file.encode() + rollout.to_bytes())
    return digest.hexdigest()[:16]


def _key(*parts: str) -> str:
    return hashlib.sha256(repr((_FORMAT, *parts)).encode()).hexdigest()[:16]


def _at_cells(solid: NDArray[np.bool_], errors: NDArray, corners: NDArray) -> NDArray:
    """Errors at the corners of all solid cells' faces, by the lattice of corners in C order: what the page draws of blocks."""
    size = len(solid) + 1
    index = np.round((corners / WORKSPACE_EDGE + 0.5) * len(solid)).astype(np.int64)
    at = np.zeros((size,) * 3)
    at[tuple(index.T)] = errors
    used = np.zeros((size,) * 3, dtype=bool)
    used[tuple(index.T)] = True
    return at[used]


def _joint_range() -> NDArray[np.float64]:
    return JOINT_LIMITS + np.array([-_SLACK, _SLACK])


def _joints(motion: Motion) -> NDArray[np.uint16]:
    """(201, 28): positions within :func:`_joint_range` in 16 bits."""
    low, high = _joint_range().T
    return np.round(np.clip((motion.joints - low) / (high - low), 0, 1) * 65535).astype(np.uint16)


def _voxels(touched_step: NDArray[np.int64]) -> dict[str, NDArray]:
    """Touched voxels (index in C order) and their steps, in the order in which they were touched."""
    voxels = np.flatnonzero(touched_step >= 0)
    steps = touched_step.reshape(-1)[voxels]
    order = np.argsort(steps, kind="stable")
    return {"x": voxels[order].astype(np.uint16), "s": steps[order].astype(np.uint8)}


def _parts(recall: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.round(recall * _PARTS).astype(np.uint16)
