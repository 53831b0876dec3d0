"""The learner alone: its formulas against second implementations and closed forms, and a small task that it solves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from counting_environment import Counter
from gymnasium import spaces
from torch import nn

from tslam_bench.baselines.model_files import make_network
from tslam_bench.baselines.network import NETWORKS, ConvolutionTrunk, Encoded, PatchTrunk, around_hand
from tslam_bench.baselines.ppo import PPO, ReturnScale, advantages, log_probability, policy_loss
from tslam_bench.baselines.training_config import TrainingConfig
from tslam_bench.constants import GRID_SIZE, NUM_JOINTS, VOXEL_EDGE
from tslam_bench.errors import InvalidInputError
from tslam_bench.hand_constants import SKIN_LINKS

ARM_AT_REST = torch.zeros(3, NUM_JOINTS)
GENERATOR = np.random.Generator(np.random.PCG64(5))


def observation(n: int, generator: np.random.Generator) -> dict[str, torch.Tensor]:
    """n drawn observations of the protocol's shapes."""
    drawn = {
        "qpos": generator.normal(size=(n, NUM_JOINTS)).astype(np.float32),
        "qvel": generator.normal(size=(n, NUM_JOINTS)).astype(np.float32),
        "touch": generator.integers(0, 2, (n, len(SKIN_LINKS)), dtype=np.uint8),
        "occupancy": generator.integers(0, 2, (n, 2, *(GRID_SIZE,) * 3), dtype=np.uint8),
        "time": generator.random((n, 1), dtype=np.float32),
    }
    return {key: torch.from_numpy(value) for key, value in drawn.items()}


# -- formulas ---------------------------------------------------------------------------------------------------------
def test_advantages_are_the_weighted_sum_of_all_multi_step_estimates() -> None:
    """Against the definition: (1 - lambda) sum of lambda^(k-1) times the k-step estimate, episode by episode."""
    steps, gamma, decay = 12, 0.9, 0.7
    rewards, values = GENERATOR.normal(size=(2, steps, 3))
    last = GENERATOR.normal(size=3)
    ended = np.zeros((steps, 3), dtype=bool)
    ended[4, 0] = ended[[2, 11], 1] = True  # in the middle, twice and at the very end, never

    def estimate(t: int, env: int) -> float:
        returns, discounted, discount = [], 0.0, 1.0
        for step in range(t, steps):
            discounted += discount * rewards[step, env]
            discount *= gamma
            if ended[step, env]:
                returns.append(discounted)
                break
            following = last[env] if step == steps - 1 else values[step + 1, env]
            returns.append(discounted + discount * following)
        weights = [(1 - decay) * decay**k for k in range(len(returns) - 1)] + [decay ** (len(returns) - 1)]
        return sum(w * r for w, r in zip(weights, returns, strict=True)) - values[t, env]

    expected = [[estimate(t, env) for env in range(3)] for t in range(steps)]
    tensors = [torch.tensor(x, dtype=torch.float32) for x in (rewards, values)]
    found = advantages(*tensors, torch.tensor(ended), torch.tensor(last, dtype=torch.float32), gamma, decay)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-5)


def test_log_probability_is_torchs_own() -> None:
    actions, mean, log_std = (torch.from_numpy(GENERATOR.normal(size=(6, 4))) for _ in range(3))
    expected = torch.distributions.Normal(mean, log_std[0].exp()).log_prob(actions)
    torch.testing.assert_close(log_probability(actions, mean, log_std[0]), expected)


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss", "slope"),
    [
        (1.1, 2.0, -2.2, -2.2),  # within the clip: ratio * advantage, which follows the ratio
        (1.5, 2.0, -2.4, 0.0),  # better than the clip allows: no further reward
        (1.5, -2.0, 3.0, 3.0),  # worse: the whole loss counts
        (0.5, 2.0, -1.0, -1.0),
        (0.5, -2.0, 1.6, 0.0),
    ],
)
def test_clipped_loss_has_its_closed_form(ratio: float, advantage: float, loss: float, slope: float) -> None:
    log_ratio = torch.tensor([math.log(ratio)], requires_grad=True)
    found = policy_loss(log_ratio, torch.tensor([advantage]), 0.2)
    found.backward()
    assert float(found.detach()) == pytest.approx(loss, rel=1e-6)
    assert log_ratio.grad is not None and float(log_ratio.grad) == pytest.approx(slope, rel=1e-6)


