"""Score a submission: write one without the benchmark's evaluation, as any lab can, and read its scores.

No simulator and no torch are needed here. The shape that is handed in is a ball of 4 cm radius, whatever the object. Nobody
touched anything for it, so it is a reference (privileged); an entry that is to be ranked adds its rollouts (docs/submission.md).

python examples/6_score_a_submission.py --output runs/balls
"""

from pathlib import Path

import numpy as np
import tyro

from tslam_bench.constants import GRID_SIZE, VOXEL_EDGE, WORKSPACE_LOW
from tslam_bench.objects.store import asset_sha256
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.info import SubmissionInfo
from tslam_bench.scoring.scoring import score_submission
from tslam_bench.scoring.submission import RECONSTRUCTED_POSES, SubmissionWriter
from tslam_bench.version import __version__


def ball(radius: float) -> Volume:
    """A ball (m) at the centre of the workspace."""
    centres = WORKSPACE_LOW + VOXEL_EDGE * (np.arange(GRID_SIZE) + 0.5)
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    distance = np.sqrt(x**2 + y**2 + z**2) - radius
    return Volume(np.clip(0.5 - distance / (2 * VOXEL_EDGE), 0, 1))


def main(objects: tuple[str, ...] = ("mug", "hammer"), output: Path = Path("runs/balls")) -> None:
    """Writes a submission and scores it.

    Args:
        objects: objects of the test split.
        output: folder of the submission.
    """
    info = SubmissionInfo(
        method="balls",
        explorer="none",
        reconstructor="ball",
        authors=("Your name",),
        asset_manifest_sha256=asset_sha256(objects),
        seeds=(0,),
        object_set="quick",
        privileged=True,
        package_version=__version__,
    )
    with SubmissionWriter(output, info) as writer:
        for name in objects:
            for poses in RECONSTRUCTED_POSES:  # after 1, 2, 4 and 8 poses
                writer.add_reconstruction(name, poses, 0, ball(0.04))
    score = score_submission(output, objects)
    for result in score.results:
        print(f"{result.object}: IoU {result.poses['8']['iou']:.3f}, Chamfer-L1 {result.poses['8']['chamfer_l1']:.3f}")
    print(f"IoU area {score.aggregate['areas']['iou_area'].mean:.3f}")
    for note in score.notes:
        print("note:", note)


if __name__ == "__main__":
    tyro.cli(main)
