"""Interrupts, kills, closes and partial resets at random moments: does the vector environment ever give a wrong answer?

python benchmarks/soak.py --steps 100000 --events 200 --output soak.json

An environment with worker processes is disturbed; another one, stepped in this process, is not, and gets every call that the
first one answered. All that both return has to be the same, bit for bit. After a disturbance the first one either answers the
next call as the other does, or says that it is broken; then its processes have to be gone, and a new one is made.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import re
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import tyro

import tslam_bench
from tslam_bench.constants import NUM_JOINTS
from tslam_bench.engine.hand_workers import WorkerError
from tslam_bench.files import write_json

KINDS: Final = ("interrupt", "kill", "reset", "close")
_PATIENCE: Final = 20.0
"""Seconds after which a process that should have ended counts as left behind."""


@dataclass(frozen=True)
class Config:
    """Disturbs a vector environment and compares it with one that is left alone."""

    steps: int = 100_000
    """Control steps of all hands together."""
    events: int = 200
    """Disturbances: as many of each kind."""
    num_envs: int = 3
    """Hands."""
    processes: int = 2
    """Worker processes of the disturbed environment."""
    objects: tuple[str, ...] = ("mug", "hammer", "toruslarge")
    """Objects that episodes draw from."""
    seed: int = 0
    """Of actions, episodes and disturbances."""
    output: Path | None = None
    """JSON file for the figures."""


@dataclass
class Figures:
    """What happened.

    Attributes:
        steps: control steps that were compared.
        calls: calls that were answered, and compared.
        touches: voxels touched for the first time, all episodes together: the comparison includes contact.
        episodes: ends of episodes among them.
        outcomes: disturbance, and what became of it -> count.
        environments: environments made.
        wrong: what should not have been: wrong answers, raw errors, things left behind.
        left: processes, open files and bytes of shared memory more than at the start.
    """

    steps: int = 0
    calls: int = 0
    touches: int = 0
    episodes: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    environments: int = 0
    wrong: list[str] = field(default_factory=list)
    left: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0


class Interruption(Exception):
    """What a signal handler of the user's raises."""


