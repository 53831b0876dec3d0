"""Writing, loading and checking prepared objects, and what bad names and broken files get."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.objects import splits, store


@pytest.fixture
def cache(tmp_path, torus):
    """A cache that holds the torus as test object ``mug``, and as train object ``ring``."""
    faces = _sample_faces(torus)
    for name, split in (("mug", "test"), ("ring", "train")):
        store.write(dataclasses.replace(torus, name=name, split=split), faces, tmp_path)
    return tmp_path


def _sample_faces(prepared) -> np.ndarray:
    """Some face with the normal of each surface sample."""
    a, b, c = prepared.vertices[prepared.faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.concatenate([(part @ normals.T).argmax(axis=1) for part in np.array_split(prepared.surface_normals, 50)])


def _one_line(message: str) -> bool:
    return "\n" not in message and len(message) > 0


def test_what_is_written_is_loaded(cache, torus):
    loaded = store.load_object("mug", cache=cache)
    for name in ("vertices", "faces", "solid", "surface", "surface_points", "solid_at_iou_points"):
        before, after = getattr(torus, name), getattr(loaded, name)
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, before)
    np.testing.assert_allclose(loaded.surface_normals, torus.surface_normals, atol=1e-6)
    assert len(loaded.hulls) == len(torus.hulls)
    for (v0, f0), (v1, f1) in zip(loaded.hulls, torus.hulls, strict=True):
        np.testing.assert_array_equal(v0, v1)
        np.testing.assert_array_equal(f0, f1)
    assert loaded.field.values.dtype == np.float32
    np.testing.assert_allclose(loaded.field.values, torus.field.values, atol=1e-4)  # half precision at 0.1 m
    near = np.abs(torus.field.values) < 5e-3
    np.testing.assert_allclose(loaded.field.values[near], torus.field.values[near], atol=5e-6)
    np.testing.assert_array_equal(loaded.field.origin, torus.field.origin)
    assert loaded.field.spacing == torus.field.spacing


def test_aliases_and_split_names_resolve(cache):
    assert store.load_object("coffeemug", "contactdb50", cache).name == "mug"
    assert set(splits.ALIASES.values()) <= set(splits.OBJECTS)


def test_list_objects(cache):
    assert [record["name"] for record in store.list_objects("test", cache)] == ["mug"]
    assert [record["name"] for record in store.list_objects("train", cache)] == ["ring"]
    assert store.list_objects("val", cache) == []


@pytest.mark.parametrize(
    ("name", "split", "error", "words"),
    [
        ("mgu", "test", InvalidInputError, ["mgu", "mug", "unknown"]),
        ("table", "test", InvalidInputError, ["table", "GRAB"]),
        ("rign", "train", InvalidInputError, ["rign", "did you mean ring"]),
        ("mug", "tets", InvalidInputError, ["tets", "did you mean test"]),
        ("../mug", "test", InvalidInputError, ["../mug", "unknown"]),
        ("mug", "../objects/test", InvalidInputError, ["unknown"]),
        ("hammer", "test", AssetError, ["hammer", "tslam-bench assets prepare --objects hammer"]),
        ("anything", "val", AssetError, ["val", "tslam-bench assets prepare --split val"]),
    ],
)
def test_bad_names(cache, name, split, error, words):
    with pytest.raises(error) as caught:
        store.load_object(name, split, cache)
    assert _one_line(str(caught.value))
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize("product", store.ARRAYS)
@pytest.mark.parametrize("harm", ["missing", "truncated", "other"])
def test_broken_products_are_named_with_the_remedy(cache, product, harm):
    path = store.object_directory("ring", "train", cache) / f"{product}.npy"
    if harm == "missing":
        path.unlink()
    elif harm == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        np.save(path, np.zeros((3, 3), dtype=np.float16))
    with pytest.raises(AssetError) as caught:
        store.load_object("ring", "train", cache)
    message = str(caught.value)
    assert _one_line(message)
    assert path.name in message
    assert "tslam-bench assets prepare --split train --objects ring" in message
    assert any(path.name in line for line in store.damage("ring", "train", cache))


def test_a_pickle_is_not_loaded(cache):
    path = store.object_directory("ring", "train", cache) / "vertices.npy"
    np.save(path, np.array([{"not": "numbers"}], dtype=object), allow_pickle=True)
    with pytest.raises(AssetError, match=r"vertices\.npy"):
        store.load_object("ring", "train", cache)


def test_flipped_bits_are_found_by_hashing(cache):
    assert store.damage("mug", "test", cache) == []
    path = store.object_directory("mug", "test", cache) / "surface_points.npy"
    data = bytearray(path.read_bytes())
    data[-5] ^= 0xFF
    path.write_bytes(data)
    store.load_object("mug", cache=cache)  # the cheap check cannot see it
    assert any("surface_points.npy" in line for line in store.damage("mug", "test", cache))


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", json.dumps({"name": "mug", "products": {}, "format": 0})])
def test_a_broken_record(cache, text):
    (store.object_directory("mug", "test", cache) / "record.json").write_text(text)
    with pytest.raises(AssetError) as caught:
        store.load_object("mug", cache=cache)
    assert _one_line(str(caught.value))
    assert "record.json" in str(caught.value)


def test_a_cache_that_cannot_be_written(tmp_path, torus):
    blocked = tmp_path / "file"
    blocked.write_text("not a directory")
    with pytest.raises(AssetError) as caught:
        store.write(torus, np.zeros(len(torus.surface_points), dtype=np.int64), blocked)
    assert "TSLAM_BENCH_CACHE" in str(caught.value)
