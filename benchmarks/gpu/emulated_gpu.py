"""PhysX's GPU interface with CPU physics behind it, so that all code above a GPU simulation runs where there is no GPU.

What ManiSkill and the tasks do on a GPU (buffers for all sub-scenes, rows by index, apply and fetch, partial resets) happens
here on CPU tensors, and every sub-scene is a real PhysX CPU system. It says nothing about PhysX's GPU solver: contacts, speed
and memory are the CPU's.

    with emulated_gpu():
        envs = tslam_bench.make_vec(num_envs=4, device="cuda", ...)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import mani_skill.envs.sapien_env as sapien_env
import numpy as np
import sapien
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import BackendInfo
from sapien import physx

from tslam_bench.engine import gpu_physics

BODY_SIZE = 13
"""Numbers of a body's row: position, quaternion (w, x, y, z), linear and angular velocity."""


class Buffer:
    """Stands in for SAPIEN's ``CudaArray``."""

    def __init__(self, tensor: torch.Tensor) -> None:
        self._tensor = tensor

    def torch(self) -> torch.Tensor:
        """The tensor itself: writing to it writes the buffer."""
        return self._tensor


class EmulatedGpuSystem:
    """``PhysxGpuSystem`` on one CPU system per sub-scene: buffers of zeros until the first fetch, applied as a whole.

    Args:
        scenes: the sub-scenes.
    """

    def __init__(self, scenes: list[sapien.Scene]) -> None:
        self._systems = [scene.physx_system for scene in scenes]
        self._scenes = scenes
        self.after_init: list[Any] = []
        """Contacts of every sub-scene after the step that ``gpu_init`` makes."""

    @property
    def timestep(self) -> float:
        """Duration of a physics step (s)."""
        return self._systems[0].timestep

    @timestep.setter
    def timestep(self, value: float) -> None:
        for system in self._systems:
            system.timestep = value

    def gpu_init(self) -> None:
        """Gives every body and hand a row, and simulates one step, as SAPIEN does."""
        self._bodies = [
            body
            for scene in self._scenes
            for entity in scene.entities
            if (body := entity.find_component_by_type(physx.PhysxRigidDynamicComponent)) is not None
        ]
        links = [
            link
            for scene in self._scenes
            for entity in scene.entities
            if (link := entity.find_component_by_type(physx.PhysxArticulationLinkComponent)) is not None
        ]
        self._hands = list({id(link.articulation): link.articulation for link in links if link.is_root}.values())
        self._links = [link for hand in self._hands for link in hand.links]
        rows, joints = len(self._bodies) + len(self._links), max(hand.dof for hand in self._hands)
        self.cuda_rigid_body_data = Buffer(torch.zeros(rows, BODY_SIZE))
        for name in ("qpos", "qvel", "qf", "qacc", "target_qpos", "target_qvel"):
            setattr(self, f"cuda_articulation_{name}", Buffer(torch.zeros(len(self._hands), joints)))
        self.step()
        self.after_init = [system.get_contacts() for system in self._systems]

    def row_of_body(self, body: Any) -> int:
        """Row of a rigid body or link in ``cuda_rigid_body_data``."""
        return [*self._bodies, *self._links].index(body)

    def row_of_hand(self, hand: Any) -> int:
        """Row of an articulation in the articulation buffers."""
        return self._hands.index(hand)

    def step(self) -> None:
        """One physics step of every sub-scene."""
        for system in self._systems:
            system.step()

    # -- apply --------------------------------------------------------------------------------------------------------
    def gpu_apply_rigid_dynamic_data(self) -> None:
        """Moves all bodies, known to the caller or not."""
        for body, row in zip(self._bodies, self.cuda_rigid_body_data.torch().numpy(), strict=False):
            body.entity.pose = sapien.Pose(row[:3], row[3:7] if row[3:7].any() else [1, 0, 0, 0])

    def gpu_apply_articulation_root_pose(self) -> None:
        """Moves all hands."""
        rows, first = self.cuda_rigid_body_data.torch().numpy(), len(self._bodies)
        for hand in self._hands:
            row = rows[first + self._links.index(hand.links[0])]
            if row[3:7].any():
                hand.set_root_pose(sapien.Pose(row[:3], row[3:7]))

    def gpu_apply_articulation_root_velocity(self) -> None:
        """Nothing: roots are fixed."""

    def gpu_apply_articulation_qpos(self) -> None:
        """Sets joint positions."""
        for hand, row in zip(self._hands, self.cuda_articulation_qpos.torch().numpy(), strict=True):
            hand.set_qpos(row)

    def gpu_apply_articulation_qvel(self) -> None:
        """Sets joint velocities."""
        for hand, row in zip(self._hands, self.cuda_articulation_qvel.torch().numpy(), strict=True):
            hand.set_qvel(row)

    def gpu_apply_articulation_qf(self) -> None:
        """Sets joint forces."""
        for hand, row in zip(self._hands, self.cuda_articulation_qf.torch().numpy(), strict=True):
            hand.set_qf(row)

    def gpu_apply_articulation_target_position(self) -> None:
        """Sets drive targets."""
        for hand, row in zip(self._hands, self.cuda_articulation_target_qpos.torch().tolist(), strict=True):
            for joint, target in zip(hand.active_joints, row, strict=True):
                joint.set_drive_target(target)

    def gpu_apply_articulation_target_velocity(self) -> None:
        """Sets drive velocity targets."""
        for hand, row in zip(self._hands, self.cuda_articulation_target_qvel.torch().tolist(), strict=True):
            for joint, target in zip(hand.active_joints, row, strict=True):
                joint.set_drive_velocity_target(target)

    def gpu_update_articulation_kinematics(self) -> None:
        """Nothing: a CPU system moves links with their joints."""

    # -- fetch --------------------------------------------------------------------------------------------------------
    def gpu_fetch_rigid_dynamic_data(self) -> None:
        """Reads all bodies."""
        self._fetch_bodies(0, self._bodies)

    def gpu_fetch_articulation_link_pose(self) -> None:
        """Reads all links."""
        self._fetch_bodies(len(self._bodies), self._links)

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """Nothing: came with the poses."""

    def gpu_fetch_articulation_qpos(self) -> None:
        """Reads joint positions."""
        self._fetch_hands("qpos", [hand.qpos for hand in self._hands])

    def gpu_fetch_articulation_qvel(self) -> None:
        """Reads joint velocities."""
        self._fetch_hands("qvel", [hand.qvel for hand in self._hands])

    def gpu_fetch_articulation_qacc(self) -> None:
        """Reads joint accelerations."""
        self._fetch_hands("qacc", [hand.qacc for hand in self._hands])

    def gpu_fetch_articulation_target_qpos(self) -> None:
        """Reads drive targets."""
        targets = [[joint.drive_target for joint in hand.active_joints] for hand in self._hands]
        self._fetch_hands("target_qpos", targets)

    def gpu_fetch_articulation_target_qvel(self) -> None:
        """Reads drive velocity targets."""
        targets = [[joint.drive_velocity_target for joint in hand.active_joints] for hand in self._hands]
        self._fetch_hands("target_qvel", targets)

    def _fetch_bodies(self, first: int, bodies: list[Any]) -> None:
        rows = self.cuda_rigid_body_data.torch()
        for row, body in enumerate(bodies, start=first):
            pose = body.entity.pose
            values = np.concatenate([pose.p, pose.q, body.linear_velocity, body.angular_velocity])
            rows[row] = torch.from_numpy(values.astype(np.float32))

    def _fetch_hands(self, name: str, values: list[Any]) -> None:
        rows = np.array(values, dtype=np.float32).reshape(len(self._hands), -1)
        getattr(self, f"cuda_articulation_{name}").torch()[:] = torch.from_numpy(rows)


