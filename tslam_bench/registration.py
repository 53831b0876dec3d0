"""Registers the environment ids with Gymnasium, without importing the simulator."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import gymnasium
import gymnasium.vector

from tslam_bench.constants import ENVIRONMENT_ID
from tslam_bench.engine import gpu_physics
from tslam_bench.extras import named_extra
from tslam_bench.variants import ENVIRONMENT_IDS, get_variant

_TASKS = ("tslam_bench.tasks.tactile_slam", "tslam_bench.tasks.tabletop")


@named_extra()
def make_environment(environment_id: str, **kwargs: Any) -> gymnasium.Env:
    """Makes the unwrapped environment; what ``gymnasium.make`` calls."""
    import tslam_bench.engine  # noqa: F401  (before the simulator: quiet about a missing Vulkan)

    from mani_skill.utils import registration  # isort: skip

    for module in _TASKS:
        importlib.import_module(module)  # registers with ManiSkill

    return registration.make(environment_id, **kwargs)


@named_extra()
def make_vec(
    environment_id: str = ENVIRONMENT_ID,
    num_envs: int = 16,
    device: str = "auto",
    *,
    object: str | None = None,
    objects: Sequence[str] | None = None,
    split: str | None = None,
    pose: int | None = None,
    reward_mode: str = "tslam",
    control_mode: str = "pd_joint_delta_pos",
    processes: int | None = None,
    timeout: float = 60.0,
    action_repeat: int = 1,
) -> gymnasium.vector.VectorEnv:
    """A Gymnasium vector environment (1.x semantics, autoreset ``SAME_STEP``) of many hands.

    ``gymnasium.make_vec(environment_id, num_envs, ...)`` is the same, with the same arguments by name. Its modes ``sync`` and
    ``async`` are not meant for these environments: they batch what ManiSkill has batched already.

    On the CPU: scenes in worker processes, sensed as one batch per worker, observations as numpy arrays; bit for
    bit the episodes of ``gymnasium.make`` with the same seeds. On CUDA: ManiSkill's GPU simulation, observations as
    torch tensors on the device. *The CUDA path has not been run on a GPU yet.*

    Args:
        environment_id: a registered id.
        num_envs: environments.
        device: ``cpu``, ``cuda`` or ``auto``: CUDA where ``tslam-bench gpu-check`` has passed, else the CPU.
        object: one object for every episode.
        objects: names to draw from, one draw per episode; neither means the whole split.
        split: ``test``, ``train``, ``val`` or a private split; None: named objects are found in whatever split has them, and
            without names episodes draw from what is prepared of ``train``.
        pose: one of the environment's poses for every episode; None draws.
        reward_mode: see the environment.
        control_mode: see the environment.
        processes: CPU worker processes; None means the cores, 0 steps in the caller's own process (notebooks, daemonic pools,
            debuggers), with the same bits.
        timeout: seconds after which a CPU worker that does not answer a step counts as hung.
        action_repeat: control steps that a step holds its action for, a divisor of the horizon; rewards are added up.

    Raises:
        InvalidInputError: unknown id, device, object, pose or mode, a bad action_repeat; CUDA asked for where there is none.
        AssetError: objects or the hand are not prepared.
        MissingPackageError: the extra ``sim`` is not installed.
    """
    get_variant(environment_id)
    if gpu_physics.simulation_device(device, environment_id) == "cuda":
        return _make_cuda_vec(
            environment_id,
            num_envs,
            {
                "object": object,
                "objects": objects,
                "split": split,
                "pose": pose,
                "reward_mode": reward_mode,
                "control_mode": control_mode,
            },
            action_repeat,
        )
    from tslam_bench.engine.hand_batch import BatchSettings
    from tslam_bench.engine.requests import check_names
    from tslam_bench.engine.worker_vector_env import TactileVectorEnv

    chosen = None if objects is None else check_names(objects)
    settings = BatchSettings(object, chosen, split, pose, reward_mode, control_mode, environment_id)
    return TactileVectorEnv(num_envs, settings, processes, timeout, action_repeat)


def _make_cuda_vec(
    environment_id: str, num_envs: int, kwargs: dict[str, Any], action_repeat: int
) -> gymnasium.vector.VectorEnv:
    from tslam_bench.engine.maniskill_vector_env import BatchedVectorEnv

    environment = gymnasium.make(environment_id, num_envs=num_envs, sim_backend="physx_cuda", **kwargs)
    return BatchedVectorEnv(environment, action_repeat)


def register_environments() -> None:
    """Registers every id; safe to call twice. The environments truncate themselves at the horizon, batched."""
    for environment_id in ENVIRONMENT_IDS:
        if environment_id in gymnasium.registry:
            continue
        gymnasium.register(
            environment_id,
            entry_point="tslam_bench.registration:make_environment",
            vector_entry_point="tslam_bench.registration:make_vec",
            disable_env_checker=True,  # ManiSkill environments return batched tensors, which the checker refuses
            kwargs={"environment_id": environment_id},
        )
