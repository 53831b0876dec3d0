"""TactileSLAM benchmark: a blind robot hand explores an unknown object and rebuilds its shape.

Importing this package registers every environment id with Gymnasium::

    import gymnasium as gym
    import tslam_bench

    env = gym.make("TactileSLAM-v0", object="mug", pose=0)
    envs = tslam_bench.make_vec("TactileSLAM-v0", num_envs=32)

A policy and a reconstructor of your own are evaluated beside the benchmark's::

    tslam_bench.register_policy("mine", MyPolicy)
    tslam_bench.evaluate("mine", ("hull", MyReconstructor), objects=("mug",), output="runs/mine")

The simulator is imported when an environment is made, not before: metrics and scoring do without it.
"""

from pathlib import Path as _Path

from tslam_bench.evaluation.door import evaluate
from tslam_bench.evaluation.policies import register_policy
from tslam_bench.reconstruction.registry import register_reconstructor
from tslam_bench.registration import make_vec, register_environments
from tslam_bench.version import __version__

__all__ = ["__version__", "evaluate", "make_vec", "register_policy", "register_reconstructor"]

# In a clone the leaves (tasks, baselines, leaderboard) and assets lie beside this folder; a wheel has them inside it.
if not (_Path(__file__).parent / "tasks").is_dir():
    __path__.append(str(_Path(__file__).resolve().parents[1]))

register_environments()
