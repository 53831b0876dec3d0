"""A small soak: one disturbance of each kind, and what the soak itself would notice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from soak import KINDS, Config, Soak, difference


def test_no_wrong_answer_and_nothing_left_behind() -> None:
    figures = Soak(Config(steps=300, events=len(KINDS), num_envs=2, objects=("mug", "hammer"))).run()
    assert figures.wrong == []
    assert figures.steps >= 300 and figures.environments >= 2
    assert {kind.split()[0].rstrip(":") for kind in figures.outcomes} == set(KINDS)


class OneBehind:
    """An environment that answers as one does whose pipe holds an answer too many (openai/gym issue 1543)."""

    def __init__(self, envs: Any) -> None:
        self._envs, self._late = envs, None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._envs, name)

    def step(self, actions: Any) -> Any:
        answer = self._envs.step(actions)
        late, self._late = self._late or answer, answer
        return late


def test_an_environment_that_is_one_answer_behind_is_noticed() -> None:
    soak = Soak(Config(steps=12, events=0, num_envs=2, processes=0))
    soak.envs = OneBehind(soak.envs)
    wrong = soak.run().wrong
    assert wrong and "step: answer[0][" in wrong[0] and wrong[0].endswith("differs")


@pytest.mark.parametrize(
    ("one", "other", "where"),
    [
        (np.float32([0.0]), np.float32([-0.0]), "answer"),
        (np.zeros(2, np.float32), np.zeros(2), "answer"),
        ({"a": 1}, {"b": 1}, "answer (keys)"),
        (({"a": [np.zeros(3)]},), ({"a": [np.array([0, 0, 1e-300])]},), "answer[0]['a'][0]"),
        (np.array([None, {"q": np.ones(1)}], object), np.array([None, None], object), "answer[1] (type)"),
        ({"a": [1, "x"]}, {"a": [1, "x"]}, None),
        (np.float64([np.nan]), np.float64([np.nan]), None),
    ],
)
def test_every_bit_is_compared(one: Any, other: Any, where: str | None) -> None:
    assert difference(one, other) == where
