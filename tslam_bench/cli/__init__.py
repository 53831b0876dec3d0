"""The ``tslam-bench`` command: hands its arguments to the part that knows them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

from tslam_bench.cli.commands import choose
from tslam_bench.cli.ending import one_line_errors

_COMMANDS = {
    "assets": ("tslam_bench.cli.assets", "main", "prepare, import, list, show and verify objects and the hand"),
    "env": ("tslam_bench.cli.environments", "main", "list environments, describe their spaces, record a video"),
    "baselines": ("tslam_bench.baselines.commands", "main", "list and train the registered policies"),
    "reconstruct": ("tslam_bench.cli.reconstruct", "main", "list, train and run reconstructors"),
    "evaluate": ("tslam_bench.cli.evaluate", "main", "let a policy explore, reconstruct, and write submissions"),
    "view": ("tslam_bench.cli.view", "main", "watch episodes and turn shapes in the browser"),
    "verify": ("tslam_bench.cli.verify", "main", "replay a submission's rollouts and record which reproduce"),
    "submit": ("tslam_bench.cli.submit", "main", "check a submission as a maintainer does, before it is sent"),
    "score": ("tslam_bench.cli.score", "score_main", "score submissions: a table and JSON"),
    "leaderboard": ("tslam_bench.leaderboard.commands", "page_main", "rank scored submissions and build the page"),
    "gpu-check": ("tslam_bench.cli.gpu_check", "main", "compare the GPU simulation with the CPU's"),
    "doctor": ("tslam_bench.cli.doctor", "main", "tell what this machine can do, what is missing, and how fast it is"),
}
"""Word -> module, function and summary: nothing is imported before its word is given."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; :func:`tslam_bench.cli.ending.one_line_errors` has the exit statuses."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["--version"]:
        from tslam_bench.version import __version__

        print(__version__)
        return
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # what a terminal's encoding lacks is an escape, no traceback
    with one_line_errors("tslam-bench"):
        about = "A benchmark for tactile exploration and reconstruction."
        summaries = {name: summary for name, (_, _, summary) in _COMMANDS.items()}
        module, function, _ = _COMMANDS[choose("tslam-bench", about, summaries, given)]
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.append(here)  # for policies of the user's; last, so that it hides nothing
        getattr(importlib.import_module(module), function)(given[1:])
