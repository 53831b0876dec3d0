"""What a GPU runs, as far as it can be run without one: the torch code on real simulation data, no waiting for the device,
memory sizes, and the comparison behind ``tslam-bench gpu-check``."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import tslam_bench
from tslam_bench.cli import main
from tslam_bench.constants import ENVIRONMENT_ID, NUM_JOINTS, REWARD_MODES
from tslam_bench.engine.arrays import NumpyBackend, TorchBackend
from tslam_bench.engine.control import DriveTargets
from tslam_bench.engine.field_atlas import FieldAtlas
from tslam_bench.engine.gpu_memory import CONTACTS_PER_PAIR, HAND_SHAPES, TOUCHING_PAIRS, gpu_memory
from tslam_bench.engine.hand_agent import _finite, matrices_from_poses
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.native_output import captured_output
from tslam_bench.engine.rewards import Rewards
from tslam_bench.engine.sensing import Sensing
from tslam_bench.engine.sensing_numba import CompiledSensing
from tslam_bench.engine.sensing_torch import TorchSensing
from tslam_bench.engine.skin import build_skin
from tslam_bench.errors import InvalidInputError
from tslam_bench.evaluation.gpu_check import Episodes, compare, judge, record
from tslam_bench.hand_constants import CONTROL_MODES, SKIN_LINKS
from tslam_bench.objects.hand import load_hand
from tslam_bench.objects.store import load_object

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "gpu"))
from emulated_gpu import emulated_gpu

ENVS, STEPS = 4, 70
EPISODES = Episodes.draw(("mug", "hammer"), (0, 2, 5), ENVS)


@pytest.fixture(scope="module")
def simulated():
    """Link poses (T, E, L, 3, 4), joint positions (T, E, 28) and actions of real episodes."""
    batch = HandBatch(ENVS, BatchSettings(objects=("mug", "hammer"), reward_mode="none"))
    arrays = batch.arrays
    batch.reset(list(EPISODES.seeds), list(range(ENVS)), list(EPISODES.objects), list(EPISODES.poses))
    links, qpos = [], []
    for action in EPISODES.actions[:STEPS]:
        qpos.append(arrays["qpos"].copy())
        arrays["action"][:] = action
        batch.step()
        links.append(batch._links.copy())
    return np.stack(links), np.stack(qpos), EPISODES.actions[:STEPS]


def begun(mode: str, device: str | None) -> tuple[Sensing, Rewards]:
    """Sensing and rewards at the start of the episodes: as the CPU engine has them, or on a torch device."""
    skin = build_skin(load_hand().shapes)
    sensing: Sensing = CompiledSensing(ENVS, skin) if device is None else TorchSensing(ENVS, skin, device)
    rewards = Rewards(mode, ENVS, sensing.backend)
    for env, (name, pose) in enumerate(zip(EPISODES.objects, EPISODES.poses, strict=True)):
        prepared = load_object(name)
        sensing.set_object(env, name, prepared.field, pose)
        rewards.set_object(env, prepared, pose)
    sensing.begin(range(ENVS))
    rewards.begin(range(ENVS))
    return sensing, rewards


ROUNDED = ("knn", "disagreement", "chamfer")
"""Modes with sums over many numbers, which numpy and torch add in another order; all others are equal to the last bit."""


@pytest.mark.parametrize("mode", REWARD_MODES)
def test_tensors_on_real_episodes_are_the_cpu_engine_in_every_reward_mode(simulated, mode):
    links, _, _ = simulated
    host, host_rewards = begun(mode, None)
    device, device_rewards = begun(mode, "cpu")
    felt = 0
    for step in range(STEPS):
        a = host.step(links[step], np.full(ENVS, step))
        b = device.step(torch.from_numpy(links[step]), torch.full((ENVS,), step))
        felt += int(a.on.sum())
        np.testing.assert_array_equal(a.on, b.on.numpy())
        np.testing.assert_array_equal(host.link_touch(), device.link_touch().numpy())
        expected, found = host_rewards.step(a), device_rewards.step(b)
        assert found.dtype == torch.float32 and found.shape == (ENVS,)
        if mode in ROUNDED:
            np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=5e-5, err_msg=f"step {step}")
        else:
            np.testing.assert_array_equal(found.numpy(), expected, err_msg=f"step {step}")
    for name in ("touched", "visited", "touched_step"):
        np.testing.assert_array_equal(getattr(host, name), getattr(device, name).numpy(), err_msg=name)
    assert felt > 500, "the comparison has to include contact"


@pytest.mark.parametrize("control_mode", CONTROL_MODES)
def test_torch_drive_targets_are_numpys(simulated, control_mode):
    _, qpos, actions = simulated
    host, device = DriveTargets(control_mode, NumpyBackend()), DriveTargets(control_mode, TorchBackend("cpu"))
    for step in range(0, STEPS, 7):
        expected = host(1.5 * actions[step], qpos[step])
        found = device(torch.from_numpy(1.5 * actions[step]), torch.from_numpy(qpos[step]))
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6, atol=1e-6)


class NoHostCopies(TorchDispatchMode):
    """Refuses operations that wait for the device or copy between it and the host."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = str(func)
        host = [a for a in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(a, torch.Tensor)]
        mixed = {a.device.type for a in host if a.dim() > 0} | {str((kwargs or {}).get("device") or "meta")}
        if "_local_scalar_dense" in name or "nonzero" in name or "cpu" in mixed:
            raise AssertionError(f"{name} waits for the device or copies from or to the host")
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("mode", REWARD_MODES)
def test_a_step_makes_no_host_copies(mode):
    """On torch's meta device nothing has a value: whatever asks for one fails. ``disagreement`` has to: qhull is on the host."""
    sensing, rewards = begun(mode, "meta")
    targets = DriveTargets(CONTROL_MODES[0], sensing.backend)
    bodies = torch.zeros((100, 13), device="meta")
    rows = torch.zeros((ENVS, len(SKIN_LINKS)), dtype=torch.int64, device="meta")
    steps = torch.zeros(ENVS, dtype=torch.int32, device="meta")
    action, qpos = (torch.zeros((ENVS, NUM_JOINTS), device="meta") for _ in range(2))

    def step():
        with NoHostCopies():
            links = matrices_from_poses(bodies[rows, :7])
            assert targets(_finite(action), _finite(qpos)).shape == (ENVS, NUM_JOINTS)
            contacts = sensing.step(links, steps)
            sensing.link_touch()
            assert rewards.step(contacts).shape == (ENVS,)

    if mode == "disagreement":
        with pytest.raises((AssertionError, NotImplementedError, RuntimeError)):
            step()
    else:
        step()
        step()


