"""``tslam-bench gpu-check``: does the GPU simulation agree with the CPU's, and how fast is it?"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from tslam_bench.cli.commands import parse
from tslam_bench.constants import ENVIRONMENT_ID, QUICK_OBJECTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.registration import make_vec
from tslam_bench.variants import get_variant


@dataclass(frozen=True)
class GpuCheck:
    """Plays the same episodes on a CUDA GPU and on the CPU and compares touch, grids and rewards.

    Prints each figure with its tolerance and the steps per second; exit status 0 if all hold, else 1; 2 without a GPU.
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


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench gpu-check`` with the given arguments. Raises BenchmarkError for bad input or no GPU."""
    command: GpuCheck = parse("tslam-bench gpu-check", GpuCheck, arguments)
    variant = get_variant(command.environment)
    import torch

    from tslam_bench.engine.native_output import captured_output
    from tslam_bench.evaluation.gpu_check import Episodes, compare, judge, record

    if not torch.cuda.is_available():
        raise InvalidInputError("gpu-check: there is no CUDA GPU that torch can use; run it on a machine that has one")
    episodes = Episodes.draw(command.objects, variant.poses, command.num_envs, command.seed)

    def play(device: str, played: Episodes):
        envs = make_vec(
            command.environment, command.num_envs, device, objects=command.objects, reward_mode=command.reward_mode
        )
        try:
            return record(envs, played)
        finally:
            envs.close()

    with captured_output() as output:
        on_gpu = play("cuda", episodes)  # GPU only
    reference, perturbed = play("cpu", episodes), play("cpu", episodes.perturbed())
    found, yardstick = compare(reference, on_gpu), compare(reference, perturbed)
    findings, overflows = judge(found, yardstick), output.overflows()
    passed = all(finding.passed for finding in findings) and not overflows
    if command.json:
        report = {
            "passed": passed,
            "findings": [asdict(finding) for finding in findings],
            "yardstick": asdict(yardstick),
            "overflows": overflows,
            "steps_per_second": {"cuda": on_gpu.steps_per_second, "cpu": reference.steps_per_second},
            "num_envs": command.num_envs,
            "device": torch.cuda.get_device_name(),
        }
        print(json.dumps(report, indent=2))
    else:
        for finding in findings:
            print(f"{finding.name:12} {finding.value:10.4f}  limit {finding.limit:8.4f}  {_word(finding.passed)}")
        print(f"{'buffers':12} {len(overflows):10d}  overflows              {_word(not overflows)}")
        for line in overflows[:3]:
            print(f"  {line}")
        print(f"steps per second, cuda: {on_gpu.steps_per_second:,.0f} ({torch.cuda.get_device_name()})")
        print(f"steps per second, cpu:  {reference.steps_per_second:,.0f}")
    if not passed:
        sys.exit(1)


def _word(passed: bool) -> str:
    return "ok" if passed else "FAILED"
