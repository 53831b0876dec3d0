"""Packs carry objects bit for bit, and nothing else gets out of them."""

from __future__ import annotations

import json
import shutil
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from tslam_bench.cli import main
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.files import CACHE_VARIABLE
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.packs import decode, encode, pack_hand, pack_objects, unpack
from tslam_bench.objects.splits import split_directory
from tslam_bench.objects.store import ARRAYS, asset_sha256, damage, load_object

NAMES = ["cubemedium", "hammer", "mug"]


@pytest.fixture(scope="module")
def packed(tmp_path_factory) -> list[Path]:
    """Three real objects of the test split in packs of one each at most: the limit is below two."""
    output = tmp_path_factory.mktemp("packs")
    return [path for path, _ in pack_objects(NAMES, "test", output, limit=2_400_000)]


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "uint8", "int32"])
def test_encoding_keeps_every_bit(dtype):
    bits = np.random.default_rng(0).integers(0, 256, 24 * np.dtype(dtype).itemsize, dtype=np.uint8)
    array = bits.view(dtype).reshape(2, 3, 4)  # NaN of all kinds among them
    for differences in {False, dtype == "float16"}:
        found = decode(encode(array, differences), dtype, array.shape, differences)
        assert found.dtype == array.dtype and found.tobytes() == array.tobytes()


def test_unpacked_objects_are_the_same_files(packed, tmp_path):
    assert len(packed) > 1 and all(path.stat().st_size <= 2_400_000 for path in packed)
    assert sum(unpack(path, tmp_path)[0] for path in packed) == len(NAMES)
    for name in NAMES:
        assert damage(name, "test", tmp_path) == []
        for file in ("record.json", *(f"{product}.npy" for product in ARRAYS)):
            ours = split_directory("test") / name / file
            assert (split_directory("test", tmp_path) / name / file).read_bytes() == ours.read_bytes()
    assert asset_sha256(NAMES, "test", tmp_path) == asset_sha256(NAMES)
    assert [unpack(path, tmp_path)[0] for path in packed] == [0] * len(packed), "what is there stays"


def test_the_command_packs_and_unpacks_with_the_hand(tmp_path, monkeypatch, capsys):
    main(["assets", "pack", "--objects", "mug", "--output", str(tmp_path / "packs")])
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    main(["assets", "unpack", *map(str, sorted((tmp_path / "packs").iterdir()))])
    assert "1 written, 0 there" in capsys.readouterr().out
    assert load_object("mug").name == "mug" and load_hand().urdf.is_relative_to(tmp_path)


def changed(source: Path, target: Path, change) -> Path:
    """A copy of a pack whose members went through ``change(name, data)``."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            new.writestr(*change(name, zlib.decompress(old.read(name))))
    return target


def test_a_changed_byte_is_found_and_nothing_is_left_behind(packed, tmp_path):
    def flip(name: str, data: bytes) -> tuple[str, bytes]:
        if name.endswith("/field"):
            data = data[:1000] + bytes([data[1000] ^ 1]) + data[1001:]
        return name, zlib.compress(data)

    with pytest.raises(AssetError, match=r"field.npy: SHA-256 differs"):
        unpack(changed(packed[0], tmp_path / "bad.zip", flip), tmp_path / "cache")
    left = [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]
    assert left == []


@pytest.mark.parametrize("name", ["../../evil", "a/b", "", "C:evil"])
def test_names_cannot_leave_the_cache(packed, tmp_path, name):
    def rename(member: str, data: bytes) -> tuple[str, bytes]:
        if member == "pack.json":
            data = json.dumps(json.loads(data) | {"objects": [name]}).encode()
        return member, zlib.compress(data)

    with pytest.raises(AssetError, match="not a name"):
        unpack(changed(packed[0], tmp_path / "bad.zip", rename), tmp_path / "cache")


def test_files_of_the_hand_cannot_leave_the_cache(tmp_path):
    def rename(member: str, data: bytes) -> tuple[str, bytes]:
        if member == "pack.json":
            index = json.loads(data)
            data = json.dumps(index | {"files": {"../../evil": "0", **index["files"]}}).encode()
        return member, zlib.compress(data)

    with pytest.raises(AssetError, match="not a file of the hand"):
        unpack(changed(pack_hand(tmp_path), tmp_path / "bad.zip", rename), tmp_path / "cache")


def test_what_is_no_pack_is_one_line(tmp_path):
    (tmp_path / "text.zip").write_text("hello", encoding="utf-8")
    for path in (tmp_path / "text.zip", tmp_path / "missing.zip"):
        with pytest.raises(AssetError) as caught:
            unpack(path, tmp_path)
        assert "\n" not in str(caught.value)


def test_another_object_of_that_name_is_kept(packed, tmp_path):
    target = split_directory("test", tmp_path) / "cubemedium"
    shutil.copytree(split_directory("test") / "cubesmall", target)
    before = (target / "field.npy").read_bytes()
    with pytest.raises(AssetError, match="another object"):
        for path in packed:
            unpack(path, tmp_path)
    assert (target / "field.npy").read_bytes() == before


def test_a_limit_below_one_object_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="more than the limit"):
        list(pack_objects(["mug"], "test", tmp_path, limit=100_000))
