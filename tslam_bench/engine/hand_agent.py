"""The Adroit hand on its arm as a ManiSkill agent (protocol section 2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController, ControllerConfig
from mani_skill.agents.registration import register_agent

from tslam_bench.constants import NUM_JOINTS
from tslam_bench.engine.arrays import NumpyBackend, TorchBackend
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.physics import Drives
from tslam_bench.engine.spaces import action_space
from tslam_bench.hand_constants import BASE_POSITION, BASE_QUATERNION, CONTROL_MODES, JOINT_NAMES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand


class HandController(BaseController):
    """Position drives on all 28 joints; sets all targets in one go, which ManiSkill's own does one by one."""

    config: HandControllerConfig
    sets_target_qpos = True
    sets_target_qvel = False

    def _initialize_action_space(self) -> None:
        self.single_action_space = action_space()
        self._on_gpu = self.scene.gpu_sim_enabled
        self._targets = DriveTargets(self.config.mode, TorchBackend(self.device) if self._on_gpu else NumpyBackend())
        self._order = self.active_joint_indices.cpu().numpy()
        self.targets = np.zeros(NUM_JOINTS, dtype=np.float32)
        """(28,) drive targets that were set last, CPU simulation."""

    def set_drive_property(self) -> None:
        """Sets gains, force limits and armature; joint friction is zero."""
        drives = [Drives([joint._objs[env] for joint in self.joints]) for env in range(self.scene.num_envs)]
        self._drives = drives[0]

    def set_action(self, action: torch.Tensor) -> None:
        """Sets the drive targets for actions (E, 28) in [-1, 1]."""
        if self._on_gpu:
            self._set_device_targets(self._targets(action.to(torch.float32), _finite(self.qpos)))
            return
        qpos = self.articulation._objs[0].qpos[self._order]
        self._set_host_targets(self._targets(action.numpy().astype(np.float32, copy=False), qpos[None])[0])

    def _set_host_targets(self, targets: np.ndarray) -> None:
        self.targets = targets
        self._drives.set_targets(targets.tolist())

    def _set_device_targets(self, targets: torch.Tensor) -> None:
        """Writes (E, 28) targets of all hands. ManiSkill's setter masks the rows, which waits for the device each step."""
        rows, columns = self.articulation.get_joint_target_indices(self.joints)
        self.articulation.px.cuda_articulation_target_qpos.torch()[rows, columns] = targets

    def hold(self) -> None:
        """Makes the current joint positions the targets (start of an episode)."""
        if self._on_gpu:
            self._set_device_targets(_finite(self.qpos))
            return
        self._set_host_targets(self.articulation._objs[0].qpos[self._order])

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

    def device_skin_matrices(self) -> torch.Tensor:
        """(E, L, 3, 4) float32 poses of the skin links in each sub-scene, GPU simulation."""
        return matrices_from_poses(self.robot.px.cuda_rigid_body_data.torch()[self._skin_rows, :7])

    @cached_property
    def _skin_rows(self) -> torch.Tensor:
        """(E, L) rows of the skin links in PhysX's body data; known once the scene is set up."""
        return torch.stack([link._body_data_index for link in self.skin_links], dim=1)


def _finite(value: torch.Tensor) -> torch.Tensor:
    """``value`` with zeros where a simulation that broke left something else: PhysX must not be handed NaN."""
    return torch.where(torch.isfinite(value), value, 0.0)


def matrices_from_poses(poses: torch.Tensor) -> torch.Tensor:
    """(..., 3, 4) matrices of (..., 7) poses: position, then unit quaternion (w, x, y, z)."""
    x, y, z, qw, qx, qy, qz = poses.unbind(-1)
    rows = [
        *(1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy), x),
        *(2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx), y),
        *(2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy), z),
    ]
    return torch.stack(rows, dim=-1).reshape(*poses.shape[:-1], 3, 4)
