"""Verification records: what a replay of a submission's rollouts found, and whether scoring may believe it (protocol section 12).

A record is written by :mod:`tslam_bench.evaluation.verify` and read here, without a simulator. It belongs to one submission (its
``content_hash``) on one set of assets. A seal, an HMAC under a key that lies in this user's asset cache and goes nowhere, tells
records that were made here from those that somebody sent along.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import GRID_SIZE, HORIZON, PROTOCOL_VERSION
from tslam_bench.episodes import Episode
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import read_plain_file, write_json
from tslam_bench.objects.splits import SPLITS
from tslam_bench.objects.store import asset_sha256
from tslam_bench.scoring.attestation import Attestation
from tslam_bench.scoring.origin import beside
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.score_file import Tier
from tslam_bench.scoring.seal import seal, sealed_here
from tslam_bench.scoring.submission import Submission

RECORD_VERSION: Final = 1
"""Version of a record's layout."""
MAX_RECORD_SIZE: Final = 64 * 2**20
"""Bytes of a record."""
SUFFIX: Final = ".verification.json"
Mode = Literal["bits", "segments"]
_VOXELS: Final = GRID_SIZE**3


@dataclass(frozen=True)
class Tolerances:
    """How far the replay of a ten-step segment may be from what is stored; ``docs/verification.md`` has the measurements."""

    arm: float = 0.01
    """Farthest translation of the arm at a segment's end (m)."""
    joints: float = 0.3
    """Farthest of the other joints at a segment's end (rad)."""
    beyond: float = 0.25
    """Share of an episode's segments that may end further away, where a contact went the other way."""
    far: float = 10.0
    """How many times further even those may not be."""
    touches: float = 0.15
    """Share of the stored touched voxels (three voxels at least) that may have no replayed one among their neighbours."""


@dataclass(frozen=True)
class Verdict:
    """What the replay of one episode found.

    Attributes:
        object, pose, seed: the episode.
        departed: what differs first (``start``, ``joints``, ``touches``, ``visited``), or None if the episode reproduces.
        step: control step (from 0) by which it departed; None if it reproduces or did not start alike.
        touched: the replay's touched voxels and their first steps: see :func:`pack_steps`.
    """

    object: str
    pose: int
    seed: int
    departed: str | None
    step: int | None
    touched: str

    @property
    def episode(self) -> Episode:
        """Object, pose, repetition."""
        return self.object, self.pose, self.seed

    def __str__(self) -> str:
        where = f"{self.object}, pose {self.pose}, seed {self.seed}"
        if self.departed is None:
            return f"{where}: reproduces"
        return f"{where}: {self.departed} depart" + ("" if self.step is None else f" by step {self.step}")


