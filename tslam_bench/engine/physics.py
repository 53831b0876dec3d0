"""PhysX settings and bodies: everything that decides the physics, in one place (protocol sections 2 to 4)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien import physx

from tslam_bench import grids
from tslam_bench.constants import CONTROL_STEP_SECONDS, SUBSTEPS, TABLE_SIZE
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.geometry.triangles import face_normals
from tslam_bench.hand_constants import ARMATURE, DAMPING, DELTA_STEP, FORCE_LIMIT, STIFFNESS
from tslam_bench.objects.store import PreparedObject

SOLVER_POSITION_ITERATIONS: Final = 8
SOLVER_VELOCITY_ITERATIONS: Final = 1
CONTACT_OFFSET: Final = 2e-3
PERSISTENT_CONTACTS: Final = False
"""PhysX's persistent contact manifolds lose contacts of moving fingers with thin walls (``docs/fidelity.md``)."""
REST_OFFSET: Final = 0.0
GRAVITY: Final = (0.0, 0.0, -9.81)
"""The hand is gravity-compensated and the object fixed, so this moves nothing yet."""
SLEEP_THRESHOLD: Final = 0.005
BOUNCE_THRESHOLD: Final = 2.0
STATIC_FRICTION: Final = 1.0
DYNAMIC_FRICTION: Final = 1.0
RESTITUTION: Final = 0.0
MATERIAL: Final = (STATIC_FRICTION, DYNAMIC_FRICTION, RESTITUTION)
COOKING_SCALE: Final = 100.0
"""Hulls are cooked in centimetres and scaled back: PhysX's plane tolerance is 0.7 mm and eats small hulls cooked in metres."""

GPU_SCENE_WORKERS: Final = 8
"""Most threads that a GPU scene uses on the host."""
CACHED_BODIES: Final = 64
"""Cooked objects kept per process: cooking one takes up to a few dozen milliseconds."""
_ARM_TRANSLATIONS: Final = slice(0, 3)


@dataclass(frozen=True)
class PhysicsSettings:
    """What the physics can be tuned by; the defaults are the protocol's, and ``docs/fidelity.md`` says how they were chosen.

    Attributes:
        substeps: physics steps per control step, whose duration does not change.
        position_iterations: of the TGS solver.
        arm_step: how far a translation's target may be ahead of its joint (m per control step), in both control modes.
        arm_force: largest force of a translation's drive (N).
        contact_offset: distance (m) from which contacts are made.
        persistent_contacts: whether contact manifolds are kept from step to step (PCM) or made anew.

    Raises:
        InvalidInputError: a number that is not above 0.
    """

    substeps: int = SUBSTEPS
    position_iterations: int = SOLVER_POSITION_ITERATIONS
    arm_step: float = float(DELTA_STEP[0])
    arm_force: float = float(FORCE_LIMIT[0])
    contact_offset: float = CONTACT_OFFSET
    persistent_contacts: bool = PERSISTENT_CONTACTS

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "persistent_contacts" and not value > 0:
                raise InvalidInputError(f"{name} {value!r}: must be above 0")

    @property
    def timestep(self) -> float:
        """Duration of a physics step (s)."""
        return CONTROL_STEP_SECONDS / self.substeps

    @property
    def step_limit(self) -> NDArray[np.float64]:
        """(28,) how far each joint's target may be ahead of the joint (m or rad)."""
        return _with_arm(DELTA_STEP, self.arm_step)

    @property
    def force_limit(self) -> NDArray[np.float64]:
        """(28,) largest drive force of each joint (N or N m)."""
        return _with_arm(FORCE_LIMIT, self.arm_force)


def _with_arm(values: NDArray[np.float64], arm: float) -> NDArray[np.float64]:
    changed = values.copy()
    changed[_ARM_TRANSLATIONS] = arm
    return changed


PROTOCOL: Final = PhysicsSettings()
"""The protocol's settings."""


