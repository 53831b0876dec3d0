"""``submission.json``: what a submission says about itself, read strictly (protocol section 12)."""

from __future__ import annotations

import dataclasses
import difflib
import re
from dataclasses import dataclass, field
from typing import Any, Final

from tslam_bench.constants import (
    ENVIRONMENT_ID,
    PRIVILEGED_EXPLORERS,
    PRIVILEGED_REWARD_MODES,
    PROTOCOL_VERSION,
    REWARD_MODES,
)
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.plugins import IDENTIFIER
from tslam_bench.scoring.untrusted_json import parse_json
from tslam_bench.text import CONTROL

SCHEMA_VERSION: Final = 2
"""Version of the submission format. 2: rollouts hold joint checkpoints."""
OBJECT_SETS: Final = ("quick", "test")
"""What a submission covers: the five quick objects or the whole test split; one of another split names that."""

_SHA256 = re.compile(r"[0-9a-f]{64}")
_SPLIT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_SALT = re.compile(r"[0-9a-fA-F]{1,64}")
_STATED = ("schema_version", "protocol_version", "environment_id", "control_mode", "policy_salt")
"""Fields that have a default for who writes a submission; a file has to state them."""
_MAX_TEXT = 300
_MAX_SEED = 2**31 - 1
_MAX_HOURS = 10_000_000


@dataclass(frozen=True)
class Training:
    """Training budget and the machine it was spent on.

    Attributes:
        steps: environment steps of training; 0 for untrained methods.
        wall_time_hours: wall-clock hours of training.
        hardware: processor, accelerator, number of machines.
    """

    steps: int = 0
    wall_time_hours: float = 0.0
    hardware: str = ""


@dataclass(frozen=True)
class SubmissionInfo:
    """Contents of ``submission.json``.

    Attributes:
        method: name shown on the leaderboard.
        explorer: id of the baseline, or a name of your own: what moves the hand.
        reconstructor: id of the reconstructor, or a name of your own: what completes the shape.
        authors: names, at least one.
        asset_manifest_sha256: hash of the asset manifest that the rollouts were made with, 64 hexadecimal digits.
        seeds: episode seeds, each with its own rollouts and reconstructions.
        object_set: ``"quick"`` or ``"test"``, or the name of another split: submissions are ranked within one set.
        privileged: anything the policy saw or was rewarded with derives from the true mesh.
        reward_mode: reward the policy was trained with (``REWARD_MODES``), or None for another or no reward.
        control_mode: mode (``CONTROL_MODES``) that the rollouts' actions are of.
        policy_salt: 1 to 64 hexadecimal digits that salt the benchmark's stream of random numbers for policies
            (``tslam_bench.episodes``), or None if the policy's random numbers did not come from that stream.
        training: budget and hardware.
        label: a remark shown beside every figure, such as "quick run: 4,000 steps, proves the path".
        contact: how to reach the authors; may be empty.
        link: http(s) address of a paper or of code; may be empty.
        package_version: version of tslam-bench that made the rollouts.
        protocol_version, environment_id: must be the scorer's own.
        schema_version: version of this format.
    """

    method: str
    explorer: str
    reconstructor: str
    authors: tuple[str, ...]
    asset_manifest_sha256: str
    seeds: tuple[int, ...]
    object_set: str
    privileged: bool
    package_version: str
    reward_mode: str | None = None
    control_mode: str = "pd_joint_delta_pos"
    policy_salt: str | None = None
    training: Training = field(default_factory=Training)
    label: str = ""
    contact: str = ""
    link: str = ""
    protocol_version: int = PROTOCOL_VERSION
    environment_id: str = ENVIRONMENT_ID
    schema_version: int = SCHEMA_VERSION

    def __post_init__(self) -> None:
        """Raises InvalidInputError naming the first field that is not what it has to be."""
        for name in ("schema_version", "protocol_version"):
            _integer(getattr(self, name), name, 0)
        for name, own, remedy in (
            ("schema_version", SCHEMA_VERSION, "write the submission with this package's SubmissionWriter"),
            ("protocol_version", PROTOCOL_VERSION, "make the rollouts with this version of the package"),
            ("environment_id", ENVIRONMENT_ID, "only the default task is scored"),
        ):
            if getattr(self, name) != own:
                raise InvalidInputError(f"{name} is {_shown(getattr(self, name))}, the scorer's is {own!r}; {remedy}")
        for name in ("method", "package_version"):
            if not _text(getattr(self, name), name).strip():
                raise InvalidInputError(f"{name} is empty; fill it in")
        for name in ("label", "contact", "link"):
            _text(getattr(self, name), name)
        for name in ("explorer", "reconstructor"):
            if not IDENTIFIER.fullmatch(_text(getattr(self, name), name)):
                raise InvalidInputError(
                    f"{name} {_shown(getattr(self, name))}: use at most 64 of a-z, 0-9, '_', '.', '-'"
                )
        if self.link and not re.fullmatch(r"https?://\S+", self.link):
            raise InvalidInputError(f"link {_shown(self.link)}: give an http(s) address or leave it empty")
        if not _SHA256.fullmatch(_text(self.asset_manifest_sha256, "asset_manifest_sha256")):
            raise InvalidInputError("asset_manifest_sha256: expected 64 hexadecimal digits in lower case")
        if not isinstance(self.authors, tuple) or not 1 <= len(self.authors) <= 100:
            raise InvalidInputError("authors: expected a list of 1 to 100 names")
        for author in self.authors:
            if not _text(author, "authors").strip():
                raise InvalidInputError("authors: one name is empty; fill it in")
        if not isinstance(self.seeds, tuple) or not 1 <= len(self.seeds) <= 100:
            raise InvalidInputError("seeds: expected a list of 1 to 100 integers")
        for seed in self.seeds:
            _integer(seed, "seeds", 0, _MAX_SEED)
        if len(set(self.seeds)) != len(self.seeds):
            raise InvalidInputError("seeds: the same seed is listed twice")
        if not _SPLIT.fullmatch(_text(self.object_set, "object_set")):
            raise InvalidInputError(
                f"object_set {_shown(self.object_set)}: choose one of {', '.join(OBJECT_SETS)}, or give the name of another split"
            )
        if not isinstance(self.privileged, bool):
            raise InvalidInputError(f"privileged is {self.privileged!r}; expected true or false")
        if self.reward_mode is not None and self.reward_mode not in REWARD_MODES:
            raise InvalidInputError(
                f"reward_mode {_shown(self.reward_mode)}: choose null or one of {', '.join(REWARD_MODES)}"
            )
        if self.control_mode not in CONTROL_MODES:
            raise InvalidInputError(
                f"control_mode {_shown(self.control_mode)}: choose one of {', '.join(CONTROL_MODES)}"
            )
        if self.policy_salt is not None and not _SALT.fullmatch(_text(self.policy_salt, "policy_salt")):
            raise InvalidInputError("policy_salt: expected 1 to 64 hexadecimal digits, or null")
        if not isinstance(self.training, Training):
            raise InvalidInputError("training: expected an object with steps, wall_time_hours and hardware")
        _integer(self.training.steps, "training.steps", 0)
        hours = self.training.wall_time_hours
        if isinstance(hours, bool) or not isinstance(hours, int | float) or not 0 <= hours <= _MAX_HOURS:
            raise InvalidInputError(
                f"training.wall_time_hours is {_shown(hours)}; expected a number of hours from 0 to {_MAX_HOURS:,}"
            )
        _text(self.training.hardware, "training.hardware")
        if not self.privileged and (
            self.reward_mode in PRIVILEGED_REWARD_MODES or self.explorer in PRIVILEGED_EXPLORERS
        ):
            used = f"explorer {self.explorer!r}"
            if self.reward_mode in PRIVILEGED_REWARD_MODES:
                used = f"reward mode {_shown(self.reward_mode)}"
            raise InvalidInputError(f"privileged is false, but {used} counts as privileged; set privileged to true")

    @property
    def split(self) -> str:
        """The split that its objects are of."""
        return "test" if self.object_set in OBJECT_SETS else self.object_set

    def to_json(self) -> dict[str, Any]:
        """Plain values for ``submission.json``."""
        return dataclasses.asdict(self)

    def identity(self) -> tuple[object, ...]:
        """What must not change when a submission is resumed."""
        names = ("method", "explorer", "reconstructor", "object_set", "environment_id", "protocol_version")
        more = ("asset_manifest_sha256", "privileged", "reward_mode", "control_mode", "policy_salt")
        return tuple(getattr(self, n) for n in (*names, *more))


