"""Explore an object: a scripted hand feels the mug in all eight poses, and its shape is rebuilt.

python examples/1_explore_an_object.py --output mug.obj
"""

from pathlib import Path

import gymnasium as gym
import tyro

import tslam_bench  # noqa: F401  (registers the environments)
from tslam_bench import grids
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.reconstruction.registry import make_reconstructor


def main(object: str = "mug", explorer: str = "heuristic", poses: int = 8, output: Path = Path("explored.obj")) -> None:
    """Explores, merges what was touched, rebuilds.

    Args:
        object: what to explore (tslam-bench assets list).
        explorer: who explores (tslam-bench baselines list).
        poses: in how many of the eight poses.
        output: mesh file to write.
    """
    policy = make_baseline(explorer)
    env = gym.make("TactileSLAM-v0", object=object, control_mode=policy.control_mode)
    touched, visited = [], []
    for pose in range(poses):
        observation, _ = env.reset(seed=pose, options={"pose": pose})
        policy.reset(num_envs=1, seed=pose)
        for _ in range(200):
            action = policy.act({key: value.numpy() for key, value in observation.items()})
            observation, reward, terminated, truncated, info = env.step(action)
        # The hand knows the object's pose, so what it felt can be carried into the object's frame.
        touched.append(grids.world_to_object(env.unwrapped.touched[0], pose))
        visited.append(grids.world_to_object(env.unwrapped.visited[0], pose))
        print(f"pose {pose}: {int(touched[-1].sum())} voxels touched")
    env.close()
    felt, free = grids.merge(touched), grids.merge(visited)
    mesh = make_reconstructor("carve").reconstruct(felt, free).to_mesh()
    mesh.export(output)
    print(f"{int(felt.sum())} voxels touched in {poses} poses; {output}: {len(mesh.faces)} triangles")


if __name__ == "__main__":
    tyro.cli(main)
