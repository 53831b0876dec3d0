"""``frontier``: its body against the simulator's, its heat against closed forms, and what it does on a map made by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from tslam_bench.baselines.frontier import (
    FrontierBaseline,
    FrontierConfig,
    heat_kernel,
    joint_steps,
    slopes,
    spread,
    voxel_of,
)
from tslam_bench.baselines.hand_kinematics import HandKinematics
from tslam_bench.baselines.random_actions import RandomTargetsBaseline
from tslam_bench.constants import GRID_SIZE, HORIZON, NUM_JOINTS, VOXEL_EDGE
from tslam_bench.engine.hand_batch import BatchSettings, HandBatch
from tslam_bench.engine.skin import build_skin
from tslam_bench.engine.spaces import OBSERVATION_ARRAYS
from tslam_bench.evaluation.policies import get_baseline
from tslam_bench.evaluation.policy import Policy
from tslam_bench.hand_constants import JOINT_LIMITS, SKIN_LINKS
from tslam_bench.objects.hand import load_hand


@pytest.fixture(scope="module")
def body() -> HandKinematics:
    hand = load_hand()
    return HandKinematics(hand, build_skin(hand.shapes).probes)


def anywhere(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(JOINT_LIMITS[:, 0], JOINT_LIMITS[:, 1], (count, NUM_JOINTS))


def observed(count: int = 1) -> dict[str, np.ndarray]:
    """The first observation of hands that know nothing."""
    shapes = {name: np.zeros((count, *shape), dtype) for name, (shape, dtype) in OBSERVATION_ARRAYS.items()}
    shapes["qpos"][:, 1] = 0.17
    return shapes


# -- body -------------------------------------------------------------------------------------------------------------
def test_points_are_where_the_simulator_has_them(body: HandKinematics) -> None:
    probes = build_skin(load_hand().shapes).probes
    hands = HandBatch(3, BatchSettings(object="mug", reward_mode="none"))
    hands.reset([1, 2, 3], range(3), ["mug"] * 3, [0] * 3)
    generator = np.random.default_rng(0)
    for _ in range(20):
        hands.arrays["action"][:] = generator.uniform(-1, 1, (3, NUM_JOINTS))
        hands.step()
    matrices = hands._links.astype(np.float64)[:, probes.link]
    simulated = (matrices[..., :3] @ probes.position[:, :, None])[..., 0] + matrices[..., 3]
    ours = body.points(body.links(hands.arrays["qpos"].astype(np.float64)))
    assert np.abs(ours - simulated).max() < 1e-6


def test_jacobian_is_the_derivative(body: HandKinematics) -> None:
    qpos = anywhere(2)
    links = body.links(qpos)
    points = body.points(links)
    jacobian = body.jacobian(links, points)
    for joint in range(NUM_JOINTS):
        ends = []
        for side in (-1, 1):
            moved = qpos.copy()
            moved[:, joint] += side * 1e-5
            ends.append(body.points(body.links(moved)))
        assert np.abs((ends[1] - ends[0]) / 2e-5 - jacobian[:, joint]).max() < 1e-8
    assert not jacobian[:, 27][:, build_skin(load_hand().shapes).probes.link == SKIN_LINKS.index("palm")].any()


def test_a_joint_goes_where_its_agents_want_to_on_average(body: HandKinematics) -> None:
    links = body.links(anywhere(1))
    jacobian = body.jacobian(links, body.points(links))
    wish = np.random.default_rng(1).normal(size=(1, jacobian.shape[2], 3))
    steps = joint_steps(jacobian, wish, body.moves, damping=0.0)
    for joint, axis in enumerate(links.axis[0, :3]):  # they move the whole hand
        assert steps[0, joint] == pytest.approx((wish[0] @ axis).mean(), rel=1e-9)
    finger = jacobian[0, 27][body.moves[27]].reshape(-1), wish[0][body.moves[27]].reshape(-1)
    assert steps[0, 27] == pytest.approx(np.linalg.lstsq(finger[0][:, None], finger[1], rcond=None)[0][0], rel=1e-9)
    assert (np.abs(joint_steps(jacobian, wish, body.moves)) < np.abs(steps)).all()


# -- heat -------------------------------------------------------------------------------------------------------------
def test_heat_is_that_of_the_equation() -> None:
    laplacian = np.diag(np.full(31, 1.0), 1) + np.diag(np.full(31, 1.0), -1)
    laplacian -= np.diag(laplacian.sum(axis=1))
    kernel = heat_kernel(2.0)
    assert np.allclose(kernel, scipy.linalg.expm(2.0 * laplacian), atol=1e-6)
    assert np.allclose(kernel.sum(axis=0), 1, atol=1e-5) and (kernel > -1e-6).all()
    from_middle = kernel[16].astype(float)
    at = np.arange(GRID_SIZE) - 16
    assert from_middle @ at**2 == pytest.approx(4.0, rel=1e-3)  # the variance is the length squared
    grids = np.random.default_rng(0).random((3, *(GRID_SIZE,) * 3), dtype=np.float32)
    by_hand = np.einsum("ai,bj,ck,nijk->nabc", *[kernel.astype(np.float64)] * 3, grids, optimize=True)
    assert np.allclose(spread(grids, kernel), by_hand, atol=1e-5)
    assert np.array_equal(spread(grids[1:2], kernel)[0], spread(grids, kernel)[1])  # bit for bit in any batch


def test_slopes_of_a_plane() -> None:
    x, y, z = np.meshgrid(*[np.arange(GRID_SIZE)] * 3, indexing="ij")
    plane = (2.0 * x - 3.0 * y + 0.5 * z)[None].astype(np.float32)
    index = np.array([[[5, 6, 7], [30, 1, 16]]])
    value, slope = slopes(plane, index)
    assert value.tolist() == [[-4.5, 65.0]] and np.array_equal(slope, np.broadcast_to([2.0, -3.0, 0.5], (1, 2, 3)))
    points = np.array([[[-0.125, 0.0, 0.1249], [9.0, -9.0, 0.0]]])
    assert voxel_of(points).tolist() == [[[0, 16, 31], [31, 0, 16]]]


# -- behaviour --------------------------------------------------------------------------------------------------------
def plate() -> np.ndarray:
    """Grids of a hand that has felt the middle of a plate from above: (1, 2, 32, 32, 32)."""
    occupancy = np.zeros((1, 2, *(GRID_SIZE,) * 3), dtype=np.uint8)
    occupancy[0, 0, 12:20, 12:20, 14] = 1
    occupancy[0, 1, 10:22, 10:22, 15:24] = 1
    return occupancy


def test_surface_that_goes_on_is_worth_most() -> None:
    explorer = FrontierBaseline(FrontierConfig(close=0.2, wear=0.0))
    far_away = np.full((1, 2, 3), 9.0)
    worth = explorer._map(far_away, plate())[0][0]
    best = np.array(np.unravel_index(worth.argmax(), worth.shape))
    assert best[2] in (13, 14) and worth[20, 16, 14] > 0.7 * worth.max()  # beside the felt ones, on their level
    assert worth[20, 16, 14] > 3 * worth[16, 16, 8] and worth[20, 16, 14] > 20 * worth[1, 1, 1]
    assert worth[15, 15, 14] < 0.05 * worth.max() and worth[15, 15, 18] < 0.05 * worth.max()  # felt, and visited


def test_presence_wears_and_uncertainty_weighs() -> None:
    there = np.broadcast_to((np.array([20, 16, 14]) + 0.5) * VOXEL_EDGE - 0.125, (1, 9, 3))
    explorer = FrontierBaseline(FrontierConfig(close=0.2, near=1.0, wear=0.5))
    worn = [explorer._map(there, plate())[0][0, 20, 16, 14] for _ in range(3)]
    kernel = heat_kernel(1.0)
    each = np.exp(-0.5 * 9 * kernel[20, 20] * kernel[16, 16] * kernel[14, 14])  # nine agents, each with its heat
    assert worn[1] / worn[0] == pytest.approx(each, rel=0.03) and worn[2] / worn[1] == pytest.approx(each, rel=0.03)

    def known_on_one_side(occupancy: np.ndarray) -> np.ndarray:
        weights = np.ones((len(occupancy), *(GRID_SIZE,) * 3))
        weights[:, 16:] = 0
        return weights

    weighed = FrontierBaseline(FrontierConfig(close=0.2), known_on_one_side)._map(there, plate())[0][0]
    assert weighed[20:].max() < 1e-3 * weighed.max() and weighed[11, 16, 14] > 0.5 * weighed.max()


def test_a_touching_agent_slides() -> None:
    """Above the plate, worth lies below and beside: who touches gives up what goes down."""
    explorer = FrontierBaseline(FrontierConfig(slide=1.0))
    agents = np.broadcast_to((np.array([18, 16, 15]) + 0.5) * VOXEL_EDGE - 0.125, (1, 2, 3)).copy()
    _, potential, free = explorer._map(agents, plate())
    wish = explorer._wishes(agents, potential, free, np.array([[False, True]]))[0]
    normal = slopes(free, voxel_of(agents))[1][0, 1]
    normal /= np.linalg.norm(normal)
    assert normal[2] > 0.8 and wish[0] @ normal < -1e-3 and abs(wish[1] @ normal) < 1e-9
    assert np.linalg.norm(wish, axis=1).max() <= explorer.config.reach * VOXEL_EDGE + 1e-12


def test_of_several_goals_that_is_taken_which_promises_most() -> None:
    explorer = FrontierBaseline()
    worth = np.zeros((1, *(GRID_SIZE,) * 3), dtype=np.float32)
    worth[:, 24:] = 1  # on the side that ARTx moves away from: its axis points along -x in the world
    goals = np.zeros((1, 2, NUM_JOINTS))
    goals[0, :, 0] = (-0.6, 0.6)
    promise = explorer._promise(np.zeros((1, NUM_JOINTS)), goals, worth)
    assert promise[0, 0] > promise[0, 1]


def test_it_holds_its_action_and_begins_anew_with_each_episode() -> None:
    explorer = FrontierBaseline(FrontierConfig(hold=3))
    explorer.reset(2, [1, 2])
    actions = [explorer.act(observed(2)) for _ in range(6)]
    assert np.array_equal(actions[0], actions[2]) and not np.array_equal(actions[0], actions[3])
    explorer.reset(2, [1, 2])
    assert np.array_equal(explorer.act(observed(2)), actions[0])


def touched(policy: Policy) -> float:
    """Mean touched voxels of a mug and a bowl of the train split in four poses."""
    names = ["mug-000", "bowl-000"] * 2
    settings = BatchSettings(objects=tuple(names[:2]), control_mode=policy.control_mode, reward_mode="none")
    hands = HandBatch(4, settings)
    seen = {name: hands.arrays[name] for name in OBSERVATION_ARRAYS}
    policy.reset(4, [1, 2, 3, 4])
    hands.reset([1, 2, 3, 4], range(4), names, [0, 2, 5, 7])
    for _ in range(HORIZON):
        hands.arrays["action"][:] = policy.act(seen)
        hands.step()
    return float(hands.arrays["final_occupancy"][:, 0].sum(axis=(1, 2, 3), dtype=np.int64).mean())


def test_it_touches_more_than_random_targets() -> None:
    assert get_baseline("frontier").kind == "scripted"
    assert touched(FrontierBaseline()) > 1.3 * touched(RandomTargetsBaseline())
