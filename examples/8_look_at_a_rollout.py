"""Look at a rollout: pictures of what the hand had touched after 50, 100 and 200 control steps, beside the truth.

python examples/8_look_at_a_rollout.py --object mug --output rollout.png
"""

from pathlib import Path

import gymnasium as gym
import numpy as np
import trimesh
import tyro
from PIL import Image

import tslam_bench  # noqa: F401  (registers the environments)
from tslam_bench import grids
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.geometry.render import fit_camera, render, voxels_to_mesh
from tslam_bench.objects.store import load_object

BLUE, ORANGE = (0.33, 0.53, 0.80), (0.93, 0.55, 0.20)


def main(object: str = "mug", explorer: str = "heuristic", pose: int = 0, output: Path = Path("rollout.png")) -> None:
    """Draws one rollout.

    Args:
        object: what to explore.
        explorer: who explores.
        pose: 0 to 7.
        output: picture to write.
    """
    policy = make_baseline(explorer)
    env = gym.make("TactileSLAM-v0", object=object, pose=pose, control_mode=policy.control_mode)
    observation, _ = env.reset(seed=0)
    policy.reset(num_envs=1, seed=0)
    for _ in range(200):
        observation, *_ = env.step(policy.act({key: value.numpy() for key, value in observation.items()}))
    # touched_step says when each voxel was first touched, so one grid holds the whole rollout.
    touched_step = grids.world_to_object(np.asarray(env.unwrapped.touched_step[0]), pose)
    env.close()

    prepared = load_object(object)
    truth = trimesh.Trimesh(prepared.vertices, prepared.faces, process=False)
    camera = fit_camera([truth], margin=1.3)
    panels = [
        render(
            [(voxels_to_mesh((touched_step >= 0) & (touched_step < steps)), ORANGE)], camera, (360, 360), ground=None
        )
        for steps in (50, 100, 200)
    ]
    panels.append(render([(truth, BLUE)], camera, (360, 360), ground=None))
    Image.fromarray(np.concatenate(panels, axis=1)).save(output)
    felt = prepared.surface[touched_step >= 0].sum() / prepared.surface.sum()
    print(f"{output}: {(touched_step >= 0).sum()} voxels touched, {felt:.0%} of the surface")


if __name__ == "__main__":
    tyro.cli(main)
