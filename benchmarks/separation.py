"""A ruler for penetration that both engines are measured with: MuJoCo's collision detection between hand and object.

It looks at joint positions only, so it does not matter which engine they come from.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco_peer import MujocoSettings, build_model
from numpy.typing import NDArray

from tslam_bench.engine import physics
from tslam_bench.hand_constants import JOINT_NAMES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import load_object

REACH = 2e-3
"""Shapes further apart than this (m) are not measured."""


class SeparationRuler:
    """Distances between the hand's shapes and an object's hulls, negative where they overlap.

    Args:
        name: the object.
        pose: 0..7.
        split: its split.
    """

    def __init__(self, name: str, pose: int, split: str = "test") -> None:
        self._model = build_model(load_hand().urdf, MujocoSettings(margin=REACH), load_object(name, split))
        self._data = mujoco.MjData(self._model)
        self._data.mocap_quat[0] = physics.pose_quaternion(pose)
        self._joints = np.array([self._model.joint(joint).qposadr[0] for joint in JOINT_NAMES])
        object_body = self._model.body("object").id
        self._is_object = self._model.geom_bodyid == object_body
        self._row = np.full(self._model.nbody, -1)
        for row, link in enumerate(SKIN_LINKS):
            self._row[self._model.body(link).id] = row

    def measure(self, qpos: NDArray) -> tuple[NDArray[np.float64], float]:
        """Smallest distances (m) from the object at (28,) joint positions, infinite beyond ``REACH``.

        Returns:
            (L,) of each skin link, and that of the whole hand with its forearm.
        """
        self._data.qpos[self._joints] = qpos
        mujoco.mj_fwdPosition(self._model, self._data)
        distance, geoms = self._data.contact.dist, self._data.contact.geom.reshape(-1, 2)
        hand_geom = np.where(self._is_object[geoms[:, 0]], geoms[:, 1], geoms[:, 0])
        nearest = np.full(len(SKIN_LINKS) + 1, np.inf)  # the last one is the forearm's
        np.minimum.at(nearest, self._row[self._model.geom_bodyid[hand_geom]], distance)
        return nearest[:-1], float(nearest.min())