class Soak:
    """One run: two environments, random numbers, figures."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.figures = Figures()
        self.random = np.random.Generator(np.random.PCG64(config.seed))
        self.seconds: dict[str, float] = {}  # of the calls so far, on average
        self.alone = self._make(0)
        self.before = _resources()
        self.envs = self._make(config.processes)
        self._begin()

    def run(self) -> Figures:
        """All of it."""
        config, figures = self.config, self.figures
        kinds = [KINDS[event % len(KINDS)] for event in range(config.events)]
        self.random.shuffle(kinds)
        moments = np.sort(self.random.integers(0, config.steps, config.events))
        started = time.monotonic()
        for moment, kind in zip(moments, kinds, strict=True):
            while figures.steps < moment:
                self._both("step", self._actions())
            getattr(self, f"_{kind}")()
        while figures.steps < config.steps:
            self._both("step", self._actions())
        self.envs.close()
        self._check_gone("at the end")
        gc.collect()
        figures.left = {name: value - self.before[name] for name, value in _resources().items()}
        figures.wrong += [
            f"left behind: {value} {name}" for name, value in figures.left.items() if value > _ALLOWED[name]
        ]
        self.alone.close()
        figures.seconds = round(time.monotonic() - started, 1)
        return figures

    # -- disturbances -----------------------------------------------------------------------------------------------
    def _interrupt(self) -> None:
        """An exception comes out of a signal handler, or Ctrl-C, somewhere in a call."""
        error = (Interruption, KeyboardInterrupt)[int(self.random.integers(2))]

        def ring() -> None:
            raise error

        if self.random.random() < 0.1:
            self._interrupt_making(ring)
            return
        name = str(self.random.choice(["step", "step", "step", "reset", "state"]))
        arguments = {"step": (self._actions(),), "reset": (), "state": ()}[name]
        keywords = {"seed": self._seed()} if name == "reset" else {}
        try:
            with self._moment(self.seconds.get(name, 0.01), ring):
                answer = getattr(self.envs, name)(*arguments, **keywords)
        except (Interruption, KeyboardInterrupt):
            self._after(f"interrupt in {name}")
            return
        self.figures.outcomes[f"interrupt in {name}: came too late"] += 1
        self._compare(name, answer, getattr(self.alone, name)(*arguments, **keywords))

    def _interrupt_making(self, ring: Callable[[], None]) -> None:
        self.envs.close()
        try:
            with self._moment(self.seconds.get("make", 2.0), ring):
                self.envs = self._make(self.config.processes)
        except (Interruption, KeyboardInterrupt):
            self.figures.outcomes["interrupt in making: none was made"] += 1
            self._check_gone("an interrupt while it was made")
            self.envs = self._make(self.config.processes)
        else:
            self.figures.outcomes["interrupt in making: came too late"] += 1
        self._begin()

    def _kill(self) -> None:
        """The system kills a worker somewhere in a step, or between two."""
        process = self.envs._hands.processes[int(self.random.integers(self.config.processes))]
        for call in range(4):
            actions = self._actions()
            try:
                with (
                    self._moment(self.seconds.get("step", 0.01), process.kill) if not call else contextlib.nullcontext()
                ):
                    answer = self.envs.step(actions)
                    if not call:
                        time.sleep(self.random.uniform(0, 0.01))
                if not call:
                    process.kill()
            except WorkerError:
                self._after("kill")
                return
            self._compare("step", answer, self.alone.step(actions))
        self.figures.wrong.append("a killed worker was not noticed")
        self._renew()

    def _reset(self) -> None:
        """Some hands begin anew, with a seed or without, with an object and pose or without."""
        mask = self.random.random(self.config.num_envs) < 0.5
        options: dict[str, Any] = {"reset_mask": mask}
        if self.random.random() < 0.5:
            options["object"] = str(self.random.choice(self.config.objects))
        if self.random.random() < 0.5:
            options["pose"] = int(self.random.integers(8))
        self.figures.outcomes[f"reset of {int(mask.sum())}"] += 1
        self._both("reset", seed=self._seed() if self.random.random() < 0.5 else None, options=options)
        self._both("state")

    def _close(self) -> None:
        """It is closed in the middle of a step, or the closing is interrupted."""
        if self.random.random() < 0.5:
            actions = self._actions()
            try:
                with self._moment(self.seconds.get("step", 0.01), self.envs.close):
                    answer = self.envs.step(actions)
            except WorkerError:
                self._after("close in step")
                return
            self._compare("step", answer, self.alone.step(actions))
            self.envs.close()
            self._after("close between steps")
            return

        def ring() -> None:
            raise Interruption

        with contextlib.suppress(Interruption), self._moment(0.03, ring):
            self.envs.close()
        self.envs.close()
        self._after("close")

    # -- what has to hold afterwards --------------------------------------------------------------------------------
    def _after(self, event: str) -> None:
        """The environment goes on as the other does, or says in every call that it is broken and has left nothing."""
        refused = []
        for call in (self.envs.state, lambda: self.envs.step(self._actions()), lambda: self.envs.reset(seed=1)):
            try:
                call()
            except WorkerError as error:
                refused.append(str(error))
        if not refused:
            self.figures.outcomes[f"{event}: goes on"] += 1
            self._begin()
            return
        self.figures.outcomes[f"{event}: says that it is broken"] += 1
        if len(refused) < 3 or any("\n" in text for text in refused):
            self.figures.wrong.append(f"{event}: only some calls say that it is broken: {refused}")
        self._check_gone(event)
        self._renew()

    def _renew(self) -> None:
        self.envs.close()
        self.envs = self._make(self.config.processes)
        self._begin()

    def _begin(self) -> None:
        self._both("reset", seed=self._seed())

    def _check_gone(self, event: str) -> None:
        deadline = time.monotonic() + _PATIENCE
        while _children() and time.monotonic() < deadline:
            time.sleep(0.02)
        if _children():
            self.figures.wrong.append(f"{event}: {len(_children())} processes go on")

    # -- calls ------------------------------------------------------------------------------------------------------
    def _make(self, processes: int) -> Any:
        started = time.monotonic()
        envs = tslam_bench.make_vec(
            num_envs=self.config.num_envs, device="cpu", objects=self.config.objects, processes=processes
        )
        if processes:
            self._took("make", started)
            self.figures.environments += 1
        return envs

    def _both(self, name: str, *arguments: Any, **keywords: Any) -> None:
        """A call that nobody disturbs, of both."""
        started = time.monotonic()
        answer = getattr(self.envs, name)(*arguments, **keywords)
        self._took(name, started)
        self._compare(name, answer, getattr(self.alone, name)(*arguments, **keywords))

    def _compare(self, name: str, answer: Any, expected: Any) -> None:
        different = difference(answer, expected)
        if different is not None:
            self.figures.wrong.append(f"call {self.figures.calls}, {name}: {different} differs")
            self._begin_both_anew()
        self.figures.calls += 1
        if name == "step":
            self.figures.steps += self.config.num_envs
            self.figures.touches += int(expected[4]["new_touched"].sum())
            self.figures.episodes += int(expected[3].sum())

    def _begin_both_anew(self) -> None:
        """After a difference: else each later call would be one."""
        seed = self._seed()
        for envs in (self.envs, self.alone):
            envs.reset(seed=seed)

    def _took(self, name: str, started: float) -> None:
        seconds = time.monotonic() - started
        self.seconds[name] = 0.8 * self.seconds.get(name, seconds) + 0.2 * seconds

    def _actions(self) -> Any:
        """(E, 28) random actions whose arm goes down, where the object is."""
        actions = self.random.uniform(-1, 1, (self.config.num_envs, NUM_JOINTS)).astype(np.float32)
        actions[:, 1] -= 0.5
        return actions

    def _seed(self) -> int:
        return int(self.random.integers(2**31))

    @contextlib.contextmanager
    def _moment(self, seconds: float, what: Callable[[], None]) -> Iterator[None]:
        """Calls ``what`` from a signal handler at a random moment of a call that takes so many seconds."""
        armed = True

        def ring(*_: object) -> None:
            if armed:
                what()

        before = signal.signal(signal.SIGALRM, ring)
        signal.setitimer(signal.ITIMER_REAL, float(self.random.uniform(1e-5, 1.2 * seconds)))
        try:
            yield
        finally:
            armed = False
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)


def difference(answer: Any, expected: Any, where: str = "answer") -> str | None:
    """Where two answers differ in a bit, a type or a key; None if nowhere."""
    if type(answer) is not type(expected):
        return f"{where} (type)"
    if isinstance(expected, dict):
        if answer.keys() != expected.keys():
            return f"{where} (keys)"
        parts: Any = [(f"{where}[{key!r}]", answer[key], expected[key]) for key in expected]
    elif isinstance(expected, (list, tuple)) or (isinstance(expected, np.ndarray) and expected.dtype == object):
        if len(answer) != len(expected):
            return f"{where} (length)"
        parts = [
            (f"{where}[{index}]", one, other) for index, (one, other) in enumerate(zip(answer, expected, strict=True))
        ]
    elif isinstance(expected, np.ndarray):
        same = (
            answer.dtype == expected.dtype and answer.shape == expected.shape and answer.tobytes() == expected.tobytes()
        )
        return None if same else where
    else:
        return None if answer == expected else where
    return next((found for name, one, other in parts if (found := difference(one, other, name)) is not None), None)


_ALLOWED: Final = {
    "processes": 0,
    "open files": 16,
    "named blocks of shared memory": 0,
    "megabytes of shared memory": 4,
}
"""What may be more at the end than at the start, however many environments there were: Python's allocator of shared memory keeps
up to 4 MB of blocks, each with two open files, for the next environment; its resource tracker has a pipe."""


def _resources() -> dict[str, int]:
    """What this process has (Linux; elsewhere only its children)."""
    maps, shared = Path("/proc/self/maps"), Path("/dev/shm")
    mapped = 0
    if maps.is_file():
        for line in maps.read_text().splitlines():
            if "pym-" in line:
                low, high = (int(end, 16) for end in line.split()[0].split("-"))
                mapped += high - low
    own = re.compile(rf"pym-{os.getpid()}-|psm_")
    return {
        "processes": len(_children()),
        "open files": sum(1 for _ in Path("/proc/self/fd").iterdir()) if maps.is_file() else 0,
        "named blocks of shared memory": sum(bool(own.match(path.name)) for path in shared.iterdir())
        if shared.is_dir()
        else 0,
        "megabytes of shared memory": mapped >> 20,
    }


def _children() -> list[int]:
    """Processes that this one has started and that have not ended, but for Python's own resource tracker."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, parent = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
            tracker = b"resource_tracker" in (folder / "cmdline").read_bytes()
            if int(parent) == os.getpid() and state != "Z" and not tracker:
                found.append(int(folder.name))
    return found


def main(config: Config) -> None:
    """Prints the figures; exits with 1 if anything was wrong."""
    figures = Soak(config).run()
    outcomes, figures.outcomes = dict(sorted(figures.outcomes.items())), Counter()  # asdict cannot copy a Counter
    value = {"config": {**asdict(config), "output": None}, **asdict(figures), "outcomes": outcomes}
    print(json.dumps(value, indent=2))
    if config.output is not None:
        write_json(config.output, value)
    sys.exit(1 if figures.wrong else 0)


if __name__ == "__main__":
    main(tyro.cli(Config))
