"""Feeds wrong and hostile submissions, score files and meshes to the readers that meet them, and counts what becomes of them.

Every input is read in a process with a time and a memory limit, as the commands read it: a submission is scored and shown, a
score file ranked and shown on a page, a mesh read (with ``--repair``: repaired and gated as well, on the coarse grids of
``fuzz_importer``). What must not happen: another exception than the one-line refusal, a crash, a hang, more time or memory than
allowed, a figure that cannot be, anything taken for verified, a stranger's markup or control characters on a page or a terminal.

    python benchmarks/fuzz_inputs.py --count 300 --seed 1
"""

from __future__ import annotations

import io
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import fuzz_importer
import hostile_inputs
import numpy as np
import tyro
from hostile_inputs import LINK, PIPE, Case
from rich.console import Console
from rich.table import Table

from tslam_bench import __version__, grids
from tslam_bench.cli.score import object_table, summary_table
from tslam_bench.constants import HORIZON
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import cache_directory
from tslam_bench.leaderboard.page import build_page
from tslam_bench.leaderboard.ranking import rank
from tslam_bench.objects.store import asset_sha256, load_object
from tslam_bench.preparation.workers import WorkerPool
from tslam_bench.scoring.info import SubmissionInfo
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import SubmissionWriter
from tslam_bench.scoring.untrusted_scores import parse_score, read_score, sealed_json
from tslam_bench.sources.importer import ImportedSource
from tslam_bench.sources.meshfiles import read_mesh_file

TIME_LIMIT = 20.0
"""Seconds of a processor for one input."""
PATIENCE = 600.0
"""Seconds on the clock after which a process hangs; its start counts, and the machine may have other work."""
MEMORY_LIMIT = 2 * 2**30
"""Resident bytes for one input."""
ADDRESS_SPACE = 8 * 2**30
"""Bytes that a process may ask for: compiled code and libraries lie there without using memory."""
GOOD = ("accepted", "empty", "refused")
_MARKUP = re.compile(r"<script>alert|<img src=x|onerror=alert\(1\)>|href=\"javascript:")
_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f]")


@dataclass(frozen=True)
class Config:
    """Makes inputs, reads them, prints counts."""

    count: int = 300
    """Damaged inputs of each family, beside those made by hand."""
    seed: int = 1
    """Seed of all damage."""
    workers: int = 2
    """Processes."""
    costly: bool = True
    """With inputs that take seconds each."""
    repair: bool = False
    """Meshes are repaired and gated too (a second each)."""
    output: Path | None = None
    """JSON file for the counts and every input's outcome."""


class Outcome(NamedTuple):
    """What became of an input.

    Attributes:
        status: one of ``GOOD``, or what must not happen.
        reason: the line of a refusal, or what went wrong.
        seconds: processor time it took.
        peak: largest resident memory (bytes) while it was read; 0 where the system does not say.
    """

    status: str
    reason: str
    seconds: float
    peak: int


def good_submission(folder: Path, cache: Path) -> dict[str, bytes]:
    """Files of a submission of one rollout and one reconstruction of the mug: it touched a tenth of its surface voxels."""
    prepared = load_object("mug", cache=cache)
    info = SubmissionInfo(
        method="fuzz",
        explorer="mine",
        reconstructor="own",
        authors=("A. Author",),
        asset_manifest_sha256=asset_sha256(("mug",), cache=cache),
        seeds=(0,),
        object_set="quick",
        privileged=False,
        package_version=__version__,
    )
    generator = np.random.default_rng(0)
    world = grids.object_to_world(grids.points_to_grid(prepared.surface_points), 0)
    found = world & (generator.random(world.shape) < 0.1)
    steps = np.where(found, generator.integers(0, HORIZON, world.shape), -1).astype(np.int16)
    rollout = Rollout(
        "mug", 0, 0, np.zeros((HORIZON, 28), np.float32), found, ~world, steps, np.zeros((21, 28), np.float32)
    )
    with SubmissionWriter(folder, info) as writer:
        writer.add_rollout(rollout)
    path = folder / hostile_inputs.ROLLOUT
    path.write_bytes(hostile_inputs.npz(**np.load(path)))  # without the date: the same bytes at any time
    (folder / hostile_inputs.VOLUME).parent.mkdir()
    (folder / hostile_inputs.VOLUME).write_bytes(hostile_inputs.volume(hostile_inputs.ball(16)))
    names = (hostile_inputs.INFO, hostile_inputs.ROLLOUT, hostile_inputs.VOLUME)
    return {name: (folder / name).read_bytes() for name in names}


