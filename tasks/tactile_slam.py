"""``TactileSLAM-v0``: a blind hand explores an unknown object (protocol sections 1 to 7), as a ManiSkill task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, Final

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.registration import register
from mani_skill.utils.structs.types import DefaultMaterialsConfig, GPUMemoryConfig, SceneConfig, SimConfig

from tslam_bench.constants import CONTROL_STEP_SECONDS, HORIZON
from tslam_bench.engine import gpu_physics, physics, requests
from tslam_bench.engine.arrays import NumpyBackend, TorchBackend
from tslam_bench.engine.gpu_memory import gpu_memory
from tslam_bench.engine.hand_agent import AdroitHand
from tslam_bench.engine.hand_scene import HandScene
from tslam_bench.engine.rendering import OneLineRendering, choose_backend
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.scene_objects import SceneObjects, register_actor
from tslam_bench.engine.sensing import Contacts
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.sensing_torch import TorchSensing
from tslam_bench.engine.skin import build_skin
from tslam_bench.engine.spaces import observation_space
from tslam_bench.engine.starts import Start, StartSampler
from tslam_bench.engine.whole_state import WholeState
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.hand_constants import CONTROL_MODES
from tslam_bench.objects.hand import load_hand
from tslam_bench.variants import FREE, Variant

MAX_GPU_ENVIRONMENTS: Final = 1 << 16
"""More sub-scenes than this on one GPU are probably a mistake."""
SPACING: Final = 2.5
"""Metres between the sub-scenes of a GPU: float32 is the coarser the further out one lies (docs/gpu.md)."""


class TactileSLAMEnv(OneLineRendering, WholeState):
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

    **One environment as numpy.** ``tslam_bench.wrappers.NumpyEnv(env)`` takes the batch axis and the tensors away: plain
    Gymnasium, which its ``check_env`` accepts. ``reset(seed=...)`` seeds ``np_random`` too; the environment itself draws nothing
    from it.

    **State.** ``env.unwrapped.get_state_dict()`` is all of an episode, as tensors: simulation, object and pose, time, grids,
    reward memory, generators. After ``set_state_dict`` (here or in another environment) the episode goes on bit for bit, as
    the CPU simulation replays the drive targets from the episode's start: PhysX shows no other way to its contact caches. On a
    GPU positions and velocities are set. ``get_state()`` is the flat vector of the simulation alone.

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
    environments; None draws an object).

    Raises:
        InvalidInputError: unknown object, split, pose, reward mode or control mode; an action of wrong shape or not finite.
        AssetError: an object or the hand is not prepared; pictures are observed, or ``render`` is called, without Vulkan.

    **Version history.** v0: first version, protocol 1.
    """

    SUPPORTED_ROBOTS = ("adroit28",)
    SUPPORTED_OBS_MODES = ("state_dict", "state", "none", "sensor_data", "any_textures", "pointcloud")
    SUPPORTED_REWARD_MODES = requests.ENVIRONMENT_REWARD_MODES
    VARIANT: ClassVar[Variant] = FREE
    agent: AdroitHand
    _contacts: Contacts | None
    _objects: SceneObjects

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
        backend = kwargs.get("sim_backend", "auto")
        on_gpu = str(backend).partition(":")[0] in ("cuda", "gpu", "physx_cuda")
        self._wants_gpu = on_gpu or (isinstance(num_envs, int) and num_envs > 1)
        if self._wants_gpu and not gpu_physics.cuda_available():
            raise InvalidInputError(
                f"num_envs {num_envs}, sim_backend {backend!r}: batched simulation needs a GPU and there is none (CUDA); "
                "make environments with num_envs=1 instead"
            )
        self._asked_num_envs = requests.check_whole("num_envs", num_envs, 1, MAX_GPU_ENVIRONMENTS)
        if self._wants_gpu:
            gpu_physics.enable_gpu_physics()
        self._starts = StartSampler(object, objects, split, pose, self.VARIANT)
        self.object_name: list[str] = [""] * num_envs
        self.pose: list[int] = [0] * num_envs
        self.faults: Any = 0
        """(E,) int64 on a GPU: control steps since this was made with an action or a hand that was not finite."""
        render_backend = choose_backend(obs_mode, render_mode, render_backend)
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

    # -- configuration ------------------------------------------------------------------------
    @property
    def _default_sim_config(self) -> SimConfig:
        memory = GPUMemoryConfig()
        if self._wants_gpu:
            memory = GPUMemoryConfig(**vars(gpu_memory(self._asked_num_envs, self._starts.most_hulls())))
        return SimConfig(
            # Whole numbers with the right ratio; the true time step is set in _setup_scene.
            sim_freq=physics.PROTOCOL.substeps * round(1 / CONTROL_STEP_SECONDS),
            control_freq=round(1 / CONTROL_STEP_SECONDS),
            spacing=SPACING,
            scene_config=SceneConfig(**physics.scene_settings(on_gpu=self._wants_gpu)),
            default_materials_config=DefaultMaterialsConfig(*physics.MATERIAL),
            gpu_memory_config=memory,
        )

    @property
    def sim_timestep(self) -> float:
        """Physics timestep (s)."""
        return physics.PROTOCOL.timestep

    @property
    def control_timestep(self) -> float:
        """Control timestep (s)."""
        return CONTROL_STEP_SECONDS

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=[0.42, -0.30, 0.36], target=[0.0, -0.02, 0.02])
        return CameraConfig("render_camera", pose=pose, width=512, height=512, fov=0.9, near=0.01, far=10.0)

    @cached_property
    def single_observation_space(self) -> spaces.Space:
        """The unbatched observation space."""
        return observation_space() if self._obs_mode == "state_dict" else super().single_observation_space

    # -- scene --------------------------------------------------------------------------------
    def _setup_scene(self) -> None:
        super()._setup_scene()
        self.scene.px.timestep = self.sim_timestep

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, AdroitHand.base_pose())

    def _load_scene(self, options: dict) -> None:
        skin = build_skin(load_hand().shapes)
        backend = TorchBackend(self.device) if self.gpu_sim_enabled else NumpyBackend()
        self._sensing: Any = (
            TorchSensing(self.num_envs, skin, self.device)
            if self.gpu_sim_enabled
            else CompiledSensing(self.num_envs, skin)
        )
        self._rewards = Rewards(self._reward_mode, self.num_envs, backend)
        if self.gpu_sim_enabled and isinstance(self.faults, int):
            self.faults = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        render = self.scene.can_render()
        if self.gpu_sim_enabled:
            prepared = [self._draw_object(env, options) for env in range(self.num_envs)]
            self._objects = SceneObjects(self.scene, prepared, self.VARIANT.table, render)
            self.object_name = [one.name for one in prepared]
        else:
            table = physics.table_entity(can_render=render) if self.VARIANT.table else None
            bodies = physics.BodyPool(can_render=render)
            self.hand = HandScene(self.scene.sub_scenes[0], self.agent.robot._objs[0], bodies, table)

    def _clear(self) -> None:
        """Lets go of all that holds the scene, so that the old one is gone before a new one is made."""
        for name in ("hand", "_objects", "_sensing", "_rewards", "_contacts", "_reward"):
            setattr(self, name, None)
        self.__dict__.pop("segmentation_id_map", None)  # ManiSkill's cache holds actors, and they the scene
        super()._clear()

    # -- reset --------------------------------------------------------------------------------
    def reset(self, seed: Any = None, options: dict | None = None) -> tuple[Any, dict]:
        """Starts an episode; see the class docstring for ``options``."""
        request = requests.check_reset(seed, options, self.num_envs, self._starts)
        envs, reconfigure = np.flatnonzero(request.mask), bool((options or {}).get("reconfigure"))
        if not reconfigure and self.gpu_sim_enabled:
            for env, name in enumerate(request.objects or ()):
                if name is not None and self._starts.canonical(name) != self.object_name[env]:
                    raise InvalidInputError(
                        f"options['object']: a GPU scene keeps its objects ({self.object_name[env]!r} in environment {env}); "
                        "add options['reconfigure'] = True"
                    )
        if reconfigure and len(envs) < self.num_envs:
            raise InvalidInputError("options['reconfigure']: rebuilds all environments; leave env_idx out")
        if request.seeds[0] is not None:
            gym.Env.reset(self, seed=request.seeds[0])  # np_random, for wrappers: nothing here draws from it
        if len(envs) == 0:
            info = self.get_info() | {"reconfigure": False}
            return self.get_obs(info), info
        options = {**(options or {}), "object": request.objects, "pose": request.poses}
        options["env_idx"] = torch.as_tensor(envs, device=self.device)
        return super().reset(seed=self._seeds(request, envs, reconfigure), options=options)

    def _draw_object(self, env: int, options: Mapping[str, Any]) -> Any:
        names = options.get("object")
        return self._starts.draw_object(self._batched_episode_rng[env], names[env] if names else None)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        starts, poses = [], options.get("pose")
        for env in env_idx.tolist():
            rng, pose = self._batched_episode_rng[env], poses[env] if poses else None
            if self.gpu_sim_enabled:  # bodies are fixed until the next reconfigure
                self._starts.skip_object(rng)
                prepared = self._objects.prepared[env]
            else:
                prepared = self._draw_object(env, options)
            starts.append(self._starts.draw(rng, pose=pose, prepared=prepared))
        self._begin(env_idx, starts)
        if not self.gpu_sim_enabled and bool(self._sensing.touches(self.hand.skin_matrices()).any()):
            name = self.object_name[0]
            raise AssetError(f"{name}: touches the hand at the start, so it does not fit in the workspace")

    def _begin(self, env_idx: torch.Tensor, starts: Sequence[Start]) -> None:
        """Puts hands and objects of ``env_idx`` where their episodes start, with nothing felt yet."""
        envs = env_idx.tolist()
        for env, start in zip(envs, starts, strict=True):
            self.object_name[env], self.pose[env] = start.prepared.name, start.pose
            self._sensing.set_object(env, start.prepared.name, start.prepared.field, start.pose)
            self._rewards.set_object(env, start.prepared, start.pose)
        if self.gpu_sim_enabled:
            self._place_on_gpu(env_idx, starts)
        else:
            self._start, self._past_targets = starts[0], []
            self.hand.begin(starts[0])
            self.scene.sub_scenes[0], self.scene.px = self.hand.scene, self.hand.system
            register_actor(self.scene, "object", [self.hand.object_body])
        self._sensing.begin(envs)
        self._rewards.begin(envs)
        self._contacts = None
        self._reward = None

    def _place_on_gpu(self, env_idx: torch.Tensor, starts: Sequence[Start]) -> None:
        """Places objects and hands of ``env_idx``, which is in ascending order: ManiSkill's setters go by a mask."""
        self._objects.place(starts)
        order = np.argsort(self.agent.joint_order)  # from JOINT_NAMES to the simulator's order
        self.agent.robot.set_qpos(
            torch.tensor(np.stack([start.qpos for start in starts])[:, order], device=self.device)
        )
        self.agent.robot.set_qvel(torch.zeros_like(self.agent.robot.get_qvel()[env_idx]))

    # -- step ---------------------------------------------------------------------------------
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
        if not self.gpu_sim_enabled:
            return torch.from_numpy(requests.check_actions(action, self.num_envs))
        # Raising would wait for the device in every step: what is not finite is replaced there and counted in ``faults``.
        value = torch.as_tensor(action, dtype=torch.float32, device=self.device)
        value = value.reshape(requests.check_action_shape(tuple(value.shape), self.num_envs))
        self.faults += ~torch.isfinite(value).all(1)
        return torch.where(torch.isfinite(value), value, 0.0)

    def _step_action(self, action: Any) -> Any:
        action = super()._step_action(action)
        step = self._elapsed_steps  # counted up after the action
        if not self.gpu_sim_enabled:
            self._past_targets.append(self.agent.controller.targets)
        if self.gpu_sim_enabled:
            self._contacts = self._sensing.step(self.agent.device_skin_matrices(), step)
            self.faults += self._sensing.lost
        else:
            self._contacts = self._sensing.step(self.hand.skin_matrices(), step.numpy())
        self._reward = self._rewards.step(self._contacts)
        return action

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """(E,) float32 reward of the last step in the environment's reward mode."""
        if self._reward is None:
            return torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        return torch.as_tensor(self._reward)

    def get_info(self) -> dict:
        """``elapsed_steps``, and how many voxels the last step touched and visited for the first time."""
        info = {"elapsed_steps": self._elapsed_steps.clone()}
        for key in ("new_touched", "new_visited"):
            none = torch.zeros_like(self._elapsed_steps, dtype=torch.int64)
            info[key] = none if self._contacts is None else torch.as_tensor(getattr(self._contacts, key))
        return info

    # -- observation --------------------------------------------------------------------------
    def _get_obs_state_dict(self, info: dict) -> dict[str, torch.Tensor]:
        return {**self._get_obs_agent(), **self._get_obs_extra(info)}

    def _get_obs_agent(self) -> dict[str, torch.Tensor]:
        if self.gpu_sim_enabled:
            order, robot = self.agent.device_joint_order, self.agent.robot
            joints = {"qpos": robot.get_qpos()[:, order], "qvel": robot.get_qvel()[:, order]}
            return {name: torch.where(torch.isfinite(value), value, 0.0) for name, value in joints.items()}
        return {"qpos": torch.from_numpy(self.hand.qpos[None]), "qvel": torch.from_numpy(self.hand.qvel[None])}

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        occupancy = self._sensing.occupancy
        return {
            "touch": torch.as_tensor(self._sensing.link_touch()),
            "occupancy": occupancy if self.gpu_sim_enabled else torch.from_numpy(occupancy.copy()),
            "time": (self._elapsed_steps.to(torch.float32) / HORIZON).clamp(max=1.0)[:, None],
        }

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return self._flat(obs)
        if self.obs_mode_struct.state and isinstance(obs, dict) and "agent" in obs:
            obs["state"] = self._flat({**obs.pop("agent"), **obs.pop("extra")})
        return obs

    def _flat(self, entries: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return torch.cat([value.reshape(self.num_envs, -1).to(torch.float32) for value in entries.values()], dim=1)

    @property
    def touched(self) -> Any:
        """(E, 32, 32, 32) bool, world frame."""
        return self._sensing.touched

    @property
    def visited(self) -> Any:
        """(E, 32, 32, 32) bool, world frame."""
        return self._sensing.visited

    @property
    def touched_step(self) -> Any:
        """(E, 32, 32, 32) int16, step (0..199) of the first touch, -1 where never touched; a view."""
        return self._sensing.touched_step


register(FREE.id, TactileSLAMEnv, max_episode_steps=HORIZON)
