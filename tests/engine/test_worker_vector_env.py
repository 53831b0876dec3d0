"""The batched CPU environment: the ManiSkill task bit for bit, Gymnasium's semantics, and workers that die."""

from __future__ import annotations

import contextlib
import hashlib
import multiprocessing
import os
import selectors
import signal
import struct
import subprocess
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import gymnasium as gym
import numpy as np
import pytest
import torch

import tslam_bench
from tslam_bench.constants import ENVIRONMENT_ID, HORIZON, NUM_JOINTS, TABLETOP_ID
from tslam_bench.engine.hand_batch import BatchSettings
from tslam_bench.engine.hand_workers import HandWorkers, WorkerError
from tslam_bench.errors import InvalidInputError

OBJECTS = ("mug", "hammer", "toruslarge")


COUNTS = ("new_touched", "new_visited")


def counted(info: dict, name: str) -> np.ndarray:
    """What a step counted: that of an ended episode is in ``final_info``."""
    return info[name] + info["final_info"][name] if "final_info" in info else info[name]


def actions_of(seed: int, steps: int) -> np.ndarray:
    generator = np.random.Generator(np.random.PCG64(seed))
    actions = generator.uniform(-1, 1, (steps, NUM_JOINTS)).astype(np.float32)
    actions[:40, 1] = -1.0
    return actions


@pytest.mark.parametrize(
    ("environment_id", "control_mode"),
    [
        (ENVIRONMENT_ID, "pd_joint_delta_pos"),
        (ENVIRONMENT_ID, "pd_joint_pos"),
        (TABLETOP_ID, "pd_joint_delta_pos"),
    ],
)
def test_bit_for_bit_the_maniskill_task_over_episodes_objects_and_poses(environment_id, control_mode):
    num_envs, steps = 3, HORIZON + 30  # into the second episode, whose object and pose the generator draws on
    envs = tslam_bench.make_vec(
        environment_id, num_envs, "cpu", objects=OBJECTS, processes=2, control_mode=control_mode
    )
    single = gym.make(environment_id, objects=OBJECTS, control_mode=control_mode)
    actions = np.stack([actions_of(env, steps) for env in range(num_envs)], axis=1)
    observation, info = envs.reset(seed=7)
    batch = [(observation, None, None, info)]
    for step in range(steps):
        observation, reward, terminated, truncated, info = envs.step(actions[step])
        assert not terminated.any()
        batch.append((observation, reward, truncated, info))
    touched = 0
    for env in range(num_envs):
        expected, _ = single.reset(seed=7 + env)
        for step in range(steps + 1):
            observation, reward, truncated, info = batch[step]
            if step:
                expected, expected_reward, _, expected_truncated, expected_info = single.step(actions[step - 1, env])
                assert reward[env] == expected_reward.numpy()[0]
                assert truncated[env] == expected_truncated.numpy()[0]
                own_info = info["final_info"] if truncated[env] else info
                assert own_info["new_touched"][env] == int(expected_info["new_touched"])
                assert own_info["new_visited"][env] == int(expected_info["new_visited"])
                if truncated[env]:
                    final = info["final_obs"][env]
                    for key, value in expected.items():
                        np.testing.assert_array_equal(final[key], value[0].numpy(), err_msg=f"final {key}")
                    touched += int(final["occupancy"][0].sum())
                    expected, _ = single.reset()
            for key, value in expected.items():
                np.testing.assert_array_equal(observation[key][env], value[0].numpy(), err_msg=f"{key}, step {step}")
    assert touched > 0, "the comparison has to include contact"
    envs.close()
    single.close()


