"""JSON of strangers: one meaning, or one line that says why there is none."""

from __future__ import annotations

import pytest

from tslam_bench.scoring.untrusted_json import MAX_DIGITS, parse_json


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"a": ' + "7" * 5000 + "}", "a number of 5000 digits"),
        ('{"a": -' + "7" * MAX_DIGITS + "}", f"a number of {MAX_DIGITS + 1} digits"),
        ('{"a": 1e999}', "1e999 is beyond all numbers"),
        ('{"a": -Infinity}', "-Infinity is not a JSON number"),
        ('{"a": {"b": 1, "b": 1}}', "the key 'b' is there twice"),
        ('["\\udfff"]', "half a character"),
        ("[" * 300_000, "nested too deeply"),
    ],
)
def test_what_has_no_single_meaning_is_refused_in_one_line(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as caught:
        parse_json(text.encode())
    assert "\n" not in str(caught.value) and "sys." not in str(caught.value)


def test_what_has_one_is_read() -> None:
    assert parse_json('\ufeff{"a": [1, -2.5, "\\u00e9", null]}'.encode()) == {"a": [1, -2.5, "é", None]}
    assert parse_json(b"9" * MAX_DIGITS) == int("9" * MAX_DIGITS)
