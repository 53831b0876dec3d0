"""``tslam-bench doctor``: what can this machine do, what is missing, and how fast will it be?"""

from __future__ import annotations

import ctypes.util
import json
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Final

from tslam_bench.cli import checkup
from tslam_bench.cli.commands import parse
from tslam_bench.cli.findings import Finding, guarded, import_remedy
from tslam_bench.cli.probe import Probe, Tried
from tslam_bench.cli.progress import Progress
from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.extras import EXTRAS
from tslam_bench.machine import available_memory, usable_cores
from tslam_bench.text import visible
from tslam_bench.version import __version__

_GROUPS: Final = ("software", "machine", "objects", "graphics", "speed", "tools")
_IMPORT_TIMEOUT: Final = 120.0
_SPEED_TIMEOUT: Final = 180.0
"""Seconds. The first environment of a machine compiles its sensing."""
_MOST_PROCESSES: Final = 16
"""Of the probe."""
QUICK_CPU_MINUTES: Final = 13.0
"""Time of all processes of the quick run together, measured on a core that makes ``REFERENCE_RATE`` steps per second."""
REFERENCE_RATE: Final = 3000.0
QUICK_CHAIN_MINUTES: Final = 3.0
"""The longest chain of jobs that wait for each other (an estimate); further cores do not help."""


@dataclass(frozen=True)
class Doctor:
    """Tell what this machine can do: versions, cores, memory, disk, objects, rendering, GPU, tools; its speed is probed briefly.

    Every line that is not ok says what to do. Exit status 0 if no line fails, else 1; notes do not count. Downloads and
    changes nothing. Takes some 15 seconds.
    """

    json: bool = False
    """Print JSON instead of lines."""
    no_probe: bool = False
    """Leave the speed out, which takes all cores for a few seconds."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench doctor`` with the given arguments; exits with 1 if a line fails."""
    command: Doctor = parse("tslam-bench doctor", Doctor, arguments)
    findings = examine(command.no_probe)
    able = abilities(findings)
    passed = all(finding.status != "fails" for finding in findings)
    if command.json:
        report = {"version": __version__, "passed": passed, "can": able, "findings": [asdict(f) for f in findings]}
        print(json.dumps(report, indent=2))
    else:
        _print(findings)
        print("\nthis machine can: " + ", ".join(what for what, can in able.items() if can))
        if lacking := ", ".join(what for what, can in able.items() if not can):
            print("not yet:          " + lacking)
    if not passed:
        sys.exit(1)


def examine(no_probe: bool = False) -> list[Finding]:
    """Looks at everything; takes some seconds, as native libraries are tried in processes of their own."""
    findings: list[Finding] = []
    probes = {extra: Probe(extra) for extra in ("sim", "assets") if checkup.has_extra(extra)}
    try:
        with Progress("doctor", "part", 5 - no_probe, leave=False, disable=not sys.stderr.isatty()) as bar:
            for group, check in (
                ("software", checkup.python),
                ("software", checkup.packages),
                ("machine", checkup.machine),
                ("machine", checkup.disks),
                ("objects", checkup.objects),
                ("tools", checkup.tools),
            ):
                findings += guarded(group, check)
            bar.show(1)
            tried = {}
            for done, (extra, probe) in enumerate(probes.items(), start=2):
                tried[extra] = probe.wait(_IMPORT_TIMEOUT)
                findings += guarded("software", partial(_imports, extra, tried[extra]))
                bar.show(done)
            findings += guarded("graphics", partial(_vulkan, tried.get("sim")))
            findings += guarded("graphics", partial(_cuda, tried.get("sim")))
            bar.show(4)
            if not no_probe:
                findings += guarded("speed", partial(_speed, findings))
    finally:
        for probe in probes.values():
            probe.stop()
    return sorted(findings, key=lambda finding: _GROUPS.index(finding.group))


def _imports(extra: str, tried: Tried) -> Iterator[Finding]:
    """The packages of an extra that are installed and cannot be imported."""
    for module in EXTRAS[extra]:
        error = tried.results.get(module, {"error": tried.end or "not tried"}).get("error")
        if error:
            yield Finding("software", module, "fails", f"cannot be imported: {error}", import_remedy(error, extra))
            if module not in tried.results:  # the process ended here; the others were not tried
                return


def _vulkan(tried: Tried | None) -> Iterator[Finding]:
    """Is there anything that renders?"""
    if tried is None:
        yield Finding(
            "graphics", "Vulkan", "note", "not tried: [sim] is not installed", "pip install 'tslam-bench[sim]'"
        )
        return
    result = tried.results.get("vulkan", {"error": tried.end or "not tried"})
    if result.get("device"):
        yield Finding("graphics", "Vulkan", "ok", "renders (env video, render_mode)", "", {"device": True})
        return
    reason = result.get("error") or "no device: no videos (env video, render_mode); all else works"
    if shutil.which("nvidia-smi"):
        remedy = "install the NVIDIA driver's Vulkan part; in a container: NVIDIA_DRIVER_CAPABILITIES=all"
    elif ctypes.util.find_library("vulkan") is None:
        remedy = (
            "apt-get install libvulkan1 mesa-vulkan-drivers (Mesa 25 or later renders on the CPU), or a GPU's driver"
        )
    else:
        remedy = "apt-get install mesa-vulkan-drivers (Mesa 25 or later renders on the CPU), or a GPU's driver"
    yield Finding("graphics", "Vulkan", "note", reason, remedy, {"device": False})


