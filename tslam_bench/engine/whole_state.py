"""Saving and restoring a ManiSkill task's episodes as a whole: simulation, time, grids, reward memory, generators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import common
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.engine.hand_scene import HandScene
from tslam_bench.engine.requests import ResetRequest
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.sensing import Sensing
from tslam_bench.engine.starts import Start, StartSampler
from tslam_bench.errors import InvalidInputError

NAME_BYTES: Final = 64
"""Longest name of an object, in UTF-8."""


class WholeState(BaseEnv):
    """What a task needs for :meth:`get_state_dict` and :meth:`set_state_dict` to hold all of an episode.

    PhysX does not show its contact caches, and an articulation whose positions are set goes on differently in the last bits. So
    on the CPU a state holds the drive targets since the episode's start, and restoring replays them in a new physics system: the
    same bits, at about 0.2 ms for each control step.
    """

    object_name: list[str]
    pose: list[int]
    hand: HandScene
    """The simulated hand, CPU simulation."""
    _starts: StartSampler
    _sensing: Sensing
    _rewards: Rewards
    _start: Start
    _past_targets: list[NDArray[np.float32]]
    """(28,) drive targets of every control step of the episode, CPU simulation."""

    def _begin(self, env_idx: torch.Tensor, starts: Sequence[Start]) -> None:
        raise NotImplementedError

    def _seeds(self, request: ResetRequest, envs: NDArray[np.int64], reconfigure: bool) -> list[int] | None:
        """What to hand to ManiSkill, which seeds all generators or none; a part of them is seeded here."""
        given = {env: request.seeds[env] for env in envs.tolist() if request.seeds[env] is not None}
        if not given or len(given) == self.num_envs:
            return list(given.values()) or None
        main = self._batched_main_rng.rngs
        if reconfigure:
            return [int(given[env] if env in given else main[env].randint(2**31)) for env in range(self.num_envs)]
        for env, seed in given.items():
            main[env], self._batched_episode_rng.rngs[env] = (np.random.RandomState(seed) for _ in range(2))
        return None

    def get_state_dict(self) -> dict[str, Any]:
        """The whole state, a nested dict of tensors (E, ...): copies. See the class docstring."""
        episode: dict[str, Any] = {
            "object": names_to_array(self.object_name),
            "pose": np.array(self.pose),
            "elapsed_steps": self._elapsed_steps.clone(),
        }
        if not self.gpu_sim_enabled:
            targets = np.zeros((1, max(HORIZON, len(self._past_targets)), NUM_JOINTS), dtype=np.float32)
            if self._past_targets:
                targets[0, : len(self._past_targets)] = self._past_targets
            episode |= {"start": self._start.qpos[None].copy(), "targets": targets}
        generators = {
            "main": generators_to_array(self._batched_main_rng.rngs),
            "episode": generators_to_array(self._batched_episode_rng.rngs),
        }
        ours = {
            "episode": episode,
            "sensing": self._sensing.state(),
            "reward": self._rewards.state(),
            "generators": generators,
        }
        return {**super().get_state_dict(), **common.to_tensor(ours, device=self.device)}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """Goes on from a state, in the environments ``env_idx`` (None: all). See the class docstring.

        A state whose hand was moved by other means than actions is set as it is; bits are then not promised.

        Raises:
            InvalidInputError: a state of another reward mode, of an object that is unknown here, or on a GPU of another object
            than the scene's.
        """
        if "episode" not in state:  # ManiSkill's own: where things are
            super().set_state_dict(state, env_idx)
            return
        env_idx = torch.arange(self.num_envs, device=self.device) if env_idx is None else env_idx
        envs, episode = env_idx.tolist(), common.to_numpy(state["episode"])
        if envs != sorted(set(envs)):
            raise InvalidInputError(
                "env_idx: ManiSkill sets rows by a mask; give ascending numbers and the state's rows so"
            )
        starts = []
        for row, name in enumerate(names_from_array(episode["object"])):
            if self.gpu_sim_enabled and name != self.object_name[envs[row]]:
                raise InvalidInputError(f"state: of {name!r}; a GPU scene keeps {self.object_name[envs[row]]!r}")
            qpos = episode["start"][row] if "start" in episode else np.zeros(NUM_JOINTS, dtype=np.float32)
            starts.append(Start(self._starts.load(name), int(episode["pose"][row]), qpos))
        kept, self.scene._reset_mask = self.scene._reset_mask, torch.zeros_like(self.scene._reset_mask)
        self.scene._reset_mask[env_idx] = True  # what ManiSkill's setters move
        self._begin(env_idx, starts)
        self.scene._reset_mask = kept
        self._sensing.set_state(envs, state["sensing"])
        self._rewards.set_state(envs, state["reward"])
        self._elapsed_steps[env_idx] = torch.as_tensor(state["episode"]["elapsed_steps"], device=self.device)
        for name, generators in (("main", self._batched_main_rng), ("episode", self._batched_episode_rng)):
            saved = common.to_numpy(state["generators"][name])
            set_generators([generators.rngs[env] for env in envs], saved)
        if not self.gpu_sim_enabled:
            for targets in episode["targets"][0, : int(episode["elapsed_steps"][0])]:
                self.hand.set_targets(targets.tolist())
                self.hand.step()
                self._past_targets.append(targets)
        wanted = {"articulations": common.to_tensor(state["articulations"], device=self.device)}
        now = self.scene.get_sim_state()["articulations"]
        if self.gpu_sim_enabled or any(not torch.equal(now[name], wanted["articulations"][name]) for name in now):
            super().set_state_dict(wanted, env_idx)

    def get_state(self) -> torch.Tensor:
        """(E, D) where things are, as a flat vector; the rest of the state has no place in one."""
        return common.flatten_state_dict(super().get_state_dict(), use_torch=True)


def names_to_array(names: Sequence[str]) -> NDArray[np.uint8]:
    """(E, NAME_BYTES) UTF-8, filled up with zeros."""
    rows = [np.frombuffer(name.encode().ljust(NAME_BYTES, b"\0"), dtype=np.uint8) for name in names]
    return np.stack(rows)


def names_from_array(array: NDArray[np.uint8]) -> list[str]:
    """Inverse of :func:`names_to_array`."""
    return [row.tobytes().rstrip(b"\0").decode() for row in np.asarray(array, dtype=np.uint8)]


def generators_to_array(generators: Sequence[np.random.RandomState]) -> NDArray[np.int64]:
    """(E, 627) state of Mersenne Twisters: 624 words, position, and what ``normal`` has left over (flag, bits)."""
    rows = []
    for generator in generators:
        state: Any = generator.get_state(legacy=False)
        left = np.array([state["gauss"]], dtype=np.float64).view(np.int64)
        rows.append([*state["state"]["key"], state["state"]["pos"], state["has_gauss"], *left])
    return np.array(rows, dtype=np.int64)


def set_generators(generators: Sequence[np.random.RandomState], array: NDArray[np.int64]) -> None:
    """Puts rows of :func:`generators_to_array` back."""
    for generator, row in zip(generators, np.asarray(array, dtype=np.int64), strict=True):
        left = float(row[626:].view(np.float64)[0])
        generator.set_state(("MT19937", row[:624].astype(np.uint32), int(row[624]), int(row[625]), left))