def test_return_scale_is_the_variance_of_all_batches_together() -> None:
    scale, batches = ReturnScale(), [GENERATOR.normal(3, 5, size=n) for n in (10, 1, 400)]
    for batch in batches:
        scale.update(torch.from_numpy(batch))
    everything = np.concatenate(batches)
    assert scale.factor == pytest.approx(1 / everything.std(), rel=1e-3)  # the prior counts for 1e-4 numbers


# -- networks ---------------------------------------------------------------------------------------------------------
def test_patches_are_convolutions_that_do_not_overlap() -> None:
    """The matrix products of ``fast`` against torch's own convolutions and pooling with the same weights."""
    trunk = PatchTrunk((8, 6, 4))
    occupancy = observation(3, GENERATOR)["occupancy"]
    with torch.no_grad():
        grid = nn.functional.avg_pool3d(occupancy.float(), 2) * 8 * 0.25
        width = 2
        for layer in trunk.layers:
            assert isinstance(layer, nn.Linear)
            # A patch's inputs come by place (x, y, z), then by channel.
            kernel = layer.weight.view(layer.out_features, 2, 2, 2, width).permute(0, 4, 1, 2, 3)
            grid = torch.relu(nn.functional.conv3d(grid, kernel, layer.bias, stride=2))
            width = layer.out_features
        features = trunk(trunk.encode(occupancy, ARM_AT_REST)).view(3, 2, 2, 2, 4).permute(0, 4, 1, 2, 3)
    torch.testing.assert_close(features, grid, rtol=1e-4, atol=1e-5)


def test_grids_around_the_hand_are_moved_by_the_arm() -> None:
    """Voxel by voxel: what lies at the palm's place in the world comes to the middle, what leaves the grid is lost."""
    occupancy = observation(3, GENERATOR)["occupancy"].clone()
    occupancy[:, :, ::2] = 0
    arm = np.array([[0.05, 0.0, 0.0], [-0.11, 0.06, 0.2], [0.25, 0.25, -0.3]])  # sideways, up, forward (m)
    qpos = torch.zeros(3, NUM_JOINTS)
    qpos[:, :3] = torch.from_numpy(arm)
    palm = np.round(np.stack([-arm[:, 0], arm[:, 2], arm[:, 1]], axis=1) / VOXEL_EDGE).astype(int)  # world x, y, z
    expected = np.zeros_like(occupancy.numpy())
    for n, channel, *voxel in np.argwhere(occupancy.numpy()):
        x, y, z = voxel - palm[n]
        if min(x, y, z) >= 0 and max(x, y, z) < GRID_SIZE:
            expected[n, channel, x, y, z] = 1
    assert expected[0].any() and expected[1].any() and not expected[2].any()
    assert np.array_equal(around_hand(occupancy, qpos).numpy(), expected)


