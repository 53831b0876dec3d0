"""Preparing processes: their settings, and that they do not outlive the command that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from tslam_bench.preparation.workers import WorkerPool


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent_in_the_middle_of_a_job(how):
    script = textwrap.dedent("""
        import time
        from tslam_bench.preparation.workers import WorkerPool
        if __name__ == "__main__":
            pool = WorkerPool(time.sleep, size=2, time_limit=600.0)
            for job in range(2):
                pool.submit(job, (300.0,))
            print(*(worker.process.pid for worker in pool._workers), flush=True)
            time.sleep(300)
    """)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(workers) == 2
        time.sleep(2)  # until they work
        parent.send_signal(how)
    deadline = time.monotonic() + 30
    while any(_runs(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_runs(pid) for pid in workers)


def test_a_worker_has_settings_of_its_own(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MALLOC_TRIM_THRESHOLD_", raising=False)
    pool: WorkerPool[str, str | None] = WorkerPool(os.getenv, size=1, time_limit=60.0)
    seen = {}
    try:
        for variable in ("OMP_NUM_THREADS", "MALLOC_TRIM_THRESHOLD_"):
            pool.submit(variable, (variable,))
            seen |= {item: result for item, result, _ in pool.results()}
    finally:
        pool.close()
    assert seen == {"OMP_NUM_THREADS": "1", "MALLOC_TRIM_THRESHOLD_": str(2**32)}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MALLOC_TRIM_THRESHOLD_" not in os.environ


def test_preparation_says_that_it_needs_a_process():
    """What may crash is kept to a process of its own, so there is no going on without."""
    code = """
        import os, resource
        from tslam_bench.errors import AssetError
        from tslam_bench.preparation.workers import WorkerPool
        used = len(os.listdir("/proc/self/fd"))
        for more in range(8):  # wherever it runs out
            resource.setrlimit(resource.RLIMIT_NOFILE, (used + more, 100))
            pool = WorkerPool(abs, size=1, time_limit=60.0)
            try:
                pool.submit("one", (-1,))
                pool.close()
                break
            except AssetError as error:
                print(error)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert len(lines) >= 3 and done.returncode == 0, done.stderr
    assert set(lines) == {
        "preparation works in processes, and the system refuses one (Too many open files); give it fewer --workers"
    }


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False