@pytest.mark.parametrize(("control_mode", "reward_mode"), [("pd_joint_pos", "tslam"), ("pd_joint_delta_pos", "knn")])
def test_held_actions_are_bit_for_bit_single_steps(control_mode, reward_mode):
    """Rewards and counts added up, over the end of an episode, and with episodes that end at different times."""
    num_envs, repeat, decisions = 3, 8, 40
    arguments = {"objects": OBJECTS, "control_mode": control_mode, "reward_mode": reward_mode, "processes": 2}
    held = tslam_bench.make_vec(ENVIRONMENT_ID, num_envs, "cpu", action_repeat=repeat, **arguments)
    single = tslam_bench.make_vec(ENVIRONMENT_ID, num_envs, "cpu", **arguments)
    actions = np.stack([actions_of(env, decisions) for env in range(num_envs)], axis=1)
    for envs in (held, single):
        envs.reset(seed=5)
    ends = 0
    for decision in range(decisions):
        if decision == 10:
            for envs in (held, single):
                envs.reset(options={"reset_mask": np.array([False, True, False])})
        observation, reward, terminated, truncated, info = held.step(actions[decision])
        total, sums, final = np.zeros(num_envs, np.float32), dict.fromkeys(COUNTS, 0), None
        for step in range(repeat):
            expected, one, _, ended, expected_info = single.step(actions[decision])
            total += one
            sums = {name: value + counted(expected_info, name) for name, value in sums.items()}
            assert step == repeat - 1 or not ended.any()
            final = expected_info.get("final_obs")
        np.testing.assert_array_equal(reward, total)
        np.testing.assert_array_equal(truncated, ended)
        assert not terminated.any() and (final is None) == ("final_obs" not in info)
        for name, value in sums.items():
            np.testing.assert_array_equal(counted(info, name), value)
        for key, value in expected.items():
            np.testing.assert_array_equal(observation[key], value)
            for env in np.flatnonzero(ended):
                np.testing.assert_array_equal(info["final_obs"][env][key], final[env][key])
        ends += int(ended.sum())
    assert ends == num_envs  # at different times
    held.close()
    single.close()


def test_spaces_options_and_partial_resets():
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", objects=OBJECTS, processes=1)
    assert envs.metadata["autoreset_mode"] == gym.vector.AutoresetMode.SAME_STEP
    observation, info = envs.reset(seed=0, options={"object": ["hammer", "mug"], "pose": 6})
    assert envs.observation_space.contains(observation)
    assert {name for name in info if name[0] != "_"} == {"elapsed_steps", *COUNTS}
    state = envs.state()
    assert state["object_name"] == ["hammer", "mug"] and state["pose"] == [6, 6]
    for action in actions_of(0, 20):
        observation, *_ = envs.step(np.repeat(action[None], 2, axis=0))
    kept = {key: value[0].copy() for key, value in observation.items()}
    observation, info = envs.reset(options={"reset_mask": np.array([False, True]), "pose": 1})
    for key, value in kept.items():
        np.testing.assert_array_equal(observation[key][0], value, err_msg="the other environment goes on")
    assert info["elapsed_steps"].tolist() == [20, 0] and observation["occupancy"][1].sum() == 0
    assert info["_elapsed_steps"].tolist() == [False, True]
    envs.close()
    with pytest.raises(WorkerError, match="closed"):
        envs.step(np.zeros((2, NUM_JOINTS), np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_envs": 0}, "num_envs 0: must be a whole number from 1"),
        ({"num_envs": 10**9}, "num_envs 1000000000"),
        ({"num_envs": -3}, "num_envs -3"),
        ({"num_envs": 2.0}, r"num_envs 2\.0: must be a whole number"),
        ({"num_envs": True}, "num_envs True"),
        ({"num_envs": "many"}, "num_envs 'many'"),
        ({"num_envs": 2, "processes": -1}, "processes -1: must be a whole number from 0 to 256"),
        ({"num_envs": 2, "processes": 2.0}, r"processes 2\.0"),
        ({"num_envs": 2, "timeout": 0}, "timeout 0: must be a number of seconds above 0"),
        ({"num_envs": 2, "device": "tpu"}, "device 'tpu': unknown"),
        ({"num_envs": 2, "action_repeat": 3}, "action_repeat 3: must divide the 200 steps of an episode"),
        ({"num_envs": 2, "action_repeat": 0}, "action_repeat 0"),
        ({"num_envs": 2, "action_repeat": 2.0}, r"action_repeat 2\.0"),
        ({"num_envs": 2, "object": "mugg"}, "mugg"),
        ({"num_envs": 2, "pose": 9}, "pose 9"),
        ({"num_envs": 2, "reward_mode": "dense"}, "reward_mode 'dense'"),
        ({"num_envs": 2, "environment_id": "TactileSLAM-v9"}, "environment 'TactileSLAM-v9': unknown"),
        pytest.param(
            {"num_envs": 2, "device": "cuda"},
            "no CUDA GPU",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, so this is no error"),
        ),
    ],
)
def test_bad_arguments_get_one_line(arguments, message):
    with pytest.raises(InvalidInputError, match=message) as caught:
        tslam_bench.make_vec(**{"device": "cpu", **arguments})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("processes", [0, 1])
def test_a_step_before_the_first_reset_gets_one_line(processes):
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=processes)
    actions = np.zeros((2, NUM_JOINTS), np.float32)
    with pytest.raises(InvalidInputError, match="step: no episode has begun; call reset first"):
        envs.step(actions)
    with pytest.raises(InvalidInputError, match="the first reset is of all environments"):
        envs.reset(seed=0, options={"reset_mask": np.array([True, False])})
    envs.reset()
    envs.step(actions)
    envs.close()


