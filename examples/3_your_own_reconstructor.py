"""Your own reconstructor: from touched and visited voxels to an occupancy volume, compared with the hull.

python examples/3_your_own_reconstructor.py

The command line takes it too:

tslam-bench evaluate --policy heuristic --reconstructor hull examples/3_your_own_reconstructor.py:Closing
"""

from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy import ndimage

import tslam_bench
from tslam_bench.reconstruction.volume import Volume
from tslam_bench.scoring.scoring import score_submission


class Closing:
    """Grows the touched voxels until they meet, fills what is enclosed, shrinks again, and takes the swept space away.

    Args:
        radius: voxels that the touched ones grow by.
    """

    def __init__(self, radius: int = 3) -> None:
        self.radius = radius

    def reconstruct(self, touched: NDArray[np.bool_], visited: NDArray[np.bool_]) -> Volume:
        """Both grids are (32, 32, 32) bool in the object frame; returns a probability in each voxel."""
        padded = np.pad(touched, self.radius)  # growing must not stop at the border
        closed = ndimage.binary_closing(padded, iterations=self.radius) if touched.any() else padded
        inside = slice(self.radius, -self.radius)
        solid = ndimage.binary_fill_holes(closed)[inside, inside, inside] & ~visited | touched
        return Volume(solid.astype(np.float32), interpolation="nearest")


def main(objects: tuple[str, ...] = ("mug", "hammer"), output: Path = Path("runs/own_reconstructor")) -> None:
    """Lets the heuristic explore once, and scores both reconstructors on the same touches.

    Args:
        objects: objects of the test split.
        output: folder for rollouts and submissions.
    """
    for submission in tslam_bench.evaluate("heuristic", ("hull", Closing), objects=objects, output=output):
        score = score_submission(submission, objects)
        print(f"{score.info.method}: IoU area {score.aggregate['areas']['iou_area'].mean:.3f}")


if __name__ == "__main__":
    tyro.cli(main)