def test_the_check_for_host_copies_can_fail():
    value = torch.zeros(3, device="meta")
    for copies in (lambda: value.sum().item(), lambda: value[torch.tensor([0, 1])], lambda: value.to("cpu")):
        with pytest.raises((AssertionError, RuntimeError, NotImplementedError)), NoHostCopies():
            copies()


@pytest.fixture(scope="module")
def recordings():
    """Three episodes: by the CPU engine, again with perturbed actions, and by the GPU path on an emulated GPU."""
    objects = ("mug", "hammer")
    episodes = Episodes.draw(objects, (0, 5), 3)
    envs = tslam_bench.make_vec(ENVIRONMENT_ID, 3, "cpu", objects=objects, processes=0)
    reference, perturbed = record(envs, episodes), record(envs, episodes.perturbed())
    envs.close()
    with emulated_gpu():
        envs = tslam_bench.make_vec(ENVIRONMENT_ID, 3, "cuda", objects=objects)
        tensors = record(envs, episodes)
        envs.close()
    return reference, perturbed, tensors


def test_the_gpu_path_passes_the_check_against_the_cpu_engine(recordings):
    """The same solver on both sides, but the GPU path starts an episode without a new physics system."""
    reference, perturbed, tensors = recordings
    found, yardstick = compare(reference, tensors), compare(reference, perturbed)
    assert found.contacts > 100 and found.touch > 0.99 and found.touched_iou > 0.95 and found.visited_iou > 0.98
    assert found.free_motion == 0, "same physics, same bits"
    assert yardstick.touch < 1 and 0 < yardstick.free_motion < 5e-3, "the yardstick is no copy"
    assert all(finding.passed for finding in judge(found, yardstick))


def test_the_check_fails_where_it_should(recordings):
    reference, perturbed, _ = recordings
    yardstick = compare(reference, perturbed)
    broken = {
        "touch": replace(reference, touch=np.roll(reference.touch, 1, axis=2)),
        "touched_iou": replace(reference, touched=np.roll(reference.touched, 3, axis=1)),
        "visited_iou": replace(reference, visited=np.roll(reference.visited, 5, axis=1)),
        "mean_return": replace(reference, rewards=2 * reference.rewards),
        "free_motion": replace(reference, qpos=reference.qpos + np.float32(0.02)),
    }
    for name, other in broken.items():
        failed = {finding.name for finding in judge(compare(reference, other), yardstick) if not finding.passed}
        assert name in failed, name
    silent = replace(reference, touch=np.zeros_like(reference.touch))
    assert "contacts" in {f.name for f in judge(compare(silent, silent), yardstick) if not f.passed}
    same = compare(reference, reference)
    assert (same.touch, same.touched_iou, same.visited_iou, same.mean_return, same.free_motion) == (1, 1, 1, 0, 0)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_command_says_so_in_one_line(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["gpu-check", "--num-envs", "4"])
    assert ended.value.code == 2
    assert capsys.readouterr().err == (
        "tslam-bench: gpu-check: there is no CUDA GPU that torch can use; run it on a machine that has one; "
        "tslam-bench doctor tells what is found here\n"
    )