def digest_of_an_episode(processes: int | None) -> str:
    """Hash of what three environments return past the end of their episodes, ManiSkill's own tasks beside them or not."""
    envs = tslam_bench.make_vec(TABLETOP_ID, 3, "cpu", objects=OBJECTS, processes=processes, reward_mode="chamfer")
    digest, touched = hashlib.sha256(), 0
    observation, _ = envs.reset(seed=4)
    for action in actions_of(3, HORIZON + 30):
        observation, reward, _, truncated, info = envs.step(np.stack([action, -action, action[::-1]]))
        for value in (*observation.values(), reward, truncated, *(counted(info, name) for name in COUNTS)):
            digest.update(value.tobytes())
        for final in info.get("final_obs", ()):
            touched += int(final["occupancy"][0].sum())
            for value in final.values():
                digest.update(value.tobytes())
    digest.update(envs.state()["touched_step"].tobytes())
    envs.close()
    assert touched > 20, "the comparison has to include contact"
    return digest.hexdigest()


def in_a_daemonic_process(_: int) -> tuple[bool, list[str], str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        digest = digest_of_an_episode(None)
    messages = [str(warning.message) for warning in caught if "daemonic" in str(warning.message)]
    try:
        tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2)
    except InvalidInputError as error:
        messages.append(str(error))
    return multiprocessing.current_process().daemon, messages, digest


def test_the_caller_s_own_process_gives_the_same_bits_without_workers():
    other = gym.make(ENVIRONMENT_ID, object="mug")  # SAPIEN's defaults are global: another task may have set them
    other.reset(seed=0)
    children = multiprocessing.active_children()
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 1, "cpu", object="mug", processes=0)
    assert multiprocessing.active_children() == children
    envs.close()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        daemonic, messages, there = pool.map(in_a_daemonic_process, [0])[0]
    assert daemonic and len(messages) == 2 and not any("\n" in message for message in messages)
    assert "the hands are stepped in this one" in messages[0] and "give processes=0" in messages[1]
    assert digest_of_an_episode(0) == digest_of_an_episode(2) == there
    other.close()


