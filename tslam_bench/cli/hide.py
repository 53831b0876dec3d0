"""``tslam-bench assets hide``: an organiser's hidden split, the commitment to it, and its opening."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tslam_bench.errors import AssetError, InvalidInputError


@dataclass(frozen=True)
class Hide:
    """Make a hidden split that nobody has seen, and a commitment to publish before anybody is judged on it.

    Objects are drawn by the generator from a secret seed; those of a folder of meshes come on top. Afterwards, --open shows
    whoever has the opening that neither seed nor objects were exchanged.
    """

    seed: str | None = None
    """Secret, at least 12 characters; default: drawn, and kept in the opening."""
    count: int = 50
    """Generated objects."""
    name: str = "hidden"
    """Name of the split."""
    categories: tuple[str, ...] = ()
    """Kinds of things that are drawn; empty: all that the generator knows."""
    folder: Path | None = None
    """Folder of meshes that come on top, as for assets import."""
    license: str = ""
    """Licence of the meshes of the folder."""
    source: str = ""
    """Where they come from."""
    commitment: Path | None = None
    """File to publish, or with --open the one that was published; default: NAME.commitment.json."""
    open: Path | None = None
    """Check this opening against the commitment instead of making anything."""
    workers: int = 2
    """Processes."""
    time_limit: float = 900.0
    """Seconds after which one object is given up."""


Show = Callable[..., tuple[dict[str, int], list[Any]]]
"""Prepares sources and shows how far it is."""


def hide(command: Hide, prepare: Show) -> None:
    """Runs ``tslam-bench assets hide``.

    Args:
        prepare: as :func:`tslam_bench.cli.assets._show_progress`.

    Raises:
        BenchmarkError: bad input, objects that cannot be prepared, or an opening that is not the commitment's.
    """
    from tslam_bench.preparation import hidden
    from tslam_bench.preparation.schedule import write_manifest
    from tslam_bench.sources.generator.hidden import hidden_sources
    from tslam_bench.sources.importer import check_name, scan

    commitment = command.commitment or Path(f"{command.name}.commitment.json")
    if command.open is not None:
        print("\n".join(hidden.check_opening(command.open, commitment)))
        return
    if command.count < 1:
        raise InvalidInputError(f"--count {command.count}: must be at least 1")
    split = check_name(command.name, "split")
    secret = hidden.check_free(split, command.seed) or secrets.token_hex(16)
    sources = hidden_sources(split, secret, 4 * command.count, command.categories)
    own = scan(command.folder, split, command.license, command.source) if command.folder is not None else []
    hidden.write_opening(split, secret)  # before the work: it is gone on with under the same secret
    _, outcomes = prepare(f"hiding in {split}", sources, command.count, command.workers, command.time_limit)
    ready = sum(outcome.record is not None for outcome in outcomes)
    if ready < command.count:
        raise AssetError(f"split {split}: only {ready} of the {command.count} objects could be made")
    if own:
        _, outcomes = prepare(f"importing into {split}", own, None, command.workers, command.time_limit)
        lost = [outcome for outcome in outcomes if outcome.record is None]
        if lost:
            raise AssetError(f"{len(lost)} of {len(own)} meshes could not be prepared; first: {lost[0].message}")
    write_manifest(split)
    opening = hidden.write_opening(split, secret)
    published = hidden.commit(opening, commitment)
    print(f"{commitment}: publish it now; {published['count']} objects, SHA-256 {published['sha256']}")
    print(f"{hidden.opening_path(split)}: the secret and the objects; publish it when all is judged")