def test_memory_grows_with_environments_and_hulls():
    small, default = gpu_memory(1, 1), gpu_memory(1024, 40)
    assert small.max_rigid_contact_count == 2**19 and small.max_rigid_patch_count == 2**18
    assert default.max_rigid_patch_count >= 1024 * TOUCHING_PAIRS
    assert default.max_rigid_contact_count >= 1024 * TOUCHING_PAIRS * CONTACTS_PER_PAIR
    many = gpu_memory(8192, 128)
    assert many.max_rigid_contact_count >= 8192 * TOUCHING_PAIRS * CONTACTS_PER_PAIR
    assert many.found_lost_pairs_capacity >= 2 * 8192 * HAND_SHAPES * 129
    assert load_hand().urdf.read_text(encoding="utf-8").count("<collision") == HAND_SHAPES
    for value in vars(many).values():
        assert value & (value - 1) == 0, "a power of two"
    with pytest.raises(InvalidInputError, match="use fewer environments"):
        gpu_memory(1 << 20, 128)


COMPLAINTS = (
    "Contact buffer overflow detected, please increase its size to at least 600000",
    "[SAPIEN] [error] PhysX: fail to launch kernel!!",
    "Memcpy failed with error code 700!",
    "GPU contactManager: Mem free failed with error code 2",
    "[SAPIEN] [critical] Cooking::cookConvexMesh: GPU-compatible convex hull could not be built because of oblong shape.",
)


def test_complaints_in_native_output_are_found():
    with captured_output() as output:
        os.write(1, b"harmless line\n")
        for line in COMPLAINTS:
            os.write(2, f"{line}\n".encode())
    assert output.complaints() == list(COMPLAINTS)
    with captured_output() as output:
        os.write(2, b"all is well at step 7000\n")
    assert output.complaints() == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_a_hand_that_broke_feels_nothing_and_leaves_the_others_alone(simulated, bad):
    links, _, _ = simulated
    whole, broken = begun("tslam", "cpu"), begun("tslam", "cpu")
    for step in range(STEPS):
        matrices = torch.from_numpy(links[step].copy())
        steps = torch.full((ENVS,), step)
        expected = whole[0].step(matrices, steps)
        matrices[1, 3, 1, 2] = bad
        found = broken[0].step(matrices, steps)
        assert broken[0].lost.tolist() == [False, True, False, False]
        assert not found.on[1].any() and int(found.new_visited[1]) == 0
        others = [0, 2, 3]
        for name in ("on", "new", "points", "mask", "new_touched", "new_visited"):
            assert torch.equal(getattr(found, name)[others], getattr(expected, name)[others]), name
        rewards = broken[1].step(found)
        assert torch.equal(rewards[others], whole[1].step(expected)[others]) and torch.isfinite(rewards).all()


def test_the_drives_never_hand_physx_what_is_not_finite():
    qpos = torch.zeros(2, NUM_JOINTS)
    qpos[1, 5] = torch.nan
    for mode in CONTROL_MODES:
        targets = DriveTargets(mode, TorchBackend("cpu"))(torch.zeros(2, NUM_JOINTS), _finite(qpos))
        assert torch.isfinite(targets).all()


def test_fields_in_half_precision_are_the_same_bits(simulated):
    """Prepared fields are stored so: half the memory, every gathered value the same."""
    atlases = [FieldAtlas(2, TorchBackend("cpu"), dtype) for dtype in (np.float16, np.float32)]
    for atlas in atlases:
        for env, name in enumerate(("mug", "hammer")):
            atlas.set_object(env, name, load_object(name).field, 0)
    half, single = (atlas.bound().values for atlas in atlases)
    assert half.dtype == torch.float16 and half.element_size() * 2 == single.element_size()
    assert torch.equal(half.to(torch.float32), single) and int((single != 0).sum()) > 10_000


def test_the_old_atlas_is_freed_before_a_larger_one_is_made():
    import weakref

    made: list[weakref.ref] = []

    class Watching(TorchBackend):
        def full(self, shape, value, dtype):
            assert not any(ref() is not None and ref().numel() > 1e5 for ref in made), "two at once"
            tensor = super().full(shape, value, dtype)
            made.append(weakref.ref(tensor))
            return tensor

    sensing = TorchSensing(2, build_skin(load_hand().shapes), "cpu")
    sensing.atlas._backend = Watching("cpu")
    fields = {name: load_object(name).field for name in ("mug", "hammer", "wineglass")}
    for names in (("hammer", "hammer"), ("mug", "wineglass")):
        for env, name in enumerate(names):
            sensing.set_object(env, name, fields[name], 0)
        sensing.begin([0, 1])
    assert len(made) == 2


def test_the_list_of_lines_that_only_a_gpu_reaches_is_current():
    script = Path(__file__).parents[2] / "docs" / "build_gpu.py"
    subprocess.run([sys.executable, str(script), "--check"], check=True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, so these are no errors")
@pytest.mark.parametrize(
    "arguments", [{"num_envs": 2}, {"num_envs": 70_000}, {"sim_backend": "physx_cuda"}, {"sim_backend": "cuda:3"}]
)
def test_cuda_where_there_is_none_is_one_line(arguments):
    with pytest.raises(InvalidInputError, match="needs a GPU and there is none") as caught:
        gym.make(ENVIRONMENT_ID, object="mug", **arguments)
    assert "\n" not in str(caught.value)
