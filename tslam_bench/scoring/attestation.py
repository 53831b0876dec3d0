"""What an organiser found who ran a submission's own code (protocol section 12, *attested*): part of a verification record."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

MOST_DROP: Final = 0.02
"""By so much the IoU area of fresh episodes may be below the claimed one, beside what chance does."""
STANDARD_ERRORS: Final = 3.0
"""Chance: standard errors of the mean difference over objects."""
LEAST_COLLAPSE: Final = 0.3
"""With another object's touches, at least this share of the IoU has to go."""
ROTATED_SHARE: Final = 0.8
"""Less than this share of the IoU left with turned touches is remarked on."""


@dataclass(frozen=True)
class Attestation:
    """Results of running the code of a submission, shut in.

    Attributes:
        policy, reconstructor: what ran: reference, arguments, hashes of model and source file.
        confinement: how it was shut in, ``policy`` and ``reconstructor`` -> ``network`` and ``files`` -> how.
        limits: what it might use.
        salt: the organiser's own; order and fresh episodes come from it.
        fresh_seed: repetition of the fresh episodes.
        episodes, departed_actions: episodes whose actions were computed again, and those where they are others.
        shapes, departed_shapes: reconstructions that were computed again, and those that are others.
        claimed, fresh: object -> mean IoU area of the submission, and of fresh episodes.
        own, swapped, turned: object -> IoU after 8 poses from its own touches, with another object's touches, and with its
            own turned; ``swapped`` is empty where there is only one object.
    """

    policy: Mapping[str, Any]
    reconstructor: Mapping[str, Any]
    confinement: Mapping[str, Mapping[str, str]]
    limits: Mapping[str, Any]
    salt: str
    fresh_seed: int
    episodes: int
    departed_actions: Sequence[str]
    shapes: int
    departed_shapes: Sequence[str]
    claimed: Mapping[str, float]
    fresh: Mapping[str, float]
    own: Mapping[str, float]
    swapped: Mapping[str, float]
    turned: Mapping[str, float]

    def failures(self) -> list[str]:
        """Why the entry is not attested, a line each; empty if it is."""
        lines = []
        for what, departed, count in (
            ("actions", self.departed_actions, self.episodes),
            ("reconstructions", self.departed_shapes, self.shapes),
        ):
            if departed:
                more = f" and {len(departed) - 5} more" if len(departed) > 5 else ""
                lines.append(
                    f"{what} are not those that the code computes: {len(departed)} of {count}: "
                    f"{'; '.join(departed[:5])}{more}"
                )
        drops = np.array([self.claimed[name] - self.fresh[name] for name in self.claimed])
        chance = STANDARD_ERRORS * float(drops.std(ddof=1)) / math.sqrt(len(drops)) if len(drops) > 1 else 0.0
        if drops.mean() > MOST_DROP + chance:
            lines.append(
                f"fresh episodes reach IoU area {_mean(self.fresh):.3f}, the claim is {_mean(self.claimed):.3f}: "
                f"{drops.mean():.3f} more, where chance explains {chance:.3f}"
            )
        if not self.swapped:
            lines.append("one object alone: no touches to swap; give two objects or more")
        elif _mean(self.swapped) > (1 - LEAST_COLLAPSE) * _mean(self.own):
            lines.append(
                f"with another object's touches the IoU stays at {_mean(self.swapped):.3f} of {_mean(self.own):.3f}: "
                "the shapes do not come from the touches"
            )
        return lines

    def flags(self) -> list[str]:
        """What a reader should know of an entry that is attested."""
        lines = []
        if _mean(self.turned) < ROTATED_SHARE * _mean(self.own):
            lines.append(
                f"flag: with turned touches the IoU is {_mean(self.turned):.3f} instead of {_mean(self.own):.3f}: the "
                "reconstructor knows which way its objects stand"
            )
        weak = [name for name, held in self.confinement.items() if "audit hook" in held.values()]
        if weak:
            lines.append(
                f"the code of {' and '.join(weak)} was confined by an audit hook alone, which stops mistakes, not attackers"
            )
        return lines

    def summary(self) -> str:
        """One line for readers of figures."""
        failures = self.failures()
        if failures:
            return f"not attested: {'; '.join(failures)}"
        swapped = f"swapped touches {_mean(self.swapped):.3f}, turned {_mean(self.turned):.3f}"
        return (
            f"attested: the code gives all {self.episodes} episodes' actions and all {self.shapes} reconstructions; IoU area "
            f"{_mean(self.claimed):.3f} claimed, {_mean(self.fresh):.3f} in fresh episodes; IoU {_mean(self.own):.3f}, {swapped}"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}


def _mean(values: Mapping[str, float]) -> float:
    return float(np.mean(list(values.values())))
