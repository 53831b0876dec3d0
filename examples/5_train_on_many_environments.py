"""Train on many environments: a learner of your own on the batched engine, without any framework.

Cross-entropy search over the mean of an open-loop policy: 32 hands try 32 sequences of joint targets at a time, and the best
become the next mean. Crude, but it shows the loop: one array of actions in, one dict of arrays out.

python examples/5_train_on_many_environments.py --generations 20
"""

import numpy as np
import tyro

import tslam_bench


def main(generations: int = 5, num_envs: int = 32, targets: int = 10, object: str = "mug") -> None:
    """Searches a sequence of joint targets that touches much of one object.

    Args:
        generations: rounds of the search.
        num_envs: hands side by side, each with a candidate of its own.
        targets: joint targets per episode, each held for an equal part of it.
        object: what to explore.
    """
    rng = np.random.default_rng(0)
    # A step holds its action for 200 / targets control steps, and returns the sum of their rewards.
    envs = tslam_bench.make_vec(
        num_envs=num_envs, object=object, pose=0, control_mode="pd_joint_pos", action_repeat=200 // targets
    )
    mean = np.zeros((targets, 28), dtype=np.float32)
    deviation = np.full((targets, 28), 0.6, dtype=np.float32)
    for generation in range(generations):
        candidates = mean + deviation * rng.standard_normal((num_envs, targets, 28), dtype=np.float32)
        candidates = np.clip(candidates, -1, 1)
        envs.reset(seed=0)
        touched = np.zeros(num_envs, dtype=np.int64)
        for step in range(targets):
            observation, reward, terminated, truncated, info = envs.step(candidates[:, step])
            # All episodes end together here; then `info` is that of the next ones, and `final_info` that of this step.
            touched += info.get("final_info", info)["new_touched"]
        best = candidates[np.argsort(touched)[-num_envs // 4 :]]
        mean, deviation = best.mean(axis=0), best.std(axis=0) + 0.05
        print(f"generation {generation}: mean {touched.mean():.0f}, best {touched.max()} voxels touched")
    envs.close()


if __name__ == "__main__":
    tyro.cli(main)
