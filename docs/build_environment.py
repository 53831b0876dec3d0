"""Writes docs/environment.md from the environment's own spaces and constants.

python docs/build_environment.py           # write
python docs/build_environment.py --check   # fail if the file is out of date
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import tyro
from sections import table, write_or_check

import tslam_bench  # noqa: F401  (registers the environment)
from tslam_bench.cli.environments import action_rows, environment_rows, reward_rows
from tslam_bench.constants import ENVIRONMENT_ID, TABLETOP_ID
from tslam_bench.engine.spaces import observation_rows
from tslam_bench.hand_constants import SKIN_LINKS

TARGET = Path(__file__).parent / "environment.md"

VECTOR = """\
`gymnasium.make_vec("TactileSLAM-v0", num_envs=16, split="train")` and `tslam_bench.make_vec("TactileSLAM-v0", 16, split="train")`
are the same vector environment, with the same arguments. Gymnasium's modes `sync` and `async` are not meant for it.

On the CPU, results have the form of `gymnasium.vector.SyncVectorEnv` with autoreset `SAME_STEP`. Where an episode ends,
observation and `info` are the next episode's first. `info["final_obs"]` is an array of objects: an environment's true last
observation, a dict of arrays without the batch axis, or None. `info["final_info"]` holds the last step's numbers. Each entry of
an info has a mask (`_final_obs`, `_new_touched`). A `reset_mask` needs one full reset before it.

`RecordEpisodeStatistics` and Gymnasium's other vector wrappers of actions, rewards and infos take it. Its wrappers of
observations, and its conversion to torch, take no environment that resets in the same step.

`processes=0` steps in the caller's own process, for notebooks, daemonic pools and debuggers. It needs no
`if __name__ == "__main__":`, and an error has its own traceback. The number of processes does not change a bit.

On CUDA, values are torch tensors on the device. `info["final_obs"]` is an array of objects there too, with tensors in its
observations. Gymnasium's wrappers compute with numpy and do not take these results."""


@dataclass(frozen=True)
class Config:
    """Writes or checks docs/environment.md."""

    check: bool = False
    """Only compare; exit with status 1 if the file is out of date."""


def rows_table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of rows with the same keys."""
    return table(list(rows[0]), [[_cell(value) for value in row.values()] for row in rows]).strip()


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"`{value}`" if isinstance(value, str) and " " not in value else str(value)  # names, not sentences


def page() -> str:
    """The page's text."""
    environment = gymnasium.make(ENVIRONMENT_ID, object="mug")
    manual = inspect.cleandoc(type(environment.unwrapped).__doc__ or "")
    environment.close()
    tabletop = gymnasium.make(TABLETOP_ID, object="mug")
    tabletop_manual = inspect.cleandoc(type(tabletop.unwrapped).__doc__ or "")
    tabletop.close()
    parts = [
        "# Environment",
        "<!-- Written by docs/build_environment.py: change the code, not this page. -->",
        "## Registered ids",
        rows_table(environment_rows()),
        f"## `{ENVIRONMENT_ID}`",
        f"```text\n{manual}\n```",
        f"## `{TABLETOP_ID}`",
        f"```text\n{tabletop_manual}\n```",
        "## Many environments",
        VECTOR,
        "## Observations",
        "Per environment; every value is batched `(num_envs, ...)`. `touch` follows the order of the skin links: "
        + ", ".join(f"`{name}`" for name in SKIN_LINKS)
        + ".",
        rows_table(observation_rows()),
        "## Actions",
        "One number in [-1, 1] per joint. `delta_per_step` is the change of the target at action 1 in `pd_joint_delta_pos`.",
        rows_table(action_rows()),
        "## Reward modes",
        rows_table(reward_rows()),
    ]
    return "\n\n".join(parts) + "\n"


def main(config: Config) -> None:
    """Writes the page, or compares it."""
    write_or_check({TARGET: page()}, config.check)


if __name__ == "__main__":
    main(tyro.cli(Config))
