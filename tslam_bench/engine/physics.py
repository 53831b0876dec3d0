"""PhysX settings and bodies: everything that decides the physics, in one place (protocol sections 2 to 4)."""

from __future__ import annotations

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
from tslam_bench.hand_constants import DELTA_STEP, FORCE_LIMIT
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
COOKING_SCALE: Final = 100.0
"""Hulls are cooked in centimetres and scaled back: PhysX's plane tolerance is 0.7 mm and eats small hulls cooked in metres."""

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


def configure(settings: PhysicsSettings = PROTOCOL) -> None:
    """Sets SAPIEN's global defaults for scenes, bodies and shapes that are made next: what ManiSkill sets for the task."""
    physx.set_shape_config(contact_offset=settings.contact_offset, rest_offset=REST_OFFSET)
    physx.set_body_config(
        solver_position_iterations=settings.position_iterations,
        solver_velocity_iterations=SOLVER_VELOCITY_ITERATIONS,
        sleep_threshold=SLEEP_THRESHOLD,
    )
    physx.set_scene_config(
        gravity=np.array(GRAVITY),
        bounce_threshold=BOUNCE_THRESHOLD,
        enable_pcm=settings.persistent_contacts,
        enable_tgs=True,
        enable_ccd=False,
        enable_enhanced_determinism=False,
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    physx.set_default_material(STATIC_FRICTION, DYNAMIC_FRICTION, RESTITUTION)


def pose_quaternion(pose: int) -> np.ndarray:
    """(4,) unit quaternion (w, x, y, z) of a pose of protocol section 3."""
    half_yaw = np.deg2rad(90 * (grids.check_pose(pose) % 4)) / 2
    yaw = np.array([np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)])
    if pose < 4:
        return yaw
    w, z = yaw[0], yaw[3]
    return np.array([0.0, w, z, 0.0])  # yaw * (0, 1, 0, 0)


def collision_shapes(prepared: PreparedObject) -> list[physx.PhysxCollisionShapeConvexMesh]:
    """Cooks an object's hulls.

    Raises:
        AssetError: PhysX cannot cook a hull.
    """
    material = physx.PhysxMaterial(STATIC_FRICTION, DYNAMIC_FRICTION, RESTITUTION)
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


def object_entity(prepared: PreparedObject, name: str, shapes: Sequence[Any], can_render: bool) -> sapien.Entity:
    """A fixed body with the object's hulls, and its true mesh as its looks where rendering is possible."""
    entity = sapien.Entity()
    entity.name = name
    body = physx.PhysxRigidDynamicComponent()
    body.kinematic = (
        True  # fixed in the world; kinematic rather than static so that a GPU scene can turn it between episodes
    )
    for shape in shapes:
        body.attach(shape)
    if len(body.collision_shapes) != len(prepared.hulls):
        raise AssetError(f"{prepared.name}: {len(body.collision_shapes)} of {len(prepared.hulls)} hulls reached PhysX")
    if can_render:
        entity.add_component(_looks(prepared))
    entity.add_component(body)
    return entity


def table_entity(name: str, can_render: bool) -> sapien.Entity:
    """The tabletop variant's table: a fixed box."""
    entity = sapien.Entity()
    entity.name = name
    body = physx.PhysxRigidDynamicComponent()
    body.kinematic = True  # as the object: its height changes with the object between episodes
    half = np.array(TABLE_SIZE, dtype=np.float32) / 2
    material = physx.PhysxMaterial(STATIC_FRICTION, DYNAMIC_FRICTION, RESTITUTION)
    body.attach(physx.PhysxCollisionShapeBox(half, material))
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
