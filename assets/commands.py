"""``tslam-bench assets``: prepare, list, show and verify objects."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from tslam_bench.assets import contactdb, store
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import AssetError, BenchmarkError, InvalidInputError
from tslam_bench.files import atomic_file

QUICK_GENERATED = {"train": 24, "val": 6}
"""Generated objects of the quick run."""


@dataclass(frozen=True)
class Prepare:
    """Fetch or generate objects, repair, decompose and measure them, and write the split's manifest.

    Objects that are intact in the cache are skipped; corrupt or missing files are named and rebuilt. Preparing the test
    split also converts the hand, if that has not been done.
    """

    objects: tuple[str, ...] = ()
    """Names of objects (default: the whole split)."""
    hand: bool = False
    """Only convert the hand."""
    quick: bool = False
    """Only the objects of the quick run."""
    split: str = "test"
    """Split: test, train or val."""
    source: Literal["generated"] | None = None
    """Where train and val objects come from."""
    count: int | None = None
    """How many train or val objects."""
    workers: int = 2
    """Processes."""
    manifest: Path | None = None
    """Also write the manifest to this file."""


@dataclass(frozen=True)
class List:
    """List the objects of a split, with their gate figures."""

    split: str = "test"
    """Split: test, train or val."""
    json: bool = False
    """Print JSON: one record per object."""


@dataclass(frozen=True)
class Show:
    """Draw one object: mesh, hulls in colours, solid and surface voxels."""

    name: Annotated[str, tyro.conf.Positional]
    """Name of the object, or an alias."""
    split: str = "test"
    """Split: test, train or val."""
    output: Path | None = None
    """PNG to write (default: NAME.png)."""


@dataclass(frozen=True)
class Verify:
    """Hash every file of every prepared object again."""

    split: str | None = None
    """Split (default: all that are prepared)."""


Command = (
    Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
)


def main(arguments: list[str] | None = None) -> None:
    """Runs ``tslam-bench assets``. Exits with status 2 and one line on standard error for bad input."""
    command: Any = tyro.cli(
        Command,
        args=arguments,
        prog="tslam-bench assets",
        description="Prepare, list, show and verify the benchmark's objects.",
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    handlers: dict[type, Callable[[Any], None]] = {Prepare: _prepare, List: _list, Show: _show, Verify: _verify}
    try:
        handlers[type(command)](command)
    except BenchmarkError as error:
        print(f"tslam-bench assets: {error}", file=sys.stderr)
        sys.exit(2)


def _sources(command: Prepare) -> tuple[list[Any], int | None]:
    """What to prepare, and how many of it (None: all)."""
    from tslam_bench.assets.prepare import ContactDBSource

    split = store.SPLIT_ALIASES.get(command.split, command.split)
    if split not in store.SPLITS:
        raise InvalidInputError(f"split {command.split!r}: unknown; choose one of {', '.join(store.SPLITS)}")
    if command.workers < 1:
        raise InvalidInputError(f"--workers {command.workers}: must be at least 1")
    if command.count is not None and command.count < 1:
        raise InvalidInputError(f"--count {command.count}: must be at least 1")
    if split == "test":
        if command.source is not None or command.count is not None:
            raise InvalidInputError(
                "--source and --count: the test split is fixed; use --objects NAME ... for a part of it"
            )
        names = command.objects or (QUICK_OBJECTS if command.quick else tuple(contactdb.OBJECTS))
        resolved = dict.fromkeys(store.resolve_name(name, "test") for name in names)
        return [ContactDBSource(name) for name in resolved], None
    from tslam_bench.assets import generate

    candidates = generate.candidates(split)
    if command.objects:
        by_name = {source.name: source for source in candidates}
        unknown = [name for name in command.objects if name not in by_name]
        if unknown:
            raise InvalidInputError(f"object {unknown[0]!r}: no generated object of split {split} has this name")
        return [by_name[name] for name in command.objects], None
    return candidates, command.count or QUICK_GENERATED[split]


def _prepare_hand(again: bool) -> None:
    """Converts the hand if it is missing or damaged, or ``again`` in any case."""
    from tslam_bench.assets import hand
    from tslam_bench.assets.fetch import fetch
    from tslam_bench.assets.sources import HAND_WHEEL

    try:
        hand.load_hand()
        ready = True
    except AssetError:
        ready = False
    if again or not ready:
        print(f"hand: {hand.prepare_hand(fetch(HAND_WHEEL)).urdf}")


def _prepare(command: Prepare) -> None:
    from tslam_bench.assets.prepare import prepare, write_manifest

    if command.hand:
        _prepare_hand(again=True)
        return
    started = time.monotonic()
    split = store.SPLIT_ALIASES.get(command.split, command.split)
    items, count = _sources(command)
    tally: dict[str, int] = {}
    failures = []
    with tqdm(total=count or len(items), unit="object", desc=f"preparing {split}", dynamic_ncols=True) as bar:
        for outcome in prepare(items, count=count, workers=command.workers):
            tally[outcome.status] = tally.get(outcome.status, 0) + 1
            if outcome.status in ("reused", "prepared"):
                bar.update()
            if outcome.status == "prepared":
                gates = outcome.record["gates"] if outcome.record else {}
                why = f" (rebuilt: {outcome.message})" if outcome.message else ""
                bar.write(
                    f"{outcome.name}: {outcome.record['hull_count']} hulls, hull IoU {gates['hull_iou']:.3f}{why}"
                )
            elif outcome.status in ("rejected", "failed"):
                bar.write(outcome.message)
                failures += [outcome.message] if outcome.status == "failed" else []
    if split == "test":
        _prepare_hand(again=False)
    path = write_manifest(split)
    if command.manifest is not None:
        write_manifest(split, command.manifest)
    summary = ", ".join(f"{number} {status}" for status, number in tally.items())
    print(f"{summary}; {time.monotonic() - started:.0f} s; manifest: {path}")
    if failures:
        raise AssetError(f"{len(failures)} of {len(items)} objects failed; first: {failures[0]}")
    if count is not None and tally.get("reused", 0) + tally.get("prepared", 0) < count:
        raise AssetError(f"split {split}: only part of the {count} objects could be made")


def _list(command: List) -> None:
    records = store.list_objects(command.split)
    if command.json:
        print(json.dumps(records, indent=2, sort_keys=True))
        return
    if not records:
        split = store.check_split(command.split)
        print(f"no object of split {split} is prepared; run: tslam-bench assets prepare --split {split}")
        return
    table = Table(box=None, pad_edge=False)
    left = ("name", "category", "aliases")
    for heading in (*left, "extents cm", "volume cm3", "hulls", "hull IoU", "field error mm"):
        table.add_column(heading, justify="left" if heading in left else "right", no_wrap=True)
    for record in records:
        gates = record["gates"]
        table.add_row(
            record["name"],
            record["category"],
            ", ".join(record["aliases"]),
            " x ".join(f"{100 * x:.1f}" for x in record["extents_m"]),
            f"{1e6 * record['volume_m3']:.0f}",
            str(record["hull_count"]),
            f"{gates['hull_iou']:.3f}" + (" " if gates["hull_iou_passes"] else "*"),
            f"{1e3 * gates['field_error_m']:.2f}",
        )
    console = Console()
    console = Console(width=max(console.width, 110))  # a pipe has no width; names must not be cut
    console.print(table)
    if not all(record["gates"]["hull_iou_passes"] for record in records):
        print("* below the gate of 0.85 (docs/objects.md gives the reasons)")


def _show(command: Show) -> None:
    from tslam_bench.assets.pictures import object_picture

    prepared = store.load_object(command.name, command.split)
    path = command.output or Path(f"{prepared.name}.png")
    if path.suffix.lower() != ".png":
        raise InvalidInputError(f"--output {path}: must end in .png")
    picture = object_picture(prepared)
    with atomic_file(path.absolute()) as temporary:
        picture.save(temporary)
    print(path)


def _verify(command: Verify) -> None:
    splits = [store.check_split(command.split)] if command.split else [*store.SPLITS]
    lines, count = [], 0
    for split in splits:
        for name in tqdm(store.prepared_names(split), unit="object", desc=f"verifying {split}", dynamic_ncols=True):
            count += 1
            lines += store.damage(name, split)
    for line in lines:
        print(line)
    if lines:
        raise AssetError(f"{len(lines)} files are missing or corrupt; run the prepare command again to rebuild them")
    print(f"{count} objects are intact")
