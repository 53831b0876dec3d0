"""Registers the environment ids with Gymnasium, without importing the simulator."""

from __future__ import annotations

from typing import Any

import gymnasium

from tslam_bench.constants import ENVIRONMENT_ID

ENVIRONMENT_IDS = (ENVIRONMENT_ID,)
"""Every id that the package registers."""


def make_environment(environment_id: str, **kwargs: Any) -> gymnasium.Env:
    """Makes the unwrapped environment; what ``gymnasium.make`` calls."""
    from mani_skill.utils import registration

    import tslam_bench.tasks.tactile_slam  # noqa: F401  (registers with ManiSkill)

    return registration.make(environment_id, **kwargs)


def register_environments() -> None:
    """Registers every id; safe to call twice. The environments truncate themselves at the horizon, batched."""
    for environment_id in ENVIRONMENT_IDS:
        if environment_id in gymnasium.registry:
            continue
        gymnasium.register(
            environment_id,
            entry_point="tslam_bench.registration:make_environment",
            disable_env_checker=True,  # ManiSkill environments return batched tensors, which the checker refuses
            kwargs={"environment_id": environment_id},
        )