def good_score(folder: Path, cache: Path) -> bytes:
    """Its score file, as another machine would have written it."""
    content = sealed_json(score_submission(folder, ["mug"], cache=cache))
    return json.dumps({name: value for name, value in content.items() if name != "seal"}).encode()


def corpus(cache: Path, config: Config) -> list[Case]:
    """All inputs."""
    with tempfile.TemporaryDirectory() as name:
        base = good_submission(Path(name) / "s", cache)
        score = good_score(Path(name) / "s", cache)
    good = fuzz_importer.shapes(contactdb=False)
    return [
        *hostile_inputs.submissions(base, config.count, config.seed, config.costly),
        *hostile_inputs.score_files(score, config.count, config.seed),
        *hostile_inputs.meshes(good, config.count, config.seed),
    ]


# --- in a worker ------------------------------------------------------------------------------------------------


def read(family: str, path: Path, cache: Path, repair: bool) -> Outcome:
    """Reads one input and checks what came out of it."""
    _reset_peak()
    started = time.process_time()
    try:
        status, reason = {"submission": _submission, "score file": _score_file, "mesh": _mesh}[family](
            path, cache, repair
        )
    except (InvalidInputError, AssetError) as error:
        reason = str(error)
        status = "refused" if _is_one_line(reason) else "refused in a form that is no line"
    except Exception as error:
        status, reason = "another exception", f"{type(error).__name__}: {error}"
    seconds, peak = time.process_time() - started, _peak()
    if status in GOOD and seconds > TIME_LIMIT:
        status, reason = "time above the limit", f"{seconds:.0f} s"
    if status in GOOD and peak > MEMORY_LIMIT:
        status, reason = "memory above the limit", f"{peak / 2**30:.2f} GiB"
    return Outcome(status, reason[:300], seconds, peak)


def _submission(path: Path, cache: Path, _: bool) -> tuple[str, str]:
    archive = path / "s.zip"
    score = score_submission(archive if archive.is_file() else path, ["mug"], cache=cache)
    for estimates in score.aggregate.values():
        if not all(0 <= estimate.mean <= 3 for estimate in estimates.values()):
            return "a figure that cannot be", str(estimates)
    parse_score(json.loads(json.dumps(sealed_json(score))), "its score file")
    if score.verified:
        return "taken for verified", ""
    text = io.StringIO()
    console = Console(file=text, width=170)
    console.print(summary_table([score]))
    console.print(object_table(score))
    if _CONTROL.search(text.getvalue()):
        return "control characters in a table", ""
    reason = score.results[0].reasons["1"]
    return ("accepted", "") if reason is None else ("empty", reason)


def _score_file(path: Path, *_: Any) -> tuple[str, str]:
    score = read_score(path / "score.json")
    if score.verified or score.made_here or score.own_run:
        return "taken for verified", ""
    leaderboard = rank([score])
    page = build_page(leaderboard, {})
    if _MARKUP.search(page) or _CONTROL.search(page):
        return "text of a stranger in a page", ""
    mean = leaderboard["tables"][0]["entries"][0]["aggregate"]["areas"]["iou_area"]["mean"]
    return ("accepted", "") if 0 <= mean <= 1 else ("a figure that cannot be", str(mean))


def _mesh(path: Path, cache: Path, repair: bool) -> tuple[str, str]:
    file = path / (path / ".name").read_text(encoding="utf-8")
    if repair:
        source = ImportedSource("fuzz", "fuzz", "fuzz", str(file), "CC0", "fuzz")
        status, reason = fuzz_importer.cheap_import(source, cache)
        if status == "rejected":
            return ("refused" if _is_one_line(reason) else "refused in a form that is no line"), reason
        return status, reason
    mesh = read_mesh_file(file)
    whole = len(mesh.faces) and mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
    return ("accepted", "") if whole and np.isfinite(mesh.vertices).all() else ("a mesh that cannot be", "")


