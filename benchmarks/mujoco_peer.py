"""The benchmark's hand and objects in MuJoCo: a peer to measure the CPU engine against, not part of the product.

:class:`MujocoScene` has the methods of ``tslam_bench.engine.hand_scene.HandScene``, so the rest of the engine (worker processes,
shared memory, drive targets, sensing, rewards, episode starts) runs unchanged on top of it: what differs is the physics.
The hand is the same URDF, its drives are position actuators with the same gains and force limits, the object is a mocap body of
the same convex hulls. Needs ``mujoco``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import CONTROL_STEP_SECONDS, SUBSTEPS
from tslam_bench.engine import physics
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.starts import Start
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import (
    ARMATURE,
    BASE_POSITION,
    BASE_QUATERNION,
    DAMPING,
    FORCE_LIMIT,
    JOINT_NAMES,
    SKIN_LINKS,
    STIFFNESS,
)
from tslam_bench.objects.store import PreparedObject

_HAND, _OBJECT = 1, 2  # contact bits: the hand collides with the object only


@dataclass(frozen=True)
class MujocoSettings:
    """What can be tuned of the peer; the defaults are MuJoCo's own but for the time step."""

    substeps: int = SUBSTEPS
    """Physics steps per control step of 30.1 ms."""
    integrator: str = "implicitfast"
    """``euler``, ``implicitfast`` or ``implicit``."""
    time_constant: float = 0.02
    """Contact softness ``solref[0]`` (s); MuJoCo raises it to two time steps where it is less."""
    impedance: tuple[float, float, float] = (0.9, 0.95, 0.001)
    """Contact softness ``solimp[:3]``: at no penetration, at ``width`` and deeper, width (m)."""
    margin: float = 0.0
    """Distance (m) from which a contact pushes."""
    speculative: bool = False
    """Whether contacts that would come about within a step act before they do."""


STIFF: Final = MujocoSettings(time_constant=1e-3, impedance=(0.999, 0.9999, 1e-4))
"""The stiffest contacts that MuJoCo integrates safely: it raises the time constant to two time steps."""
EQUAL_PENETRATION: Final = replace(STIFF, substeps=6)
"""The coarsest time step at which the peer sinks in no deeper than the engine; found by ``penetration.py``."""


