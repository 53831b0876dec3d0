"""Runs on clusters: a Ray cluster of two nodes of which one is killed, submitit's local executor, and what both run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tslam_bench.baselines.run import main
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.jobs import Job, JobError, JobRunner
from tslam_bench.evaluation.launchers import Launcher, LocalLauncher, RayLauncher, SlurmLauncher, make_launcher
from tslam_bench.evaluation.work import LostError, Work, run_work

EXPLORERS = ("random", "heuristic")


def evaluations(output: Path) -> list[Job]:
    """Two small jobs: an explorer each feels two objects in eight poses and rebuilds them."""
    options = "--objects mug hammer --reconstructor grid --policy-salt 2021 --processes 1 --output"
    command = ("tslam-bench", "evaluate", *options.split(), str(output), "--policy")
    return [Job(name, (*command, name), outputs=(output / "submissions" / f"{name}-grid",)) for name in EXPLORERS]


def run_jobs(folder: Path, launcher: Launcher, jobs: list[Job], show: Any = lambda *_: None) -> None:
    JobRunner(folder, launcher, lambda line: None, show).run(jobs)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a run but the logs, and but hidden ones: a job that is killed may leave a file half written, out of sight."""
    paths = (path for path in folder.rglob("[!.]*") if path.is_file())
    return {name: p.read_bytes() for p in paths if not (name := p.relative_to(folder).as_posix()).startswith("logs/")}


def python(code: str) -> tuple[str, ...]:
    return (sys.executable, "-c", code)


def killed_once(trace: Path) -> tuple[str, ...]:
    """A command that kills itself the first time."""
    return python(
        f"import os, pathlib\np = pathlib.Path({str(trace)!r})\nfirst = not p.exists()\n"
        "p.open('a').write('x')\nif first: os.kill(os.getpid(), 9)"
    )


def log_of(folder: Path, name: str) -> str:
    return (folder / "logs" / f"{name}.log").read_text()


# -- Ray ----------------------------------------------------------------------------------------------------------------
def two_nodes() -> Any:
    """A Ray cluster of two nodes with a core each."""
    from ray.cluster_utils import Cluster

    # A dead node is found within ten seconds, and one that is only slow, because the machine is busy, stays.
    health = {"health_check_period_ms": 1000, "health_check_failure_threshold": 10, "health_check_timeout_ms": 20_000}
    size = {"num_cpus": 1, "object_store_memory": 80_000_000}
    made = Cluster()
    try:
        made.add_node(**size, include_dashboard=False, _system_config=health)
        made.add_node(**size)
    except BaseException:
        made.shutdown()
        raise
    return made


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes, the second of which may be killed."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'tslam-bench[ray]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        try:
            made = two_nodes()
        except Exception as error:
            if "timed out during startup" not in str(error):
                raise
            pytest.skip("this machine is too busy: Ray gives a node 30 s to start")
        yield made
        made.shutdown()


@pytest.fixture
def ray_launcher(cluster: Any) -> Iterator[RayLauncher]:
    launcher = RayLauncher(cluster.address)
    yield launcher
    launcher.close()


@pytest.mark.slow
def test_a_ray_cluster_that_loses_a_node_leaves_the_files_of_a_local_run(cluster, ray_launcher, tmp_path) -> None:
    (doomed,) = cluster.worker_nodes
    mark, killed = f"(node {doomed.node_id[:8]})", []

    def kill_in_the_middle(*_: object) -> None:
        """Kills the second node as soon as the job that runs there has saved its first episodes."""
        for name in () if killed else EXPLORERS:
            log = tmp_path / "ray" / "logs" / f"{name}.log"
            if log.exists() and mark in log.read_text() and any((tmp_path / "ray/rollouts" / name).glob("*/*.npz")):
                killed.append(name)
                cluster.remove_node(doomed, allow_graceful=False)

    run_jobs(tmp_path / "ray", ray_launcher, evaluations(tmp_path / "ray"), kill_in_the_middle)
    (name,) = killed
    first, second = (line for line in log_of(tmp_path / "ray", name).splitlines() if line.startswith("# on "))
    assert mark in first and mark not in second  # begun again, on the other node
    (same,) = (job for job in evaluations(tmp_path / "local") if job.name == name)
    run_jobs(tmp_path / "local", LocalLauncher(2), [same])
    local, ray = contents(tmp_path / "local"), contents(tmp_path / "ray")
    assert len(local) > 2 * 2 * 8  # rollouts, and again in the submission
    assert {path for path in ray if name in path} == local.keys()
    assert [path for path in local if ray[path] != local[path]] == []