def _is_one_line(text: str) -> bool:
    return bool(text) and not _CONTROL.search(text) and "\n" not in text and len(text) < 1000


def _reset_peak() -> None:
    """Linux counts the peak of a process anew."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _peak() -> int:
    try:
        found = re.search(r"^VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) * 1024 if found else 0


# --- all of them ------------------------------------------------------------------------------------------------


def write(case: Case, folder: Path) -> None:
    """Writes the files of a case."""
    folder.mkdir(parents=True)
    files = case.files()
    (folder / ".name").write_text(next(iter(files)), encoding="utf-8")
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data == PIPE:
            os.mkfifo(path)
        elif data == LINK:
            path.symlink_to("/etc/passwd")
        else:
            path.write_bytes(data)


def run(cases: list[Case], cache: Path, config: Config) -> list[Outcome]:
    """Outcome of each case, in order."""
    pool: WorkerPool[int, Outcome] = WorkerPool(read, config.workers, PATIENCE, ADDRESS_SPACE)
    outcomes: dict[int, Outcome] = {}
    waiting = list(range(len(cases)))[::-1]
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        try:
            while waiting or pool.busy:
                while waiting and pool.has_room:
                    index = waiting.pop()
                    write(cases[index], root / str(index))
                    pool.submit(index, (cases[index].family, root / str(index), cache, config.repair))
                for index, result, problem in pool.results():
                    outcomes[index] = result or Outcome("hang" if "given up" in problem else "crash", problem, 0.0, 0)
        finally:
            pool.close()
        touched = [str(p.relative_to(root)) for p in root.iterdir() if not p.name.isdigit()]
        assert not touched, touched
    return [outcomes[index] for index in range(len(cases))]


def faults(cases: list[Case], outcomes: list[Outcome]) -> list[str]:
    """One line for each input of which something became that must not."""
    lines = []
    for case, outcome in zip(cases, outcomes, strict=True):
        wrong = outcome.status not in GOOD
        if not wrong and case.expected is not None and outcome.status != case.expected:
            wrong = True
        if wrong:
            expected = f", not {case.expected}" if case.expected else ""
            lines.append(f"{case.family}, {case.kind}: {outcome.status}{expected} ({outcome.reason})")
    return lines


def main(config: Config) -> None:
    """Prints the counts; exits with status 1 if anything happened that must not."""
    started = time.monotonic()
    cache = cache_directory()
    cases = corpus(cache, config)
    outcomes = run(cases, cache, config)
    counts = Counter((case.family, outcome.status) for case, outcome in zip(cases, outcomes, strict=True))
    families = list(dict.fromkeys(case.family for case in cases))
    table = Table("outcome", *families)
    for status in (*GOOD, *sorted({o.status for o in outcomes} - set(GOOD))):
        table.add_row(status, *(str(counts[family, status]) for family in families))
    table.add_row("slowest (s)", *(f"{_most(cases, outcomes, family, 'seconds'):.1f}" for family in families))
    table.add_row(
        "most memory (GiB)", *(f"{_most(cases, outcomes, family, 'peak') / 2**30:.2f}" for family in families)
    )
    Console(width=110).print(table)
    print(f"{len(cases)} inputs, {time.monotonic() - started:.0f} s")
    wrong = faults(cases, outcomes)
    for line in wrong:
        print(line)
    if config.output is not None:
        rows = [
            {"family": c.family, "kind": c.kind, "expected": c.expected, **o._asdict()}
            for c, o in zip(cases, outcomes, strict=True)
        ]
        config.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    if wrong:
        sys.exit(1)


def _most(cases: list[Case], outcomes: list[Outcome], family: str, what: str) -> float:
    return max((getattr(o, what) for c, o in zip(cases, outcomes, strict=True) if c.family == family), default=0.0)


if __name__ == "__main__":
    main(tyro.cli(Config))
