"""Train with stable-baselines3: its PPO learns on our vector environment.

The benchmark's own trainer (`tslam-bench baselines train`) is about ten times as fast; this is the way to try another algorithm.

python examples/4_train_with_stable_baselines3.py --steps 100000
"""

from pathlib import Path

import tyro
from stable_baselines3 import PPO

import tslam_bench
from tslam_bench.baselines.sb3_adapter import TactileVecEnv


def main(steps: int = 20_000, num_envs: int = 8, output: Path = Path("sb3_policy.zip")) -> None:
    """Trains a policy and saves it.

    Args:
        steps: decisions over all environments.
        num_envs: environments side by side.
        output: where to save.
    """
    # Absolute joint targets that are held for four control steps explore much better than small steps.
    envs = tslam_bench.make_vec(num_envs=num_envs, split="train", control_mode="pd_joint_pos", action_repeat=4)
    learner = PPO(
        "MultiInputPolicy",
        TactileVecEnv(envs, seed=0),
        n_steps=50,  # one episode: 200 control steps, four per decision
        batch_size=200,
        n_epochs=4,
        gamma=0.97,
        policy_kwargs={"log_std_init": -0.5},
        seed=0,
        device="cpu",
    )
    learner.learn(steps, progress_bar=False)
    learner.save(output)
    print(f"{output}: trained for {learner.num_timesteps} decisions")
    envs.close()


if __name__ == "__main__":
    tyro.cli(main)