def parse_info(text: bytes) -> SubmissionInfo:
    """Reads the bytes of ``submission.json``.

    Raises:
        InvalidInputError: not JSON, a field is missing, unknown or not what it has to be.
    """
    try:
        values = parse_json(text)
    except ValueError as error:
        reason = " ".join(str(error).split())[:120]
        raise InvalidInputError(f"not valid JSON ({reason}); see docs/submission.md for the format") from error
    return check_info(values)


def check_info(values: Any) -> SubmissionInfo:
    """What JSON values say about a submission.

    Raises:
        InvalidInputError: a field is missing, unknown or not what it has to be.
    """
    return _build(SubmissionInfo, values, "")


def _build(kind: type, values: Any, prefix: str) -> Any:
    """Builds a dataclass of this module from a JSON object with exactly its fields."""
    if not isinstance(values, dict):
        raise InvalidInputError(f"{prefix or 'the file'}: expected a JSON object")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        if name not in fields:
            near = difflib.get_close_matches(name, fields, n=1)
            remedy = f"did you mean {near[0]!r}?" if near else "remove it"
            raise InvalidInputError(f"unknown field {prefix}{name[:60]!r}; {remedy}")
    for name, f in fields.items():
        required = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if name not in values and (required or name in _STATED):
            raise InvalidInputError(f"field {prefix}{name} is missing; see docs/submission.md for the format")
    read = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    if "training" in read:
        read["training"] = _build(Training, read["training"], "training.")
    return kind(**read)


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise InvalidInputError(f"{name} is {_shown(value)}; expected text")
    if len(value) > _MAX_TEXT or CONTROL.search(value):
        raise InvalidInputError(f"{name}: expected at most {_MAX_TEXT} characters on one line")
    return value


def _integer(value: Any, name: str, low: int, high: int = 10**15) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InvalidInputError(f"{name} is {_shown(value)}; expected an integer from {low} to {high}")
    return value


def _shown(value: Any) -> str:
    return repr(value)[:60]
