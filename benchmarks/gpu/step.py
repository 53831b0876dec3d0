"""What the scripts for the first half hour on a GPU share: a time limit, one JSON file that grows, and the device."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from tslam_bench.engine import gpu_physics
from tslam_bench.engine.native_output import captured_output
from tslam_bench.files import write_json
from tslam_bench.machine import processor_name

GRACE = 30.0
"""Seconds after the limit at which a process that hangs in native code is ended."""


class TimeIsUp(Exception):
    """The step's time is over; what it has found so far is in its file."""


@dataclass(frozen=True)
class Step:
    """Settings that every script has; scripts add their own."""

    device: Literal["cuda", "emulated"] = "cuda"
    """cuda, or emulated: GPU physics by CPU physics and CPU tensors, to try the script without a GPU."""
    output: Path | None = None
    """JSON file (default: the script's name in the folder gpu_results)."""
    seconds: float = 450.0
    """Time limit; a step ends by itself within 8 minutes."""
    no_capture: bool = False
    """Leave what native code prints alone, so that it is seen if the process crashes."""


class Report:
    """Findings by name; the file is written anew with each, so that a crash leaves all that came before."""

    def __init__(self, path: Path, head: dict[str, Any]) -> None:
        self.path, self.content = path, head

    def __setitem__(self, name: str, value: Any) -> None:
        self.content[name] = value
        write_json(self.path, self.content)
        print(f"{name}: {json.dumps(value)}", flush=True)

    def check(self, name: str, value: float, limit: float) -> None:
        """Takes down a figure that has to be at most ``limit``; goes on if it is not."""
        passed = bool(value <= limit)
        self[name] = {"value": float(value), "limit": limit, "passed": passed}
        self.content["passed"] = self.content.get("passed", True) and passed


def run(step: Step, work: Callable[[Any, Report], None]) -> None:
    """Does a script's work; exit status 0 if it came to its end and every check passed, else 1."""
    script = Path(sys.argv[0]).stem
    path = (step.output or Path("gpu_results") / f"{script}.json").absolute()
    report = Report(path, {"step": script, **_machine(step)})
    signal.signal(signal.SIGALRM, _raise_time_is_up)
    signal.setitimer(signal.ITIMER_REAL, step.seconds)
    watchdog = threading.Timer(step.seconds + GRACE, os._exit, (3,))
    watchdog.daemon = True
    watchdog.start()
    start = datetime.datetime.now()
    ended, output = "finished", None
    with contextlib.ExitStack() as stack:
        if not step.no_capture:
            output = stack.enter_context(captured_output())
        try:
            stack.enter_context(physics_of(step.device))
            work(step, report)
        except TimeIsUp:
            ended = "time is up"
        except Exception as error:
            traceback.print_exc()
            ended = f"{type(error).__name__}: {error}"
    signal.setitimer(signal.ITIMER_REAL, 0)
    watchdog.cancel()
    complaints = output.complaints() if output else []
    report.content |= {"ended": ended, "complaints": complaints[:20], "number_of_complaints": len(complaints)}
    report["seconds"] = round((datetime.datetime.now() - start).total_seconds(), 1)
    sys.exit(0 if ended == "finished" and report.content.get("passed", True) and not complaints else 1)


@contextlib.contextmanager
def physics_of(device: str) -> Iterator[None]:
    """GPU physics switched on, or emulated."""
    if device == "emulated":
        from emulated_gpu import emulated_gpu

        with emulated_gpu():
            yield
        return
    gpu_physics.enable_gpu_physics()
    yield


def tensor_device(step: Step) -> str:
    """Where the step's tensors are."""
    return "cuda" if step.device == "cuda" else "cpu"


def synchronise(step: Step) -> None:
    """Waits until the device has done all it was told to."""
    if step.device == "cuda":
        torch.cuda.synchronize()


def memory(step: Step) -> dict[str, float]:
    """MB in use: by torch, and of the card as a whole (PhysX allocates past torch); of the process where there is no card."""
    if step.device == "cuda":
        free, total = torch.cuda.mem_get_info()
        return {"torch": torch.cuda.memory_allocated() / 1e6, "card": (total - free) / 1e6}
    return {"process": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


def _raise_time_is_up(*_: object) -> None:
    raise TimeIsUp


def _machine(step: Step) -> dict[str, Any]:
    card = "none: emulated on the CPU"
    if step.device == "cuda":
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        with contextlib.suppress(OSError):
            card = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    return {
        "command": " ".join(sys.argv),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "card": card,
        "processor": f"{os.cpu_count()} x {processor_name()}",
        "torch": str(torch.__version__),
        "cuda": str(torch.version.cuda),
    }
