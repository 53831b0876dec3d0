"""Fetching a pinned wheel through the user's own pip settings, without a network: pip serves a local folder."""

from __future__ import annotations

import zipfile

import pytest

from tslam_bench.errors import AssetError
from tslam_bench.files import sha256_file
from tslam_bench.sources.fetch import fetch_wheel


@pytest.fixture
def index(tmp_path, monkeypatch):
    """A folder that pip searches instead of the network, holding the wheel tslam-dummy 1.0."""
    folder = tmp_path / "index"
    folder.mkdir()
    with zipfile.ZipFile(folder / "tslam_dummy-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("tslam_dummy/data.txt", "payload")
        wheel.writestr("tslam_dummy-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: tslam-dummy\nVersion: 1.0\n")
        wheel.writestr(
            "tslam_dummy-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        wheel.writestr("tslam_dummy-1.0.dist-info/RECORD", "")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    return folder


def test_a_wheel_is_fetched_once_and_kept(index, tmp_path):
    (source,) = index.glob("*.whl")
    digest = sha256_file(source)
    cache = tmp_path / "cache"
    path = fetch_wheel("tslam-dummy", "1.0", digest, cache)
    assert path.parent == cache / "downloads"
    assert sha256_file(path) == digest
    source.unlink()  # the second time nothing is downloaded
    assert fetch_wheel("tslam_dummy", "1.0", digest, cache) == path
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_damaged_download_is_fetched_again(index, tmp_path):
    (source,) = index.glob("*.whl")
    digest = sha256_file(source)
    path = fetch_wheel("tslam-dummy", "1.0", digest, tmp_path / "cache")
    path.write_bytes(path.read_bytes()[:-10])
    assert sha256_file(fetch_wheel("tslam-dummy", "1.0", digest, tmp_path / "cache")) == digest


def test_another_hash_is_refused(index, tmp_path):
    with pytest.raises(AssetError) as caught:
        fetch_wheel("tslam-dummy", "1.0", "0" * 64, tmp_path / "cache")
    assert "SHA-256" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list((tmp_path / "cache" / "downloads").iterdir()) == []


def test_no_network_is_one_line(index, tmp_path):
    with pytest.raises(AssetError) as caught:
        fetch_wheel("tslam-dummy", "2.0", "0" * 64, tmp_path / "cache")
    message = str(caught.value)
    assert "tslam-dummy==2.0" in message
    assert "network" in message
    assert "\n" not in message
    assert list((tmp_path / "cache" / "downloads").iterdir()) == []
