"""A policy or a reconstructor of a stranger's in a process of its own that cannot reach the network, the true shapes or any file.

What comes back are plain arrays of checked type, shape and range (:mod:`tslam_bench.evaluation.messages`); nothing is unpickled.
:mod:`tslam_bench.evaluation.confined` is the other side.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.errors import InvalidInputError, UserCodeError
from tslam_bench.evaluation.messages import Garbled, Message, decode, encode, read_until, write_until
from tslam_bench.files import cache_directory
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.reconstruction.volume import Volume

_VISIBLE: Final = ("hand",)
"""What a stranger's code may read of the asset cache, beside the learning objects."""
_LEARNING_SPLITS: Final = ("train", "val")
_NO_NAMESPACES: Final = 71
"""Exit status of a child that could not shut itself in."""
_START: Final = 120.0
"""Seconds in which the code has to be imported and made."""
_KEPT: Final = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "TSLAM_BENCH_WEIGHTS")


@dataclass(frozen=True)
class Limits:
    """What a stranger's code may use."""

    answer: float = 120.0
    """Seconds for one answer: the actions of a step, or one reconstruction."""
    cpu: int = 7200
    """CPU seconds of a process."""
    memory: float = 8.0
    """GiB of address space of each process."""
    files: int = 256
    """MiB that it may write, all of it gone afterwards."""
    namespaces: bool = True
    """Ask the system for namespaces. Without them an audit hook of Python is all there is: it stops mistakes, not attackers."""


@dataclass(frozen=True)
class Code:
    """A policy or reconstructor as it was handed in.

    Attributes:
        kind: which of the two.
        reference: registered id, ``module:Class`` or ``path/to/file.py:Class``.
        model: what it reads, or None.
        arguments: of the policy's class.
        learning_objects: see :func:`tslam_bench.evaluation.evaluate.make_reconstructors`.
    """

    kind: Literal["policy", "reconstructor"]
    reference: str
    model: Path | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict)
    learning_objects: tuple[str, ...] = ()

    def located(self) -> str:
        """The reference with an absolute path: the child stands elsewhere."""
        where, _, name = self.reference.rpartition(":")
        return f"{Path(where).resolve()}:{name}" if where.endswith(".py") else self.reference


