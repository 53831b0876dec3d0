"""``tslam-bench view``: episodes played back and shapes to turn, in the browser, without a GPU."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from tslam_bench.cli.commands import parse
from tslam_bench.cli.progress import Progress
from tslam_bench.episodes import new_salt
from tslam_bench.errors import InvalidInputError
from tslam_bench.grids import check_pose, merge, world_to_object
from tslam_bench.objects.splits import resolve_name
from tslam_bench.plugins import parse_arguments
from tslam_bench.reconstruction.volume import Reconstructor
from tslam_bench.scoring.rollout import Rollout
from tslam_bench.scoring.submission import EXPLORATION_ORDER, INFO_FILE, Submission, read_submission
from tslam_bench.viewing.entries import Entry, Explored, members_of, submission_entry
from tslam_bench.viewing.motion import Motion, MotionSource, interpolation
from tslam_bench.viewing.site import check_folder, episodes_key, write_viewer

FIRST_OBJECT: Final = "mug"
"""What is explored if nothing else is asked for."""


@dataclass(frozen=True)
class View:
    """Watch a hand explore, and turn what it touched, what was rebuilt, and the true shape.

    Writes a folder that any browser opens, also without network, and opens it. Without PATHS a policy explores now; a rollout
    file or a submission is played back. Needs neither Vulkan nor a GPU.
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Rollout files (.npz), submissions (folders or zip archives) or runs that hold some; none: a policy explores now."""
    object: tuple[str, ...] = ()
    """Objects; default: mug if a policy explores, all objects of a submission."""
    pose: tuple[int, ...] = ()
    """Poses of the object, 0 to 7; default: 0 if a policy explores, all poses of a submission."""
    policy: str = "heuristic"
    """Who explores: id (tslam-bench baselines list), module:Class or path/to/file.py:Class."""
    policy_arguments: tuple[str, ...] = ()
    """Arguments of the policy's class: key=value pairs or one JSON object."""
    model: Path | None = None
    """Trained model of the policy."""
    reconstructor: tuple[str, ...] = ("carve",)
    """What completes the shape: ID, module:Class, or either with =MODEL; none only shows what was touched. A submission has its
    own."""
    seed: int | None = None
    """Repetition: where the hand starts; default: 0, or the first of a submission."""
    policy_salt: str | None = None
    """Hexadecimal digits that the policy's random numbers come from; default: drawn at random, so each call differs."""
    split: str = "test"
    """Split of the objects."""
    replay: bool = True
    """Simulate stored episodes again to show every step (--no-replay: between the file's checkpoints)."""
    output: Path = Path("runs/view")
    """Folder to write; an earlier page in it is replaced."""
    browser: bool = True
    """Open the page (--no-browser: only write it)."""


def main(arguments: Sequence[str]) -> None:
    """Runs ``tslam-bench view`` with the given arguments.

    Raises:
        BenchmarkError: bad input, or the user's own code went wrong; the message is one line.
    """
    parsed: View = parse("tslam-bench view", View, arguments)
    for pose in parsed.pose:
        check_pose(pose)
    check_folder(parsed.output)
    if not parsed.paths:
        entries, motions = _explore(parsed)
    else:
        entries, motions = _stored(parsed)
    with Progress("page", "object", leave=False) as bar:
        written = write_viewer(parsed.output, entries, motions, _title(parsed, entries), bar.show)
    if not written.links:
        raise InvalidInputError("view: none of the objects is prepared; run: tslam-bench assets prepare --quick")
    print(
        f"{written.page}: {sum(written.sizes.values()) / 2**20:.1f} MiB; copy the whole folder {parsed.output} to share it"
    )
    if parsed.browser and not _open(written.page):
        print("no browser on this machine; open the page elsewhere")


def _explore(parsed: View) -> tuple[list[Entry], MotionSource]:
    """Lets the policy explore every object, and every reconstructor complete it."""
    from tslam_bench.evaluation.evaluate import make_reconstructors
    from tslam_bench.evaluation.playback import play
    from tslam_bench.evaluation.policies import get_baseline, make_baseline, policy_label
    from tslam_bench.evaluation.policy import CheckedPolicy

    spec = get_baseline(parsed.policy)
    names = [resolve_name(name, parsed.split) for name in parsed.object or (FIRST_OBJECT,)]
    poses = [pose for pose in EXPLORATION_ORDER if pose in (parsed.pose or (0,))]
    made = make_baseline(parsed.policy, parsed.model, **parse_arguments(parsed.policy_arguments))
    policy = CheckedPolicy(made, policy_label(parsed.policy))
    reconstructors = make_reconstructors(parsed.reconstructor)
    explored: dict[str, dict[int, Rollout]] = {}
    steps: dict[str, Motion] = {}
    salt = parsed.policy_salt or new_salt()
    with Progress(f"{spec.id} explores", "object", len(names), leave=False) as bar:
        bar.show(0)
        for done, name in enumerate(dict.fromkeys(names)):
            episodes = [(name, pose, parsed.seed or 0) for pose in poses]
            policy.playing = episodes
            played = play(policy, episodes, salt, parsed.split)
            explored[name] = {rollout.pose: rollout for rollout, _ in played}
            steps |= {rollout.file: motion for rollout, motion in played}
            bar.show(done + 1)

    made_reconstructors = {label: chosen.made for label, chosen in reconstructors.items()}
    entries = _entries(spec.id, explored, made_reconstructors, policy.control_mode, parsed)
    return entries, MotionSource("live", lambda rollouts, mode, split: [steps[rollout.file] for rollout in rollouts])


