"""Entries of one explorer: a row of the gallery and a line of the charts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

COLOURS: Final = 12
"""Number of line colours in the style sheet."""


@dataclass
class Explorer:
    """Entries that share their rollouts: one row of the gallery, one line of the charts."""

    label: str
    privileged: bool
    colour: int = 0
    entries: list[dict[str, Any]] = field(default_factory=list)

    @property
    def style(self) -> str:
        """Classes of the style sheet for its swatch; a line beyond the last colour takes the first again, dashed."""
        return f"c{self.colour % COLOURS}" + (" dashed" if self.dashed else "")

    @property
    def dashed(self) -> bool:
        """Whether its lines are dashed."""
        return self.privileged or self.colour >= COLOURS

    @property
    def curve(self) -> list[float]:
        """Mean touched-surface recall every few steps; empty for a reference without rollouts."""
        return self.entries[0]["recall_curve"]


def group_explorers(entries: Sequence[dict[str, Any]]) -> list[Explorer]:
    """Explorers in the order of their best entry; entries of one explorer name and one exploration curve belong together.

    One that only claims the name of a baseline is another, whatever its curve.
    """
    explorers: dict[tuple[str, bool, tuple[float, ...]], Explorer] = {}
    for entry in entries:
        name = entry["submission"]["explorer"]
        key = (name, entry["claimed"], tuple(entry["recall_curve"]))
        if key not in explorers:
            taken = any(known == name and not claimed for known, claimed, _ in explorers)
            label = f"{name} ({entry['submission']['method']})" if taken or entry["claimed"] else name
            explorers[key] = Explorer(label, entry["submission"]["privileged"])
        explorers[key].entries.append(entry)
    found = list(explorers.values())
    # Ranked explorers first: where colours run out, a dashed line shares the colour of a plain one.
    for colour, explorer in enumerate(sorted(found, key=lambda e: e.privileged)):
        explorer.colour = colour
    return found