def test_where_the_system_refuses_processes_the_caller_s_own_does_the_work():
    """A limit on open files: no pipe, no process. Asked for, it is an error; else it is said once, with the same bits."""
    code = """
        import resource, warnings, numpy as np, tslam_bench
        if __name__ == "__main__":
            envs = tslam_bench.make_vec(num_envs=2, device="cpu", object="mug", processes=1)
            first, _ = envs.reset(seed=7)
            envs.close()
            used = len(__import__("os").listdir("/proc/self/fd"))
            resource.setrlimit(resource.RLIMIT_NOFILE, (used + 6, used + 6))
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                envs = tslam_bench.make_vec(num_envs=2, device="cpu", object="mug")
            again, _ = envs.reset(seed=7)
            print(*[warning.message for warning in caught if "worker processes" in str(warning.message)])
            print(all(np.array_equal(first[name], again[name]) for name in first))
            try:
                tslam_bench.make_vec(num_envs=2, device="cpu", object="mug", processes=2)
            except tslam_bench.errors.BenchmarkError as error:
                print(error)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    lines = done.stdout.splitlines()
    assert len(lines) == 3 and lines[1] == "True", (lines, done.stderr)
    assert lines[0].startswith("the system refuses worker processes ([Errno 24] Too many open files")
    assert lines[2].endswith("give processes=0")


class Interruption(Exception):
    """What the alarm raises."""


def test_what_fails_in_the_caller_s_own_process_has_its_traceback_and_closes_the_environment():
    """An alarm rings while the hands are stepped one by one: some are a step ahead of others, so nothing may go on."""
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 4, "cpu", object="mug", processes=0)
    envs.reset(seed=0)

    def ring(_: int, frame: FrameType | None) -> None:
        while frame is not None:
            if Path(frame.f_code.co_filename).name == "hand_batch.py":
                raise Interruption
            frame = frame.f_back
        signal.setitimer(signal.ITIMER_REAL, 0.001)

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, 0.02)
    try:
        with pytest.raises(Interruption) as caught:
            while True:
                envs.step(np.zeros((4, NUM_JOINTS), np.float32))
    finally:
        signal.signal(signal.SIGALRM, before)
    assert "hand_batch.py" in {Path(entry.path).name for entry in caught.traceback}
    with pytest.raises(WorkerError, match="closed"):
        envs.reset()


@contextlib.contextmanager
def alarm(seconds: float, what: Callable[[], None] | None = None) -> Iterator[None]:
    """Calls ``what``, or raises ``Interruption``, after so many seconds, wherever this process is then."""

    def ring(*_: object) -> None:
        if what is None:
            raise Interruption
        what()

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("interrupted", ["reset", "step", "state"])
def test_no_call_gets_the_answer_of_an_interrupted_one(interrupted):
    """A worker is stopped while it should answer, the own time limit rings, then the worker goes on."""
    workers = HandWorkers(2, BatchSettings("mug"), 2, timeout=60.0)
    calls = {
        "reset": lambda: workers.reset([3, 4], [0, 1]),
        "step": lambda: workers.step(),
        "state": lambda: workers.state(),
    }
    calls["reset"]()
    processes = workers.processes
    os.kill(processes[0].pid, signal.SIGSTOP)
    with pytest.raises(Interruption), alarm(0.3):
        calls[interrupted]()
    for call in calls.values():
        with pytest.raises(WorkerError, match="stopped; make a new environment"):
            call()
    assert not any(process.is_alive() for process in processes)
    workers.stop()


def test_an_answer_to_another_request_is_none():
    workers = HandWorkers(2, BatchSettings("mug"), 2, timeout=60.0)
    workers.reset([3, 4], [0, 1])
    workers._workers[1][1].send((7, "state", None))  # as a second thread would
    with pytest.raises(WorkerError, match="worker 1: its answer was to another request; use one thread only"):
        workers.step()
    assert workers.processes == []


def test_an_interrupted_environment_says_what_broke_it():
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2)
    envs.reset(seed=0)
    os.kill(envs._hands.processes[0].pid, signal.SIGSTOP)
    with pytest.raises(Interruption), alarm(0.3):
        envs.step(np.zeros((2, NUM_JOINTS), np.float32))
    with pytest.raises(WorkerError, match="is closed since step ended with Interruption; make a new one"):
        envs.reset(seed=7)
    envs.close()
    envs.close()


@pytest.mark.parametrize("closed", ["step", "state"])
def test_an_environment_that_a_signal_handler_closes_in_the_middle_of_a_call_says_so(closed):
    """As a batch system's warning before its time limit does; the call must not come back with what half the hands did."""
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2)
    envs.reset(seed=0)
    processes = envs._hands.processes
    os.kill(processes[0].pid, signal.SIGSTOP)
    calls = {"step": (np.zeros((2, NUM_JOINTS), np.float32),), "state": ()}
    with (
        pytest.raises(
            WorkerError, match=f"the workers were stopped in the middle of a {closed}; make a new environment"
        ),
        alarm(0.3, envs.close),
    ):
        getattr(envs, closed)(*calls[closed])
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(WorkerError, match="make a new one"):
        envs.state()


def test_half_an_answer_is_the_end_of_a_worker():
    workers = HandWorkers(2, BatchSettings("mug"), 2, timeout=60.0)
    workers.reset([3, 4], [0, 1])
    ours, theirs = multiprocessing.Pipe()
    os.write(theirs.fileno(), struct.pack("!i", 1000) + bytes(10))  # a message of 1000 bytes begins
    theirs.close()
    process, pipe = workers._workers[1]
    workers._selector.unregister(pipe)
    workers._selector.register(ours, selectors.EVENT_READ, 1)
    workers._workers[1] = (process, ours)
    pipe.close()
    with pytest.raises(WorkerError, match="worker 1: died"):
        workers.state()
    assert not process.is_alive()