def scene_settings(settings: PhysicsSettings = PROTOCOL, on_gpu: bool = False) -> dict[str, Any]:
    """The settings of scenes, bodies and shapes, by the names of ManiSkill's ``SceneConfig``.

    On a GPU hands never sleep (nothing would wake one whose targets are written into a buffer), and threads share PhysX's
    filtering of pairs out, which stays on the host.
    """
    return {
        "gravity": np.array(GRAVITY),
        "bounce_threshold": BOUNCE_THRESHOLD,
        "sleep_threshold": 0.0 if on_gpu else SLEEP_THRESHOLD,
        "contact_offset": settings.contact_offset,
        "rest_offset": REST_OFFSET,
        "solver_position_iterations": settings.position_iterations,
        "solver_velocity_iterations": SOLVER_VELOCITY_ITERATIONS,
        "enable_pcm": settings.persistent_contacts,
        "enable_tgs": True,
        "enable_ccd": False,
        "enable_enhanced_determinism": False,
        "enable_friction_every_iteration": True,
        "cpu_workers": min(GPU_SCENE_WORKERS, os.cpu_count() or 1) if on_gpu else 0,
    }


def configure(settings: PhysicsSettings = PROTOCOL) -> None:
    """Sets SAPIEN's global defaults for the scenes, bodies and shapes that are made next."""
    values = scene_settings(settings)
    shape = ("contact_offset", "rest_offset")
    body = ("solver_position_iterations", "solver_velocity_iterations", "sleep_threshold")
    physx.set_shape_config(**{name: values.pop(name) for name in shape})
    physx.set_body_config(**{name: values.pop(name) for name in body})
    physx.set_scene_config(**values)
    physx.set_default_material(*MATERIAL)


class Drives:
    """The position drives of one hand: sets gains, force limits and armature; joint friction is zero.

    Args:
        joints: SAPIEN's 28 joints in the order of ``JOINT_NAMES``.
        settings: of the physics.
    """

    def __init__(self, joints: Sequence[Any], settings: PhysicsSettings = PROTOCOL) -> None:
        for index, (joint, force) in enumerate(zip(joints, settings.force_limit, strict=True)):
            joint.set_drive_properties(float(STIFFNESS[index]), float(DAMPING[index]), float(force), "force")
            joint.set_friction(0.0)
            joint.set_armature(np.array([ARMATURE[index]], dtype=np.float32))
        self._setters = [joint.set_drive_target for joint in joints]

    def set_targets(self, targets: Sequence[float]) -> None:
        """Sets the 28 targets (m, rad), plain numbers; CPU simulation."""
        for setter, target in zip(self._setters, targets, strict=True):
            setter(target)


def pose_quaternion(pose: int) -> np.ndarray:
    """(4,) unit quaternion (w, x, y, z) of a pose of protocol section 3."""
    half_yaw = np.deg2rad(90 * (grids.check_pose(pose) % 4)) / 2
    yaw = np.array([np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)])
    if pose < 4:
        return yaw
    w, z = yaw[0], yaw[3]
    return np.array([0.0, w, z, 0.0])  # yaw * (0, 1, 0, 0)


def collision_shapes(prepared: PreparedObject, material: Any = None) -> list[physx.PhysxCollisionShapeConvexMesh]:
    """Cooks an object's hulls, of ``material`` or one made for them.

    Raises:
        AssetError: PhysX cannot cook a hull.
    """
    material = material or physx.PhysxMaterial(*MATERIAL)
    shapes = []
    for index, (vertices, _) in enumerate(prepared.hulls):
        try:
            shape = physx.PhysxCollisionShapeConvexMesh(
                vertices=np.asarray(vertices * COOKING_SCALE, dtype=np.float32),
                scale=[1 / COOKING_SCALE] * 3,
                material=material,
            )
        except RuntimeError as error:
            raise AssetError(
                f"{prepared.name}: PhysX cannot cook hull {index} ({error}); "
                f"rebuild it with 'tslam-bench assets prepare --objects {prepared.name}'"
            ) from error
        shapes.append(shape)
    return shapes


