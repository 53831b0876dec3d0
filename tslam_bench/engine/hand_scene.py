"""One hand and one object in a physics system of their own, on the CPU: bare SAPIEN, the same physics as the ManiSkill task.

No torch, no ManiSkill: worker processes import this and stay small.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx

from tslam_bench.engine import link_poses, physics
from tslam_bench.engine.physics import PhysicsSettings
from tslam_bench.engine.starts import Start
from tslam_bench.hand_constants import (
    ARMATURE,
    BASE_POSITION,
    BASE_QUATERNION,
    DAMPING,
    JOINT_NAMES,
    SKIN_LINKS,
    STIFFNESS,
)

_NO_SELF_COLLISION: Final = 1 << 29  # shapes that share an ignore bit do not collide


class BodyPool:
    """Cooked objects of one process, lent to its scenes: cooking is dear, moving a body between systems is cheap.

    Args:
        settings: the physics that the bodies are made for.
    """

    def __init__(self, settings: PhysicsSettings = physics.PROTOCOL) -> None:
        self.settings = settings
        self._free: dict[str, list[sapien.Entity]] = {}
        self._count = 0

    def borrow(self, start: Start) -> sapien.Entity:
        """A body of the start's object that is in no scene."""
        waiting = self._free.get(start.prepared.name)
        if waiting:
            return waiting.pop()
        physics.configure(self.settings)
        shapes = physics.collision_shapes(start.prepared)
        self._count += 1
        return physics.object_entity(start.prepared, start.prepared.name, shapes, can_render=False)

    def give_back(self, body: sapien.Entity) -> None:
        """Takes a body that has left its scene."""
        self._free.setdefault(body.name, []).append(body)
        while self._count > physics.CACHED_BODIES and any(self._free.values()):
            oldest = next(name for name, bodies in self._free.items() if bodies)
            self._free[oldest].pop()
            if not self._free[oldest]:
                del self._free[oldest]
            self._count -= 1


class HandScene:
    """A hand that explores one object at a time.

    Args:
        urdf: the converted hand.
        bodies: where object bodies come from, and the settings of the physics.
        table: whether the object stands on a table.
    """

    def __init__(self, urdf: Path, bodies: BodyPool, table: bool = False) -> None:
        self.settings = bodies.settings
        physics.configure(self.settings)
        self._table = physics.table_entity("table", can_render=False) if table else None
        self._bodies = bodies
        self._body: sapien.Entity | None = None
        self._scene = sapien.Scene([physx.PhysxCpuSystem()])
        self._robot = _build_hand(self._scene, urdf)
        self._entities = [link.entity for link in self._robot.links]
        joints = {joint.name: index for index, joint in enumerate(self._robot.active_joints)}
        self.joint_order = np.array([joints[name] for name in JOINT_NAMES])
        self._from_order = np.argsort(self.joint_order)
        ordered = [self._robot.active_joints[index] for index in self.joint_order]
        force_limit = self.settings.force_limit
        for index, joint in enumerate(ordered):
            joint.set_drive_properties(
                float(STIFFNESS[index]), float(DAMPING[index]), float(force_limit[index]), "force"
            )
            joint.set_friction(0.0)
            joint.set_armature(np.array([ARMATURE[index]], dtype=np.float32))
        self._setters = [joint.set_drive_target for joint in ordered]
        links = {link.name: link for link in self._robot.links}
        self._skin_links = [links[name] for name in SKIN_LINKS]
        self._system: Any = None

    def begin(self, start: Start) -> None:
        """Puts hand and object into a new physics system, so that nothing of the last episode remains."""
        for entity in list(self._scene.entities):
            self._scene.remove_entity(entity)
        if self._body is not None:
            self._bodies.give_back(self._body)
        self._body = self._bodies.borrow(start)
        physics.configure(self.settings)
        self._system = physx.PhysxCpuSystem()
        self._system.timestep = self.settings.timestep
        self._scene = sapien.Scene([self._system])
        for entity in self._entities:
            self._scene.add_entity(entity)
        self._body.pose = sapien.Pose([0, 0, 0], physics.pose_quaternion(start.pose))
        self._scene.add_entity(self._body)
        if self._table is not None:
            self._table.pose = physics.table_pose(start.prepared)
            self._scene.add_entity(self._table)
        qpos = start.qpos[self._from_order]
        self._robot.set_root_pose(sapien.Pose(BASE_POSITION, BASE_QUATERNION))
        self._robot.set_qpos(qpos)
        self._robot.set_qvel(np.zeros_like(qpos))
        self._robot.set_qf(np.zeros_like(qpos))
        self.set_targets(start.qpos.tolist())

    def set_targets(self, targets: Sequence[float]) -> None:
        """Sets the 28 drive targets (m, rad), plain numbers in the order of ``JOINT_NAMES``."""
        for setter, target in zip(self._setters, targets, strict=True):
            setter(target)

    def step(self) -> None:
        """One control step."""
        for _ in range(self.settings.substeps):
            self.substep()

    def substep(self) -> None:
        """One physics step."""
        self._system.step()

    def contacts(self) -> Sequence[Any]:
        """PhysX's contacts of the poses that the last physics step started from."""
        return self._system.get_contacts()

    def read(self, qpos: NDArray, qvel: NDArray, poses: NDArray) -> None:
        """Writes (28,) positions and velocities in the simulator's order (``joint_order``), and (M, 7) packed poses."""
        qpos[:] = self._robot.qpos
        qvel[:] = self._robot.qvel
        poses[:] = link_poses.packed_poses(self._scene)

    @property
    def num_bodies(self) -> int:
        """M, bodies of an episode."""
        return len(self._entities) + (2 if self._table is not None else 1)

    def skin_rows(self) -> NDArray[np.int64]:
        """(L,) rows of the skin links in the packed poses; the same in every scene."""
        return link_poses.rows_of(self._entities, self._skin_links)


def _build_hand(scene: sapien.Scene, urdf: Path) -> Any:
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    builder = loader.parse(str(urdf))[0][0]
    for link in builder.link_builders:
        link.visual_records.clear()
        link.collision_groups[2] |= _NO_SELF_COLLISION
    builder.initial_pose = sapien.Pose(BASE_POSITION, BASE_QUATERNION)
    robot = builder.build(fix_root_link=True)
    for link in robot.links:
        link.disable_gravity = True
    return robot
