"""The run: its plan, and the runner of its commands, on real processes."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tslam_bench import cli
from tslam_bench.baselines import run
from tslam_bench.baselines.run import PRESETS, Arguments, plan, settings_of
from tslam_bench.constants import QUICK_OBJECTS
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.jobs import Job, JobError, JobRunner
from tslam_bench.evaluation.launchers import LocalLauncher
from tslam_bench.evaluation.policies import list_baselines
from tslam_bench.sources.generator.generate import candidates

ROOT = Path(__file__).parents[2]


def runner(folder: Path, said: list[str] | None = None, workers: int = 2) -> JobRunner:
    return JobRunner(folder, LocalLauncher(workers), (said if said is not None else []).append, lambda *_: None)


def python(code: str) -> tuple[str, ...]:
    return (sys.executable, "-c", code)


def appending(path: Path, word: str) -> tuple[str, ...]:
    return python(f"open({str(path)!r}, 'a').write({word + ' '!r})")


# -- plan -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_plan_can_be_run_in_order(preset: str, tmp_path: Path) -> None:
    jobs = plan(PRESETS[preset], tmp_path, 2)
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names)
    for index, job in enumerate(jobs):
        assert set(job.after) <= set(names[:index]), job.name
        assert job.command[0] == "tslam-bench" and job.command[1] in cli._COMMANDS
    # Everything but the assets leads to the page.
    needed, found = ["leaderboard"], set[str]()
    by_name = {job.name: job for job in jobs}
    while needed:
        name = needed.pop()
        found.add(name)
        needed += by_name[name].after
    assert found == set(names)


def test_quick_run_is_what_it_promises(tmp_path: Path) -> None:
    settings = settings_of(Arguments(quick=True))
    assert settings.objects == QUICK_OBJECTS
    jobs = {job.name: job for job in plan(settings, tmp_path, 2)}
    for spec in list_baselines():
        assert f"evaluate-{spec.id}" in jobs
        assert (f"train-{spec.id}" in jobs) == (spec.kind == "learned")
        if spec.kind == "learned":
            command = shlex.join(jobs[f"evaluate-{spec.id}"].command)
            assert "32,000 steps, proves the path, not the method" in command
    assert tmp_path / "leaderboard.json" in jobs["leaderboard"].outputs
    assert tmp_path / "index.html" in jobs["leaderboard"].outputs


def test_reconstructors_are_trained_where_no_weights_are_shipped_or_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained(arguments: Arguments) -> set[str]:
        jobs = plan(settings_of(arguments), tmp_path, 2)
        evaluated = next(shlex.join(job.command) for job in jobs if job.name == "evaluate-heuristic")
        names = {job.name for job in jobs if job.command[:3] == ("tslam-bench", "reconstruct", "train")}
        assert ("ifnet=" in evaluated) == ("train-ifnet" in names)  # a model is named where one is trained
        return names

    monkeypatch.setattr(run, "shipped_reconstructor", lambda name: None)
    assert trained(Arguments(quick=True)) >= {"train-ifnet"}
    monkeypatch.setattr(run, "shipped_reconstructor", lambda name: Path("weights"))
    assert trained(Arguments(quick=True)) == set()
    assert trained(Arguments(quick=True, retrain=True)) >= {"train-ifnet"}
    assert trained(Arguments(full=True)) >= {"train-ifnet"}
    (unet,) = (
        job for job in plan(settings_of(Arguments(quick=True, retrain=True)), tmp_path, 2) if job.name == "train-unet"
    )
    assert "--data" in unet.command and unet.after == ("collect-touches",)  # it learns from collected touches only
    (collect,) = (job for job in plan(PRESETS["full"], tmp_path, 2) if job.name == "collect-touches")
    full = {job.name: job for job in plan(PRESETS["full"], tmp_path, 2)}
    assert full["train-ifnet"].after == ("collect-touches",)
    folder = collect.command[collect.command.index("--output") + 1]
    assert full["train-ifnet"].command[full["train-ifnet"].command.index("--data") + 1] == folder


def test_what_is_learned_from_is_named(tmp_path: Path) -> None:
    """What else the cache holds must not change a quick run; a full one leaves the hash of what it found."""
    jobs = {job.name: job for job in plan(PRESETS["quick"], tmp_path, 2)}
    generated = {split: {source.name for source in candidates(split, rounds=3)} for split in ("train", "val")}
    train, val = (dict(PRESETS["quick"].learning_objects)[split] for split in ("train", "val"))
    assert set(train) <= generated["train"] and len(set(train)) == 24
    assert set(val) <= generated["val"] and len(set(val)) == 6
    for name, flag, names in (
        ("assets-train", "--objects", train),
        ("assets-val", "--objects", val),
        ("train-ifnet", "--objects", train),
        ("train-ifnet", "--threshold-objects", val),
        ("train-tslam", "--objects", train),
        ("evaluate-nothing", "--learning-objects", train),
    ):
        command = jobs[name].command
        first = command.index(flag) + 1
        assert command[first : first + len(names)] == names
        assert all(word.startswith("--") for word in command[first + len(names) : first + len(names) + 1])
    tiny = {job.name: job for job in plan(PRESETS["tiny"], tmp_path, 2)}["train-ifnet"].command
    assert "--threshold-split train --threshold-objects bottle-000" in shlex.join(tiny)
    scripted = {job.name: shlex.join(job.command) for job in plan(PRESETS["scripted"], tmp_path, 2)}
    assert "--seeds 0 1 2" in scripted["evaluate-heuristic"] and "--policy-salt 2021" in scripted["evaluate-heuristic"]
    assert "--policy-salt" not in scripted["evaluate-oracle"] and not any("train-tslam" in name for name in scripted)
    for job in plan(PRESETS["full"], tmp_path, 2):
        assert (job.fingerprint is not None) == job.name.startswith("assets-")


def test_flags_change_the_preset(tmp_path: Path) -> None:
    arguments = Arguments(tiny=True, objects=("hammer",), baselines=("tslam_knn",), seeds=(3, 4), steps=999)
    jobs = {job.name: shlex.join(job.command) for job in plan(settings_of(arguments), tmp_path, 1)}
    assert "train-tslam" not in jobs and "--steps 999" in jobs["train-tslam_knn"]
    assert "--objects hammer" in jobs["assets-test"] and "--seeds 3 4" in jobs["evaluate-tslam_knn"]


def test_policies_and_reconstructors_of_the_users_own_can_be_run(tmp_path: Path) -> None:
    arguments = Arguments(tiny=True, baselines=("mypkg:MyPolicy",), reconstructors=("grid", "mypkg:make"))
    jobs = {job.name: job for job in plan(settings_of(arguments), tmp_path, 1)}
    job = jobs["evaluate-mypkg.mypolicy"]
    assert "--policy mypkg:MyPolicy" in shlex.join(job.command) and "grid mypkg:make" in shlex.join(job.command)
    assert [path.parent.name for path in job.outputs] == ["mypkg.mypolicy-grid", "mypkg.mypolicy-mypkg.make"]
    assert not any(name.startswith("train") for name in jobs)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (Arguments(), "choose one of --quick"),
        (Arguments(quick=True, full=True), "choose one of --quick"),
        (Arguments(quick=True, baselines=("nope",)), "unknown"),
        (Arguments(quick=True, objects=()), "--objects: give at least one"),
        (Arguments(quick=True, steps=0), "--steps"),
    ],
)
def test_bad_arguments(arguments: Arguments, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        settings_of(arguments)


def test_commands_of_the_plan_are_understood(tmp_path: Path, capsys) -> None:
    """Every flag that the plan uses is in the help of its command."""
    helps: dict[tuple[str, ...], str] = {}
    for job in plan(PRESETS["tiny"], tmp_path, 2):
        words = job.command[1:3] if job.command[1] in ("assets", "baselines", "reconstruct") else job.command[1:2]
        if words not in helps:
            with pytest.raises(SystemExit) as ended:
                cli.main([*words, "--help"])
            assert ended.value.code in (0, None)
            helps[words] = capsys.readouterr().out
        for word in job.command:
            if word.startswith("--"):
                assert re.search(rf"{word}\b", helps[words]), f"{word} is no flag of {' '.join(words)}"


def test_scripts_help() -> None:
    shown = subprocess.run(["bash", ROOT / "baselines" / "run_all.sh", "--help"], capture_output=True, text=True)
    assert shown.returncode == 0 and "--quick" in shown.stdout
    flags = set(re.findall(r"--[a-z-]+", shown.stdout)) - {"--help"}
    fields = {"--" + name.replace("_", "-") for name in Arguments.__dataclass_fields__}
    assert flags == fields


# -- runner -----------------------------------------------------------------------------------------------------------
def test_order_reuse_and_what_follows_from_a_change(tmp_path: Path) -> None:
    trace = tmp_path / "trace"

    def jobs(first: str) -> list[Job]:
        return [
            Job("a", appending(trace, first)),
            Job("b", appending(trace, "b"), after=("a",)),
            Job("c", appending(trace, "c"), after=("b",)),
            Job("d", appending(trace, "d"), after=("c",), always=True),
        ]

    runner(tmp_path).run(jobs("a"))
    assert trace.read_text().split() == ["a", "b", "c", "d"]
    said: list[str] = []
    runner(tmp_path, said).run(jobs("a"))
    assert trace.read_text().split() == ["a", "b", "c", "d", "d"]
    assert sum("done before" in line for line in said) == 3
    runner(tmp_path).run(jobs("A"))  # another command: it and what depends on it run again
    assert trace.read_text().split()[5:] == ["A", "b", "c", "d"]


def test_missing_output_is_made_again(tmp_path: Path) -> None:
    output = tmp_path / "result"
    job = Job("make", python(f"open({str(output)!r}, 'w').write('x')"), outputs=(output,))
    runner(tmp_path).run([job])
    output.unlink()
    runner(tmp_path).run([job])
    assert output.exists()
    lazy = Job("lazy", python("pass"), outputs=(tmp_path / "never",))
    with pytest.raises(JobError, match=r"lazy failed.*wrote no"):
        runner(tmp_path).run([lazy])


def test_results_of_other_products_are_not_mixed(tmp_path: Path) -> None:
    products = ["first"]
    job = Job("assets", python("pass"), always=True, fingerprint=lambda: products[0])
    after = Job("use", appending(tmp_path / "trace", "x"), after=("assets",))
    runner(tmp_path).run([job, after])
    runner(tmp_path).run([job, after])
    products[0] = "second"
    with pytest.raises(InvalidInputError, match="made with other products of assets; delete it"):
        runner(tmp_path).run([job, after])
    assert (tmp_path / "trace").read_text() == "x "


def test_failure_names_job_reason_and_log_and_stops_the_others(tmp_path: Path) -> None:
    slow = Job("slow", python("import time; time.sleep(60)"))
    bad = Job("bad", python("import sys; print('first'); print('the reason'); sys.exit(3)"))
    after = Job("after", appending(tmp_path / "trace", "x"), after=("bad",))
    begun = time.monotonic()
    with pytest.raises(JobError, match=r"bad failed with status 3: the reason \(log: .*bad\.log\)") as caught:
        runner(tmp_path).run([slow, bad, after])
    assert time.monotonic() - begun < 30 and "\n" not in str(caught.value)
    assert not (tmp_path / "trace").exists()
    repaired = Job("bad", python("pass"))
    runner(tmp_path).run([repaired, after])  # goes on
    assert (tmp_path / "trace").read_text() == "x "


def test_independent_jobs_share_the_workers(tmp_path: Path) -> None:
    """Two jobs that wait for each other end only if they run at the same time."""

    def meets(own: str, other: str) -> tuple[str, ...]:
        code = (
            "import pathlib, time, sys\n"
            f"pathlib.Path({str(tmp_path / own)!r}).touch()\n"
            "end = time.time() + 20\n"
            f"while not pathlib.Path({str(tmp_path / other)!r}).exists():\n"
            "    time.sleep(0.05)\n"
            "    if time.time() > end: sys.exit(1)\n"
        )
        return python(code)

    runner(tmp_path).run([Job("one", meets("1", "2")), Job("two", meets("2", "1"))])


def test_a_job_of_two_slots_runs_alone(tmp_path: Path) -> None:
    busy = tmp_path / "busy"
    code = (
        f"import pathlib, sys, time\np = pathlib.Path({str(busy)!r})\n"
        "if p.exists(): sys.exit(1)\np.touch(); time.sleep(0.4); p.unlink()"
    )
    runner(tmp_path).run([Job("one", python(code), slots=2), Job("two", python(code), slots=2)])


def test_two_runs_in_one_folder_are_refused(tmp_path: Path) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "from tslam_bench.evaluation.jobs import Job, JobRunner\n"
        "from pathlib import Path\n"
        f"job = Job('long', ({sys.executable!r}, '-c', 'import time; time.sleep(60)'))\n"
        "from tslam_bench.evaluation.launchers import LocalLauncher\n"
        f"JobRunner(Path({str(tmp_path)!r}), LocalLauncher(1), print, lambda *_: None).run([job])\n"
    )
    first = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    try:
        end = time.monotonic() + 30
        while not (tmp_path / "logs" / "long.log").exists() and time.monotonic() < end:
            time.sleep(0.05)
        with pytest.raises(InvalidInputError, match="another run uses this folder"):
            runner(tmp_path).run([Job("quick", python("pass"))])
        # Its runner dies hard: the job that it leaves behind still holds the folder.
        first.kill()
        first.wait()
        with pytest.raises(InvalidInputError, match="another run"):
            runner(tmp_path).run([Job("quick", python("pass"))])
    finally:
        os.killpg(first.pid, signal.SIGKILL)
    end = time.monotonic() + 10
    while time.monotonic() < end:
        try:
            runner(tmp_path).run([Job("quick", python("pass"))])
            break
        except InvalidInputError:
            time.sleep(0.1)
    else:
        pytest.fail("the folder stayed locked")


WITHOUT_LOCKS = """
import ctypes, errno, platform, struct, sys
number = {"x86_64": 73, "aarch64": 32}[platform.machine()]  # of flock
rules = [(0x20, 0, 0, 0), (0x15, 0, 1, number), (6, 0, 0, 0x50000 | errno.ENOLCK), (6, 0, 0, 0x7FFF0000)]
code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *rule) for rule in rules))
program = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(rules), ctypes.addressof(code)))
libc = ctypes.CDLL(None)
if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, program, 0, 0):  # no new rights, and a filter of system calls
    sys.exit(77)

from pathlib import Path
from tslam_bench.evaluation.jobs import Job, JobRunner
from tslam_bench.evaluation.launchers import LocalLauncher
runner = JobRunner(Path(sys.argv[1]), LocalLauncher(1), print, lambda *_: None)
runner.run([Job("one", ("true",))])
runner.run([Job("one", ("true",))])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can be told to refuse locks")
def test_a_file_system_without_locks_is_named_and_used(tmp_path: Path) -> None:
    """As many network file systems: the system call ends with "No locks available"."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_LOCKS, str(tmp_path)], capture_output=True, text=True, timeout=60, check=False
    )
    if done.returncode == 77:
        pytest.skip("the system takes no filter")
    assert done.returncode == 0, done.stderr
    assert "[1/1] one: done in" in done.stdout and "[1/1] one: done before" in done.stdout
    said = f"{tmp_path}: cannot be locked (No locks available); start no second run in this folder"
    assert said in done.stderr