def test_workers_leave_ctrl_c_to_the_caller():
    """A terminal and a notebook send Ctrl-C to every process; a program that finishes its step first may go on."""
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2)
    envs.reset(seed=0)
    for process in envs._hands.processes:
        os.kill(process.pid, signal.SIGINT)
    for _ in range(3):
        envs.step(np.zeros((2, NUM_JOINTS), np.float32))
    envs.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_a_forked_process_takes_nothing_from_its_parent():
    """Data loaders fork: what the child asks or ends there must not reach the workers of the parent."""
    code = """
        import os, numpy as np, tslam_bench
        if __name__ == "__main__":
            envs = tslam_bench.make_vec(num_envs=2, device="cpu", object="mug", processes=2)
            first, _ = envs.reset(seed=7)
            child = os.fork()
            if child == 0:
                try:
                    envs.state()
                except tslam_bench.errors.BenchmarkError as error:
                    print(error, flush=True)
                envs.close()
                os._exit(0)
            os.waitpid(child, 0)
            again, _ = envs.reset(seed=7)
            print(all(np.array_equal(first[name], again[name]) for name in first), envs.state()["object_name"])
            envs.close()
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines() == [
        "the vector environment belongs to the process that made it; make one in this process",
        "True ['mug', 'mug']",
    ], done.stderr


def test_bad_actions_and_dead_workers():
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2)
    envs.reset(seed=0)
    good = np.zeros((2, NUM_JOINTS), np.float32)
    for bad, message in (
        (good[:1], r"shape \(1, 28\), expected \(2, 28\)"),
        (np.where(np.arange(NUM_JOINTS) == 1, np.nan, good), "not finite for joint ARTy of environment 0"),
        ("up", "not an array of numbers"),
        (np.full((2, NUM_JOINTS), np.inf), "not finite for joint ARTx of environment 0"),
        (np.full((2, NUM_JOINTS), "a"), "not an array of numbers"),
        (None, r"shape \(\)"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            envs.step(bad)
    envs.step(good)  # refused actions harm nothing
    processes = envs._hands.processes
    os.kill(processes[1].pid, signal.SIGKILL)
    started = time.monotonic()
    with pytest.raises(WorkerError, match=r"worker 1: died \(exit code -9\)"):
        for _ in range(3):
            envs.step(good)
    assert time.monotonic() - started < 20
    assert not any(process.is_alive() for process in processes), "no worker is left behind"


@pytest.mark.parametrize("request_name", ["step", "state"])
def test_a_hung_worker_is_found_within_the_timeout(request_name):
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=2, timeout=3.0)
    envs.reset(seed=0)
    processes = envs._hands.processes
    os.kill(processes[0].pid, signal.SIGSTOP)
    started = time.monotonic()
    with pytest.raises(WorkerError, match="worker 0: no answer for 3 s; all workers were stopped") as caught:
        envs.step(np.zeros((2, NUM_JOINTS), np.float32)) if request_name == "step" else envs.state()
    assert "\n" not in str(caught.value) and 2.5 < time.monotonic() - started < 60
    assert not any(process.is_alive() for process in processes), "a stopped worker is killed, none is left behind"
    with pytest.raises(WorkerError, match="closed"):
        envs.reset()


def test_a_run_that_is_stopped_as_a_whole_goes_on():
    """Ctrl-Z, or a batch system that suspends a job for longer than the workers have to answer."""
    code = """
        import numpy as np, tslam_bench
        if __name__ == "__main__":
            envs = tslam_bench.make_vec(num_envs=2, device="cpu", object="mug", processes=2, timeout=3.0)
            envs.reset(seed=0)
            print("ready", flush=True)
            for step in range(600):
                envs.step(np.zeros((2, 28), np.float32))
            print("done", flush=True)
    """
    run = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert run.stdout is not None and run.stdout.readline() == "ready\n"
    os.killpg(run.pid, signal.SIGSTOP)
    time.sleep(4.5)
    os.killpg(run.pid, signal.SIGCONT)
    assert run.stdout.readline() == "done\n" and run.wait(30) == 0


def test_refused_options_harm_nothing():
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 2, "cpu", object="mug", processes=1)
    envs.reset(seed=0)
    for options, message in (
        ({"object": "mugg"}, "mugg"),
        ({"object": ["mug"]}, r"options\['object'\]: 1 values for 2 environments"),
        ({"pose": 8}, "pose 8"),
        ({"reset_mask": np.ones(3, dtype=bool)}, "reset_mask"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            envs.reset(options=options)
    with pytest.raises(InvalidInputError, match="seed: 3 values for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    observation, *_ = envs.step(np.zeros((2, NUM_JOINTS), np.float32))
    assert (observation["time"] > 0).all()
    envs.close()


def test_nothing_is_left_when_the_parent_is_killed():
    code = """
        import sys, time, tslam_bench
        if __name__ == "__main__":
            envs = tslam_bench.make_vec(num_envs=2, device="cpu", object="mug", processes=2)
            envs.reset(seed=0)
            print(*[process.pid for process in envs._hands.processes], flush=True)
            time.sleep(60)
    """
    before = set(Path("/dev/shm").iterdir()) if Path("/dev/shm").exists() else set()
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pids = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(pids) == 2
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(Path(f"/proc/{pid}/stat").exists() for pid in pids):
        if all(_is_zombie(pid) for pid in pids):
            break
        time.sleep(0.1)
    assert all(_is_zombie(pid) for pid in pids), "workers outlive their parent"
    if before:
        assert set(Path("/dev/shm").iterdir()) <= before, "shared memory is left behind"


def _is_zombie(pid: int) -> bool:
    """Gone, or dead and waiting for whoever inherited it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True
