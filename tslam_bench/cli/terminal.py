"""Texts of strangers in the tables that commands print."""

from __future__ import annotations

from rich.text import Text

from tslam_bench.text import visible


def cell(text: str, style: str = "") -> Text:
    """A text as it is, in a table of rich's: no markup, no emoji codes, no escape characters."""
    return Text(visible(text), style)
