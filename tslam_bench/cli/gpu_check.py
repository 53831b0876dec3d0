"""``tslam-bench gpu-check``: does the GPU simulation agree with the CPU's, and how fast is it?"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import tyro

from tslam_bench.cli.commands import parse
from tslam_bench.constants import ENVIRONMENT_ID, QUICK_OBJECTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.registration import make_vec
from tslam_bench.variants import get_variant


@dataclass(frozen=True)
class GpuCheck:
    """Plays the same episodes on a CUDA GPU and on the CPU and compares touch, grids and rewards.

    Prints each figure with its tolerance and the steps per second; exit status 0 if all hold, else 1; 2 without a GPU. Where all
    hold, device "auto" is this GPU from then on, until a version or the card changes.
    """

    num_envs: int = 256
    """Environments, each with its own object, pose and start."""
    objects: tuple[str, ...] = QUICK_OBJECTS
    """Test objects, in turn."""
    environment: Annotated[str, tyro.conf.arg(name="environment")] = ENVIRONMENT_ID
    """Environment id."""
    reward_mode: str = "tslam"
    """Reward mode to compare."""
    seed: int = 0
    """Seed of starts and actions."""
    json: bool = False
    """Print JSON instead of lines."""
    no_capture: bool = False
    """Leave what native code prints alone, so that it is seen if the process crashes; complaints are not counted then."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench gpu-check`` with the given arguments. Raises BenchmarkError for bad input or no GPU."""
    command: GpuCheck = parse("tslam-bench gpu-check", GpuCheck, arguments)
    variant = get_variant(command.environment)
    from tslam_bench.engine import gpu_physics
    from tslam_bench.engine.native_output import NativeOutput, captured_output
    from tslam_bench.evaluation.gpu_check import Episodes, Finding, compare, judge, record

    if not gpu_physics.cuda_available():
        raise InvalidInputError(
            "gpu-check: there is no CUDA GPU that torch can use; run it on a machine that has one; "
            "tslam-bench doctor tells what is found here"
        )
    gpu_physics.enable_gpu_physics()  # before the capture, which would hide what fails here
    episodes = Episodes.draw(command.objects, variant.poses, command.num_envs, command.seed)

    def play(device: str, played: Episodes):
        envs: Any = make_vec(
            command.environment, command.num_envs, device, objects=command.objects, reward_mode=command.reward_mode
        )
        try:
            recording = record(envs, played)
            return recording, int(envs.faults.sum()) if device == "cuda" else 0
        finally:
            envs.close()

    with nullcontext(NativeOutput()) if command.no_capture else captured_output() as output:
        on_gpu, faults = play("cuda", episodes)
    reference, perturbed = play("cpu", episodes)[0], play("cpu", episodes.perturbed())[0]
    found, yardstick = compare(reference, on_gpu), compare(reference, perturbed)
    findings, complaints = [*judge(found, yardstick), Finding("faults", faults, 0, faults == 0)], output.complaints()
    passed = all(finding.passed for finding in findings) and not complaints
    card = gpu_physics.machine_identity()["card"]
    stamped = passed and not command.no_capture
    if stamped:
        gpu_physics.write_stamp(variant.id)
    if command.json:
        report = {
            "passed": passed,
            "findings": [asdict(finding) for finding in findings],
            "yardstick": asdict(yardstick),
            "complaints": complaints,
            "captured": not command.no_capture,
            "stamped": stamped,
            "steps_per_second": {"cuda": on_gpu.steps_per_second, "cpu": reference.steps_per_second},
            "num_envs": command.num_envs,
            "device": card,
        }
        print(json.dumps(report, indent=2))
    else:
        for finding in findings:
            print(f"{finding.name:12} {finding.value:10.4f}  limit {finding.limit:8.4f}  {_word(finding.passed)}")
        print(f"{'complaints':12} {len(complaints):10d}  of PhysX               {_word(not complaints)}")
        for line in complaints[:3]:
            print(f"  {line}")
        print(f"steps per second, cuda: {on_gpu.steps_per_second:,.0f} ({card})")
        print(f"steps per second, cpu:  {reference.steps_per_second:,.0f}")
    if not passed:
        sys.exit(1)


def _word(passed: bool) -> str:
    return "ok" if passed else "FAILED"
