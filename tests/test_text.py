"""Texts of strangers: every script passes, nothing talks to the terminal."""

from __future__ import annotations

import unicodedata

import pytest

from tslam_bench.text import visible


@pytest.mark.parametrize(
    "text",
    [
        "Größe 力 τ",
        "می\u200cخواهم",  # noqa: RUF001 (Persian, with the joiner that it needs)
        "東京\u3000大学",
        "no\u00a0break",
        "👩\u200d🔬",
        "क्\u200dष",
        "[/b] {{ x }} <i> \\x1b",
    ],
)
def test_what_people_write_stays(text: str) -> None:
    assert visible(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2J", r"\x1b[2J"),
        ("a\nb\r\tc", r"a\nb\r\tc"),
        ("\x9b31m", r"\x9b31m"),
        ("abc\u202edcba", r"abc\u202edcba"),
        ("\u2066x\u2069", r"\u2066x\u2069"),
        ("zero\u200bwidth\ufeff", r"zero\u200bwidth\ufeff"),
        ("half \ud800", r"half \ud800"),
        ("tag \U000e0041", r"tag \U000e0041"),
    ],
)
def test_what_is_no_text_is_shown_as_an_escape(text: str, shown: str) -> None:
    assert visible(text) == shown


def test_nothing_invisible_is_left_but_joiners_and_spaces() -> None:
    left = [chr(k) for k in range(0x110000) if unicodedata.category(chr(k)) in ("Cc", "Cf", "Cs", "Zl", "Zp")]
    kept = {character for character in left if visible(character) == character}
    assert {"\u200c", "\u200d"} <= kept
    # Signs that enclose numbers and notes (Arabic, Syriac, Kaithi, shorthand, music, hieroglyphs) are seen where they stand.
    assert all(unicodedata.name(character).split()[0] in {"ZERO", "ARABIC", "SYRIAC", "KAITHI", "SHORTHAND", "MUSICAL",
                                                         "EGYPTIAN"} for character in kept)  # fmt: skip
