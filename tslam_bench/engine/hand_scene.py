"""One hand and one object in a physics system of their own, on the CPU: bare SAPIEN, for worker processes and ManiSkill task.

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
from tslam_bench.engine.physics import BodyPool, Drives, PhysicsSettings
from tslam_bench.engine.starts import Start
from tslam_bench.hand_constants import BASE_POSITION, BASE_QUATERNION, JOINT_NAMES, SKIN_LINKS

_NO_SELF_COLLISION: Final = 1 << 29  # shapes that share an ignore bit do not collide


class HandScene:
    """A hand that explores one object at a time.

    Args:
        scene: holds the hand and whatever stays with it (cameras, lights), but no object.
        robot: the hand's articulation.
        bodies: where object bodies come from, and the settings of the physics.
        table: the table's body where the object stands on one.
    """

    def __init__(self, scene: sapien.Scene, robot: Any, bodies: BodyPool, table: sapien.Entity | None = None) -> None:
        self.scene = scene
        self.system: Any = None
        self.settings = bodies.settings
        self._bodies, self._table, self._robot = bodies, table, robot
        self._start: Start | None = None
        self._body: sapien.Entity | None = None
        joints = {_plain(joint.name): index for index, joint in enumerate(robot.active_joints)}
        self.joint_order = np.array([joints[name] for name in JOINT_NAMES])
        """Position of each joint of ``JOINT_NAMES`` in the simulator's own order."""
        self._from_order = np.argsort(self.joint_order)
        self.set_targets = Drives([robot.active_joints[i] for i in self.joint_order], self.settings).set_targets
        """Sets the 28 drive targets (m, rad), plain numbers in the order of ``JOINT_NAMES``."""
        links = {_plain(link.name): link for link in robot.links}
        self._skin_links = [links[name] for name in SKIN_LINKS]
        self._skin_rows: NDArray[np.int64] | None = None
        self._skin_matrices = np.zeros((1, len(SKIN_LINKS), 3, 4), dtype=np.float32)

    def begin(self, start: Start) -> None:
        """Moves hand and object into a new physics system, so that nothing of the last episode remains.

        PhysX keeps contact caches that setting positions leaves behind: episodes would differ from the first contact on.
        """
        added = (self._body, self._table)
        kept = [entity for entity in self.scene.entities if entity not in added]
        others = [self.scene.render_system] if self._bodies.can_render else []
        for entity in list(self.scene.entities):
            self.scene.remove_entity(entity)
        if self._body is not None and self._start is not None:
            self._bodies.give_back(self._start.prepared, self._body)
        self._start, self._body = start, self._bodies.borrow(start.prepared)
        physics.configure(self.settings)
        self._skin_rows = None
        self.system = physx.PhysxCpuSystem()
        self.system.timestep = self.settings.timestep
        self.scene = sapien.Scene([self.system, *others])
        for entity in kept:
            self.scene.add_entity(entity)
        self._body.pose = sapien.Pose([0, 0, 0], physics.pose_quaternion(start.pose))
        self.scene.add_entity(self._body)
        if self._table is not None:
            self._table.pose = physics.table_pose(start.prepared)
            self.scene.add_entity(self._table)
        qpos = start.qpos[self._from_order]
        self._robot.set_root_pose(sapien.Pose(BASE_POSITION, BASE_QUATERNION))
        self._robot.set_qpos(qpos)
        self._robot.set_qvel(np.zeros_like(qpos))
        self._robot.set_qf(np.zeros_like(qpos))
        self.set_targets(start.qpos.tolist())

    def put_joints(self, qpos: NDArray[np.float32]) -> None:
        """Moves the joints to ``qpos`` (28,), in the order of ``JOINT_NAMES``; their velocities stay."""
        self._robot.set_qpos(qpos[self._from_order])

    def step(self) -> None:
        """One control step."""
        for _ in range(self.settings.substeps):
            self.substep()

    def substep(self) -> None:
        """One physics step."""
        self.system.step()

    def contacts(self) -> Sequence[Any]:
        """PhysX's contacts of the poses that the last physics step started from."""
        return self.system.get_contacts()

    def read(self, qpos: NDArray, qvel: NDArray, poses: NDArray) -> None:
        """Writes (28,) positions and velocities in the simulator's order (``joint_order``), and (M, 7) packed poses."""
        qpos[:] = self._robot.qpos
        qvel[:] = self._robot.qvel
        poses[:] = link_poses.packed_poses(self.scene)

    @property
    def qpos(self) -> NDArray[np.float32]:
        """(28,) joint positions in the order of ``JOINT_NAMES``."""
        return self._robot.qpos[self.joint_order]

    @property
    def qvel(self) -> NDArray[np.float32]:
        """(28,) joint velocities in the order of ``JOINT_NAMES``."""
        return self._robot.qvel[self.joint_order]

    def skin_matrices(self) -> NDArray[np.float32]:
        """(1, L, 3, 4) poses of the skin links in the world; the array is reused."""
        if self._skin_rows is None:
            self._skin_rows = self.skin_rows()
        poses = link_poses.packed_poses(self.scene)[None]
        link_poses.link_matrices(poses, self._skin_rows, self._skin_matrices)
        return self._skin_matrices

    @property
    def object_body(self) -> sapien.Entity:
        """The body of the object at hand."""
        assert self._body is not None
        return self._body

    @property
    def num_bodies(self) -> int:
        """M, bodies of an episode."""
        return len(self.scene.entities) + (0 if self._body is not None else 1 if self._table is None else 2)

    def skin_rows(self) -> NDArray[np.int64]:
        """(L,) rows of the skin links in the packed poses; the same in every scene of the same bodies."""
        return link_poses.rows_of(list(self.scene.entities), self._skin_links)


def _plain(name: str) -> str:
    """A joint's or link's own name: ManiSkill puts the scene's and the robot's in front, with underscores."""
    return name.rpartition("_")[2]


def physx_scenes(urdf: Path, settings: PhysicsSettings, table: bool, count: int) -> list[HandScene]:
    """``count`` scenes that share one pool of bodies, each with a hand (its converted file ``urdf``) and maybe a table."""
    bodies = BodyPool(settings)
    scenes = []
    for _ in range(count):
        physics.configure(settings)
        scene = sapien.Scene([physx.PhysxCpuSystem()])
        robot = _build_hand(scene, urdf)
        scenes.append(HandScene(scene, robot, bodies, physics.table_entity() if table else None))
    return scenes


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
