"""``TactileSLAM-v0``: a blind hand explores an unknown object (protocol sections 1 to 7), as a ManiSkill task."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np
import sapien
import torch
from gymnasium import spaces
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register
from mani_skill.utils.structs import Actor
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.types import DefaultMaterialsConfig, GPUMemoryConfig, SceneConfig, SimConfig
from sapien import physx

from tslam_bench.constants import (
    CONTROL_STEP_SECONDS,
    HORIZON,
    NUM_JOINTS,
)
from tslam_bench.engine import physics, requests
from tslam_bench.engine.arrays import Backend, NumpyBackend, TorchBackend
from tslam_bench.engine.gpu_memory import gpu_memory
from tslam_bench.engine.hand_agent import AdroitHand
from tslam_bench.engine.rendering import vulkan_device_available
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.sensing import Contacts, TactileSensing
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.skin import build_skin
from tslam_bench.engine.spaces import observation_space
from tslam_bench.engine.starts import StartSampler
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.hand_constants import (
    CONTROL_MODES,
    JOINT_NAMES,
)
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import PreparedObject
from tslam_bench.variants import FREE, Variant

MAX_GPU_ENVIRONMENTS: Final = 1 << 16
"""More sub-scenes than this on one GPU are a slip of the pen."""


class TactileSLAMEnv(BaseEnv):
    """A blind 28-DoF hand with binary touch explores a fixed, unknown object for 200 steps (6 s).

    **Description.** The object hangs at the workspace centre, a cube W of edge 0.25 m, and does not move. The hand
    starts open above it and never sees it: it feels which skin links touch, and forward kinematics tells where. Touched
    voxels of W, and voxels the hand passed through, accumulate in two 32^3 grids. The task is to touch as much new
    surface as possible; a reconstructor then completes the shape.

    **Actions.** ``Box(-1, 1, (28,), float32)``, one number per joint of ``tslam_bench.hand_constants.JOINT_NAMES``.
    ``control_mode="pd_joint_delta_pos"`` (default) moves each target by up to ``DELTA_STEP`` from the current position;
    ``"pd_joint_pos"`` maps [-1, 1] to the joint limits and moves each target towards there by at most ``DELTA_STEP``.

    **Observations** (a dict of batched tensors, E environments): ``qpos`` (E, 28) and ``qvel`` (E, 28) in m, rad and per
    second; ``touch`` (E, 18) 0/1 per skin link; ``occupancy`` (E, 2, 32, 32, 32) 0/1, channel 0 touched and channel 1
    visited since the episode began; ``time`` (E, 1) elapsed fraction. ``obs_mode="state"`` flattens them.

    **Rewards.** ``reward_mode`` is one of ``tslam_bench.constants.REWARD_MODES`` (section 7), or ``"none"``.

    **Starting state.** Arm uniform in ``START_ARM_LOW..HIGH``, above the workspace; fingers open with small noise; nothing
    touched. It follows from seed and pose alone: the first observation is the same for every object.

    **Episode end.** Truncated at step 200, never terminated.

    Args:
        object: name of one object for every episode; None draws one per episode.
        objects: names to draw from; None means the whole split.
        split: ``test``, ``train``, ``val``, or the name of a private split; None: named objects are found in whatever split has
            them, and without names episodes draw from what is prepared of ``train``.
        pose: 0..7 for every episode (section 3); None draws one per episode.
        num_envs: environments; more than one needs a GPU.
        reward_mode, control_mode, obs_mode, render_mode: as above and in ManiSkill.
        render_backend: ``"auto"`` renders only if ``render_mode`` or images are asked for and a Vulkan device is there.
        **kwargs: passed on to ManiSkill's ``BaseEnv``.

    ``reset(options={"object": name, "pose": k})`` overrides object and pose for one episode (lists for several
    environments).

    Raises:
        InvalidInputError: unknown object, split, pose, reward mode or control mode; an action of wrong shape or not finite.
        AssetError: an object or the hand is not prepared.

    **Version history.** v0: first version, protocol 1.
    """

    SUPPORTED_ROBOTS = ("adroit28",)
    SUPPORTED_OBS_MODES = ("state_dict", "state", "none", "sensor_data", "any_textures", "pointcloud")
    SUPPORTED_REWARD_MODES = requests.ENVIRONMENT_REWARD_MODES
    VARIANT: ClassVar[Variant] = FREE
    agent: AdroitHand

    def __init__(
        self,
        *args: Any,
        object: str | None = None,
        objects: Sequence[str] | None = None,
        split: str | None = None,
        pose: int | None = None,
        num_envs: int = 1,
        obs_mode: str = "state_dict",
        reward_mode: str = "tslam",
        control_mode: str = CONTROL_MODES[0],
        render_mode: str | None = None,
        render_backend: str = "auto",
        robot_uids: str = "adroit28",
        **kwargs: Any,
    ) -> None:
        requests.check_reward_mode(reward_mode)
        requests.check_control_mode(control_mode)
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise InvalidInputError(f"num_envs {num_envs!r}: must be a whole number of at least 1")
        wants_gpu = num_envs > 1 or "cuda" in str(kwargs.get("sim_backend", ""))
        if wants_gpu and not torch.cuda.is_available():
            raise InvalidInputError(
                f"num_envs {num_envs}, sim_backend {kwargs.get('sim_backend', 'auto')!r}: batched simulation needs a GPU and "
                "there is none (CUDA); make environments with num_envs=1 instead"
            )
        if wants_gpu and num_envs > MAX_GPU_ENVIRONMENTS:
            raise InvalidInputError(f"num_envs {num_envs}: must be a whole number from 1 to {MAX_GPU_ENVIRONMENTS}")
        self._wants_gpu, self._asked_num_envs = wants_gpu, num_envs
        self._starts = StartSampler(object, objects, split, pose, self.VARIANT)
        self.object_name: list[str] = [""] * num_envs
        self.pose: list[int] = [0] * num_envs
        self._bodies: dict[str, sapien.Entity] = {}
        self._table: sapien.Entity | None = None
        self._contacts: Contacts | None = None
        if render_backend == "auto":
            wants_images = render_mode is not None or obs_mode not in ("state_dict", "state", "none")
            render_backend = "gpu" if wants_images and vulkan_device_available() else "none"
        super().__init__(
            *args,
            num_envs=num_envs,
            obs_mode=obs_mode,
            reward_mode=reward_mode,
            control_mode=control_mode,
            render_mode=render_mode,
            render_backend=render_backend,
            robot_uids=robot_uids,
            **kwargs,
        )

    # -- configuration ----------------------------------------------------------------------------------------
    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            # Whole numbers with the right ratio; the true time step is set in _setup_scene.
            sim_freq=physics.PROTOCOL.substeps * round(1 / CONTROL_STEP_SECONDS),
            control_freq=round(1 / CONTROL_STEP_SECONDS),
            scene_config=SceneConfig(
                gravity=np.array(physics.GRAVITY),
                bounce_threshold=physics.BOUNCE_THRESHOLD,
                sleep_threshold=physics.SLEEP_THRESHOLD,
                contact_offset=physics.PROTOCOL.contact_offset,
                rest_offset=physics.REST_OFFSET,
                solver_position_iterations=physics.PROTOCOL.position_iterations,
                solver_velocity_iterations=physics.SOLVER_VELOCITY_ITERATIONS,
                enable_tgs=True,
                enable_pcm=physics.PROTOCOL.persistent_contacts,
            ),
            default_materials_config=DefaultMaterialsConfig(
                physics.STATIC_FRICTION, physics.DYNAMIC_FRICTION, physics.RESTITUTION
            ),
            gpu_memory_config=self._gpu_memory_config() if self._wants_gpu else GPUMemoryConfig(),
        )

    def _gpu_memory_config(self) -> GPUMemoryConfig:
        """PhysX's buffers for the number of environments and the object with the most hulls."""
        return GPUMemoryConfig(**vars(gpu_memory(self._asked_num_envs, self._starts.most_hulls())))

    @property
    def uses_tensors(self) -> bool:
        """Whether sensing, rewards and observations are computed with torch on the device rather than numpy on the host."""
        return self.gpu_sim_enabled

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=[0.42, -0.30, 0.36], target=[0.0, -0.02, 0.02])
        return CameraConfig("render_camera", pose=pose, width=512, height=512, fov=0.9, near=0.01, far=10.0)

    @property
    def sim_timestep(self) -> float:
        """Physics timestep (s)."""
        return physics.PROTOCOL.timestep

    @property
    def control_timestep(self) -> float:
        """Control timestep (s)."""
        return CONTROL_STEP_SECONDS

    @cached_property
    def single_observation_space(self) -> spaces.Space:
        """The unbatched observation space."""
        if self._obs_mode != "state_dict":
            return super().single_observation_space
        return observation_space()

    # -- scene ------------------------------------------------------------------------------------------------
    def _setup_scene(self) -> None:
        super()._setup_scene()
        self.scene.px.timestep = self.sim_timestep
        self._bodies = {}
        self._table = None

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, AdroitHand.base_pose())

    def _load_scene(self, options: dict) -> None:
        self._arrays: Backend = TorchBackend(self.device) if self.uses_tensors else NumpyBackend()
        skin = build_skin(load_hand().shapes)
        self._sensing = (
            TactileSensing(self.num_envs, skin, self._arrays)
            if self.uses_tensors
            else CompiledSensing(self.num_envs, skin)
        )
        self._rewards = None
        if self._reward_mode != "none":
            self._rewards = Rewards(self._reward_mode, self.num_envs, self._arrays)
        if self.gpu_sim_enabled:
            self._load_gpu_objects(options)  # GPU only

    def _load_gpu_objects(self, options: dict) -> None:
        """One body per sub-scene, fixed until the next reconfigure: a GPU scene cannot gain bodies."""  # GPU only
        entities = []
        for env in range(self.num_envs):
            name = options["object"][env] if "object" in options else None
            prepared = self._starts.draw_object(self._batched_episode_rng[env], name)
            shapes = physics.collision_shapes(prepared)
            entity = physics.object_entity(prepared, f"scene-{env}_object", shapes, self.scene.can_render())
            entity.pose = sapien.Pose([0, 0, 0], physics.pose_quaternion(0))
            self.scene.sub_scenes[env].add_entity(entity)
            self.object_name[env] = prepared.name
            entities.append(entity)
            if self.VARIANT.table:
                table = physics.table_entity(f"scene-{env}_table", self.scene.can_render())
                table.pose = physics.table_pose(prepared)
                self.scene.sub_scenes[env].add_entity(table)
        self._register_object(entities)

    def _register_object(self, entities: list[sapien.Entity]) -> None:
        scene_idxs = torch.arange(self.num_envs, dtype=torch.int, device=self.device)
        actor = Actor.create_from_entities(entities, self.scene, scene_idxs, shared_name="object")
        actor.initial_pose = Pose.create(entities[0].pose, device=self.device)
        self.scene.actors["object"] = actor
        self.object_actor = actor

    # -- episodes ---------------------------------------------------------------------------------------------
    def reset(self, seed: Any = None, options: dict | None = None) -> tuple[Any, dict]:
        """Starts an episode; see the class docstring for ``options``."""
        options = dict(options or {})
        for key in ("object", "pose"):
            if key in options and not isinstance(options[key], (list, tuple)):
                options[key] = [options[key]] * self.num_envs
            if key in options and len(options[key]) != self.num_envs:
                raise InvalidInputError(
                    f"options[{key!r}]: {len(options[key])} values for {self.num_envs} environments; give one each"
                )
        for env, name in enumerate(options.get("object", ())):
            known = self._starts.load(name).name
            if self.gpu_sim_enabled and not options.get("reconfigure") and known != self.object_name[env]:  # GPU only
                raise InvalidInputError(
                    f"options['object']: a GPU scene keeps its objects ({self.object_name[env]!r} in environment {env}); "
                    "add options['reconfigure'] = True"
                )
        for pose in options.get("pose", ()):
            self.VARIANT.check_pose(pose)
        if isinstance(seed, (int, np.integer)) and self.num_envs > 1:  # environment i is seed + i, as in make_vec
            seed = list(range(int(seed), int(seed) + self.num_envs))  # GPU only
        return super().reset(seed=seed, options=options)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        envs = env_idx.tolist()
        starts = []
        for env in envs:
            rng = self._batched_episode_rng[env]
            name = options["object"][env] if "object" in options else None
            prepared = self._starts.draw_object(rng, name)
            if self.gpu_sim_enabled:  # bodies are fixed until the next reconfigure
                prepared = self._starts.load(self.object_name[env])  # GPU only
            start = self._starts.draw(rng, pose=options["pose"][env] if "pose" in options else None, prepared=prepared)
            starts.append(start)
            self.object_name[env], self.pose[env] = prepared.name, start.pose
            self._sensing.set_object(env, prepared.name, prepared.field, start.pose)
            if self._rewards is not None:
                self._rewards.set_object(env, prepared, start.pose)
        order = np.argsort(self.agent.joint_order)  # from JOINT_NAMES to the simulator's order
        qpos = np.stack([start.qpos for start in starts])[:, order]
        if self.gpu_sim_enabled:
            self._place_gpu_objects(env_idx, qpos)  # GPU only
        else:
            self._fresh_physics(starts[0].prepared, starts[0].pose, qpos[0])
        self._sensing.begin(envs)
        if self._rewards is not None:
            self._rewards.begin(envs)
        self._contacts = None
        self._reward = None
        if not self.uses_tensors and bool(self._sensing.touches(self.agent.host_skin_matrices()).any()):
            raise AssetError(
                f"{self.object_name[0]}: touches the hand at the start, so it does not fit in the workspace"
            )

    def _place_gpu_objects(self, env_idx: torch.Tensor, qpos: np.ndarray) -> None:
        """Turns the objects and places the hands of ``env_idx``."""  # GPU only
        quaternions = np.stack([physics.pose_quaternion(self.pose[env]) for env in env_idx.tolist()])
        position = torch.zeros((len(env_idx), 3), device=self.device)
        rotation = torch.tensor(quaternions, dtype=torch.float32, device=self.device)
        self.object_actor.set_pose(Pose.create_from_pq(position, rotation))
        self.agent.robot.set_qpos(torch.tensor(qpos, device=self.device))
        self.agent.robot.set_qvel(torch.zeros_like(self.agent.robot.get_qvel()[env_idx]))

    def _fresh_physics(self, prepared: PreparedObject, pose: int, qpos: np.ndarray) -> None:
        """Moves hand and object into a new physics system, so that an episode does not depend on those before it.

        PhysX keeps contact caches that a soft reset leaves behind: its episodes differ from the first contact on.
        """
        old = self.scene.sub_scenes[0]
        body = self._bodies.get(prepared.name)
        if body is None:
            self._set_scene_config()
            shapes = physics.collision_shapes(prepared)
            body = physics.object_entity(prepared, "scene-0_object", shapes, self.scene.can_render())
            while len(self._bodies) >= physics.CACHED_BODIES:
                del self._bodies[next(iter(self._bodies))]
            self._bodies[prepared.name] = body
        if self.VARIANT.table and self._table is None:
            self._set_scene_config()
            self._table = physics.table_entity("scene-0_table", self.scene.can_render())
        entities = [e for e in old.entities if e.name not in ("scene-0_object", "scene-0_table")]
        for entity in list(old.entities):
            old.remove_entity(entity)
        self._set_scene_config()
        system = physx.PhysxCpuSystem()
        system.timestep = self.sim_timestep
        systems: list[Any] = [system]
        if self.scene.can_render():
            systems.append(old.render_system)
        new = sapien.Scene(systems)
        robot = self.agent.robot._objs[0]
        for entity in entities:
            new.add_entity(entity)
        body.pose = sapien.Pose([0, 0, 0], physics.pose_quaternion(pose))
        new.add_entity(body)
        if self._table is not None:
            self._table.pose = physics.table_pose(prepared)
            new.add_entity(self._table)
        robot.set_root_pose(AdroitHand.base_pose())
        robot.set_qpos(qpos)
        robot.set_qvel(np.zeros_like(qpos))
        robot.set_qf(np.zeros_like(qpos))
        self.scene.sub_scenes[0] = new
        self.scene.px = system
        self._register_object([body])

    # -- step -------------------------------------------------------------------------------------------------
    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """One control step (30.1 ms).

        Args:
            action: (28,) or (E, 28), clipped to [-1, 1].

        Raises:
            InvalidInputError: the action has another shape or is not finite.
        """
        observation, reward, terminated, _, info = super().step(self._checked(action))
        return observation, reward, terminated, self._elapsed_steps >= HORIZON, info

    def _checked(self, action: Any) -> torch.Tensor:
        try:
            value = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidInputError(f"action: not an array of numbers ({error}); give a float array (28,)") from error
        if self.num_envs == 1 and value.shape == (NUM_JOINTS,):
            value = value[None]
        if value.shape != (self.num_envs, NUM_JOINTS):
            expected = f"({self.num_envs}, {NUM_JOINTS})"
            raise InvalidInputError(f"action: shape {tuple(value.shape)}, expected {expected}; one number per joint")
        # A check on the GPU would stall it every step; the drive targets are clipped there all the same.
        if not self.gpu_sim_enabled and not bool(np.isfinite(value.numpy()).all()):
            joint = JOINT_NAMES[int(np.flatnonzero(~np.isfinite(value.numpy()).all(0))[0])]
            raise InvalidInputError(f"action: not finite for joint {joint}; give numbers in [-1, 1]")
        return value

    def _step_action(self, action: Any) -> Any:
        action = super()._step_action(action)
        step = self._elapsed_steps  # counted up after the action
        if self.uses_tensors:
            self._contacts = self._sensing.step(self.agent.device_skin_matrices(), step)
        else:
            self._contacts = self._sensing.step(self.agent.host_skin_matrices(), step.numpy())
        if self._rewards is not None:
            self._reward = self._rewards.step(self._contacts)
        return action

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(E,) float32 reward of the last step in the environment's reward mode."""
        if self._reward is None:
            return torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        return self._tensor(self._reward)

    def get_info(self) -> dict:
        """``elapsed_steps``, and how many voxels the last step touched and visited for the first time."""
        info = {"elapsed_steps": self._elapsed_steps.clone()}
        for key in ("new_touched", "new_visited"):
            count = None if self._contacts is None else getattr(self._contacts, key)
            info[key] = (
                torch.zeros_like(self._elapsed_steps, dtype=torch.int64) if count is None else self._tensor(count)
            )
        return info

    def _tensor(self, value: Any) -> torch.Tensor:
        return torch.from_numpy(value) if isinstance(value, np.ndarray) else value

    # -- observation ------------------------------------------------------------------------------------------
    def _get_obs_state_dict(self, info: dict) -> dict[str, torch.Tensor]:
        return {**self._get_obs_agent(), **self._get_obs_extra(info)}

    def _get_obs_agent(self) -> dict[str, torch.Tensor]:
        if self.uses_tensors:
            order = self.agent.device_joint_order
            return {"qpos": self.agent.robot.get_qpos()[:, order], "qvel": self.agent.robot.get_qvel()[:, order]}
        return {"qpos": torch.from_numpy(self.agent.host_qpos()), "qvel": torch.from_numpy(self.agent.host_qvel())}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        touch, touched, visited = self._sensing.link_touch(), self._sensing.touched, self._sensing.visited
        if isinstance(self._sensing, CompiledSensing):
            occupancy = torch.from_numpy(self._sensing.occupancy.copy())
            touch = torch.from_numpy(touch.view(np.uint8))
        else:
            occupancy = torch.stack([touched, visited], dim=1).to(torch.uint8)
            touch = touch.to(torch.uint8)
        time = (self._elapsed_steps.to(torch.float32) / HORIZON).clamp(max=1.0)[:, None]
        return {"touch": touch, "occupancy": occupancy, "time": time}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat([value.reshape(self.num_envs, -1).to(torch.float32) for value in obs.values()], dim=1)
        if self.obs_mode_struct.state and isinstance(obs, dict) and "agent" in obs:
            state = {**obs.pop("agent"), **obs.pop("extra")}
            obs["state"] = torch.cat([v.reshape(self.num_envs, -1).to(torch.float32) for v in state.values()], dim=1)
        return obs

    # -- what the hand has learned ----------------------------------------------------------------------------
    @property
    def touched(self) -> Any:
        """(E, 32, 32, 32) bool, world frame; a view that the next step changes."""
        return self._sensing.touched

    @property
    def visited(self) -> Any:
        """(E, 32, 32, 32) bool, world frame; a view that the next step changes."""
        return self._sensing.visited

    @property
    def touched_step(self) -> Any:
        """(E, 32, 32, 32) int16, step (0..199) of the first touch, -1 where never touched; a view."""
        return self._sensing.touched_step


register(FREE.id, TactileSLAMEnv, max_episode_steps=HORIZON)
