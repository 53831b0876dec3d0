"""The 3D pages of a leaderboard's entries, in a folder beside its page."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Final

from tslam_bench.scoring.submission import Submission
from tslam_bench.viewing.entries import submission_entry
from tslam_bench.viewing.site import write_viewer

VIEWER_FOLDER: Final = "viewer"


def write_entries_viewer(
    page_folder: Path,
    submissions: Mapping[str, Submission],
    objects: Collection[str],
    replay: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
    cache: Path | None = None,
) -> dict[tuple[str, str], str]:
    """Writes ``viewer/`` beside a leaderboard's page: shapes and episodes of every entry's first seed.

    What is there already is kept, so only entries that are new take time: about a second for each object, and as much for the
    episodes of an explorer.

    Args:
        page_folder: where the page lies or will lie.
        submissions: content hash -> submission.
        objects: those to show; what a submission does not hold is left out.
        replay: simulate stored episodes again where there is a simulator, so that every step is shown.
        on_progress: called with (done, all) objects of entries.
        cache: asset cache.

    Returns:
        (content hash, object) -> address relative to the page's folder: opens the object's shapes. Add ``&view=episode`` for
        the episodes.

    Raises:
        InvalidInputError: ``viewer/`` holds something else, or a submission is not readable any more.
        AssetError: it cannot be written.
    """
    entries = {}
    for content_hash, submission in submissions.items():
        held = [name for name in submission.objects() if name in objects]
        if held:
            entries[content_hash] = submission_entry(submission, held)
    motions = None
    if replay and importlib.util.find_spec("sapien") is not None:
        from tslam_bench.evaluation.playback import replays

        motions = replays()
    written = write_viewer(
        page_folder / VIEWER_FOLDER, list(entries.values()), motions, "Leaderboard", on_progress, cache
    )
    return {
        (content_hash, name): f"{VIEWER_FOLDER}/{written.links[entry.key, name]}&view=shape"
        for content_hash, entry in entries.items()
        for name in entry.objects
        if (entry.key, name) in written.links
    }