def object_entity(
    prepared: PreparedObject, name: str = "object", can_render: bool = False, material: Any = None
) -> sapien.Entity:
    """A fixed body with the object's hulls, and its true mesh as its looks where rendering is possible.

    Raises:
        AssetError: PhysX cannot cook a hull.
    """
    entity = sapien.Entity()
    entity.name = name
    body = physx.PhysxRigidDynamicComponent()
    body.kinematic = True  # fixed, but not static: a GPU scene turns it between episodes
    for shape in collision_shapes(prepared, material):
        body.attach(shape)
    if len(body.collision_shapes) != len(prepared.hulls):
        raise AssetError(f"{prepared.name}: {len(body.collision_shapes)} of {len(prepared.hulls)} hulls reached PhysX")
    if can_render:
        entity.add_component(_looks(prepared))
    entity.add_component(body)
    return entity


def table_entity(name: str = "table", can_render: bool = False, material: Any = None) -> sapien.Entity:
    """The tabletop variant's table: a fixed box."""
    entity = sapien.Entity()
    entity.name = name
    body = physx.PhysxRigidDynamicComponent()
    body.kinematic = True  # as the object: its height changes with the object between episodes
    half = np.array(TABLE_SIZE, dtype=np.float32) / 2
    body.attach(physx.PhysxCollisionShapeBox(half, material or physx.PhysxMaterial(*MATERIAL)))
    if can_render:
        looks = sapien.render.RenderBodyComponent()
        wood = sapien.render.RenderMaterial(base_color=[0.55, 0.47, 0.38, 1.0], roughness=0.8, specular=0.1)
        looks.attach(sapien.render.RenderShapeBox(half, wood))
        entity.add_component(looks)
    entity.add_component(body)
    return entity


def table_pose(prepared: PreparedObject) -> sapien.Pose:
    """Where the table stands: centred below the object, its top at the lowest point of the upright object (poses 0..3)."""
    return sapien.Pose([0.0, 0.0, float(prepared.vertices[:, 2].min()) - TABLE_SIZE[2] / 2])


class BodyPool:
    """Cooked objects of one process, lent to its scenes: cooking is expensive, moving a body between systems is cheap.

    Args:
        settings: the physics that the bodies are made for.
        can_render: whether the bodies have looks.
    """

    def __init__(self, settings: PhysicsSettings = PROTOCOL, can_render: bool = False) -> None:
        self.settings = settings
        self.can_render = can_render
        self._free: dict[str, list[sapien.Entity]] = {}
        self._count = 0

    def borrow(self, prepared: PreparedObject) -> sapien.Entity:
        """A body of the object that is in no scene."""
        waiting = self._free.get(prepared.name)
        if waiting:
            return waiting.pop()
        configure(self.settings)
        self._count += 1
        return object_entity(prepared, can_render=self.can_render)

    def give_back(self, prepared: PreparedObject, body: sapien.Entity) -> None:
        """Takes a body that has left its scene."""
        self._free.setdefault(prepared.name, []).append(body)
        while self._count > CACHED_BODIES and any(self._free.values()):
            oldest = next(name for name, bodies in self._free.items() if bodies)
            self._free[oldest].pop()
            if not self._free[oldest]:
                del self._free[oldest]
            self._count -= 1


def _looks(prepared: PreparedObject) -> Any:
    material = sapien.render.RenderMaterial(base_color=[0.90, 0.56, 0.25, 1.0], roughness=0.6, specular=0.3)
    corners = np.asarray(prepared.vertices[prepared.faces].reshape(-1, 3), dtype=np.float32)
    triangles = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    normals = face_normals(corners.reshape(-1, 3, 3))
    component = sapien.render.RenderBodyComponent()
    component.attach(
        sapien.render.RenderShapeTriangleMesh(
            corners,
            triangles,
            np.repeat(normals, 3, axis=0).astype(np.float32),
            np.zeros((len(corners), 2), dtype=np.float32),
            material,
        )
    )
    return component