def test_paper_network_gets_the_grids_bit_by_bit() -> None:
    trunk = ConvolutionTrunk()
    occupancy = observation(3, GENERATOR)["occupancy"]
    encoded = trunk.encode(occupancy, ARM_AT_REST)
    assert encoded.shape == (3, 8192) and encoded.dtype == torch.uint8
    assert torch.equal(encoded, torch.from_numpy(np.packbits(occupancy.numpy(), axis=-1, bitorder="little")).flatten(1))
    with torch.no_grad():
        torch.testing.assert_close(trunk(encoded), trunk.convolve(occupancy.float()))
    assert len(trunk.layers) == 6 and len(make_network("paper").policy) == 7  # four linear layers, three ReLUs


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_networks_start_as_they_should(name: str) -> None:
    one, same, other = (make_network(name, 0.5, seed) for seed in (1, 1, 2))
    for (key, weight), again, different in zip(
        one.state_dict().items(), same.state_dict().values(), other.state_dict().values(), strict=True
    ):
        assert torch.equal(weight, again)
        assert "weight" not in key or not torch.equal(weight, different), key
    with torch.no_grad():
        encoded = one.encode(observation(5, GENERATOR))
        mean, _, value = one(encoded)
    assert mean.shape == (5, NUM_JOINTS) and value.shape == (5,)
    assert mean.abs().max() < 0.3 and torch.allclose(one.log_std.exp(), torch.tensor(0.5))
    torch.testing.assert_close(one.distribution(encoded)[0], mean)
    with pytest.raises(InvalidInputError, match=r"network 'huge': unknown; choose one of fast, hand, paper"):
        make_network("huge")


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_a_few_touched_voxels_reach_the_features(name: str) -> None:
    """Touch is sparse: the network must not lose it on its way through the convolutions."""
    grids = torch.zeros(2, 2, *(GRID_SIZE,) * 3, dtype=torch.uint8)
    grids[:, 1, 8:24, 8:24, 8:24] = 1
    grids[1, 0, 10:14, 12:20, 12] = 1
    trunk = make_network(name, seed=3).trunk
    with torch.no_grad():
        features = trunk(trunk.encode(grids, ARM_AT_REST[:2]))
    assert (features[1] - features[0]).norm() > 0.02 * features[0].norm()


# -- learning ---------------------------------------------------------------------------------------------------------
class Bandit(Counter):
    """Ten decisions per episode, each paid by how near the action comes to what the observation asks for.

    ``touch[0]`` is drawn anew for every decision: the first joint's action should be 0.5 where it is set and -0.5
    elsewhere; the second's should be 0.5 if voxels of one half are touched. A perfect policy without noise gets 0.
    """

    def __init__(self, num_envs: int, tensors: bool) -> None:
        super().__init__((10,) * num_envs, terminates=True, tensors=tensors)
        shapes = {"qpos": (NUM_JOINTS,), "qvel": (NUM_JOINTS,), "time": (1,)}
        entries: dict[str, spaces.Space] = {
            key: spaces.Box(-np.inf, np.inf, shape, np.float32) for key, shape in shapes.items()
        }
        entries["touch"] = spaces.Box(0, 1, (len(SKIN_LINKS),), np.uint8)
        entries["occupancy"] = spaces.Box(0, 1, (2, *(GRID_SIZE,) * 3), np.uint8)
        self.set_spaces(entries, NUM_JOINTS)
        self.buffers = {
            key: torch.zeros(num_envs, *(space.shape or ()), dtype=torch.uint8 if "o" in key[:2] else torch.float32)
            for key, space in entries.items()
        }
        self.draws = torch.Generator()
        self.asked = torch.zeros(num_envs, 2)

    def reset(self, *, seed=None, options=None):
        self.draws.manual_seed(int(seed))
        self._ask()
        return super().reset(seed=seed, options=options)

    def _ask(self) -> None:
        bits = torch.randint(0, 2, (self.num_envs, 2), generator=self.draws)
        self.asked = bits - 0.5
        self.buffers["touch"][:, 0] = bits[:, 0]
        self.buffers["occupancy"][:] = 0
        self.buffers["occupancy"][:, 0, :8, :8, 4] = bits[:, 1, None, None].to(torch.uint8)

    def _observe(self) -> Any:
        return self.buffers if self.tensors else {key: value.numpy() for key, value in self.buffers.items()}

    def pay(self) -> torch.Tensor:
        assert self.last_actions is not None
        payment = -(self.last_actions[:, :2] - self.asked).square().sum(1)
        self._ask()
        return payment