def test_ray_jobs_fail_end_and_are_begun_again(ray_launcher, tmp_path) -> None:
    with pytest.raises(InvalidInputError, match="wants 3 cores, and the largest node has 1; give --workers 1"):
        run_jobs(tmp_path, ray_launcher, [Job("wide", python("pass"), slots=3)])
    bad = Job("bad", python("import sys; print('the reason'); sys.exit(3)"))
    with pytest.raises(JobError, match=r"bad failed with status 3: the reason \(log: .*bad\.log\)"):
        run_jobs(tmp_path, ray_launcher, [bad])
    run_jobs(tmp_path, ray_launcher, [Job("again", killed_once(tmp_path / "again"))])
    assert (tmp_path / "again").read_text() == "xx"
    with pytest.raises(JobError, match=r"lost: killed on .* by signal 9"):
        run_jobs(tmp_path, ray_launcher, [Job("lost", killed_once(tmp_path / "lost"), retries=0)])


def test_an_address_without_a_cluster_is_one_line() -> None:
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'tslam-bench[ray]'")
    with pytest.raises(InvalidInputError, match=r"Ray cluster nonsense: ") as caught:
        RayLauncher("nonsense")
    assert "\n" not in str(caught.value)


# -- SLURM --------------------------------------------------------------------------------------------------------------
@pytest.fixture
def slurm_launcher(tmp_path: Path) -> SlurmLauncher:
    """submitit's local executor: its files and processes, without SLURM."""
    pytest.importorskip("submitit", reason="submitit is not installed: pip install 'tslam-bench[slurm]'")
    return SlurmLauncher(tmp_path / "submitit", {"cluster": "local", "timeout_min": 2})


def test_submitit_jobs_run_in_order_fail_and_are_begun_again(slurm_launcher, tmp_path) -> None:
    jobs = [
        Job("again", killed_once(tmp_path / "trace")),
        Job("after", python(f"open({str(tmp_path / 'trace')!r}, 'a').write('y')"), after=("again",)),
    ]
    run_jobs(tmp_path, slurm_launcher, jobs)
    assert (tmp_path / "trace").read_text() == "xxy"
    assert log_of(tmp_path, "again").count("# on ") == 2
    bad = Job("bad", python("import sys; print('the reason'); sys.exit(3)"))
    with pytest.raises(JobError, match=r"bad failed with status 3: the reason"):
        run_jobs(tmp_path, slurm_launcher, [bad])
    with pytest.raises(JobError, match=r"lost: killed on .* by signal 9"):
        run_jobs(tmp_path, slurm_launcher, [Job("lost", killed_once(tmp_path / "lost"), retries=0)])


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Tests that a shell runs behind itself ignore SIGINT, and so would submitit's local jobs, which are cancelled by it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_failed_run_cancels_its_submitit_jobs(interruptible, slurm_launcher, tmp_path) -> None:
    trace = tmp_path / "trace"
    slow = Job("slow", python(f"import time; open({str(trace)!r}, 'w'); time.sleep(60)"))
    bad = Job(
        "bad",
        python(f"import os, time\nwhile not os.path.exists({str(trace)!r}): time.sleep(0.05)\nraise SystemExit(1)"),
    )
    begun = time.monotonic()
    with pytest.raises(JobError, match="bad failed"):
        run_jobs(tmp_path, slurm_launcher, [slow, bad])
    assert time.monotonic() - begun < 50
    until = time.monotonic() + 60
    while "KeyboardInterrupt" not in log_of(tmp_path, "slow") and time.monotonic() < until:  # it ends in its own time
        time.sleep(0.2)
    assert "KeyboardInterrupt" in log_of(tmp_path, "slow")


def test_slurm_options_that_are_wrong_are_one_line(tmp_path, monkeypatch) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed: pip install 'tslam-bench[slurm]'")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InvalidInputError, match="no sbatch here"):
        SlurmLauncher(tmp_path, {})
    for parameters, wrong in (
        ({"cluster": "local", "colour": "red"}, "colour"),
        ({"cluster": "moon"}, "moon"),
        ({"cluster": "local", "timeout_min": "long"}, "timeout_min"),
    ):
        with pytest.raises(InvalidInputError, match="--slurm: ") as caught:
            SlurmLauncher(tmp_path / "submitit", parameters)
        assert wrong in str(caught.value) and "\n" not in str(caught.value)


