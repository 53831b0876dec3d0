"""Runs the code of a submission, shut in, and says whether the submission is what it gives (protocol section 12: *attested*).

Four questions, each in an order that the organiser's salt shuffles, so that nothing but observations and grids tells an object:
Are the stored actions those that the policy chooses when it sees what the replay shows? Are the stored shapes those that the
reconstructor makes of the touches? Do fresh episodes, whose starts and random numbers the submitter could not choose, reach what
is claimed? And does the score collapse with another object's touches (and stay where touches are turned)?
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tslam_bench.constants import ENVIRONMENT_ID, NUM_POSES
from tslam_bench.episodes import Episode, new_salt, policy_seed, shuffled
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.attest_shapes import Shapes
from tslam_bench.evaluation.confinement import Code, ConfinedCode, ConfinedPolicy, ConfinedReconstructor, Limits
from tslam_bench.evaluation.policies import fixed_model, get_baseline, policy_source
from tslam_bench.evaluation.policy import CheckedPolicy, Policy
from tslam_bench.evaluation.rollouts import roll_out_batch
from tslam_bench.evaluation.verify import verify
from tslam_bench.reconstruction.registry import reconstructor_source
from tslam_bench.registration import make_vec
from tslam_bench.scoring.attestation import Attestation
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import Submission, read_submission
from tslam_bench.scoring.verification import VerificationRecord, record_path

SIDE_BY_SIDE: Final = 8
"""Episodes at a time."""
ACTION_TOLERANCE: Final = 1e-3
"""Actions further apart than this are others: a network's last bits depend on what is computed beside it, no more."""
MOST_OTHER_STEPS: Final = 0.01
"""Share of an episode's steps that may have another action, where a choice was on the edge."""
_NO_SALT: Final = "0"
"""Where a submission names no salt, the policy must not need one."""


@dataclass(frozen=True)
class SubmittedCode:
    """The code behind a submission.

    Attributes:
        policy, reconstructor: registered ids, ``module:Class`` or ``path/to/file.py:Class``; empty: the ids that the
            submission names.
        model: the policy's.
        arguments: of the policy's class.
        reconstructor_model: the reconstructor's.
        learning_objects: see :func:`tslam_bench.evaluation.evaluate.make_reconstructors`.
    """

    policy: str = ""
    reconstructor: str = ""
    model: Path | None = None
    arguments: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    reconstructor_model: Path | None = None
    learning_objects: tuple[str, ...] = ()


