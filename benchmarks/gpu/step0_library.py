"""Step 0: are PhysX's GPU library, the driver and torch in place, and the prepared objects and the hand?

python benchmarks/gpu/step0_library.py
"""

from __future__ import annotations

import torch
import tyro
from sapien import physx
from step import Report, Step, memory, run

from tslam_bench.engine import gpu_physics
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.splits import SPLITS, prepared_names


def work(step: Step, report: Report) -> None:
    """Looks, and says; switching GPU physics on has come before this."""
    report["library"] = str(gpu_physics.library_path())
    report["library_there"] = gpu_physics.library_path().is_file()
    report["address"] = gpu_physics.library_address()
    report["gpu_physics"] = physx.is_gpu_enabled()
    report["torch_sees"] = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    report["hand"] = load_hand().urdf.name
    report["objects"] = {split: len(prepared_names(split)) for split in SPLITS}
    report["memory"] = memory(step)


if __name__ == "__main__":
    run(tyro.cli(Step), work)