@dataclass
class MujocoPool:
    """Compiled models of one process, one per object, and the states that its scenes have given back."""

    settings: MujocoSettings
    urdf: Path
    _models: dict[str, Any] = field(default_factory=dict)
    _free: dict[str, list[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.hand = build_model(self.urdf, self.settings, None)

    def borrow(self, prepared: PreparedObject) -> tuple[Any, Any]:
        """The model of an object and a state of it that no scene uses."""
        model = self._models.get(prepared.name)
        if model is None:
            model = self._models[prepared.name] = build_model(self.urdf, self.settings, prepared)
        waiting = self._free.get(prepared.name)
        return model, waiting.pop() if waiting else mujoco.MjData(model)

    def give_back(self, name: str, data: Any) -> None:
        """Takes a state that a scene has done with."""
        self._free.setdefault(name, []).append(data)


class MujocoScene:
    """A hand that explores one object at a time; see ``HandScene``."""

    def __init__(self, pool: MujocoPool) -> None:
        self._pool = pool
        self._name = ""
        self.model: Any = None
        self.data: Any = None
        self.joint_order = np.array([pool.hand.joint(name).qposadr[0] for name in JOINT_NAMES])
        self.num_bodies = pool.hand.nbody + 1  # and the object, which comes last

    def skin_rows(self) -> NDArray[np.int64]:
        """(L,) rows of the skin links in the packed poses; the same in every scene."""
        return np.array([self._pool.hand.body(name).id for name in SKIN_LINKS], dtype=np.int64)

    def begin(self, start: Start) -> None:
        """Starts an episode from a clean state."""
        if self.data is not None:
            self._pool.give_back(self._name, self.data)
        self._name = start.prepared.name
        self.model, self.data = self._pool.borrow(start.prepared)
        mujoco.mj_resetData(self.model, self.data)
        self.data.mocap_quat[0] = physics.pose_quaternion(start.pose)
        self.data.qpos[self.joint_order] = start.qpos
        self.set_targets(start.qpos.tolist())
        mujoco.mj_kinematics(self.model, self.data)

    def set_targets(self, targets: Sequence[float]) -> None:
        """Sets the 28 drive targets, in the order of ``JOINT_NAMES``."""
        self.data.ctrl[:] = targets  # actuators are in that order

    def step(self) -> None:
        """One control step."""
        mujoco.mj_step(self.model, self.data, nstep=self._pool.settings.substeps)
        mujoco.mj_kinematics(self.model, self.data)  # mj_step leaves the body poses of the step before

    def read(self, qpos: NDArray, qvel: NDArray, poses: NDArray) -> None:
        """Writes (28,) positions and velocities in MuJoCo's order (``joint_order``), and (M, 7) packed poses."""
        data = self.data
        qpos[:] = data.qpos
        qvel[:] = data.qvel
        poses[:, :4] = data.xquat
        poses[:, 4:] = data.xpos


def build_model(urdf: Path, settings: MujocoSettings, prepared: PreparedObject | None) -> Any:
    """Compiles the hand, and an object in front of it.

    Args:
        urdf: the converted hand.
        settings: time step and contact softness.
        prepared: the object; None leaves the hand alone in space.
    """
    text = urdf.read_text(encoding="utf-8")
    compiler = '<mujoco><compiler discardvisual="true" fusestatic="false"/></mujoco>'
    spec = mujoco.MjSpec.from_string(text.replace("</robot>", f"{compiler}</robot>"))
    option = spec.option
    option.timestep = CONTROL_STEP_SECONDS / settings.substeps
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{settings.integrator.upper()}")
    option.gravity = np.zeros(3)
    if settings.speculative:
        option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)
    base = spec.body("base")
    base.pos, base.quat = BASE_POSITION, BASE_QUATERNION
    for index, name in enumerate(JOINT_NAMES):
        joint = spec.joint(name)
        joint.armature = ARMATURE[index]
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # the actuator has the same limit
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=STIFFNESS[index], kv=DAMPING[index])
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = (-FORCE_LIMIT[index], FORCE_LIMIT[index])
    for geom in spec.geoms:
        _soften(geom, settings)
        geom.contype, geom.conaffinity = _HAND, _OBJECT
    if prepared is not None:
        body = spec.worldbody.add_body(name="object", mocap=True)
        for index, (vertices, _) in enumerate(prepared.hulls):
            mesh = spec.add_mesh(name=f"hull{index}")
            mesh.uservert = np.asarray(vertices, dtype=np.float32).reshape(-1)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
            _soften(geom, settings)
            geom.contype, geom.conaffinity = _OBJECT, _HAND
    return spec.compile()


def _soften(geom: Any, settings: MujocoSettings) -> None:
    geom.friction[0] = physics.DYNAMIC_FRICTION
    geom.solref[0] = settings.time_constant
    geom.solimp[:3] = settings.impedance
    geom.margin = settings.margin / 2  # MuJoCo adds those of the two geoms


def mujoco_scenes(
    peer: MujocoSettings, urdf: Path, _: physics.PhysicsSettings, table: bool, count: int
) -> list[MujocoScene]:
    """What takes the place of ``hand_scene.physx_scenes``."""
    if table:
        raise InvalidInputError("the MuJoCo peer has no table; measure TactileSLAM-v0")
    pool = MujocoPool(peer, urdf)
    return [MujocoScene(pool) for _ in range(count)]


def with_mujoco(settings: BatchSettings, peer: MujocoSettings) -> BatchSettings:
    """The same environments, simulated by MuJoCo; all else is the engine's own code, in worker processes too."""
    return replace(settings, scenes=partial(mujoco_scenes, peer))