CONFIG = TrainingConfig(
    "tslam", num_envs=16, rollout_steps=40, epochs=8, batch_size=80, learning_rate=2e-3, gamma=0.5, torch_threads=1
)


def train(config: TrainingConfig, tensors: bool, iterations: int) -> tuple[PPO, list[float]]:
    network = make_network("fast", 0.4, 0, config.state_std)
    learner = PPO(config, Bandit(config.num_envs, tensors), network, "cpu")
    learner.begin(3)
    returns = []
    for _ in range(iterations):
        learner.iterate()
        returns.append(float(np.mean([episode["return"] for episode in learner.episodes])))
    return learner, returns


@pytest.mark.parametrize("change", [{}, {"clip_each_joint": True}, {"state_std": True}, {"noise_correlation": 0.5}])
def test_it_learns_what_touch_and_grids_ask_for(change: dict[str, Any]) -> None:
    learner, returns = train(replace(CONFIG, **change), True, 60)
    assert returns[0] < -7  # noise of 0.4 and a miss of 0.5 on two joints: -(0.16 + 0.25) * 2 * 10 = -8.2
    assert returns[-1] > -3.5  # the noise alone costs -3.2 at first
    assert learner.steps == 60 * 16 * 40
    learner.environments.reset(seed=1)
    with torch.no_grad():
        mean, _ = learner.network.distribution(learner.network.encode(learner.environments.buffers))  # type: ignore[attr-defined]
    asked = learner.environments.asked  # type: ignore[attr-defined]
    assert (mean[:, :2] - asked).abs().mean() < 0.15


def test_numpy_and_tensor_environments_teach_the_same() -> None:
    (one, first), (other, second) = train(CONFIG, True, 2), train(CONFIG, False, 2)
    assert first == second
    for a, b in zip(one.network.state_dict().values(), other.network.state_dict().values(), strict=True):
        assert torch.equal(a, b)


def test_state_carries_all_that_a_chunk_depends_on() -> None:
    learner, _ = train(CONFIG, True, 2)
    copy = PPO(CONFIG, Bandit(16, True), make_network("fast", 0.4, seed=9), "cpu")
    copy.load_state(learner.state())
    for each in (learner, copy):
        each.begin(8)
        each.iterate()
    assert learner.steps == copy.steps
    for a, b in zip(learner.network.state_dict().values(), copy.network.state_dict().values(), strict=True):
        assert torch.equal(a, b)


class Recorded(Bandit):
    """Keeps what was asked of ``reset``."""

    def reset(self, *, seed=None, options=None):
        self.calls = [*getattr(self, "calls", []), (seed, options["reconfigure"])]
        return super().reset(seed=seed, options=options)


def test_a_gpu_scene_is_built_anew_when_its_seed_changes_and_after_a_resumption() -> None:
    def calls(*begun: tuple[int, int]) -> list[tuple[int, bool]]:
        learner = PPO(CONFIG, Recorded(16, True), make_network("fast", 0.4, seed=0), "cpu")
        for seeds in begun:
            learner.begin(*seeds)
        return learner.environments.calls  # type: ignore[attr-defined]

    assert calls((10, 10), (11, 10), (12, 12)) == [(10, True), (11, False), (12, True)]
    assert calls((11, 10), (12, 12)) == [(10, True), (11, False), (12, True)], "killed after the first chunk"


def test_threads_share_minibatches_out_and_change_nothing_but_rounding() -> None:
    (one, first), (two, second), (again, third) = (
        train(replace(CONFIG, torch_threads=threads), True, 3) for threads in (1, 2, 2)
    )
    assert first == pytest.approx(second, rel=1e-3) and second == third
    pairs = zip(*(each.network.state_dict().values() for each in (one, two, again)), strict=True)
    for a, b, c in pairs:
        assert torch.allclose(a, b, atol=2e-3) and torch.equal(b, c)