class EmulatedScene(ManiSkillScene):
    """ManiSkill's scene around an :class:`EmulatedGpuSystem`: hands out rows where SAPIEN would."""

    def __init__(self, sub_scenes: list[sapien.Scene], **kwargs: Any) -> None:
        super().__init__(sub_scenes, **kwargs)
        self.px = EmulatedGpuSystem(sub_scenes)
        self.gpu_sim_enabled = True

    def _setup(self, enable_gpu: bool) -> None:
        system, init = self.px, self.px.gpu_init

        def gpu_init() -> None:
            init()
            for actor in self.actors.values():
                self._give_rows(actor)
            for hand in self.articulations.values():
                hand.__dict__["_data_index"] = torch.tensor(
                    [system.row_of_hand(obj) for obj in hand._objs], dtype=torch.int32
                )
                for link in hand.links:
                    self._give_rows(link)

        system.gpu_init = gpu_init
        super()._setup(enable_gpu)

    def _give_rows(self, struct: Any) -> None:
        struct._body_data_name = "cuda_rigid_body_data"
        struct.__dict__["_body_data_index"] = torch.tensor([self.px.row_of_body(body) for body in struct._bodies])


class _EmulatedDevice:
    """What ManiSkill asks the simulation's device."""

    def is_cuda(self) -> bool:
        return True


def _backend(sim_backend: str, render_backend: str) -> BackendInfo:
    device: Any = _EmulatedDevice()
    return BackendInfo(torch.device("cpu"), device, "physx_cuda", None, "none")


def _setup_scene(task: Any) -> None:
    task._set_scene_config()
    scenes = [sapien.Scene([physx.PhysxCpuSystem()]) for _ in range(task.num_envs)]
    task.scene = EmulatedScene(
        scenes, sim_config=task.sim_config, device=task.device, parallel_in_single_scene=False, backend=task.backend
    )


@contextmanager
def emulated_gpu() -> Iterator[None]:
    """Inside, ``device="cuda"`` and ``num_envs`` above 1 make environments on an emulated GPU."""
    with (
        patch.object(sapien_env, "parse_sim_and_render_backend", _backend),
        patch.object(sapien_env.BaseEnv, "_setup_scene", _setup_scene),
        patch.object(gpu_physics, "enable_gpu_physics", lambda: None),
        patch.object(gpu_physics, "cuda_available", lambda: True),
        patch.object(gpu_physics, "machine_identity", lambda: {"card": "emulated on the CPU"}),
    ):
        yield
