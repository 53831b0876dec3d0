"""Commands in tables: a word, and what it stands for. tyro reads the flags of the one that was chosen.

Not one nested tyro application: that has to import every command's settings, scoring and training among them, before it can print
``--help``, and its message about an unknown word is a box of several lines.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from tslam_bench.errors import InvalidInputError

Commands = Mapping[str, tuple[type, Any]]
"""Word -> the dataclass of its flags, whose docstring is its help, and the function that runs it."""


def choose(program: str, about: str, summaries: Mapping[str, str], arguments: Sequence[str]) -> str:
    """The command that ``arguments`` begin with; prints the table and exits where help or nothing was asked for.

    Raises:
        InvalidInputError: an unknown word.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(map(len, summaries))
        lines = [f"usage: {program} COMMAND ...", "", about, "", "commands:"]
        lines += [f"  {name:{width}}  {summary}" for name, summary in summaries.items()]
        print("\n".join([*lines, "", f"{program} COMMAND --help tells more."]))
        sys.exit(0 if arguments else 2)
    if arguments[0] not in summaries:
        named = " ".join([*program.split()[1:], repr(arguments[0])])
        raise InvalidInputError(f"{named}: unknown command; choose one of {', '.join(summaries)}")
    return arguments[0]


def run_command(program: str, about: str, commands: Commands, arguments: Sequence[str]) -> None:
    """Runs one of several commands of a module.

    Raises:
        BenchmarkError: bad input; the message is one line.
    """
    summaries = {name: _first_sentence(flags) for name, (flags, _) in commands.items()}
    name = choose(program, about, summaries, arguments)
    flags, run = commands[name]
    run(parse(f"{program} {name}", flags, arguments[1:]))


def parse(program: str, flags: type, arguments: Sequence[str]) -> Any:
    """The flags of a command from its arguments; prints help or what is wrong with a flag, and exits."""
    import tyro

    return tyro.cli(flags, args=list(arguments), prog=program, config=(tyro.conf.FlagCreatePairsOff,))


def _first_sentence(flags: type) -> str:
    return " ".join((inspect.getdoc(flags) or "").split("\n\n")[0].split()).partition(". ")[0].rstrip(".")