def _stored(parsed: View) -> tuple[list[Entry], MotionSource]:
    """Entries of submissions and rollout files."""
    from tslam_bench.evaluation.evaluate import make_reconstructors

    entries: list[Entry] = []
    explored: dict[str, dict[int, Rollout]] = {}
    names = [resolve_name(name, parsed.split) for name in parsed.object]
    for path in parsed.paths:
        if path.suffix == ".npz" and not path.is_dir():
            rollout = Rollout.load(path)
            earlier = explored.setdefault(rollout.object, {}).setdefault(rollout.pose, rollout)
            if earlier is not rollout:
                raise InvalidInputError(
                    f"{path}: a second episode of {rollout.object} in pose {rollout.pose}; give one"
                )
            continue
        entries += [
            submission_entry(each, names, parsed.pose, parsed.seed) for each in _submissions(path, parsed.split)
        ]
    if explored:
        made = {name: chosen.made for name, chosen in make_reconstructors(parsed.reconstructor).items()}
        entries += _entries("rollout file", explored, made, "", parsed)
    return entries, _replays(parsed)


def _submissions(path: Path, split: str) -> list[Submission]:
    """The submission that a path is, or those of a run's folder."""
    if not path.is_dir() or (path / INFO_FILE).is_file():
        return [read_submission(path, split=split)]
    found = [f.parent for where in (path, path / "submissions") for f in sorted(where.glob(f"*/{INFO_FILE}"))]
    if not found:
        raise InvalidInputError(
            f"{path}: holds no submission ({INFO_FILE} is missing) and is no rollout file; check the path"
        )
    return [read_submission(folder, split=split) for folder in found]


def _entries(
    explorer: str,
    explored: Mapping[str, Mapping[int, Rollout]],
    reconstructors: Mapping[str, Reconstructor],
    control_mode: str,
    parsed: View,
) -> list[Entry]:
    """An entry for each reconstructor of what was explored."""
    ordered = {name: {p: own[p] for p in EXPLORATION_ORDER if p in own} for name, own in explored.items()}
    keys = {name: episodes_key(rollouts) for name, rollouts in ordered.items()}

    def read(reconstructor: Reconstructor | None, name: str) -> Explored:
        rollouts, members = ordered[name], members_of(list(ordered[name]))
        shapes: dict[int, Any] = dict.fromkeys(members)
        if reconstructor is not None:
            for count, poses in members.items():
                touched = merge(world_to_object(rollouts[pose].touched, pose) for pose in poses)
                visited = merge(world_to_object(rollouts[pose].visited, pose) for pose in poses)
                shapes[count] = reconstructor.reconstruct(touched, visited)
        return Explored(name, parsed.split, control_mode, rollouts, tuple(rollouts), members, shapes)

    whole = hashlib.sha256("".join(keys.values()).encode()).hexdigest()[:16]
    none: dict[str, Reconstructor | None] = {"none": None}
    return [
        Entry(
            key=f"{whole}-{label}",
            explorer=explorer,
            reconstructor=label,
            remark="",
            objects=tuple(ordered),
            stored=False,
            episodes=keys.__getitem__,
            read=partial(read, made),
        )
        for label, made in (dict(reconstructors) or none).items()
    ]


def _replays(parsed: View) -> MotionSource:
    """Stored episodes are simulated again where there is a simulator."""
    if not parsed.replay:
        return interpolation("That was asked for.")
    if importlib.util.find_spec("sapien") is None:
        return interpolation("There was no simulator on the machine that wrote this page.")
    from tslam_bench.evaluation.playback import replays

    return replays()


def _title(parsed: View, entries: Sequence[Entry]) -> str:
    names = sorted({name for entry in entries for name in entry.objects})
    what = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"{entries[0].explorer} feels {what}" if not parsed.paths else f"Playback: {what}"


def _open(page: Path) -> bool:
    """Opens the page in a browser with windows; a browser in the terminal would take it over."""
    windows = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return bool(windows) and webbrowser.open(page.resolve().as_uri())