def attest(
    path: Path | str,
    code: SubmittedCode,
    output: Path | None = None,
    limits: Limits | None = None,
    salt: str | None = None,
    processes: int = 1,
    split: str = "test",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> VerificationRecord:
    """Replays a submission (:func:`tslam_bench.evaluation.verify.verify`), runs its code, and writes both into the record.

    Args:
        path: folder or zip archive.
        code: what made it.
        output: the record's file; by default beside the submission.
        limits: what the code may use.
        salt: the organiser's own, hexadecimal digits; None draws one. Nobody must know it before.
        processes: that simulate.
        split: of the submission's objects.
        on_progress: called with (stage, done, all).

    Raises:
        InvalidInputError: the submission is refused, an episode does not reproduce, or the code is not there.
        UserCodeError: the code raised something, was too slow, or used too much.
        AssetError: an object is not prepared.
    """
    report = on_progress or (lambda stage, done, total: None)
    record = verify(path, output, None, processes, lambda done, total: report("replay", done, total), split)
    submission = read_submission(path, split=split)
    if record.content_hash != submission.content_hash:
        raise InvalidInputError(f"{submission.location}: changed while it was replayed; run the command again")
    if record.departed:
        raise InvalidInputError(
            f"{submission.location}: {len(record.departed)} of {len(record.verdicts)} episodes do not reproduce, the first is "
            f"{record.departed[0]}; only what reproduces is attested"
        )
    file = record_path(path) if output is None else output
    run = _Run(submission, code, limits or Limits(), salt or new_salt(), file, processes, report)
    try:
        record = dataclasses.replace(record, attestation=run.attestation())
    finally:
        run.close()
    record.write(file)
    return record


class _Run:
    """One run of a submission's code."""

    def __init__(
        self,
        submission: Submission,
        code: SubmittedCode,
        limits: Limits,
        salt: str,
        file: Path,
        processes: int,
        report: Callable[[str, int, int], None],
    ) -> None:
        info = submission.info
        self._submission, self._limits, self._salt = submission, limits, salt
        self._hidden = [Path(submission.location).resolve(), file.resolve()]
        self._processes, self._report = processes, report
        policy = code.policy or info.explorer
        self._policy = Code("policy", policy, code.model, code.arguments)
        self._reconstructor = Code(
            "reconstructor",
            code.reconstructor or info.reconstructor,
            code.reconstructor_model,
            learning_objects=code.learning_objects,
        )
        self._sources = (
            policy_source(policy, dict(code.arguments), code.model),
            reconstructor_source(self._reconstructor.reference, code.reconstructor_model, code.learning_objects),
        )
        self._episodes = submission.episodes()
        self._objects = sorted({name for name, _, _ in self._episodes})
        # A repetition that nobody could foresee; the declared ones are three of 2^31.
        self._fresh_seed = policy_seed(salt, ("", 0, 0)) % 2**31

    def attestation(self) -> Attestation:
        """Asks all questions."""
        departed_actions: list[str] = []
        fresh: dict[Episode, Rollout] = {}
        shut_in: dict[str, Mapping[str, str]] = {}
        for index, (seeds, code) in enumerate(self._players()):
            with self._confined(code) as confined:
                shut_in["policy"] = confined.confinement
                policy = CheckedPolicy(ConfinedPolicy(confined), f"policy {code.reference!r}")
                if policy.control_mode != self._submission.info.control_mode:
                    raise InvalidInputError(
                        f"policy {code.reference!r}: acts by {policy.control_mode}, the submission's actions are of "
                        f"{self._submission.info.control_mode}"
                    )
                departed_actions += self._departed_actions(policy, [e for e in self._episodes if e[2] in seeds])
                if index == 0:
                    fresh = self._fresh_episodes(policy)
        with self._confined(self._reconstructor) as confined:
            shut_in["reconstructor"] = confined.confinement
            made = ConfinedReconstructor(confined, self._reconstructor.reference)
            shapes = Shapes(self._submission, self._objects, fresh, self._fresh_seed, self._salt)
            shapes.compare(made, lambda done, total: self._report("reconstruct", done, total))
        return Attestation(
            policy=self._sources[0],
            reconstructor=self._sources[1],
            confinement=shut_in,
            limits=dataclasses.asdict(self._limits),
            salt=self._salt,
            fresh_seed=self._fresh_seed,
            episodes=len(self._episodes),
            departed_actions=sorted(departed_actions),
            shapes=shapes.count,
            departed_shapes=sorted(shapes.departed),
            claimed=shapes.means("claimed"),
            fresh=shapes.means("fresh"),
            own=shapes.means("own"),
            swapped=shapes.means("swapped"),
            turned=shapes.means("turned"),
        )

    def _players(self) -> list[tuple[Sequence[int], Code]]:
        """Repetitions and what plays them: shipped weights play the repetition of their training's seed."""
        code, seeds = self._policy, self._submission.info.seeds
        spec = get_baseline(code.reference)
        if spec.kind != "learned" or fixed_model(spec, code.model, dict(code.arguments)) is not None:
            return [(seeds, code)]
        return [((seed,), dataclasses.replace(code, arguments={**code.arguments, "seed": seed})) for seed in seeds]

    def _confined(self, code: Code) -> ConfinedCode:
        return ConfinedCode(code, self._limits, self._hidden, self._submission.split)

    def _departed_actions(self, policy: Policy, episodes: Sequence[Episode]) -> list[str]:
        """Those of the episodes whose stored actions the policy does not choose."""
        salt = self._submission.info.policy_salt or _NO_SALT
        departed = []
        for batch in self._batches(episodes, "actions"):
            stored = [_stored(self._submission, episode) for episode in batch]
            prompted = _Prompted(policy, [rollout.actions for rollout in stored])
            self._roll_out(prompted, batch, salt)
            departed += [_named(episode) for episode, same in zip(batch, prompted.same(), strict=True) if not same]
        return departed

    def _fresh_episodes(self, policy: Policy) -> dict[Episode, Rollout]:
        """One more repetition of every object, from the organiser's salt."""
        episodes = [(name, pose, self._fresh_seed) for name in self._objects for pose in range(NUM_POSES)]
        rollouts: dict[Episode, Rollout] = {}
        for batch in self._batches(episodes, "fresh episodes"):
            played = self._roll_out(policy, batch, self._salt)
            rollouts |= dict(zip(batch, played, strict=True))
        return rollouts

    def _batches(self, episodes: Sequence[Episode], stage: str) -> Iterator[list[Episode]]:
        order = shuffled(self._salt, episodes)
        for first in range(0, len(order), SIDE_BY_SIDE):
            self._report(stage, first, len(order))
            yield order[first : first + SIDE_BY_SIDE]
        self._report(stage, len(order), len(order))

    def _roll_out(self, policy: Policy, batch: Sequence[Episode], salt: str) -> list[Rollout]:
        return roll_out_batch(self._environments(), policy, batch, salt)

    def _environments(self) -> Any:
        if not hasattr(self, "_envs"):
            self._envs = make_vec(
                ENVIRONMENT_ID,
                SIDE_BY_SIDE,
                "cpu",
                objects=self._objects,
                split=self._submission.split,
                control_mode=self._submission.info.control_mode,
                processes=min(self._processes, SIDE_BY_SIDE) if self._processes > 1 else 0,  # 0: in this process
            )
        return self._envs

    def close(self) -> None:
        """Ends the simulating processes."""
        if hasattr(self, "_envs"):
            self._envs.close()


class _Prompted:
    """Plays stored actions, and asks a policy in every step what it would have done."""

    def __init__(self, policy: Policy, stored: Sequence[NDArray[np.float32]]) -> None:
        self.control_mode = policy.control_mode
        self._policy, self._stored = policy, stored
        self._step = 0
        self._other = np.zeros(len(stored), dtype=np.int64)

    def reset(self, num_envs: int, seed: int | Sequence[int]) -> None:
        """See :class:`Policy`."""
        self._policy.reset(num_envs, seed)

    def act(self, observation: Mapping[str, NDArray]) -> NDArray[np.float32]:
        """See :class:`Policy`."""
        chosen = self._policy.act(observation)
        played = np.array([self._stored[min(env, len(self._stored) - 1)][self._step] for env in range(len(chosen))])
        self._other += (np.abs(chosen - played) > ACTION_TOLERANCE).any(axis=1)[: len(self._stored)]
        self._step += 1
        return played

    def same(self) -> NDArray[np.bool_]:
        """Which episodes' actions are the policy's."""
        return self._other <= MOST_OTHER_STEPS * self._step


def _stored(submission: Submission, episode: Episode) -> Rollout:
    rollout = submission.rollout(*episode)
    assert rollout is not None, "the submission listed it"
    return rollout


def _named(episode: Episode) -> str:
    name, pose, seed = episode
    return f"{name}, pose {pose}, seed {seed}"
