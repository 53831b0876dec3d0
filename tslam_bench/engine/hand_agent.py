"""The Adroit hand on its arm as a ManiSkill agent (protocol section 2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from mani_skill.agents.registration import register_agent

from tslam_bench.engine import link_poses
from tslam_bench.engine.arrays import Backend, NumpyBackend, TorchBackend
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.spaces import action_space
from tslam_bench.hand_constants import (
    ARMATURE,
    BASE_POSITION,
    BASE_QUATERNION,
    CONTROL_MODES,
    DAMPING,
    FORCE_LIMIT,
    JOINT_NAMES,
    SKIN_LINKS,
    STIFFNESS,
)
from tslam_bench.objects.hand import load_hand


class HandController(BaseController):
    """Position drives on all 28 joints; sets all targets in one go, which ManiSkill's own does one by one."""

    config: HandControllerConfig
    sets_target_qpos = True
    sets_target_qvel = False

    def _initialize_action_space(self) -> None:
        self.single_action_space = action_space()
        on_gpu = self.scene.gpu_sim_enabled
        self._arrays: Backend = TorchBackend(self.device) if on_gpu else NumpyBackend()
        self._targets = DriveTargets(self.config.mode, self._arrays)
        self._order = self.active_joint_indices.cpu().numpy()
        self._setters = None if on_gpu else [joint._objs[0].set_drive_target for joint in self.joints]

    def set_drive_property(self) -> None:
        """Sets gains, force limits and armature; joint friction is zero."""
        for index, joint in enumerate(self.joints):
            joint.set_drive_properties(
                float(STIFFNESS[index]), float(DAMPING[index]), force_limit=float(FORCE_LIMIT[index]), mode="force"
            )
            joint.set_friction(0.0)
            for raw in joint._objs:
                raw.set_armature(np.array([ARMATURE[index]], dtype=np.float32))

    def set_action(self, action: torch.Tensor) -> None:
        """Sets the drive targets for actions (E, 28) in [-1, 1]."""
        if self._setters is None:
            self._set_device_targets(self._targets(action.to(torch.float32), self.qpos))  # GPU only
            return
        qpos = self.articulation._objs[0].qpos[self._order]
        targets = self._targets(action.numpy().astype(np.float32, copy=False), qpos[None])
        for setter, target in zip(self._setters, targets[0].tolist(), strict=True):
            setter(target)

    def _set_device_targets(self, targets: torch.Tensor) -> None:
        """Writes (E, 28) targets of all hands. ManiSkill's setter masks the rows, which waits for the device each step."""
        rows, columns = self.articulation.get_joint_target_indices(self.joints)  # GPU only
        self.articulation.px.cuda_articulation_target_qpos.torch()[rows, columns] = targets  # GPU only

    def hold(self) -> None:
        """Makes the current joint positions the targets (start of an episode)."""
        if self._setters is None:
            self._set_device_targets(self.qpos)  # GPU only
            return
        qpos = self.articulation._objs[0].qpos[self._order]
        for setter, target in zip(self._setters, qpos.tolist(), strict=True):
            setter(target)

    def reset(self) -> None:
        """Start of an episode."""
        self.hold()


@dataclass
class HandControllerConfig(ControllerConfig):
    """Configuration of :class:`HandController`; ``mode`` is one of ``CONTROL_MODES``."""

    mode: str = CONTROL_MODES[0]
    joint_names: list[str] = field(default_factory=lambda: list(JOINT_NAMES))
    controller_cls = HandController


@register_agent()
class AdroitHand(BaseAgent):
    """28-DoF Adroit hand: 3 translations, roll, 2 wrist and 22 finger joints; gravity-compensated, no self-collision."""

    uid = "adroit28"
    fix_root_link = True
    disable_self_collisions = True

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.urdf_path = str(load_hand().urdf)  # raises AssetError with the remedy; ManiSkill would prompt and exit
        super().__init__(*args, **kwargs)

    @staticmethod
    def base_pose() -> sapien.Pose:
        """Pose of the arm's base in the world."""
        return sapien.Pose(BASE_POSITION, BASE_QUATERNION)

    @property
    def _controller_configs(self) -> dict[str, ControllerConfig]:
        return {mode: HandControllerConfig(mode=mode) for mode in CONTROL_MODES}

    def set_action(self, action: torch.Tensor) -> None:
        """Hands the action to the controller; the task has checked it."""
        self.controller.set_action(action)

    def _after_init(self) -> None:
        index = [self.robot.active_joints_map[name].active_index[0].item() for name in JOINT_NAMES]
        self.joint_order = np.array(index)
        """Position of each joint of ``JOINT_NAMES`` in the simulator's own order."""
        self.device_joint_order = torch.as_tensor(self.joint_order, device=self.device)
        self.skin_links = [self.robot.links_map[name] for name in SKIN_LINKS]
        self._raw_skin_links = [link._objs[0] for link in self.skin_links]
        self._scene_of_rows: Any = None
        self._skin_rows = np.zeros(len(SKIN_LINKS), dtype=np.int64)
        self._skin_matrices = np.zeros((1, len(SKIN_LINKS), 3, 4), dtype=np.float32)

    def host_skin_matrices(self) -> np.ndarray:
        """(1, L, 3, 4) float32 poses of the skin links in the world, CPU simulation; the array is reused."""
        scene = self.scene.sub_scenes[0]
        if scene is not self._scene_of_rows:  # an episode has a scene of its own
            self._scene_of_rows, self._skin_rows = scene, link_poses.rows_of(list(scene.entities), self._raw_skin_links)
        link_poses.link_matrices(link_poses.packed_poses(scene)[None], self._skin_rows, self._skin_matrices)
        return self._skin_matrices

    def device_skin_matrices(self) -> torch.Tensor:
        """(E, L, 3, 4) float32 poses of the skin links in each sub-scene, GPU simulation."""
        poses = torch.stack([link.pose.raw_pose for link in self.skin_links], dim=1)
        return matrices_from_poses(poses)

    def host_qpos(self) -> np.ndarray:
        """(1, 28) float32 joint positions in the order of ``JOINT_NAMES``, CPU simulation."""
        return self.robot._objs[0].qpos[self.joint_order][None]

    def host_qvel(self) -> np.ndarray:
        """(1, 28) float32 joint velocities in the order of ``JOINT_NAMES``, CPU simulation."""
        return self.robot._objs[0].qvel[self.joint_order][None]


def matrices_from_poses(poses: torch.Tensor) -> torch.Tensor:
    """(..., 3, 4) matrices of (..., 7) poses: position, then unit quaternion (w, x, y, z)."""
    x, y, z, qw, qx, qy, qz = poses.unbind(-1)
    rows = [
        *(1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy), x),
        *(2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx), y),
        *(2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy), z),
    ]
    return torch.stack(rows, dim=-1).reshape(*poses.shape[:-1], 3, 4)
