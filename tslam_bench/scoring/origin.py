"""Origins: whether a submission's explorer is what it calls itself (the ids of registered baselines are reserved).

``tslam-bench evaluate`` leaves a sealed note beside each submission that it makes: these files come from that explorer, here.
Whoever calls their own entry ``heuristic`` has no such note, and one that came along has another seal.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from tslam_bench.errors import AssetError
from tslam_bench.files import read_plain_file, write_json
from tslam_bench.scoring.seal import seal, sealed_here
from tslam_bench.scoring.submission import Submission
from tslam_bench.scoring.untrusted_json import parse_json

SUFFIX: Final = ".origin.json"
_MAX_SIZE: Final = 4096


def beside(submission: Path | str, suffix: str) -> Path:
    """A file beside a submission, never inside: its name without ``.zip``, and a suffix."""
    path = Path(submission).resolve()
    return path.with_name(f"{path.stem if path.suffix == '.zip' else path.name}{suffix}")


def write_origin(submission: Submission) -> None:
    """Notes that a submission was made here by its explorer; without a key to seal with, nothing."""
    content = {"content_hash": submission.content_hash, "explorer": submission.info.explorer}
    try:
        write_json(beside(submission.location, SUFFIX), {**content, "seal": seal(content)})
    except AssetError:
        return  # the cache may not be written


def has_origin(submission: Submission) -> bool:
    """Whether the note beside a submission says that its explorer made these very files here."""
    try:
        content = parse_json(read_plain_file(beside(submission.location, SUFFIX), _MAX_SIZE))
        claimed = content.pop("seal", None)
        own = {"content_hash": submission.content_hash, "explorer": submission.info.explorer}
        return content == own and sealed_here(content, claimed)
    except (ValueError, AttributeError, AssetError):
        return False
