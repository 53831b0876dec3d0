"""Episodes step by step on the CPU engine, without rendering: played by a policy now, or from a rollout's actions again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import HORIZON, NUM_JOINTS
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.episodes import Episode, episode_seed, policy_seed
from tslam_bench.errors import BenchmarkError, InvalidInputError
from tslam_bench.evaluation.observations import observation_to_numpy
from tslam_bench.evaluation.policy import Policy
from tslam_bench.evaluation.verify import Replay, judge
from tslam_bench.hand_constants import CONTROL_MODES, SKIN_LINKS
from tslam_bench.scoring.rollout import CHECKPOINT_SPACING, Rollout
from tslam_bench.viewing.motion import Motion, MotionSource, interpolate

_NO_WAY = {
    "start": "another start",
    "joints": "other joint positions",
    "touches": "other touches",
    "visited": "other visited voxels",
}


@dataclass(frozen=True)
class _Played:
    """What a batch of episodes gave.

    Attributes:
        actions: (E, 200, 28); joints: (E, 201, 28); touch: (E, 200, 17) bool; touched_step, touched, visited: (E, 32, 32, 32).
    """

    actions: NDArray[np.float32]
    joints: NDArray[np.float32]
    touch: NDArray[np.bool_]
    touched_step: NDArray[np.int16]
    touched: NDArray[np.bool_]
    visited: NDArray[np.bool_]

    @property
    def checkpoints(self) -> NDArray[np.float32]:
        """(E, 21, 28) joint checkpoints."""
        return self.joints[:, ::CHECKPOINT_SPACING]


def play(policy: Policy, episodes: Sequence[Episode], salt: str, split: str) -> list[tuple[Rollout, Motion]]:
    """Lets a policy explore, side by side in this process: the same rollouts as an evaluation's, and each step's joints.

    Args:
        policy: it is reset here.
        episodes: at least one.
        salt: hexadecimal digits that the policy's random numbers come from.
        split: of the objects.

    Raises:
        InvalidInputError: unknown object or pose.
        AssetError: an object or the hand is not prepared.
        UserCodeError: the policy raised something.
    """
    policy.reset(len(episodes), [policy_seed(salt, episode) for episode in episodes])
    played = _run(episodes, policy.control_mode, split, lambda _, observation: policy.act(observation))
    found = []
    for row, (name, pose, seed) in enumerate(episodes):
        grids = (played.touched[row], played.visited[row], played.touched_step[row])
        rollout = Rollout(name, pose, int(seed), played.actions[row], *grids, played.checkpoints[row].copy())
        found.append((rollout, Motion(played.joints[row], played.touch[row], "live")))
    return found


def replays() -> MotionSource:
    """Stored episodes, simulated again: for pages of submissions and rollout files."""
    return MotionSource("replayed", replay_motions)


def replay_motions(rollouts: Sequence[Rollout], control_mode: str, split: str) -> list[Motion]:
    """Every step of rollouts: their actions played again, or, where that departs from them, between their checkpoints.

    Args:
        control_mode: of the actions; empty: whichever reproduces.
    """
    if not rollouts:
        return []
    episodes = [(rollout.object, rollout.pose, rollout.seed) for rollout in rollouts]
    actions = np.stack([rollout.actions for rollout in rollouts], axis=1)
    motions: list[Motion] = []
    modes = [control_mode] if control_mode else list(CONTROL_MODES)
    try:
        runs = [_run(episodes, mode, split, lambda step, _: actions[step]) for mode in modes]
    except BenchmarkError as error:  # the hand or an object is not prepared
        return [interpolate(rollout, f"It was not simulated again: {error}") for rollout in rollouts]
    for row, rollout in enumerate(rollouts):
        verdicts = [judge(rollout, Replay(p.checkpoints, p.touched_step, p.visited), row, None) for p in runs]
        good = next((k for k, verdict in enumerate(verdicts) if verdict.departed is None), None)
        if good is None:
            departed, step = verdicts[0].departed, verdicts[0].step
            by = "" if step is None else f", by step {step + 1}"
            why = f"Simulated again on this machine, the actions lead to {_NO_WAY.get(departed or '', departed)}{by}."
            motions.append(interpolate(rollout, why))
            continue
        motions.append(
            Motion(
                runs[good].joints[row],
                runs[good].touch[row],
                "replayed",
                "The stored actions were simulated again on this machine, and the episode reproduces bit for bit.",
            )
        )
    return motions


def _run(
    episodes: Sequence[Episode],
    control_mode: str,
    split: str,
    act: Callable[[int, Mapping[str, NDArray]], NDArray[np.float32]],
) -> _Played:
    """Plays whole episodes; ``act`` is given the step and the observation (E, ...)."""
    if not episodes:
        raise InvalidInputError("episodes: none given; name an object and a pose")
    names = [name for name, _, _ in episodes]
    settings = BatchSettings(
        objects=tuple(dict.fromkeys(names)), split=split, control_mode=control_mode, reward_mode="contact"
    )
    count = len(episodes)
    hands = HandBatch(count, settings, autoreset=False)
    starts = [episode_seed(pose, seed) for _, pose, seed in episodes]
    hands.reset(starts, range(count), names, [pose for _, pose, _ in episodes])
    actions = np.zeros((count, HORIZON, NUM_JOINTS), dtype=np.float32)
    joints = np.zeros((count, HORIZON + 1, NUM_JOINTS), dtype=np.float32)
    touch = np.zeros((count, HORIZON, len(SKIN_LINKS)), dtype=bool)
    joints[:, 0] = hands.arrays["qpos"]
    for step in range(HORIZON):
        actions[:, step] = act(step, observation_to_numpy({name: hands.arrays[name] for name in OBSERVATION_ARRAYS}))
        hands.arrays["action"][:] = actions[:, step]
        hands.step()
        joints[:, step + 1] = hands.arrays["qpos"]
        touch[:, step] = hands.arrays["touch"]
    touched_step = hands.state()["touched_step"].astype(np.int16)
    occupancy = hands.arrays["occupancy"].astype(bool)
    return _Played(actions, joints, touch, touched_step, occupancy[:, 0].copy(), occupancy[:, 1].copy())