@dataclass(frozen=True)
class VerificationRecord:
    """Verdicts on a submission's episodes.

    Attributes:
        content_hash: of the submission that was replayed.
        assets: object -> hash of the products that it was replayed on, of the objects that are finished.
        mode: ``bits``: everything equal, bit for bit; ``segments``: each ten steps from their joint checkpoint, within
            tolerances.
        tolerances: those of ``segments``, by name.
        package_version, processor, simulator: what replayed.
        verdicts: one for each rollout of each object in ``assets``.
        split: of the objects.
        attestation: what running the submission's own code gave, if that was done.
    """

    content_hash: str
    assets: Mapping[str, str]
    mode: Mode
    tolerances: Mapping[str, float]
    package_version: str
    processor: str
    simulator: str
    verdicts: tuple[Verdict, ...]
    split: str = "test"
    attestation: Attestation | None = None

    @property
    def tier(self) -> Tier:
        """How far the submission was checked."""
        if self.attestation is None or self.departed or self.attestation.failures():
            return "replayed"
        return "attested" if self.split in SPLITS else "hidden"

    @property
    def departed(self) -> tuple[Verdict, ...]:
        """The episodes that do not reproduce."""
        return tuple(verdict for verdict in self.verdicts if verdict.departed is not None)

    def same_replay(self, other: VerificationRecord) -> bool:
        """Whether both are of one submission, replayed in one way on one machine: then one can go on where the other stopped."""
        return _bare(self) == _bare(other)

    def of_object(self, name: str) -> VerificationRecord:
        """The same record with one object's verdicts only."""
        own = tuple(verdict for verdict in self.verdicts if verdict.object == name)
        return dataclasses.replace(self, assets={k: v for k, v in self.assets.items() if k == name}, verdicts=own)

    def replayed(self, rollout: Rollout) -> Rollout | None:
        """The rollout with the touches that its replay made, or None if it did not reproduce."""
        wanted = (rollout.object, rollout.pose, rollout.seed)
        verdict = next(verdict for verdict in self.verdicts if verdict.episode == wanted)
        if verdict.departed is not None:
            return None
        steps = unpack_steps(verdict.touched)
        return dataclasses.replace(rollout, touched=steps >= 0, touched_step=steps)

    def summary(self) -> str:
        """One line for readers of figures."""
        how = "bit for bit" if self.mode == "bits" else "in segments, within tolerances"
        if not self.departed:
            return f"replayed {how}: all {len(self.verdicts)} episodes reproduce"
        named = "; ".join(map(str, self.departed[:5]))
        more = f"; and {len(self.departed) - 5} more" if len(self.departed) > 5 else ""
        return (
            f"replayed {how}: {len(self.departed)} of {len(self.verdicts)} episodes do not reproduce and count as untouched: "
            f"{named}{more}"
        )

    def check(self, submission: Submission, objects: Iterable[str], where: str, cache: Path | None = None) -> None:
        """Raises InvalidInputError unless this is a record of these files, these assets, and all rollouts of ``objects``."""
        if self.content_hash != submission.content_hash:
            raise InvalidInputError(f"{where}: made for other files than {submission.location} holds; run verify again")
        if self.split != submission.split:
            raise InvalidInputError(f"{where}: made on split {self.split}, not {submission.split}; run verify again")
        for name in objects:
            wanted = {episode for episode in submission.episodes() if episode[0] == name}
            if wanted and name not in self.assets:
                raise InvalidInputError(f"{where}: {name} is not replayed yet; run verify again to go on")
            if wanted and self.assets[name] != asset_sha256([name], self.split, cache):
                raise InvalidInputError(
                    f"{where}: {name} was replayed on other assets than are prepared here; run verify again"
                )
            if sorted(wanted) != sorted(verdict.episode for verdict in self.verdicts if verdict.object == name):
                raise InvalidInputError(f"{where}: not one verdict for each rollout of {name}; run verify again")

    def write(self, path: Path) -> None:
        """Writes the record with its seal. Raises AssetError if the file or the key cannot be written."""
        content = {"record_version": RECORD_VERSION, "protocol_version": PROTOCOL_VERSION, **dataclasses.asdict(self)}
        write_json(path, {**content, "seal": seal(content)})

    @staticmethod
    def read(path: Path) -> VerificationRecord:
        """Reads what :meth:`write` wrote here.

        Raises:
            InvalidInputError: missing, damaged, of another version, or not made by this user on this machine.
        """
        remedy = "run tslam-bench verify again"
        try:
            content = json.loads(read_plain_file(path, MAX_RECORD_SIZE))
            claimed = content.pop("seal")
            if content["record_version"] != RECORD_VERSION or content["protocol_version"] != PROTOCOL_VERSION:
                raise InvalidInputError(f"{path}: a verification record of another version; {remedy}")
            if not sealed_here(content, claimed):
                raise InvalidInputError(f"{path}: not made here, or changed since; {remedy}")
            fields = {k: v for k, v in content.items() if k not in ("record_version", "protocol_version", "verdicts")}
            attestation = fields.pop("attestation", None)
            return VerificationRecord(
                **fields,
                verdicts=tuple(Verdict(**v) for v in content["verdicts"]),
                attestation=attestation and Attestation(**attestation),
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            if isinstance(error, InvalidInputError):
                raise
            reason = " ".join(str(error).split())[:100]
            raise InvalidInputError(f"{path}: not a verification record ({reason}); {remedy}") from error


def _bare(record: VerificationRecord) -> VerificationRecord:
    return dataclasses.replace(record, assets={}, verdicts=(), attestation=None)


def record_path(submission: Path | str) -> Path:
    """Where the record of a submission lies if nothing else was said: beside it, never inside."""
    return beside(submission, SUFFIX)


def find_record(
    submission: Submission, objects: Iterable[str], cache: Path | None = None
) -> tuple[VerificationRecord | None, str | None]:
    """The record beside a submission, if there is one and it can be trusted; and else why it cannot."""
    path = record_path(submission.location)
    if not path.is_file():
        return None, None
    try:
        record = VerificationRecord.read(path)
        record.check(submission, objects, str(path), cache)
    except InvalidInputError as error:
        return None, f"not replayed: {error}"
    return record, None


def pack_steps(touched_step: NDArray[np.int16]) -> str:
    """First steps (32, 32, 32), -1 for never, as text: base64 of deflated voxel indices (uint16) and steps (uint8)."""
    flat = touched_step.reshape(-1)
    voxels = np.flatnonzero(flat >= 0)
    data = voxels.astype("<u2").tobytes() + flat[voxels].astype(np.uint8).tobytes()
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def unpack_steps(text: str) -> NDArray[np.int16]:
    """Inverse of :func:`pack_steps`. Raises InvalidInputError for anything else."""
    try:
        stream = zlib.decompressobj()
        data = stream.decompress(base64.b64decode(text, validate=True), 3 * _VOXELS + 1)
    except (ValueError, zlib.error) as error:
        raise InvalidInputError(f"verification record: damaged touches ({error}); run verify again") from error
    count = len(data) // 3
    voxels, steps = np.frombuffer(data[: 2 * count], "<u2"), np.frombuffer(data[2 * count :], np.uint8)
    if not stream.eof or len(data) != 3 * count or (voxels >= _VOXELS).any() or (steps >= HORIZON).any():
        raise InvalidInputError("verification record: touches outside the grid or the episode; run verify again")
    flat = np.full(_VOXELS, -1, dtype=np.int16)
    flat[voxels] = steps
    return flat.reshape((GRID_SIZE,) * 3)
