"""K hands in one process, sensed as one batch: the engine behind the CPU vector environment. No torch, no ManiSkill."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS
from tslam_bench.engine.arrays import NumpyBackend
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.hand_scene import physx_scenes
from tslam_bench.engine.link_poses import POSE_SIZE, link_matrices
from tslam_bench.engine.physics import PROTOCOL, PhysicsSettings
from tslam_bench.engine.requests import check_control_mode, check_reward_mode
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.skin import build_skin
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS, ArraySpec
from tslam_bench.engine.starts import StartSampler
from tslam_bench.errors import AssetError
from tslam_bench.hand_constants import CONTROL_MODES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.variants import get_variant

STEP_ARRAYS: dict[str, ArraySpec] = {
    "reward": ((), np.float32),
    "truncated": ((), np.bool_),
    "new_touched": ((), np.int64),
    "new_visited": ((), np.int64),
    "elapsed_steps": ((), np.int32),
}
"""Shape and type of what else one environment's step returns."""
SUMMED = ("reward", "new_touched", "new_visited")
"""Step arrays that add up over control steps with one action."""
FINAL = "final_"
"""Prefix of the arrays that hold an episode's last observation while its environment starts the next one."""


def batch_arrays() -> dict[str, ArraySpec]:
    """Name, shape and type, per environment, of every array that a batch reads and writes."""
    final = {FINAL + name: spec for name, spec in OBSERVATION_ARRAYS.items()}
    return {"action": ((NUM_JOINTS,), np.float32), **OBSERVATION_ARRAYS, **final, **STEP_ARRAYS}


@dataclass(frozen=True)
class BatchSettings:
    """What the environments of a batch are; the same arguments as the ManiSkill task's."""

    object: str | None = None
    objects: tuple[str, ...] | None = None
    split: str | None = None
    pose: int | None = None
    reward_mode: str = "tslam"
    control_mode: str = CONTROL_MODES[0]
    environment_id: str = ENVIRONMENT_ID
    physics: PhysicsSettings = PROTOCOL
    scenes: Callable[[Path, PhysicsSettings, bool, int], Sequence[Any]] = physx_scenes
    """Makes the scenes; benchmarks put another simulator's here. Worker processes have to be able to import it."""

    def __post_init__(self) -> None:
        check_reward_mode(self.reward_mode)
        check_control_mode(self.control_mode)

    def sampler(self) -> StartSampler:
        """Draws episode starts. Raises what :class:`StartSampler` raises."""
        return StartSampler(self.object, self.objects, self.split, self.pose, get_variant(self.environment_id))


