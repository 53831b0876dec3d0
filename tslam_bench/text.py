"""Text of strangers: any script may be written, and what a reader or a terminal would not see as text is made visible."""

from __future__ import annotations

import re
from typing import Final

CONTROL: Final = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Characters that end a line or talk to a terminal, and halves of characters."""
_INVISIBLE: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\u00ad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff\ufff9-\ufffb"
    "\U000e0000-\U000e007f]"
)
"""The same, and those that reorder or hide what stands around them. Joiners (U+200C, U+200D), which many scripts and emoji need,
and all spaces are text."""


def visible(text: str) -> str:
    """The text with escapes such as ``\\x1b`` and ``\\u202e`` for what is no text, on one line."""
    return _INVISIBLE.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)