class ConfinedCode:
    """The process that runs a :class:`Code`. Use it as a context manager.

    Attributes:
        control_mode: of a policy.
        confinement: how the process is shut in: ``network`` and ``files``.
    """

    def __init__(
        self, code: Code, limits: Limits | None = None, hidden: Sequence[Path] = (), split: str = "test"
    ) -> None:
        """Starts it.

        Args:
            code: what it runs.
            limits: what it may use.
            hidden: files and folders that it cannot read, beside the true shapes of ``split`` and the cache's secrets.

        Raises:
            InvalidInputError: there is no such code, or it does not make a policy (or reconstructor).
            UserCodeError: the code raised something, was too slow, or its process died.
        """
        self._label = f"{code.kind} {code.reference!r}"
        self._limits = limits or Limits()
        self._code, self._hidden = code, [*_secrets(split), *hidden]
        self._folder = tempfile.TemporaryDirectory(prefix="tslam-confined-")
        self._process: subprocess.Popen | None = None
        try:
            self.confinement = self._start(self._limits.namespaces)
            self.control_mode = str(self.ask(None, seconds=max(_START, self._limits.answer))[0].get("control_mode"))
        except BaseException:
            self.close()
            raise
        if code.kind == "policy" and self.control_mode not in CONTROL_MODES:
            self.close()
            raise InvalidInputError(f"{self._label}: its control_mode is none of {', '.join(CONTROL_MODES)}")

    def _start(self, namespaces: bool) -> dict[str, str]:
        """Starts the process; how it is shut in."""
        scratch = Path(self._folder.name) / "scratch"
        scratch.mkdir(exist_ok=True)
        self._log = Path(self._folder.name) / "log"
        model = self._code.model
        config = {
            "kind": self._code.kind,
            "code": self._code.located(),
            "model": None if model is None else str(model.resolve()),
            "arguments": dict(self._code.arguments),
            "learning_objects": list(self._code.learning_objects),
            "namespaces": namespaces,
            "scratch": str(scratch),
            "hidden": [str(path.resolve()) for path in self._hidden if path.exists()],
            "path": [str(Path(entry).resolve()) for entry in sys.path],
            "memory_bytes": int(self._limits.memory * 2**30),
            "file_bytes": self._limits.files * 2**20,
            "seconds": self._limits.cpu,
        }
        environment = {name: os.environ[name] for name in _KEPT if name in os.environ}
        environment |= {
            **dict.fromkeys(("HOME", "TMPDIR", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "MPLCONFIGDIR"), str(scratch)),
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
            "TSLAM_BENCH_CACHE": str(cache_directory()),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        program = Path(__file__).with_name("confined.py")
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(program)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                cwd=self._folder.name,
                start_new_session=True,
            )
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        try:
            return self._exchange(json.dumps(config).encode() + b"\n", max(_START, self._limits.answer))[0][
                "confinement"
            ]
        except EOFError:
            if namespaces and self._process.wait() == _NO_NAMESPACES:
                self._stop()
                return self._start(namespaces=False)
            raise UserCodeError(self._death()) from None

    def ask(
        self,
        header: Mapping[str, Any] | None,
        arrays: Mapping[str, NDArray] | None = None,
        seconds: float | None = None,
    ) -> Message:
        """Sends a request (None: none) and returns the answer. Raises what the constructor raises."""
        try:
            return self._exchange(b"" if header is None else encode(header, arrays), seconds or self._limits.answer)
        except (EOFError, BrokenPipeError):
            raise UserCodeError(self._death()) from None

    def _exchange(self, data: bytes, seconds: float) -> Message:
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        deadline = time.monotonic() + seconds
        try:
            write_until(process.stdin.fileno(), data, deadline)
            header, arrays = decode(read_until(process.stdout.fileno(), deadline))
        except TimeoutError:
            self._stop()
            raise UserCodeError(f"{self._label}: no answer within {seconds:g} s") from None
        except Garbled as error:
            self._stop()
            raise InvalidInputError(f"{self._label}: answered with {error}") from error
        if "error" in header:
            kind = UserCodeError if header.get("theirs") else InvalidInputError
            raise kind(f"{self._label}: {str(header['error'])[:500]}")
        return header, arrays

    def _death(self) -> str:
        self._stop()
        last = self._log.read_bytes()[-2000:].decode(errors="replace").strip().splitlines()
        said = f" ({last[-1][:200]})" if last else ""
        limits = self._limits
        return (
            f"{self._label}: its process ended{said}; it may use {limits.memory:g} GiB, {limits.cpu} CPU seconds and "
            f"{limits.files} MiB of files"
        )

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        for child in _children(process.pid):  # the first process of its namespace: all others in it end with it
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()

    def close(self) -> None:
        """Ends the process."""
        self._stop()
        self._folder.cleanup()

    def __enter__(self) -> ConfinedCode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ConfinedPolicy:
    """A policy (:class:`tslam_bench.evaluation.policy.Policy`) whose code runs shut in."""

    def __init__(self, code: ConfinedCode) -> None:
        self.control_mode = code.control_mode
        self._code = code

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        seeds = seed if isinstance(seed, int) else [int(each) for each in seed]
        self._code.ask({"do": "reset", "num_envs": num_envs, "seeds": seeds})

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`tslam_bench.evaluation.policy.Policy`."""
        header, arrays = self._code.ask({"do": "act"}, observation)
        actions = arrays.get("actions", np.zeros((0, NUM_JOINTS), np.float32))
        given = str(header.get("type"))
        return actions if given == "float32" else actions.astype("float64")  # the check of policies refuses it


class ConfinedReconstructor:
    """A reconstructor (:class:`tslam_bench.reconstruction.volume.Reconstructor`) whose code runs shut in.

    Its volumes have half precision, as in a submission.
    """

    def __init__(self, code: ConfinedCode, name: str) -> None:
        self.name = name
        self._code = code

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """See :class:`tslam_bench.reconstruction.volume.Reconstructor`."""
        grids = {"touched": touched.astype("|u1"), "visited": visited.astype("|u1")}
        header, arrays = self._code.ask({"do": "reconstruct"}, grids)
        if "probability" not in arrays:
            raise InvalidInputError(f"reconstructor {self.name}: answered without a volume")
        return Volume(arrays["probability"].astype(np.float32), header.get("interpolation", ""))


def _children(process: int) -> list[int]:
    path = Path(f"/proc/{process}/task/{process}/children")
    with contextlib.suppress(OSError):
        return [int(child) for child in path.read_text().split()]
    return []


def _secrets(split: str) -> list[Path]:
    """All of the asset cache but the hand and the objects of train and val (unless it is they that are judged)."""
    cache = cache_directory()
    if not cache.is_dir():
        return []
    entries = [path for path in cache.iterdir() if path.name not in ("objects", *_VISIBLE)]
    objects = cache / "objects"
    splits = list(objects.iterdir()) if objects.is_dir() else []
    return [*entries, *(path for path in splits if path.name not in _LEARNING_SPLITS or path.name == split)]
