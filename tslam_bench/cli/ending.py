"""How a command ends: the one place where errors become one line and an exit status."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

from tslam_bench.errors import BenchmarkError, UserCodeError
from tslam_bench.extras import named_extra
from tslam_bench.text import visible

_PACKAGE = str(Path(__file__).parents[1])


@contextlib.contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """Exits with 2 (bad input, or the system refuses a file: one line on standard error), 1 (the user's own code raised
    something: its traceback, then one line), 130 (interrupted) or 141 (the reader of a pipe has gone).
    """
    try:
        with named_extra(), _one_line_warnings(program):
            yield
        sys.stdout.flush()  # here, where what goes wrong is one line
    except UserCodeError as error:
        _print_cause(error)
        print(visible(f"{program}: {error}"), file=sys.stderr)
        sys.exit(1)
    except BenchmarkError as error:
        print(visible(f"{program}: {error}"), file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"{program}: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # a reader such as `head` that has seen enough
        _drop_output()
        sys.exit(141)
    except OSError as error:
        if error.filename is None:  # writing to standard output
            _drop_output()
        where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        print(visible(f"{program}: {where}{error.strerror or error}"), file=sys.stderr)
        sys.exit(2)


@contextlib.contextmanager
def _one_line_warnings(program: str) -> Iterator[None]:
    """Warnings of this package without the line of code that they come from."""
    usual = warnings.formatwarning

    def one_line(message: Warning | str, category: type, filename: str, lineno: int, line: str | None = None) -> str:
        if not filename.startswith(_PACKAGE):
            return usual(message, category, filename, lineno, line)
        return visible(f"{program}: {message}") + "\n"

    warnings.formatwarning = one_line
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _drop_output() -> None:
    """What is still to be written to standard output goes nowhere: Python would try again, and fail again, at its end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _print_cause(error: UserCodeError) -> None:
    """The traceback of what the user's code raised, from the first line of theirs on."""
    cause = error.__cause__
    if cause is None:
        return
    frames = cause.__traceback__
    while frames is not None and frames.tb_next is not None and frames.tb_frame.f_code.co_filename.startswith(_PACKAGE):
        frames = frames.tb_next
    traceback.print_exception(type(cause), cause, frames)
