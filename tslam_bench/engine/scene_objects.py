"""The objects, and tables, of a batched ManiSkill scene: one per sub-scene, kept until the scene is made anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.pose import Pose
from sapien import physx

from tslam_bench.engine import physics
from tslam_bench.engine.rewards import SURFACE_SUBSAMPLE
from tslam_bench.engine.starts import Start
from tslam_bench.objects.store import PreparedObject

AWAY: Final = {"object": (0.0, 0.0, -1.0), "table": (0.0, 0.0, -1.5)}
"""Where things wait before the first reset (m): PhysX simulates a step while it sets a GPU scene up, with all joints at zero, and
the hand must not stand in anything then."""


def register_actor(scene: Any, name: str, entities: Sequence[sapien.Entity]) -> Actor:
    """Makes one entity per sub-scene known to ManiSkill: on a GPU, what is not known is moved to the origin at every reset."""
    scene_idxs = torch.arange(len(entities), dtype=torch.int, device=scene.device)
    actor = Actor.create_from_entities(list(entities), scene, scene_idxs, shared_name=name)
    actor.initial_pose = Pose.create(entities[0].pose, device=scene.device)
    scene.actors[name] = actor
    return actor


class SceneObjects:
    """Makes the bodies of every sub-scene and places them at resets. A GPU scene cannot gain bodies later.

    Args:
        scene: ManiSkill's, not set up yet.
        prepared: an object per sub-scene; those of one name share what an episode needs of it.
        table: whether each stands on a table.
        can_render: whether the bodies have looks.
    """

    def __init__(self, scene: Any, prepared: Sequence[PreparedObject], table: bool, can_render: bool) -> None:
        self._device = scene.device
        kept: dict[str, PreparedObject] = {}
        bodies: dict[str, list[sapien.Entity]] = {"object": [], "table": []}
        material = physx.PhysxMaterial(*physics.MATERIAL)
        for env, (sub_scene, one) in enumerate(zip(scene.sub_scenes, prepared, strict=True)):
            kept.setdefault(one.name, _for_episodes(one))
            bodies["object"].append(physics.object_entity(one, f"scene-{env}_object", can_render, material))
            if table:
                bodies["table"].append(physics.table_entity(f"scene-{env}_table", can_render, material))
            for name, entities in bodies.items():
                if entities:
                    entities[-1].pose = sapien.Pose(AWAY[name])
                    sub_scene.add_entity(entities[-1])
        self.prepared = [kept[one.name] for one in prepared]
        """(E,) the objects, with as much of them as episodes need."""
        self._actors = {name: register_actor(scene, name, entities) for name, entities in bodies.items() if entities}

    def place(self, starts: Sequence[Start]) -> None:
        """Puts object and table of the sub-scenes that are being reset where their episodes want them, in ascending order."""
        turns = np.stack([physics.pose_quaternion(start.pose) for start in starts])
        self._move("object", np.concatenate([np.zeros((len(starts), 3)), turns], axis=1))
        if "table" in self._actors:
            poses = [physics.table_pose(start.prepared) for start in starts]
            self._move("table", np.array([[*pose.p, *pose.q] for pose in poses]))

    def _move(self, name: str, poses: np.ndarray) -> None:
        self._actors[name].set_pose(Pose.create(torch.tensor(poses, dtype=torch.float32, device=self._device)))


def _for_episodes(prepared: PreparedObject) -> PreparedObject:
    """The object without what only scoring and reconstruction read: a batch may hold thousands."""
    nothing = np.zeros(0, dtype=bool)
    return replace(
        prepared,
        surface_points=prepared.surface_points[:SURFACE_SUBSAMPLE].copy(),
        surface_normals=prepared.surface_normals[:SURFACE_SUBSAMPLE].copy(),
        solid_at_iou_points=nothing,
        raw_solid_at_iou_points=nothing,
    )
