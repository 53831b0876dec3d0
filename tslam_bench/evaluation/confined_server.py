"""What a process that is shut in does: makes one policy or one reconstructor, and answers for it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tslam_bench.errors import BenchmarkError, UserCodeError
from tslam_bench.evaluation.messages import Message, decode, encode


def serve(config: Mapping[str, Any], held: Mapping[str, str], requests: int, answers: int) -> None:
    """Answers requests until there are no more.

    Args:
        config: ``kind`` (``policy`` or ``reconstructor``), ``code`` (id or reference), ``model`` (path or None), ``arguments``.
        held: how the process is confined. Told before the stranger's code is there, which could tell anything.
        requests, answers: file descriptors.
    """

    def read(count: int) -> bytes:
        data = bytearray()
        while len(data) < count:
            part = os.read(requests, count - len(data))
            if not part:
                raise EOFError
            data += part
        return bytes(data)

    def write(header: Mapping[str, Any], arrays: Mapping[str, NDArray] | None = None) -> None:
        data = memoryview(encode(header, arrays))
        while data:
            data = data[os.write(answers, data) :]

    write({"confinement": dict(held)})
    try:
        made, mode = _make(config)
    except BenchmarkError as error:
        write(_refusal(error))
        return
    write({"control_mode": mode})
    while True:
        try:
            request = decode(read)
        except EOFError:
            return
        try:
            answer = _answer(made, request)
        except Exception as error:
            write(_refusal(error))
            return
        write(*answer)


def _make(config: Mapping[str, Any]) -> tuple[Any, str]:
    """The policy and its control mode, or the reconstructor and nothing."""
    model = None if config["model"] is None else Path(config["model"])
    if config["kind"] == "policy":
        from tslam_bench.evaluation.policies import make_baseline

        policy = make_baseline(config["code"], model, **config["arguments"])
        return policy, policy.control_mode
    from tslam_bench.reconstruction.registry import make_reconstructor

    return make_reconstructor(config["code"], model, objects=config["learning_objects"]), ""


def _answer(made: Any, request: Message) -> Message:
    header, arrays = request
    if header["do"] == "reset":
        made.reset(header["num_envs"], header["seeds"])
        return {}, {}
    if header["do"] == "act":
        actions = np.asarray(made.act({name: array.copy() for name, array in arrays.items()}))
        return {"type": str(actions.dtype)}, {"actions": actions.astype("<f4")}
    volume = made.reconstruct(arrays["touched"].astype(bool), arrays["visited"].astype(bool))
    return {"interpolation": str(volume.interpolation)}, {"probability": volume.probability.astype("<f2")}


def _refusal(error: Exception) -> dict[str, Any]:
    text = " ".join(str(error).split())[:500]
    if isinstance(error, BenchmarkError):
        return {"error": text, "theirs": isinstance(error, UserCodeError)}
    return {"error": f"raised {type(error).__name__}: {text}", "theirs": True}