def _cuda(tried: Tried | None) -> Iterator[Finding]:
    """A GPU, whether torch can use it, and what its physics needs."""
    card = shutil.which("nvidia-smi") is not None
    if tried is None:
        yield Finding("graphics", "CUDA", "note", "not tried: [sim] is not installed", "pip install 'tslam-bench[sim]'")
        return
    result = tried.results.get("cuda", {"error": tried.end or "not tried"})
    if "error" in result:
        yield Finding(
            "graphics", "CUDA", "fails" if card else "note", result["error"], "install torch again (pytorch.org)"
        )
    elif not result["available"]:
        if not card:
            yield Finding("graphics", "CUDA", "note", "no GPU: simulates and learns on the CPU", "", result)
        elif result["torch_cuda"] is None:
            remedy = "install a CUDA build of torch (pytorch.org names the command)"
            yield Finding("graphics", "CUDA", "fails", "a GPU is here, but torch is built for the CPU", remedy, result)
        else:
            found = f"a GPU is here, but torch, built for CUDA {result['torch_cuda']}, cannot use it"
            remedy = "see whether nvidia-smi works; the driver may be older than torch asks for"
            yield Finding("graphics", "CUDA", "fails", found, remedy, result)
    else:
        yield Finding(
            "graphics", "CUDA", "ok", f"{result['card']}, torch built for CUDA {result['torch_cuda']}", "", result
        )
        yield from _gpu_physics(result)


def _gpu_physics(result: dict) -> Iterator[Finding]:
    if not result["driver"]:
        found = "libcuda.so is not found, by which name the simulator loads the driver"
        yield Finding("graphics", "driver", "note", found, "tslam-bench gpu-check prints the command that links it")
    if not result["library_there"]:
        remedy = f"downloaded on first use; without internet unpack {result['library_from']} there"
        yield Finding("graphics", "PhysX on the GPU", "note", f"no {result['library']} yet", remedy)
    if ENVIRONMENT_ID in result["checked"]:
        yield Finding("graphics", "gpu-check", "ok", "has passed on this card: " + ", ".join(result["checked"]))
    else:
        found = "has not passed on this card with these versions: device auto is the CPU"
        yield Finding("graphics", "gpu-check", "note", found, "tslam-bench gpu-check (docs/gpu.md)")


def _speed(before: Iterable[Finding]) -> Iterator[Finding]:
    """Steps per second of a probe, and what they mean for the quick run."""
    failed = {finding.name for finding in before if finding.status == "fails"}
    if not checkup.has_extra("sim"):
        yield Finding(
            "speed", "simulation", "note", "not tried: [sim] is not installed", "pip install 'tslam-bench[sim]'"
        )
        return
    if failed & {"hand", "test"}:
        yield Finding(
            "speed", "simulation", "note", "not tried: hand or test objects are not ready", "see objects, above"
        )
        return
    memory = available_memory() or _MOST_PROCESSES * checkup.MEMORY_PER_PROCESS
    processes = max(min(usable_cores(), _MOST_PROCESSES, int(memory // checkup.MEMORY_PER_PROCESS)), 1)
    probe = Probe("speed", processes)
    try:
        tried = probe.wait(_SPEED_TIMEOUT)
    finally:
        probe.stop()
    result = tried.results.get("speed", {"error": tried.end or "no answer"})
    if "error" in result:
        remedy = "put right what fails above; then see: python -m tslam_bench.cli.probe speed 1"
        yield Finding("speed", "simulation", "fails", result["error"], remedy)
        return
    rate, seconds = result["steps_per_second"], result["seconds"]
    found = f"{rate:,.0f} control steps per second in {processes} processes (a probe of {seconds:.1f} s; other work slows it)"
    yield Finding("speed", "simulation", "ok", found, "", {**result, "processes": processes})
    low, high = quick_minutes(usable_cores(), rate / processes)
    found = f"{low:.0f} to {high:.0f} minutes with all cores, once objects are prepared (estimated from the probe)"
    yield Finding("speed", "quick run takes", "ok", found, "", {"minutes": [low, high]})


def quick_minutes(cores: int, rate: float) -> tuple[float, float]:
    """Least and most minutes that the quick run may take.

    The least: its processes' time, shared evenly by the cores, and no less than its longest chain of jobs. The most: twice that.

    Args:
        cores: that it may use.
        rate: control steps per second of one core.
    """
    least = max(QUICK_CPU_MINUTES / cores, QUICK_CHAIN_MINUTES) * REFERENCE_RATE / rate
    return least, 2 * least


def abilities(findings: Iterable[Finding]) -> dict[str, bool]:
    """What can be done here -> whether all that it needs is ok."""
    found = {finding.name: finding for finding in findings}
    broken = {name for name, finding in found.items() if finding.status == "fails"}
    sim, assets = (checkup.has_extra(extra) and not broken & set(EXTRAS[extra]) for extra in ("sim", "assets"))
    simulates = sim and not broken & {"hand", "test", "simulation"}
    vulkan, checked = found.get("Vulkan"), found.get("gpu-check")
    return {
        "score submissions": not broken & {"core", "test"},
        "prepare objects": assets and "cache" not in broken,
        "simulate and train": simulates,
        "make videos": simulates and vulkan is not None and vulkan.status == "ok",
        "simulate on a GPU": simulates and checked is not None and checked.status == "ok",
    }


def _print(findings: Sequence[Finding]) -> None:
    width, group = max(len(finding.name) for finding in findings), ""
    for finding in findings:
        if finding.group != group:
            group = finding.group
            print(f"{group}" if finding is findings[0] else f"\n{group}")
        word = "FAILS" if finding.status == "fails" else finding.status
        print(f"  {word:5}  {finding.name:{width}}  {visible(finding.found)}")
        if finding.remedy:
            print(f"  {'':5}  {'':{width}}  -> {visible(finding.remedy)}")
