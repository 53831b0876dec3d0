"""The hand's forward kinematics and Jacobians in numpy, for explorers that plan with their own body.

Read from the converted hand's URDF. Batched over hands; the numbers of one hand do not depend on the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tslam_bench.engine.skin import PointSet
from tslam_bench.hand_constants import BASE_POSITION, BASE_QUATERNION, JOINT_NAMES, SKIN_LINKS
from tslam_bench.objects.hand import HandFiles


@dataclass(frozen=True, eq=False)
class Links:
    """Where n hands are, in the world.

    Attributes:
        rotation: (n, 28, 3, 3) of the link that each joint moves.
        position: (n, 28, 3) its origin, which lies on the joint's axis (m).
        axis: (n, 28, 3) unit vector of each joint.
    """

    rotation: NDArray[np.float64]
    position: NDArray[np.float64]
    axis: NDArray[np.float64]


class HandKinematics:
    """Positions and Jacobians of points that are fixed in the hand's links.

    Args:
        hand: the converted hand.
        points: of the skin links.

    Attributes:
        moves: (28, P) whether a joint moves a point.
    """

    def __init__(self, hand: HandFiles, points: PointSet) -> None:
        joints = {joint.attrib["name"]: joint for joint in ElementTree.parse(hand.urdf).getroot().iter("joint")}
        child = {name: _link(joints[name], "child") for name in JOINT_NAMES}
        above = {child[name]: index for index, name in enumerate(JOINT_NAMES)}
        parent = [above.get(_link(joints[name], "parent"), -1) for name in JOINT_NAMES]
        self._axes = np.array([_numbers(joints[name], "axis", "xyz") for name in JOINT_NAMES])
        self._offsets = np.array([_numbers(joints[name], "origin", "xyz") for name in JOINT_NAMES])
        turns = np.array([_turn(*_numbers(joints[name], "origin", "rpy")) for name in JOINT_NAMES])
        cross = np.zeros((len(JOINT_NAMES), 3, 3))
        for (row, column), (axis, sign) in _CROSS.items():
            cross[:, row, column] = sign * self._axes[:, axis]
        # A link's turn against its parent: turns + sin(q) self._sine + (1 - cos(q)) self._cosine (Rodrigues).
        self._turns, self._sine, self._cosine = turns, turns @ cross, turns @ cross @ cross
        self._slides = np.array([joints[name].attrib["type"] == "prismatic" for name in JOINT_NAMES])
        depth = np.zeros(len(JOINT_NAMES), dtype=np.int64)
        ancestors = np.zeros((len(JOINT_NAMES), len(JOINT_NAMES)), dtype=bool)
        for index, above_it in enumerate(parent):  # parents come first
            depth[index] = depth[above_it] + 1 if above_it >= 0 else 0
            ancestors[:, index] = ancestors[:, above_it] if above_it >= 0 else False
            ancestors[index, index] = True
        self._levels = [
            (members, np.array(parent)[members])
            for members in (np.flatnonzero(depth == level) for level in range(depth.max() + 1))
        ]
        self._link = np.array([above[name] for name in SKIN_LINKS])[points.link]
        self._points = points.position.astype(np.float64)
        self.moves = ancestors[:, self._link]
        w, x, y, z = BASE_QUATERNION
        self._base = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    def links(self, qpos: NDArray) -> Links:
        """Where the links are at joint positions (n, 28), m and rad."""
        angle = np.where(self._slides, 0.0, qpos)[:, :, None, None]
        local = self._turns + np.sin(angle) * self._sine + (1 - np.cos(angle)) * self._cosine
        shift = self._offsets + np.where(self._slides, qpos, 0.0)[:, :, None] * self._axes
        rotation, position = np.empty_like(local), np.empty_like(shift)
        for members, parents in self._levels:
            if parents[0] < 0:
                above, origin = np.broadcast_to(self._base, (len(qpos), 1, 3, 3)), np.array(BASE_POSITION)
            else:
                above, origin = rotation[:, parents], position[:, parents]
            rotation[:, members] = above @ local[:, members]
            position[:, members] = origin + (above @ shift[:, members, :, None])[..., 0]
        return Links(rotation, position, (rotation @ self._axes[:, :, None])[..., 0])

    def points(self, links: Links) -> NDArray[np.float64]:
        """(n, P, 3) the points in the world (m)."""
        return links.position[:, self._link] + (links.rotation[:, self._link] @ self._points[:, :, None])[..., 0]

    def jacobian(self, links: Links, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 28, P, 3) how far each point moves per joint (m per m, or m per rad)."""
        axis = links.axis[:, :, None]
        arm = points[:, None] - links.position[:, :, None]
        turned = np.stack(
            [
                axis[..., 1] * arm[..., 2] - axis[..., 2] * arm[..., 1],
                axis[..., 2] * arm[..., 0] - axis[..., 0] * arm[..., 2],
                axis[..., 0] * arm[..., 1] - axis[..., 1] * arm[..., 0],
            ],
            axis=-1,
        )
        return np.where(self._slides[:, None, None], axis, turned) * self.moves[..., None]


_CROSS = {(0, 1): (2, -1), (0, 2): (1, 1), (1, 0): (2, 1), (1, 2): (0, -1), (2, 0): (1, -1), (2, 1): (0, 1)}
"""Entry of the matrix of a cross product -> component of the vector, and its sign."""


def _link(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    assert element is not None
    return element.attrib["link"]


def _numbers(joint: ElementTree.Element, element: str, attribute: str) -> list[float]:
    found = joint.find(element)
    assert found is not None
    return [float(word) for word in found.attrib[attribute].split()]


def _turn(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """(3, 3) rotation of a URDF's roll, pitch and yaw."""
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [c * b, c * e * d - f * a, c * e * a + f * d],
            [f * b, f * e * d + c * a, f * e * a - c * d],
            [-e, b * d, b * a],
        ]
    )
