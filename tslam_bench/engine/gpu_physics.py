"""PhysX's GPU simulation: switching it on, what is missing where that fails, and whether this machine's was checked."""

from __future__ import annotations

import ctypes
import importlib.metadata
import json
import platform
from pathlib import Path
from typing import Any, Final

from tslam_bench.errors import InvalidInputError
from tslam_bench.files import cache_directory, write_json
from tslam_bench.version import __version__

DEVICES: Final = ("auto", "cpu", "cuda")
STAMP_FILE: Final = "gpu-check.json"
"""In the cache: on what ``tslam-bench gpu-check`` passed last, and for which environments."""

LIBRARY: Final = "libPhysXGpu_64.so"
DRIVER: Final = "libcuda.so"
"""The driver's library by the name that SAPIEN loads; containers often have ``libcuda.so.1`` alone."""
_RELEASES: Final = "https://github.com/sapien-sim/physx-precompiled/releases/download"
_ARCHIVES: Final = {"x86_64": "linux-so.zip", "aarch64": "linux-aarch64-so.zip"}


def cuda_available() -> bool:
    """Whether torch finds a CUDA GPU."""
    import torch

    return torch.cuda.is_available()


def simulation_device(device: str, environment_id: str) -> str:
    """``cpu`` or ``cuda``: where environments that were asked for on ``device`` are simulated.

    ``auto`` is the CPU until ``tslam-bench gpu-check`` has passed on this card with these versions.

    Raises:
        InvalidInputError: an unknown device, or ``cuda`` where there is none.
    """
    if device not in DEVICES:
        raise InvalidInputError(f"device {device!r}: unknown; choose one of {', '.join(DEVICES)}")
    if device == "cuda" and not cuda_available():
        raise InvalidInputError(
            "device 'cuda': there is no CUDA GPU that torch can use; choose cpu or auto (see: tslam-bench doctor)"
        )
    trusted = device == "auto" and cuda_available() and gpu_check_passed(environment_id)
    return "cuda" if device == "cuda" or trusted else "cpu"


def machine_identity() -> dict[str, str]:
    """What a passed check holds for: the card and the versions of everything that simulates on it."""
    import torch

    versions = {name: importlib.metadata.version(name) for name in ("mani_skill", "sapien")}
    card = torch.cuda.get_device_name()  # GPU only
    return {
        "card": card,
        "cuda": str(torch.version.cuda),
        "torch": str(torch.__version__),
        "tslam_bench": __version__,
        **versions,
    }


def gpu_check_passed(environment_id: str) -> bool:
    """Whether :func:`write_stamp` was called for this environment on such a machine."""
    stamp = _read_stamp()
    return stamp.get("machine") == machine_identity() and environment_id in stamp.get("environments", [])


def write_stamp(environment_id: str) -> Path:
    """Notes that the check passed for this environment here. Raises AssetError if the cache cannot be written."""
    stamp, machine = _read_stamp(), machine_identity()
    passed = stamp.get("environments", []) if stamp.get("machine") == machine else []
    path = cache_directory() / STAMP_FILE
    write_json(path, {"machine": machine, "environments": sorted({*passed, environment_id})})
    return path


def _read_stamp() -> dict[str, Any]:
    try:
        return dict(json.loads((cache_directory() / STAMP_FILE).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def library_path() -> Path:
    """Where SAPIEN looks for PhysX's GPU library, which it downloads there if it is missing."""
    from sapien import physx

    return Path.home() / ".sapien" / "physx" / physx.version() / LIBRARY


def library_address() -> str:
    """Archive that holds the library, for those who have to bring it along."""
    from sapien import physx

    return f"{_RELEASES}/{physx.version()}/{_ARCHIVES.get(platform.machine(), _ARCHIVES['x86_64'])}"


def enable_gpu_physics() -> None:
    """Loads PhysX's GPU library and the driver; nothing where that is done. Call it before any scene is made.

    Raises:
        InvalidInputError: no GPU, or what is missing, where it belongs, and the command that puts it there.
    """
    from sapien import physx

    if physx.is_gpu_enabled():
        return
    if not cuda_available():
        raise InvalidInputError("GPU simulation: needs a GPU and there is none (CUDA); simulate on the CPU instead")
    try:
        physx.enable_gpu()  # GPU only
    except (
        Exception
    ) as error:  # requests', zipfile's, the loader's and PhysX's own: any of them, hence one line for all
        raise InvalidInputError(f"GPU simulation: {_remedy(error)}") from error


def _remedy(error: Exception) -> str:
    library, reason = library_path(), " ".join(str(error).split())
    if not library.is_file():
        return (
            f"PhysX's GPU library is missing and could not be downloaded ({type(error).__name__}); "
            f"unpack {library_address()} so that {library} is there"
        )
    try:
        ctypes.CDLL(DRIVER)
    except OSError:
        return (
            f"the NVIDIA driver's {DRIVER} is not found; where the machine has {DRIVER}.1 alone, link it and name the folder: "
            f'mkdir -p ~/.sapien/lib && ln -sf "$(ldconfig -p | grep -m1 -o "/.*{DRIVER}.1")" ~/.sapien/lib/{DRIVER} '
            "&& export LD_LIBRARY_PATH=~/.sapien/lib:$LD_LIBRARY_PATH"
        )
    if "only be enabled once" in reason:
        return "physics on the CPU is alive in this process already; make the CUDA environment first, or in a process of its own"
    return f"{library} cannot be loaded ({reason}); unpack {library_address()} there again"
