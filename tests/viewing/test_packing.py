"""Data files: what goes in comes out, and no text of a stranger leaves its string."""

from __future__ import annotations

import numpy as np
import pytest

from tslam_bench.viewing.packing import pack, unpack


@pytest.mark.parametrize("kind", ["u1", "i1", "u2", "i2", "u4"])
@pytest.mark.parametrize("shape", [(0,), (1,), (257,), (0, 3), (50, 28)])
def test_arrays_come_back(kind: str, shape: tuple[int, ...]) -> None:
    limits = np.iinfo(kind)
    array = np.random.default_rng(1).integers(limits.min, limits.max, shape, dtype=kind, endpoint=True)
    other = np.arange(7, dtype=np.uint16)
    name, header, arrays = unpack(pack("data/a.js", {"x": [1.5, "é"]}, {"first": array, "second": other}))
    assert name == "data/a.js" and header == {"x": [1.5, "é"]}
    assert arrays["first"].dtype == array.dtype and np.array_equal(arrays["first"], array)
    assert np.array_equal(arrays["second"], other)


def test_smooth_arrays_take_little() -> None:
    smooth = np.round(30_000 * np.sin(np.linspace(0, 3, 201))[:, None] * np.ones(28)).astype(np.int16)
    assert len(pack("a", {}, {"a": smooth})) < smooth.nbytes / 8


def test_texts_stay_texts() -> None:
    hostile = '</script><script>alert(1)</script>"\u2028\\'
    script = pack(hostile, {"label": hostile}, {})
    assert "<" not in script and "\u2028" not in script and script.isascii() and script.count("\n") == 1
    assert unpack(script)[:2] == (hostile, {"label": hostile})


@pytest.mark.parametrize("array", [np.zeros(3), np.zeros(3, dtype=bool), np.zeros((2, 2, 2), dtype=np.uint8)])
def test_other_arrays_are_refused(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="give integers"):
        pack("a", {}, {"a": array})


def test_numbers_that_json_lacks_are_refused() -> None:
    with pytest.raises(ValueError, match="JSON"):
        pack("a", {"x": float("nan")}, {})
