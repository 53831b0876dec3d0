"""The ``tslam-bench`` command: hands its arguments to the part that knows them."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from tslam_bench.errors import BenchmarkError

_COMMANDS = {
    "assets": ("tslam_bench.cli.assets", "main", "prepare, list, show and verify objects and the hand"),
    "baselines": ("tslam_bench.baselines.commands", "main", "list, train and evaluate the registered explorers"),
    "reconstruct": ("tslam_bench.cli.reconstruct", "main", "train and run reconstructors"),
    "score": ("tslam_bench.cli.score", "score_main", "score submissions: a table and JSON"),
    "leaderboard": ("tslam_bench.leaderboard.commands", "page_main", "rank scored submissions and build the page"),
    "gpu-check": ("tslam_bench.cli.gpu_check", "main", "compare the GPU simulation with the CPU's"),
    "env": ("tslam_bench.cli.environments", "main", "list environments, describe their spaces, record a video"),
}


def _usage() -> str:
    lines = [
        "usage: tslam-bench COMMAND ...",
        "",
        "A benchmark for tactile exploration and reconstruction.",
        "",
        "commands:",
    ]
    lines += [f"  {name:12} {summary}" for name, (_, _, summary) in _COMMANDS.items()]
    return "\n".join([*lines, "", "tslam-bench COMMAND --help tells more."])


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point. Exits with 0, 2 (bad input, one line on standard error) or 130 (interrupted)."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(_usage())
        sys.exit(0 if given else 2)
    if given[0] == "--version":
        from tslam_bench.version import __version__

        print(__version__)
        return
    if given[0] not in _COMMANDS:
        print(f"tslam-bench: unknown command {given[0]!r}; choose one of {', '.join(_COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    module, function, _ = _COMMANDS[given[0]]
    try:
        getattr(importlib.import_module(module), function)(given[1:])
    except BenchmarkError as error:
        print(f"tslam-bench: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("tslam-bench: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # a reader such as `head` that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