def test_figures_say_what_happened() -> None:
    learner = PPO(replace(CONFIG, target_kl=9.0), Bandit(16, True), make_network("fast", 0.4, seed=0), "cpu")
    learner.begin(3)
    figures = learner.iterate()
    assert figures["epochs"] == 8 and 0 < figures["approximate_kl"] < 1 and 0 < figures["clip_fraction"] < 1
    std = learner.network.log_std.detach().exp().numpy()
    assert figures["entropy"] == pytest.approx(0.5 * np.log(2 * np.pi * np.e * std**2).sum(), rel=1e-5)
    assert figures["explained_variance"] < 1 and len(learner.episodes) == 16  # ten decisions: one episode each
    assert all(seconds > 0 for seconds in learner.seconds.values())


def test_a_policy_that_moved_too_far_gets_no_further_pass() -> None:
    learner = PPO(replace(CONFIG, target_kl=1e-3), Bandit(16, True), make_network("fast", 0.4, seed=0), "cpu")
    learner.begin(3)
    assert learner.iterate()["epochs"] == 1


def test_step_sizes_shrink_linearly_and_by_group() -> None:
    config = replace(CONFIG, steps=4 * 640, final_learning_rate=0.2, std_learning_rate=10.0)
    learner = PPO(config, Bandit(16, True), make_network("fast", 0.4, seed=0), "cpu")
    learner.begin(3)
    used = []
    for _ in range(4):
        learner.iterate()
        used.append([group["lr"] for group in learner.optimizer.param_groups])
    expected = 2e-3 * np.array([1.0, 0.8, 0.6, 0.4])
    np.testing.assert_allclose(used, np.stack([10 * expected, expected], axis=1))


def test_noise_is_correlated_within_an_episode_and_not_across() -> None:
    """Bandit's episodes have ten decisions."""
    config = replace(CONFIG, noise_correlation=0.8, rollout_steps=160, num_envs=64)
    learner = PPO(config, Bandit(64, True), make_network("fast", 0.4, seed=0), "cpu")
    learner.begin(3)
    rollout = learner._collect(None)
    with torch.no_grad():
        mean, _, _ = learner.network(Encoded(rollout.inputs.grid.flatten(0, 1), rollout.inputs.flat.flatten(0, 1)))
    noise = ((rollout.actions - mean.view(rollout.actions.shape)) / 0.4).numpy()
    assert noise.std() == pytest.approx(1, abs=0.03)
    for lag, correlation in ((1, 0.8), (3, 0.512)):
        products = [(noise[t] * noise[t + lag]).mean() for t in range(40 - lag) if t // 10 == (t + lag) // 10]
        assert np.mean(products) / noise.var() == pytest.approx(correlation, abs=0.02)
    across = [(noise[t] * noise[t + 1]).mean() for t in (9, 19, 29)]
    assert np.mean(across) == pytest.approx(0, abs=0.05)


def test_coverage_bonus_is_added_to_the_reward() -> None:
    class Visiting(Bandit):
        def step(self, action):
            *rest, info = super().step(action)
            visited = 3 + torch.arange(16)
            if "final_info" in info:  # where an episode ended, the step's count is there
                info["final_info"]["new_visited"] = visited
                return *rest, info | {"new_visited": visited * ~info["_final_info"]}
            return *rest, info | {"new_visited": visited}

    plain, paid = (
        PPO(replace(CONFIG, coverage_bonus=bonus), Visiting(16, True), make_network("fast", 0.4, seed=0), "cpu")
        for bonus in (0.0, 0.5)
    )
    for learner in (plain, paid):
        learner.begin(3)
        learner.iterate()
    difference = np.array(
        [b["return"] - a["return"] for a, b in zip(plain.episodes[:16], paid.episodes[:16], strict=True)]
    )
    np.testing.assert_allclose(np.sort(difference), 10 * 0.5 * (3 + np.arange(16)), rtol=1e-4)
