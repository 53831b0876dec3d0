"""Figures of a training run for TensorBoard. They are for looking at: a run goes on where they cannot be written.

TensorBoard's own writer works in a thread, whose error on a full disk ends the run it belongs to.
"""

from __future__ import annotations

import contextlib
import os
import time
import warnings
from pathlib import Path
from typing import Any


class Curves:
    """Event files of one run in a folder.

    Args:
        folder: where TensorBoard looks for them.
        first_step: what earlier parts of the run wrote from this step on is not shown.
    """

    def __init__(self, folder: Path, first_step: int = 0) -> None:
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event = Event
        self._path = folder / f"events.out.tfevents.{time.time_ns() // 1000}.{os.getpid()}"
        self._writer: Any = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._writer = RecordWriter(self._path.open("wb"))
        except OSError as error:
            self._give_up(error)
        self._write(file_version="brain.Event:2")
        self._write(step=first_step, session_log=SessionLog(status=SessionLog.START))

    def add(self, name: str, value: float, step: int) -> None:
        """One figure."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        self._write(step=step, summary=Summary(value=[Summary.Value(tag=name, simple_value=value)]))

    def close(self) -> None:
        """Closes the file."""
        writer, self._writer = self._writer, None
        if writer is not None:
            with contextlib.suppress(OSError):  # what is left to be written is written here, or not
                writer.close()

    def _write(self, **content: Any) -> None:
        if self._writer is None:
            return
        try:
            self._writer.write(self._event(wall_time=time.time(), **content).SerializeToString())
            self._writer.flush()
        except OSError as error:
            self.close()
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        warnings.warn(
            f"{self._path}: cannot be written ({error.strerror}); the run goes on without curves", stacklevel=1
        )
