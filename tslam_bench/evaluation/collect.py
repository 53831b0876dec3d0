"""Episodes to learn a reconstructor from: when each voxel was first touched and first visited, in the object frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

from tslam_bench.constants import ENVIRONMENT_ID, GRID_SIZE, NUM_POSES
from tslam_bench.episodes import Episode
from tslam_bench.evaluation.observations import last_observation, to_numpy
from tslam_bench.evaluation.policies import make_baseline
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.grids import world_to_object
from tslam_bench.reconstruction.touch_data import NEVER, ExploredObject, explored_file
from tslam_bench.registration import make_vec

COLLECTION_SALT = "c0"
"""Salt of the policies' own random numbers: collected episodes are those of no evaluation."""
FIRST_SEED = 1000
"""Repetitions of collected episodes count from here, so that their starts are those of no evaluation either."""
_OBJECTS_AT_ONCE = 4


class FirstSteps(VectorWrapper):
    """Remembers in which step of its episode each voxel was first touched and first visited.

    Attributes:
        first: (num_envs, 2, 32, 32, 32) uint8, touched and visited: step 0 to 199, or ``NEVER``; world frame.
    """

    def __init__(self, env: VectorEnv) -> None:
        super().__init__(env)
        self.first: NDArray[np.uint8] = np.zeros(0, dtype=np.uint8)
        self._step = 0

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begins anew with all environments."""
        self.first = np.full((self.num_envs, 2, *(GRID_SIZE,) * 3), NEVER, dtype=np.uint8)
        self._step = 0
        return self.env.reset(**options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One control step."""
        result = self.env.step(actions)
        occupancy = to_numpy(last_observation(result[0], result[4])["occupancy"]).astype(bool)
        self.first[occupancy & (self.first == NEVER)] = self._step
        self._step += 1
        return result


def collect_episodes(
    policy: Any,
    objects: Sequence[str],
    split: str,
    output: Path,
    model: Path | None = None,
    repetitions: int = 1,
    processes: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **arguments: Any,
) -> None:
    """Lets a policy explore each object in all eight poses and writes one file per object. Files that exist are kept.

    Args:
        policy, model, arguments: see :func:`tslam_bench.evaluation.policies.make_baseline`.
        objects, split: prepared objects.
        output: folder of this policy's files.
        repetitions: episodes per object and pose.
        processes: worker processes; None: the cores.
        progress: called with the objects done and their number.

    Raises:
        InvalidInputError: an unknown policy or object.
        AssetError: an object is not prepared, or ``output`` cannot be written.
    """
    report = progress or (lambda done, total: None)
    missing = [name for name in objects if not explored_file(output, name).is_file()]
    report(len(objects) - len(missing), len(objects))
    if not missing:
        return
    baseline = make_baseline(policy, model, **arguments)
    mode = baseline.control_mode
    width = _OBJECTS_AT_ONCE * NUM_POSES
    envs = FirstSteps(
        make_vec(ENVIRONMENT_ID, width, "cpu", objects=missing, split=split, control_mode=mode, processes=processes)
    )
    try:
        for begin in range(0, len(missing), _OBJECTS_AT_ONCE):
            names = missing[begin : begin + _OBJECTS_AT_ONCE]
            found: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in names}
            for repetition in range(repetitions):
                episodes: list[Episode] = [
                    (name, pose, FIRST_SEED + repetition) for name in names for pose in range(NUM_POSES)
                ]
                roll_out_batch(envs, baseline, episodes, COLLECTION_SALT)
                for env, (name, pose, _) in enumerate(episodes):
                    found[name].append(world_to_object(envs.first[env], pose))
            for name in names:
                ExploredObject(np.stack(found[name]), np.tile(np.arange(NUM_POSES), repetitions)).save(output, name)
            report(len(objects) - len(missing) + begin + len(names), len(objects))
    finally:
        envs.close()