class HandBatch:
    """K environments stepped together.

    Args:
        num_envs: K.
        settings: what they are.
        arrays: the arrays of :func:`batch_arrays`, each (K, ...); actions are read from them, all else is written there. None
            makes them.
        autoreset: whether an episode that ends is followed by the next one at once; else it stays as it is until the next reset.
    """

    def __init__(
        self,
        num_envs: int,
        settings: BatchSettings,
        arrays: Mapping[str, NDArray] | None = None,
        autoreset: bool = True,
    ) -> None:
        if arrays is None:
            arrays = {name: np.zeros((num_envs, *shape), dtype) for name, (shape, dtype) in batch_arrays().items()}
        hand, backend = load_hand(), NumpyBackend()
        self.num_envs = num_envs
        self.arrays = arrays
        self._autoreset = autoreset
        self._starts = settings.sampler()
        table = self._starts.variant.table
        self._scenes = settings.scenes(hand.urdf, settings.physics, table, num_envs)
        self._sensing = CompiledSensing(num_envs, build_skin(hand.shapes), arrays["occupancy"])
        self._targets = DriveTargets(settings.control_mode, backend, settings.physics.step_limit)
        self._rewards = Rewards(settings.reward_mode, num_envs, backend)
        self._rngs: list[np.random.RandomState | None] = [None] * num_envs
        self._qpos = np.zeros((num_envs, NUM_JOINTS), dtype=np.float32)
        self._qvel = np.zeros((num_envs, NUM_JOINTS), dtype=np.float32)
        self._poses = np.zeros((num_envs, self._scenes[0].num_bodies, POSE_SIZE), dtype=np.float32)
        self._skin_rows = self._scenes[0].skin_rows()
        self._links = np.zeros((num_envs, len(SKIN_LINKS), 3, 4), dtype=np.float32)
        self.object_name = [""] * num_envs
        self.pose = [0] * num_envs

    def reset(
        self,
        seeds: Sequence[int | None],
        envs: Sequence[int],
        objects: Sequence[str | None] | None = None,
        poses: Sequence[int | None] | None = None,
    ) -> None:
        """Starts new episodes in ``envs`` (the first call has to name all).

        ``seeds`` (one per entry of ``envs``) reseeds an environment; None lets its generator go on.

        Raises:
            InvalidInputError: unknown object or pose.
            AssetError: an object is not prepared or does not fit.
        """
        for position, env in enumerate(envs):
            seed = seeds[position]
            if seed is not None or self._rngs[env] is None:
                self._rngs[env] = np.random.RandomState(seed)
            rng = self._rngs[env]
            assert rng is not None
            start = self._starts.draw(rng, objects[position] if objects else None, poses[position] if poses else None)
            self.object_name[env], self.pose[env] = start.prepared.name, start.pose
            self._scenes[env].begin(start)
            self._sensing.set_object(env, start.prepared.name, start.prepared.field, start.pose)
            self._rewards.set_object(env, start.prepared, start.pose)
        self._read(envs)
        self._sensing.begin(envs)
        self._rewards.begin(envs)
        felt = self._sensing.touches(self._links)[list(envs)].any(1)
        if felt.any():
            name = self.object_name[envs[int(np.flatnonzero(felt)[0])]]
            raise AssetError(f"{name}: touches the hand at the start, so it does not fit in the workspace")
        for name in (*STEP_ARRAYS, "touch", "time"):
            self.arrays[name][list(envs)] = 0

    def step(self, repeat: int = 1) -> None:
        """``repeat`` control steps of all environments with the actions in the arrays; ended episodes start anew at once.

        What is in ``SUMMED`` is added up. ``repeat`` is the same in all calls and a divisor of the horizon, so that an
        episode ends with the last of these steps if it ends.
        """
        self._control_step()
        for _ in range(repeat - 1):
            before = {name: self.arrays[name].copy() for name in SUMMED}
            self._control_step()
            for name, value in before.items():
                self.arrays[name][:] += value

    def _control_step(self) -> None:
        arrays = self.arrays
        targets = self._targets(arrays["action"], arrays["qpos"])
        # Hand by hand: what setting the targets brings into the processor's cache, the physics and the reading need again.
        for env, (scene, target) in enumerate(zip(self._scenes, targets.tolist(), strict=True)):
            scene.set_targets(target)
            scene.step()
            self._read_scene(env)
        self._gather()
        contacts = self._sensing.step(self._links, arrays["elapsed_steps"])
        arrays["elapsed_steps"][:] += 1
        arrays["reward"][:] = self._rewards.step(contacts)
        arrays["new_touched"][:] = contacts.new_touched
        arrays["new_visited"][:] = contacts.new_visited
        arrays["touch"][:] = self._sensing.link_touch()
        arrays["time"][:, 0] = arrays["elapsed_steps"] / np.float32(HORIZON)
        ended = np.flatnonzero(arrays["elapsed_steps"] >= HORIZON)
        arrays["truncated"][:] = False
        arrays["truncated"][ended] = True
        if len(ended) and self._autoreset:
            self._start_anew(ended)

    def _start_anew(self, ended: NDArray) -> None:
        arrays, kept = self.arrays, {}
        for name in OBSERVATION_ARRAYS:
            arrays[FINAL + name][ended] = arrays[name][ended]
        for name in SUMMED:
            kept[name] = arrays[name][ended].copy()
        self.reset([None] * len(ended), ended.tolist())
        for name, value in kept.items():
            arrays[name][ended] = value
        arrays["truncated"][ended] = True  # the reset cleared it

    def put_joints(self, qpos: NDArray[np.float32]) -> None:
        """Moves all joints to ``qpos`` (K, 28) within the running episodes; velocities stay. The next step feels from there."""
        for scene, row in zip(self._scenes, qpos, strict=True):
            scene.put_joints(row)
        self.arrays["qpos"][:] = qpos

    def _read(self, envs: Sequence[int]) -> None:
        """Reads joints and links of ``envs`` from their scenes."""
        for env in envs:
            self._read_scene(env)
        self._gather()

    def _read_scene(self, env: int) -> None:
        self._scenes[env].read(self._qpos[env], self._qvel[env], self._poses[env])

    def _gather(self) -> None:
        """From what was read to observed joints, in the order of ``JOINT_NAMES``, and link poses."""
        order = self._scenes[0].joint_order
        self.arrays["qpos"][:] = self._qpos[:, order]
        self.arrays["qvel"][:] = self._qvel[:, order]
        link_matrices(self._poses, self._skin_rows, self._links)

    def state(self) -> dict[str, Any]:
        """Objects and poses of the running episodes, touched steps (K, 32, 32, 32): for evaluation, not for learning."""
        return {
            "object_name": list(self.object_name),
            "pose": list(self.pose),
            "touched_step": np.array(self._sensing.touched_step),
        }