# -- both ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("moon", None, {}), "launcher 'moon': unknown; choose one of local, ray, slurm"),
        (("local", "10.0.0.1:6379", {}), "--address 10.0.0.1:6379: is for --launcher ray"),
        (("ray", None, {"mem_gb": 8}), "--slurm mem_gb: is for --launcher slurm"),
    ],
)
def test_options_of_another_launcher(arguments, message, tmp_path) -> None:
    name, address, slurm = arguments
    with pytest.raises(InvalidInputError, match=message):
        make_launcher(name, tmp_path, 2, address, slurm)


def test_the_run_hands_its_flags_to_the_launcher(tmp_path, capsys) -> None:
    pytest.importorskip("submitit", reason="submitit is not installed: pip install 'tslam-bench[slurm]'")
    options = ["--tiny", "--output", str(tmp_path), "--launcher", "slurm", "--slurm", "cluster=moon", "mem_gb=8"]
    with pytest.raises(SystemExit) as ended:
        main(options)
    assert ended.value.code == 2
    assert capsys.readouterr().err.strip() == "run: --slurm: cluster=moon: choose slurm or local"


def work(tmp_path: Path, code: str) -> Work:
    (tmp_path / "logs").mkdir(exist_ok=True)
    return Work("job", python(code), tmp_path / "logs" / "job.log")


def test_a_command_finds_folder_and_variables_of_where_the_run_was_started(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("TSLAM_BENCH_CACHE", "/the/cache")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    planned = work(
        tmp_path,
        "import os; print(os.getcwd(), *map(os.environ.get, ('OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'TSLAM_BENCH_CACHE')))",
    )
    monkeypatch.chdir("/")
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setenv("TSLAM_BENCH_CACHE", "/another")
    assert run_work(planned) == 0
    assert planned.log.read_text().splitlines()[-1] == f"{tmp_path} 3 1 /the/cache"


def test_other_versions_and_folders_that_are_not_shared_are_refused(tmp_path) -> None:
    with pytest.raises(InvalidInputError, match=r"has tslam-bench .* started with 9\.9\.9; install the same"):
        run_work(replace(work(tmp_path, "pass"), version="9.9.9"))
    with pytest.raises(InvalidInputError, match="has to be shared by all machines"):
        run_work(replace(work(tmp_path, "pass"), log=tmp_path / "elsewhere" / "job.log"))


def test_a_command_ends_with_whoever_started_it_and_runs_once_at_a_time(tmp_path) -> None:
    """A worker is killed; its command goes with it, and a second start waits until it has."""
    trace = tmp_path / "trace"
    planned = work(tmp_path, f"import os, time\nopen({str(trace)!r}, 'a').write(f'{{os.getpid()}} ')\ntime.sleep(60)")
    code = (
        "from pathlib import Path\nfrom tslam_bench.evaluation.work import Work, run_work\n"
        f"run_work(Work('job', {planned.command!r}, Path({str(planned.log)!r})))"
    )
    worker = subprocess.Popen([sys.executable, "-c", code])
    end = time.monotonic() + 60
    while not (trace.exists() and trace.read_text().endswith(" ")) and time.monotonic() < end:
        time.sleep(0.05)
    (command,) = map(int, trace.read_text().split())
    os.kill(command, 0)
    second = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    try:
        while "waits for an earlier start" not in planned.log.read_text() and time.monotonic() < end:
            time.sleep(0.05)
        assert len(trace.read_text().split()) == 1
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        while len(trace.read_text().split()) < 2 and time.monotonic() < end:
            time.sleep(0.05)
        assert len(trace.read_text().split()) == 2
        status = Path(f"/proc/{command}/stat")  # gone, or dead and not yet buried by the system
        assert not status.exists() or status.read_text().rpartition(")")[2].split()[0] in "ZX"
    finally:
        second.send_signal(signal.SIGINT)
        second.wait()


def test_a_command_that_is_killed_is_lost(tmp_path) -> None:
    with pytest.raises(LostError, match=r"job: killed on .* by signal 9"):
        run_work(work(tmp_path, "import os; os.kill(os.getpid(), 9)"))
    assert run_work(work(tmp_path, "raise SystemExit(4)")) == 4
