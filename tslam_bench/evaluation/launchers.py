"""Where the commands of a run are run: in processes here, on a Ray cluster, or on a SLURM cluster.

A launcher starts one command. :class:`tslam_bench.evaluation.jobs.JobRunner` decides which one is next, and the engine on which
machine it runs: nothing here schedules.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Literal, Protocol, get_args

from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.work import LostError, Work, run_work, stop_process
from tslam_bench.extras import named_extra

LauncherName = Literal["local", "ray", "slurm"]
_RAISED: Final = re.compile(r"(?:\w+\.)*\w+(?:Error|Exception|Interrupt): ")
"""Begins the last line of a traceback."""
_PATIENCE: Final = 15.0
"""Seconds that a job has to end in after it was cancelled."""
_KILL_WAIT: Final = 60.0
"""Seconds. SLURM ends a job that it takes away, to begin it again, with SIGTERM to all its processes and, half a minute later,
with SIGKILL: only what is still there after this time was killed by somebody else."""
_SLURM_MINUTES: Final = 720
"""Limit of a job where the user gives none (``timeout_min``). A job that meets it goes on where it was, ``retries`` times."""


class Launched(Protocol):
    """A command that was started."""

    def poll(self) -> int | None:
        """Exit status, or None as long as it runs or waits for a machine. Raises LostError if it was lost for good."""

    def stop(self) -> None:
        """Ends it, if it has not ended."""


class Launcher(Protocol):
    """Starts commands.

    Attributes:
        cores: those that may be busy at a time; None if the engine sees to that.
    """

    cores: int | None

    def check(self, slots: int) -> None:
        """Raises InvalidInputError if no machine has so many cores."""

    def start(self, work: Work, lock: int | None = None) -> Launched:
        """Starts a command; ``lock`` is a descriptor that it keeps open, if it is a process of this machine."""

    def close(self) -> None:
        """Leaves the engine."""


def make_launcher(name: str, folder: Path, cores: int, address: str | None, slurm: Mapping[str, Any]) -> Launcher:
    """The launcher of this name.

    Args:
        name: one of ``LauncherName``.
        folder: for the engine's own files.
        cores: of the local launcher.
        address: of the Ray cluster.
        slurm: submitit's parameters.

    Raises:
        InvalidInputError: an unknown name, options of another launcher, or the engine cannot be reached.
        MissingPackageError: the extra is not installed.
    """
    if name not in get_args(LauncherName):
        raise InvalidInputError(f"launcher {name!r}: unknown; choose one of {', '.join(get_args(LauncherName))}")
    if address is not None and name != "ray":
        raise InvalidInputError(f"--address {address}: is for --launcher ray")
    if slurm and name != "slurm":
        raise InvalidInputError(f"--slurm {' '.join(slurm)}: is for --launcher slurm")
    if name == "ray":
        return RayLauncher(address)
    return SlurmLauncher(folder, slurm) if name == "slurm" else LocalLauncher(cores)


# -- local --------------------------------------------------------------------------------------------------------------
class LocalLauncher:
    """Processes of this machine, ``cores`` at a time. One that fails is not started again."""

    def __init__(self, cores: int) -> None:
        if cores < 1:
            raise InvalidInputError(f"workers {cores}: must be at least 1")
        self.cores: int | None = cores

    def check(self, slots: int) -> None:
        """A job with more slots than there are cores runs alone."""

    def start(self, work: Work, lock: int | None = None) -> Launched:
        """Starts a process, which holds the lock until it is gone."""
        with work.log.open("a", encoding="utf-8") as log:
            process = subprocess.Popen(
                work.program(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=work.folder,
                env={**os.environ, **work.environment},
                pass_fds=() if lock is None else (lock,),
            )
        return _LocalProcess(process)

    def close(self) -> None:
        """Nothing to leave."""


class _LocalProcess:
    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def poll(self) -> int | None:
        return self._process.poll()

    def stop(self) -> None:
        stop_process(self._process)


# -- Ray ----------------------------------------------------------------------------------------------------------------
class RayLauncher:
    """Tasks of a Ray cluster: Ray finds each a node with as many free cores, and starts it again where the node is lost.

    Args:
        address: of the cluster; None: the one that ``RAY_ADDRESS`` names or that runs on this machine, or else a new one of
            this machine alone.

    Raises:
        MissingPackageError: Ray is not installed.
        InvalidInputError: there is no cluster at the address.
    """

    cores: int | None = None

    def __init__(self, address: str | None) -> None:
        with named_extra():
            import ray
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that is started here reports to nobody
        ending = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(
                address, log_to_driver=False, logging_level=logging.ERROR, include_dashboard=None if address else False
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InvalidInputError(f"Ray cluster {address or 'of this machine'}: {reason}") from error
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, ending)  # Ray has put its own there
        self._ray = ray

    def check(self, slots: int) -> None:
        """Compares with the node that has most cores; Ray would wait for ever."""
        most = max((int(node["Resources"].get("CPU", 0)) for node in self._ray.nodes() if node["Alive"]), default=0)
        if slots > most:
            raise InvalidInputError(
                f"a job wants {slots} cores, and the largest node has {most}; give --workers {most}"
            )

    def start(self, work: Work, lock: int | None = None) -> Launched:
        """Hands a command to Ray."""
        options = {
            "num_cpus": work.slots,
            "max_retries": work.retries,
            "retry_exceptions": [LostError],
            "name": work.name,
        }
        return _RayTask(self._ray, work, self._ray.remote(_run_in_ray).options(**options).remote(work))

    def close(self) -> None:
        """Leaves the cluster; one that was started here ends."""
        self._ray.shutdown()


def _run_in_ray(work: Work) -> int:
    """What Ray calls on the node."""
    import ray

    return run_work(work, f"(node {ray.get_runtime_context().get_node_id()[:8]})")


class _RayTask:
    def __init__(self, ray: Any, work: Work, reference: Any) -> None:
        self._ray, self._work, self._reference = ray, work, reference

    def poll(self) -> int | None:
        ready, _ = self._ray.wait([self._reference], timeout=0)
        if not ready:
            return None
        try:
            return int(self._ray.get(self._reference))
        except self._ray.exceptions.RayError as error:
            raise LostError(f"{self._work.name}: {_reason(error)}") from error

    def stop(self) -> None:
        for force in (False, True):  # first as Ctrl-C does, so that the command ends in order
            self._ray.cancel(self._reference, force=force)
            if self._ray.wait([self._reference], timeout=_PATIENCE)[0]:
                return


# -- SLURM --------------------------------------------------------------------------------------------------------------
class SlurmLauncher:
    """Jobs of a SLURM cluster, one each, through submitit.

    Args:
        folder: for submitit's files; shared by all machines.
        parameters: those of ``submitit.AutoExecutor.update_parameters``, such as ``slurm_partition``, ``timeout_min``;
            ``cluster="local"`` runs the jobs here through submitit, to try it out.

    Raises:
        MissingPackageError: submitit is not installed.
        InvalidInputError: SLURM's programs are not here, or submitit does not know a parameter.
    """

    cores: int | None = None

    def __init__(self, folder: Path, parameters: Mapping[str, Any]) -> None:
        with named_extra():
            import submitit
        self._submitit, self._folder = submitit, folder
        self._parameters = {"timeout_min": _SLURM_MINUTES, **parameters}
        self._cluster = str(self._parameters.pop("cluster", "slurm"))
        if self._cluster not in ("slurm", "local"):
            raise InvalidInputError(f"--slurm: cluster={self._cluster}: choose slurm or local")
        if self._cluster == "slurm" and shutil.which("sbatch") is None:
            raise InvalidInputError("SLURM: there is no sbatch here; start the run where you submit jobs")

        self._executor("check", 1, 0)

    def check(self, slots: int) -> None:
        """SLURM itself refuses what no node has."""

    def start(self, work: Work, lock: int | None = None) -> Launched:
        """Submits a command. Raises InvalidInputError if SLURM refuses it."""
        executor = self._executor(work.name, work.slots, work.retries)
        try:
            return _SlurmJob(self._submitit, work, executor)
        except self._submitit.core.utils.FailedJobError as error:  # what sbatch says
            raise InvalidInputError(f"SLURM, job {work.name}: {_reason(error)}") from error

    def _executor(self, name: str, slots: int, retries: int) -> Any:
        timeouts = {"slurm_max_num_timeout": retries} if self._cluster == "slurm" else {}
        try:
            executor = self._submitit.AutoExecutor(self._folder, self._cluster, **timeouts)
            executor.update_parameters(name=name, nodes=1, tasks_per_node=1, cpus_per_task=slots)
            executor.update_parameters(**self._parameters)
        except (AssertionError, NameError, RuntimeError, TypeError, ValueError) as error:
            raise InvalidInputError(f"--slurm: {' '.join(str(error).split())[:300]}") from error
        return executor

    def close(self) -> None:
        """Nothing to leave."""


class _Resumable:
    """What submitit calls on the node. Where SLURM takes the node away, the same command is queued again and goes on."""

    def __call__(self, work: Work) -> int:
        job = os.environ.get("SLURM_JOB_ID")
        try:
            return run_work(work, f"(job {job or os.getpid()})")
        except LostError:
            if job is not None:
                time.sleep(_KILL_WAIT)
            raise

    def checkpoint(self, work: Work) -> Any:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, work)


class _SlurmJob:
    def __init__(self, submitit: Any, work: Work, executor: Any) -> None:
        self._submitit, self._work, self._executor = submitit, work, executor
        self._left = work.retries
        self._job = executor.submit(_Resumable(), work)

    def poll(self) -> int | None:
        if not self._job.done():
            return None
        try:
            return int(self._job.result())
        except (self._submitit.core.utils.UncompletedJobError, self._submitit.core.utils.FailedJobError) as error:
            if self._left == 0:
                raise LostError(f"{self._work.name}: {_reason(error)}") from error
            self._left -= 1
            self._job = self._executor.submit(_Resumable(), self._work)
            return None

    def stop(self) -> None:
        if not self._job.done():
            self._job.cancel()
        end = time.monotonic() + _PATIENCE
        while not self._job.done() and time.monotonic() < end:
            time.sleep(0.2)


def _reason(error: BaseException) -> str:
    """What an engine says, on one line: the error that ends its traceback, or its own first line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    raised = [line for line in lines if _RAISED.match(line)]
    text = _RAISED.sub("", raised[-1]) if raised else (lines or [type(error).__name__])[0]
    return text[:300]
