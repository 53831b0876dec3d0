"""Reading JSON that nobody vouches for: one meaning or none."""

from __future__ import annotations

import json
import math
from typing import Any, Final

MAX_DIGITS: Final = 1000
"""Digits of a whole number. Python itself refuses 4300 of them, with advice that is not meant for whoever sent a file."""


def parse_json(data: bytes) -> Any:
    """The value of a JSON text in UTF-8, with or without a byte-order mark.

    Raises:
        ValueError: not JSON, nested too deeply, a key twice in one object, a number that is none (NaN, 1e999) or has thousands of
            digits, or text with half a character (a lone surrogate, which cannot be written to any file).
    """
    try:
        value = json.loads(
            data.decode("utf-8-sig"),
            parse_constant=_no_number,
            parse_float=_finite,
            parse_int=_whole,
            object_pairs_hook=_object,
        )
        if rb"\u" in data:
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    except UnicodeEncodeError as error:
        raise ValueError("text with half a character in it") from error
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    return value


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")


def _whole(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is beyond all numbers")
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:40]!r} is there twice")
    return value
