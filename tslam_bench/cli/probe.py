"""What ``tslam-bench doctor`` tries out, each in a process of its own: native libraries that crash take nothing else along.

``python -m tslam_bench.cli.probe NAME`` prints a line of JSON for each thing tried, as soon as it is known.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from tslam_bench.cli.findings import short
from tslam_bench.extras import EXTRAS

_MARK: Final = "tslam-bench-probe "
"""Begins our lines; libraries print what they like."""
WARM_UP: Final = 5
"""Steps before the clock starts."""
ENVS_PER_PROCESS: Final = 12


@dataclass(frozen=True)
class Tried:
    """What a probe said.

    Attributes:
        results: thing tried -> what came of it; ``{"error": ...}`` if it went wrong.
        end: why the process ended early; empty if it ended well.
    """

    results: Mapping[str, dict[str, Any]]
    end: str


class Probe:
    """A probe that runs beside this process.

    Args:
        words: the name of a function below, without its underscore, and arguments of it.
        module: what is run.
    """

    def __init__(self, *words: object, module: str = "tslam_bench.cli.probe") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            env={"OMP_NUM_THREADS": "1", **os.environ},
        )

    def wait(self, timeout: float) -> Tried:
        """What it said within so many seconds; then it is stopped, with the processes that it started."""
        try:
            out, err = self._process.communicate(timeout=timeout)
            end = _end(self._process.returncode, err)
        except subprocess.TimeoutExpired:
            self.stop()
            out, _ = self._process.communicate()
            end = f"no answer for {timeout:g} s"
        lines = [line.removeprefix(_MARK) for line in out.splitlines() if line.startswith(_MARK)]
        return Tried(dict(map(json.loads, lines)), end)

    def stop(self) -> None:
        """Kills it and the processes that it started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)


def _end(status: int, complaint: str) -> str:
    if status == 0:
        return ""
    if status < 0:
        with contextlib.suppress(ValueError):
            return f"crashed ({signal.Signals(-status).name})"
    lines = [line.strip() for line in complaint.splitlines() if line.strip()]
    return lines[-1] if lines else f"ended with status {status}"


# -- in the child -------------------------------------------------------------------------------------------------------
def _say(name: str, result: Mapping[str, Any]) -> None:
    print(_MARK + json.dumps([name, result]), flush=True)


@contextlib.contextmanager
def _told(name: str) -> Any:
    """Says what the block has put into a dictionary, or the error that it raised."""
    result: dict[str, Any] = {}
    try:
        yield result
    except Exception as error:
        result = {"error": short(error)}
    _say(name, result)


def _sim() -> None:
    """Imports what simulates and learns; looks for a Vulkan device and for CUDA."""
    import tslam_bench.engine  # noqa: F401  (before the simulator: quiet about a missing Vulkan)

    _imports("sim")
    with _told("vulkan") as result:
        from tslam_bench.engine.rendering import vulkan_device_available

        result["device"] = vulkan_device_available()
    with _told("cuda") as result:
        result.update(_cuda())


def _cuda() -> dict[str, Any]:
    import ctypes

    import torch

    from tslam_bench.engine import gpu_physics
    from tslam_bench.variants import ENVIRONMENT_IDS

    result: dict[str, Any] = {"available": torch.cuda.is_available(), "torch_cuda": torch.version.cuda}
    if result["available"]:
        result |= {"card": torch.cuda.get_device_name(), "library": str(gpu_physics.library_path())}
        result |= {"library_there": gpu_physics.library_path().is_file(), "library_from": gpu_physics.library_address()}
        result["checked"] = [name for name in ENVIRONMENT_IDS if gpu_physics.gpu_check_passed(name)]
        try:
            ctypes.CDLL(gpu_physics.DRIVER)
            result["driver"] = True
        except OSError:
            result["driver"] = False
    return result


def _assets() -> None:
    """Imports what prepares objects."""
    _imports("assets")


def _imports(extra: str) -> None:
    for module in EXTRAS[extra]:
        with _told(module):
            importlib.import_module(module)


def _speed(processes: str) -> None:
    """Plays one episode in a few environments per process: hands that come down and then move at random."""
    from dataclasses import replace

    from tslam_bench.constants import ENVIRONMENT_ID, QUICK_OBJECTS
    from tslam_bench.evaluation.gpu_check import Episodes, record
    from tslam_bench.objects.splits import prepared_names
    from tslam_bench.registration import make_vec
    from tslam_bench.variants import get_variant

    with _told("speed") as result:
        names = [name for name in QUICK_OBJECTS if name in prepared_names("test")]
        count = ENVS_PER_PROCESS * int(processes)
        episodes = Episodes.draw(names, get_variant(ENVIRONMENT_ID).poses, count)
        envs = make_vec(ENVIRONMENT_ID, count, "cpu", objects=names, split="test", processes=int(processes))
        try:
            record(envs, replace(episodes, actions=episodes.actions[:WARM_UP]))
            played = record(envs, episodes)
        finally:
            envs.close()
        result |= {"steps_per_second": played.steps_per_second, "seconds": played.seconds, "num_envs": count}


if __name__ == "__main__":
    probes: dict[str, Callable[..., None]] = {"sim": _sim, "assets": _assets, "speed": _speed}
    probes[sys.argv[1]](*sys.argv[2:])
