"""Switching GPU physics on where something is missing, and what ``device="auto"`` means."""

from __future__ import annotations

from pathlib import Path

import pytest
from sapien import physx
from sapien.pysapien.physx import _enable_gpu

from tslam_bench.constants import ENVIRONMENT_ID, TABLETOP_ID
from tslam_bench.engine import gpu_physics
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import cache_directory
from tslam_bench.registration import make_vec

CARD = {"card": "some card", "sapien": "3.0.3"}


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine that torch says has a GPU, with a home and a cache of its own."""
    monkeypatch.setenv("TSLAM_BENCH_CACHE", str(cache_directory()))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(gpu_physics, "cuda_available", lambda: True)
    monkeypatch.setattr(gpu_physics, "cache_directory", lambda: tmp_path / "cache")
    monkeypatch.setattr(gpu_physics, "machine_identity", lambda: dict(CARD))
    return tmp_path


def refusal() -> str:
    with pytest.raises(InvalidInputError) as caught:
        gpu_physics.enable_gpu_physics()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def put_library() -> None:
    gpu_physics.library_path().parent.mkdir(parents=True)
    gpu_physics.library_path().write_bytes(b"not a library")


def test_a_library_that_cannot_be_fetched_is_named_with_its_address_and_place(gpu, monkeypatch):
    def offline() -> None:
        raise ConnectionError("HTTPSConnectionPool(...)\nMax retries exceeded")

    monkeypatch.setattr(physx, "enable_gpu", offline)
    message = refusal()
    assert str(gpu / ".sapien" / "physx" / physx.version() / "libPhysXGpu_64.so") in message
    assert "https://github.com/sapien-sim/physx-precompiled/releases/download" in message


def test_a_driver_without_the_plain_name_gets_the_link_command(gpu):
    """SAPIEN's own code, which loads the driver before PhysX's library; there is no driver here."""
    put_library()
    assert "libcuda.so is not found" in refusal() and "ln -sf" in refusal()


def test_a_broken_library_is_named(gpu, monkeypatch):
    put_library()
    monkeypatch.setattr(gpu_physics, "DRIVER", "libc.so.6")
    assert "cannot be loaded" in refusal() and "libPhysXGpu_64.so" in refusal()


def test_physics_on_the_cpu_in_the_process_is_said(gpu, monkeypatch):
    """PhysX's own refusal, with an engine alive."""
    alive = physx.PhysxCpuSystem()
    put_library()
    monkeypatch.setattr(gpu_physics, "DRIVER", "libc.so.6")
    monkeypatch.setattr(physx, "enable_gpu", _enable_gpu)
    assert "make the CUDA environment first, or in a process of its own" in refusal()
    assert alive is not None and not physx.is_gpu_enabled()


def test_auto_is_the_cpu_until_the_check_has_passed_on_this_card(gpu, monkeypatch):
    assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cpu"
    assert gpu_physics.simulation_device("cuda", ENVIRONMENT_ID) == "cuda", "who asks for it gets it"
    path = gpu_physics.write_stamp(ENVIRONMENT_ID)
    assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cuda"
    assert gpu_physics.simulation_device("auto", TABLETOP_ID) == "cpu", "another environment was not checked"
    gpu_physics.write_stamp(TABLETOP_ID)
    assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cuda"
    assert gpu_physics.simulation_device("auto", TABLETOP_ID) == "cuda"
    monkeypatch.setattr(gpu_physics, "machine_identity", lambda: CARD | {"sapien": "3.1"})
    assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cpu", "another version"
    monkeypatch.setattr(gpu_physics, "machine_identity", lambda: dict(CARD))
    path.write_text("{", encoding="utf-8")
    assert gpu_physics.simulation_device("auto", ENVIRONMENT_ID) == "cpu"


def test_make_vec_and_training_go_by_it(gpu):
    from tslam_bench.baselines.training import learning_device
    from tslam_bench.baselines.training_config import TrainingConfig

    envs = make_vec(num_envs=1, object="mug", processes=0)
    assert type(envs).__name__ == "TactileVectorEnv"
    envs.close()
    assert learning_device(TrainingConfig("tslam")) == "cpu"
    gpu_physics.write_stamp(ENVIRONMENT_ID)
    assert learning_device(TrainingConfig("tslam")) == "cuda"
