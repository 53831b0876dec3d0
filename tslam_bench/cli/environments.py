"""``tslam-bench env``: list the environments, describe their spaces, record a video."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from tslam_bench.cli.commands import run_command
from tslam_bench.cli.progress import Progress
from tslam_bench.constants import (
    CONTROL_STEP_SECONDS,
    ENVIRONMENT_ID,
    HORIZON,
    NUM_JOINTS,
    PRIVILEGED_REWARD_MODES,
    REWARD_MODES,
)
from tslam_bench.engine.spaces import observation_rows
from tslam_bench.errors import AssetError, InvalidInputError
from tslam_bench.hand_constants import DELTA_STEP, FORCE_LIMIT, JOINT_LIMITS, JOINT_NAMES
from tslam_bench.variants import VARIANTS, get_variant


@dataclass(frozen=True)
class List:
    """List the environment ids."""

    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Describe:
    """Print the tables of actions, observations and reward modes, generated from the environments' own constants."""

    environment: Annotated[str, tyro.conf.Positional] = ENVIRONMENT_ID
    """Environment id."""
    json: bool = False
    """Print JSON instead of tables."""


@dataclass(frozen=True)
class Video:
    """Record one episode of a policy as an animated picture (needs a Vulkan device)."""

    environment: str = ENVIRONMENT_ID
    """Environment id."""
    object: str = "mug"
    """A prepared object of any split."""
    pose: int = 0
    """Pose, one of the environment's."""
    policy: str = "heuristic"
    """Policy: an id (tslam-bench baselines list), or your own as module:Class or path/to/file.py:Class."""
    policy_arguments: tuple[str, ...] = ()
    """Arguments of its class: key=value pairs or one JSON object."""
    model: Path | None = None
    """Trained model, if it needs one."""
    seed: int = 0
    """Seed of the episode."""
    every: int = 2
    """Keep every n-th control step."""
    output: Path = Path("video.webp")
    """File to write (.webp or .gif)."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench env`` with the given arguments. Raises BenchmarkError for bad input."""
    commands = {"list": (List, _list), "describe": (Describe, _describe), "video": (Video, _video)}
    run_command("tslam-bench env", "The environments: ids, spaces, and pictures.", commands, arguments)


def environment_rows() -> list[dict[str, Any]]:
    """One record per registered environment id."""
    return [
        {
            "id": variant.id,
            "summary": variant.summary,
            "poses": len(variant.poses),
            "horizon": HORIZON,
            "seconds": round(HORIZON * CONTROL_STEP_SECONDS, 2),
            "actions": NUM_JOINTS,
        }
        for variant in VARIANTS.values()
    ]


def action_rows() -> list[dict[str, Any]]:
    """One record per action, in order."""
    rows = []
    for index, name in enumerate(JOINT_NAMES):
        unit = "m" if name in ("ARTx", "ARTy", "ARTz") else "rad"
        low, high = (float(v) for v in JOINT_LIMITS[index])
        rows.append(
            {
                "index": index,
                "joint": name,
                "lower": low,
                "upper": high,
                "unit": unit,
                "delta_per_step": float(DELTA_STEP[index]),
                "force_limit": float(FORCE_LIMIT[index]),
            }
        )
    return rows


def reward_rows() -> list[dict[str, Any]]:
    """One record per reward mode."""
    return [{"reward_mode": mode, "privileged": mode in PRIVILEGED_REWARD_MODES} for mode in REWARD_MODES]


def _print_rows(title: str, rows: Sequence[dict[str, Any]]) -> None:
    table = Table(title=title)
    for index, heading in enumerate(rows[0]):
        table.add_column(heading, no_wrap=index == 0)  # a name must not be cut
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    console = Console()
    console = Console(width=max(console.width, 100))  # a pipe has no width
    console.print(table)


def _list(command: List) -> None:
    rows = environment_rows()
    print(json.dumps(rows, indent=2)) if command.json else _print_rows("environments", rows)


def _describe(command: Describe) -> None:
    get_variant(command.environment)  # all have the same spaces
    tables = {
        "observations": observation_rows(),
        "actions": action_rows(),
        "reward modes": reward_rows(),
    }
    if command.json:
        print(json.dumps(tables, indent=2).replace("Infinity", "null"))
        return
    for title, rows in tables.items():
        _print_rows(title, rows)


def _video(command: Video) -> None:
    import gymnasium
    import numpy as np
    from PIL import Image

    from tslam_bench.engine.rendering import NO_VULKAN, vulkan_device_available
    from tslam_bench.files import atomic_file, check_output

    variant = get_variant(command.environment)
    if command.output.suffix not in (".webp", ".gif"):
        raise InvalidInputError(f"{command.output}: unknown kind of video; end the name in .webp or .gif")
    check_output(command.output)
    if not vulkan_device_available():
        raise AssetError(f"video: {NO_VULKAN}")
    from tslam_bench.evaluation.policies import make_baseline, policy_label
    from tslam_bench.evaluation.policy import CheckedPolicy
    from tslam_bench.plugins import parse_arguments

    made = make_baseline(command.policy, command.model, **parse_arguments(command.policy_arguments))
    explorer = CheckedPolicy(made, policy_label(command.policy))
    environment = gymnasium.make(
        variant.id,
        object=command.object,
        pose=command.pose,
        control_mode=explorer.control_mode,
        render_mode="rgb_array",
    )
    observation, _ = environment.reset(seed=command.seed)
    explorer.reset(1, command.seed)
    frames = []
    with Progress("steps", "step", HORIZON) as bar:
        for step in range(HORIZON):
            action = explorer.act({key: value.numpy() for key, value in observation.items()})
            observation, *_ = environment.step(action)
            if step % command.every == 0:
                frames.append(Image.fromarray(np.asarray(environment.render())[0]))
            bar.show(step + 1)
    environment.close()
    milliseconds = round(1000 * CONTROL_STEP_SECONDS * command.every)
    with atomic_file(command.output) as temporary:
        frames[0].save(temporary, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
    print(f"{command.output}: {len(frames)} frames")
