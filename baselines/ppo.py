"""Proximal policy optimisation (Schulman et al., 2017) of a Gaussian policy in a Gymnasium vector environment.

One class from top to bottom: an iteration collects a fixed number of decisions from every environment, computes advantages
(generalised advantage estimation, Schulman et al., 2016), and makes several passes of clipped updates over them. Runs on
CPU and GPU tensors alike; environments may return numpy arrays or tensors.

What an end of an episode means: episodes end at the horizon and nowhere else, and the observation holds the time. So the
horizon is a true end, whose value is zero, not a cut whose value is to be guessed: what counts is what was felt by then.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from tslam_bench.constants import NUM_JOINTS

from .network import Encoded, PolicyNetwork
from .training_config import TrainingConfig

STAGES: Final = ("simulate", "encode", "infer", "learn")
"""Where an iteration's time goes; ``encode`` is copying observations into the rollout buffer's form."""
COUNTS: Final = ("new_touched", "new_visited")
"""Entries of the environments' ``info`` that are summed over each episode, where there are such."""
_HALF_LOG_TAU: Final = 0.5 * float(np.log(2 * np.pi))


def advantages(
    rewards: Tensor, values: Tensor, ended: Tensor, last_value: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Generalised advantage estimates, (T, n).

    Args:
        rewards: (T, n) float32.
        values: (T, n) float32, of the observations in which the actions were chosen.
        ended: (T, n) bool, whether an episode ended with that step: nothing behind it counts.
        last_value: (n,) float32, of the observations after the last step.
        gamma: discount per decision.
        gae_lambda: decay of the estimator.
    """
    result = torch.zeros_like(rewards)
    after, following = torch.zeros_like(last_value), last_value
    for step in reversed(range(len(rewards))):
        goes_on = (~ended[step]).float()
        error = rewards[step] + gamma * goes_on * following - values[step]
        after = error + gamma * gae_lambda * goes_on * after
        result[step], following = after, values[step]
    return result


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """(n, k) log densities of (n, k) actions under independent normals; unclipped actions, as the policy drew them."""
    scaled = (actions - mean) * torch.exp(-log_std)
    return -(0.5 * scaled.square() + log_std + _HALF_LOG_TAU)


def policy_loss(log_ratio: Tensor, advantage: Tensor, clip_range: float) -> Tensor:
    """PPO's clipped surrogate, a scalar to minimise; ``log_ratio`` is log pi_new - log pi_old, as broad as ``advantage``."""
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    return -torch.minimum(ratio * advantage, clipped * advantage).mean()


@dataclass
class ReturnScale:
    """Running variance of the discounted return, by whose root rewards are divided: (Chan et al., 1979) in batches."""

    count: float = 1e-4
    mean: float = 0.0
    variance: float = 1.0

    def update(self, returns: Tensor) -> None:
        """Takes a batch of discounted returns into account."""
        count, mean = returns.numel(), float(returns.double().mean())
        variance = float(returns.double().var(unbiased=False))
        total, shift = self.count + count, mean - self.mean
        squares = self.variance * self.count + variance * count + shift**2 * self.count * count / total
        self.count, self.mean, self.variance = total, self.mean + shift * count / total, squares / total

    @property
    def factor(self) -> float:
        """What rewards are multiplied by."""
        return float((self.variance + 1e-8) ** -0.5)


@dataclass
class Rollout:
    """What an iteration collected: (T, n, ...) tensors on the learning device.

    ``counts`` (T, n, 2) holds :data:`COUNTS`; ``last_value`` (n,) is the value of the observations after the last step.
    """

    inputs: Encoded
    actions: Tensor
    log_probability: Tensor
    values: Tensor
    rewards: Tensor
    ended: Tensor
    counts: Tensor
    last_value: Tensor


@dataclass
class Samples:
    """What is learned from: (n, ...) tensors."""

    inputs: Encoded
    actions: Tensor
    log_probability: Tensor
    advantage: Tensor
    target: Tensor

    def rows(self, index: Tensor) -> Samples:
        """Some of the samples."""
        others = (getattr(self, name)[index] for name in ("actions", "log_probability", "advantage", "target"))
        return Samples(self.inputs.rows(index), *others)


class PPO:
    """Trains ``network`` in ``environments``.

    Args:
        config: the recipe. One step of the environments is one decision, ``config.action_repeat`` control steps.
        environments: a vector environment with autoreset ``SAME_STEP``.
        network: encodes observations, and gives mean actions and values.
        device: where to learn.
    """

    def __init__(self, config: TrainingConfig, environments: VectorEnv, network: PolicyNetwork, device: str) -> None:
        self.config = config
        self.environments = environments
        self.device = torch.device(device)
        self.network = network.to(self.device)
        self._parameters = [network.log_std, *(p for p in network.parameters() if p is not network.log_std)]
        groups: list[dict[str, Any]] = [{"params": self._parameters[:1]}, {"params": self._parameters[1:]}]
        self.optimizer = torch.optim.Adam(groups, lr=config.learning_rate, eps=1e-5, fused=True)
        self.scale = ReturnScale()
        self.steps = 0
        self._scene_seed: int | None = None
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.episodes: list[dict[str, float]] = []
        self._generator = torch.Generator()
        self._parts = config.torch_threads if self.device.type == "cpu" else 1
        self._pool = ThreadPoolExecutor(self._parts, initializer=torch.set_num_threads, initargs=(1,))

    def begin(self, seed: int, scene_seed: int | None = None) -> None:
        """Resets environments and random numbers: what follows depends on the seeds and :meth:`state` alone.

        A GPU scene draws other objects, by ``scene_seed``, when that is another one than last time; the CPU draws them in
        every episode.
        """
        self._generator.manual_seed(seed)
        scene_seed = seed if scene_seed is None else scene_seed
        if scene_seed not in (self._scene_seed, seed):
            self.environments.reset(seed=scene_seed % 2**31, options={"reconfigure": True})
        rebuild = scene_seed == seed != self._scene_seed
        self._observation, _ = self.environments.reset(seed=seed % 2**31, options={"reconfigure": rebuild})
        self._scene_seed = scene_seed
        self._sums = torch.zeros(self.environments.num_envs, 1 + len(COUNTS))
        self._discounted = torch.zeros(self.environments.num_envs, device=self.device)
        self._noise = torch.randn(self.environments.num_envs, NUM_JOINTS, generator=self._generator)

    def iterate(self, on_progress: Callable[[int], None] | None = None) -> dict[str, float]:
        """One iteration; returns its figures by name. ``on_progress`` gets the control steps so far.

        ``episodes`` then holds, for each episode that ended in it, its return and the sums of :data:`COUNTS`.
        """
        if self.device.type == "cpu":
            torch.set_num_threads(1)  # the simulation wants the cores, and minibatches are shared out as a whole
        rollout = self._collect(on_progress)
        self._count_episodes(rollout)
        with self._timed("learn"):
            return self._learn(rollout)

    def state(self) -> dict[str, Any]:
        """What :meth:`load_state` needs to go on: plain numbers and tensors."""
        scale = (self.scale.count, self.scale.mean, self.scale.variance)
        network, optimizer = self.network.state_dict(), self.optimizer.state_dict()
        return {"steps": self.steps, "scale": scale, "network": network, "optimizer": optimizer}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Goes on from what :meth:`state` returned."""
        self.steps, self.scale = int(state["steps"]), ReturnScale(*state["scale"])
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))  # Adam would go on in the given tensors

    # -- collecting -------------------------------------------------------------------------------------------
    def _collect(self, on_progress: Callable[[int], None] | None) -> Rollout:
        decisions = self.config.decisions
        kept: list[tuple[Tensor, ...]] = []
        inputs = []
        for _ in range(decisions):
            with self._timed("encode"):
                inputs.append(self._encode())
            with self._timed("infer"), torch.inference_mode():
                mean, log_std, value = self.network(inputs[-1])
                action = mean + log_std.exp() * self._noise.to(self.device)
                drawn_with = log_probability(action, mean, log_std)
            with self._timed("simulate"):
                is_numpy = isinstance(self._observation["qpos"], np.ndarray)
                result = self.environments.step(action.cpu().numpy() if is_numpy else action)
                self._observation, reward, terminated, truncated, info = result
            end = self._tensor(terminated).bool() | self._tensor(truncated).bool()
            reward = self._tensor(reward).float().clone()  # the environments' memory may be written again
            count = [self._count(info, end, name) for name in COUNTS]
            reward += self.config.coverage_bonus * count[1]
            fresh = torch.randn(self._noise.shape, generator=self._generator)
            correlation = (
                self.config.noise_correlation * ~end.cpu()[:, None]
            )  # the next episode begins with other noise
            self._noise = correlation * self._noise + (1 - correlation**2).sqrt() * fresh
            kept.append((action, drawn_with, value, reward, end, torch.stack(count, dim=1)))
            self.steps += self.config.action_repeat * self.environments.num_envs
            if on_progress is not None:
                on_progress(self.steps)
        with torch.inference_mode():
            *_, last_value = self.network(self._encode())
        actions, log_probabilities, values, rewards, ended, counts = map(torch.stack, zip(*kept, strict=True))
        encoded = Encoded(torch.stack([i.grid for i in inputs]), torch.stack([i.flat for i in inputs]))
        return Rollout(encoded, actions, log_probabilities, values, rewards, ended, counts, last_value)

    def _encode(self) -> Encoded:
        return self.network.encode({key: self._tensor(value) for key, value in self._observation.items()})

    def _count(self, info: dict[str, Any], end: Tensor, name: str) -> Tensor:
        """(n,) an entry of ``info`` or zeros; where an episode ended it is in ``final_info``."""
        if name not in info:
            return torch.zeros(len(end), device=self.device)
        count = self._tensor(info[name]).float()
        return (
            torch.where(end, self._tensor(info["final_info"][name]).float(), count) if "final_info" in info else count
        )

    def _tensor(self, value: Any) -> Tensor:
        return torch.as_tensor(value, device=self.device)

    def _count_episodes(self, rollout: Rollout) -> None:
        """Adds up returns and counts, and fills ``episodes`` with those of the episodes that ended."""
        self.episodes = []
        columns = torch.cat([rollout.rewards[:, :, None], rollout.counts], dim=2).cpu()
        for step, ended in zip(columns, rollout.ended.cpu(), strict=True):
            self._sums += step
            for env in ended.nonzero()[:, 0].tolist():
                self.episodes.append(dict(zip(("return", *COUNTS), self._sums[env].tolist(), strict=True)))
                self._sums[env] = 0

    # -- learning ---------------------------------------------------------------------------------------------
    def _scaled(self, rewards: Tensor, ended: Tensor) -> Tensor:
        """Rewards divided by the running standard deviation of the discounted return, these ones included."""
        returns = torch.zeros_like(rewards)
        for step in range(len(rewards)):
            self._discounted = self._discounted * self.config.gamma + rewards[step]
            returns[step] = self._discounted
            self._discounted = self._discounted * ~ended[step]
        self.scale.update(returns)
        return rewards * self.scale.factor

    def _learn(self, rollout: Rollout) -> dict[str, float]:
        config = self.config
        rewards = self._scaled(rollout.rewards, rollout.ended)
        advantage = advantages(
            rewards, rollout.values, rollout.ended, rollout.last_value, config.gamma, config.gae_lambda
        )
        target = advantage + rollout.values
        explained = 1 - float(advantage.var() / (target.var() + 1e-12))
        samples = Samples(
            Encoded(rollout.inputs.grid.flatten(0, 1), rollout.inputs.flat.flatten(0, 1)),
            rollout.actions.flatten(0, 1),
            rollout.log_probability.flatten(0, 1),
            ((advantage - advantage.mean()) / (advantage.std() + 1e-8)).flatten(),
            target.flatten(),
        )
        done = (self.steps - config.iteration_steps) / config.total_steps
        left = 1 - (1 - config.final_learning_rate) * min(1.0, done)
        for group, factor in zip(self.optimizer.param_groups, (config.std_learning_rate, 1.0), strict=True):
            group["lr"] = config.learning_rate * left * factor
        figures: dict[str, float] = {}
        for epoch in range(config.epochs):
            sums = torch.zeros(4, device=self.device)
            batches = list(self._minibatches(target.numel()))
            for chosen in batches:
                sums += self._update(samples, chosen)
            names = ("policy_loss", "value_loss", "approximate_kl", "clip_fraction")
            figures = dict(zip(names, (sums / len(batches)).tolist(), strict=True))
            figures["epochs"] = epoch + 1
            if figures["approximate_kl"] > config.target_kl:
                break
        with torch.inference_mode():
            _, log_std = self.network.distribution(samples.inputs.rows(slice(None, None, 8)))  # a few are enough
        figures["entropy"] = float((log_std + 0.5 + _HALF_LOG_TAU).sum(1).mean())
        figures["std"] = float(log_std.exp().mean())
        figures["explained_variance"] = explained
        return figures

    def _minibatches(self, samples: int) -> Iterator[Tensor]:
        """Indices of shuffled minibatches of (nearly) equal size that together name every sample once."""
        order = torch.randperm(samples, generator=self._generator).to(self.device)
        yield from order.tensor_split(max(1, round(samples / self.config.batch_size)))

    def _update(self, samples: Samples, chosen: Tensor) -> Tensor:
        """One step of Adam on a minibatch; (4,) policy loss, value loss, approximate KL, share of clipped samples.

        On a CPU each thread takes an equal part of the minibatch through the network and back. Threads within torch's
        operations wait for each other hundreds of times per minibatch instead, for long if other work keeps a core busy.
        """
        parts = chosen.tensor_split(self._parts)
        results = list(self._pool.map(lambda part: self._gradients(samples.rows(part)), parts))
        shares = [len(part) / len(chosen) for part in parts]
        for index, parameter in enumerate(self._parameters):
            parameter.grad = _sum(
                share * gradients[index] for share, (gradients, _) in zip(shares, results, strict=True)
            )
        nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_gradient)
        self.optimizer.step()
        return _sum(share * figures for share, (_, figures) in zip(shares, results, strict=True))

    def _gradients(self, samples: Samples) -> tuple[tuple[Tensor, ...], Tensor]:
        """Gradients of the loss by every parameter, and :meth:`_update`'s figures."""
        config = self.config
        mean, log_std, value = self.network(samples.inputs)
        each = log_probability(samples.actions, mean, log_std) - samples.log_probability
        log_ratio = each.sum(1)
        if config.clip_each_joint:
            surrogate = NUM_JOINTS * policy_loss(each, samples.advantage[:, None], config.clip_range)
        else:
            surrogate = policy_loss(log_ratio, samples.advantage, config.clip_range)
        value_loss = (value - samples.target).square().mean()
        loss = surrogate + config.value_coefficient * value_loss - config.entropy_coefficient * log_std.sum(1).mean()
        gradients = torch.autograd.grad(loss, self._parameters)
        with torch.no_grad():
            change = torch.expm1(log_ratio)
            kl = (change - log_ratio).mean()  # http://joschu.net/blog/kl-approx.html
            ratios = torch.expm1(each) if config.clip_each_joint else change
            clipped = ratios.abs().gt(config.clip_range).float().mean()
            return gradients, torch.stack([surrogate, value_loss, kl, clipped])

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] += time.perf_counter() - start


def _sum(tensors: Iterable[Tensor]) -> Tensor:
    """The sum of tensors of one shape, from first to last."""
    first, *others = tensors
    for other in others:
        first = first + other
    return first
