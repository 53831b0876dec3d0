"""Observations, rewards and scores keep their bits: hashes recorded on 25 November 2026, before the modules moved.

``python tests/test_golden_bits.py`` records them again; do that only when the protocol changes, and say so in CHANGELOG.md.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import tslam_bench
from tslam_bench.evaluation.policies import make_baseline

FILE = Path(__file__).parent / "golden_bits.json"
OBSERVED = ("qpos", "qvel", "touch", "occupancy", "time")
EPISODES = {
    "free, delta, tslam": ("TactileSLAM-v0", "pd_joint_delta_pos", "tslam"),
    "free, absolute, disagreement": ("TactileSLAM-v0", "pd_joint_pos", "disagreement"),
    "tabletop, delta, chamfer": ("TactileSLAM-Tabletop-v0", "pd_joint_delta_pos", "chamfer"),
}
BATCHES = {"batch, delta, knn": ("pd_joint_delta_pos", "knn", 1), "batch, absolute, held": ("pd_joint_pos", "tslam", 4)}


def _add(digest: Any, *arrays: Any) -> None:
    for array in arrays:
        digest.update(np.ascontiguousarray(np.asarray(array)).tobytes())


def episode_hash(environment_id: str, control_mode: str, reward_mode: str) -> str:
    """Hash of everything that one episode of ``gymnasium.make`` returns under a scripted policy."""
    env = gym.make(
        environment_id, object="mug", split="test", pose=2, control_mode=control_mode, reward_mode=reward_mode
    )
    policy = make_baseline("heuristic" if control_mode == "pd_joint_delta_pos" else "random_targets")
    policy.reset(1, 5)
    digest, touched = hashlib.sha256(), 0
    try:
        observation, _ = env.reset(seed=7)
        for _ in range(200):
            _add(digest, *(observation[name] for name in OBSERVED))
            action = policy.act({name: np.asarray(observation[name]) for name in OBSERVED})[0]
            observation, reward, terminated, truncated, _ = env.step(action)
            touched = int(observation["occupancy"][0, 0].sum())
            _add(digest, reward, terminated, truncated)
        _add(digest, *(observation[name] for name in OBSERVED))
    finally:
        env.close()
    assert touched > 20, "an episode without touches would prove little"
    return digest.hexdigest()


def batch_hash(control_mode: str, reward_mode: str, action_repeat: int) -> str:
    """Hash of what three environments return, past the end of their episodes."""
    envs = tslam_bench.make_vec(
        num_envs=3,
        device="cpu",
        objects=("mug", "hammer"),
        split="test",
        control_mode=control_mode,
        reward_mode=reward_mode,
        processes=2,
        action_repeat=action_repeat,
    )
    policy = make_baseline("heuristic" if control_mode == "pd_joint_delta_pos" else "random_targets")
    policy.reset(3, 6)
    digest = hashlib.sha256()
    try:
        observation, _ = envs.reset(seed=3)
        for _ in range(220 // action_repeat):
            _add(digest, *(observation[name] for name in OBSERVED))
            actions = policy.act(observation)
            observation, reward, terminated, truncated, _ = envs.step(actions)
            _add(digest, reward, terminated, truncated)
    finally:
        envs.close()
    return digest.hexdigest()


def score_hash(folder: Path, reconstructor: str) -> str:
    """Hash of every figure of a scored submission: the heuristic on one object."""
    command = [sys.executable, "-m", "tslam_bench.cli"]
    name = f"heuristic-{reconstructor}"
    if not (folder / "submissions" / name).is_dir():
        options = ["--objects", "mug", "--reconstructor", "grid", "hull", "carve", "--policy-salt", "2021"]
        subprocess.run([*command, "evaluate", "--policy", "heuristic", *options, "--output", folder], check=True)
    output = folder / f"{name}.json"
    subprocess.run(
        [*command, "score", folder / "submissions" / name, "--objects", "mug", "--output", output], check=True
    )
    score = json.loads(output.read_text(encoding="utf-8"))
    figures = [score["results"], score["aggregate"]]
    return hashlib.sha256(json.dumps(figures, sort_keys=True).encode()).hexdigest()


@pytest.fixture(scope="module")
def recorded() -> dict[str, str]:
    return json.loads(FILE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("golden")


@pytest.mark.parametrize("name", EPISODES)
def test_an_episode_keeps_its_bits(name: str, recorded: dict[str, str]) -> None:
    assert episode_hash(*EPISODES[name]) == recorded[name]


@pytest.mark.parametrize("name", BATCHES)
def test_a_batch_keeps_its_bits(name: str, recorded: dict[str, str]) -> None:
    assert batch_hash(*BATCHES[name]) == recorded[name]


@pytest.mark.parametrize("reconstructor", ["grid", "hull", "carve"])
def test_scores_keep_their_bits(reconstructor: str, evaluated: Path, recorded: dict[str, str]) -> None:
    assert score_hash(evaluated, reconstructor) == recorded[f"score, {reconstructor}"]


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as scratch:
        values = {name: episode_hash(*arguments) for name, arguments in EPISODES.items()}
        values |= {name: batch_hash(*arguments) for name, arguments in BATCHES.items()}
        values |= {f"score, {name}": score_hash(Path(scratch), name) for name in ("grid", "hull", "carve")}
    FILE.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
