"""TactileSLAM benchmark: a blind robot hand explores an unknown object and rebuilds its shape.

Importing this package registers every environment id with Gymnasium::

    import gymnasium as gym
    import tslam_bench

    env = gym.make("TactileSLAM-v0", object="mug", pose=0)
    envs = tslam_bench.make_vec("TactileSLAM-v0", num_envs=32)

The simulator is imported when an environment is made, not before: metrics and scoring do without it.
"""

from tslam_bench.registration import make_vec, register_environments

__all__ = ["__version__", "make_vec"]
__version__ = "0.1.0"

register_environments()
