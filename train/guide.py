"""A head start for a policy: it imitates a guide that knows what each episode drew.

The guide carries the demonstrated hand along the joint as it was drawn, takes back the hand's drawn offset, and
presses a little further along the link's motion. A policy sees neither the draw nor its offset, only what follows from
them (its finger tips in the link's frame, how far the joint lags); what of the guide's actions follows from that it
learns by imitation, in the guide's episodes first and then in its own, where the guide says what it would have done:
dataset aggregation (Ross, Gordon and Bagnell 2011) under a teacher that sees more (Chen et al. 2019). Reinforcement
goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO

from taa_envs.asset import Asset
from taa_envs.vector import BatchedArticulationEnv
from train.config import Config
from train.policy import Policy
from train.vec import Normal


class Way(NamedTuple):
    """How a guide drives.

    first, last: m by which it presses along the link's motion when that begins, and later. Less than nothing: it holds
    back by so much, from :data:`LEAD` before.  full: share of the stroke at which it presses by ``last``.  pace: of
    the reference's clock while it drives, an action.  follow: whether it goes after a link that runs ahead of the
    reference.
    """

    first: float
    last: float
    full: float = 1.0
    pace: float = 0.0
    follow: bool = False


# A link that the arriving hand flings coasts ahead of it, which is no success: a hand that comes late and slowly flings
# less, one that goes after the link goes on driving it. What is best depends on the joint.
WAYS = (Way(-0.04, 0.03, 0.5, -0.3, True), Way(-0.04, 0.06, 0.7, -0.5), Way(-0.02, 0.04, 0.5, -0.3, True),
        Way(0.01, 0.03))  # fmt: skip
LEAD = 0.6  # s
TRIALS = 32  # draws in which each way is tried
STARTED = 0.005  # of the stroke: from here on the demonstrated hand drives
SEED = 250_000  # of the guide's first episode: not the training's, nor those of evaluations
ROUNDS = 3  # of as many episodes of the policy's own, which the guide comments
EPOCHS, BATCH, RATE = 200, 256, 1e-3  # of imitation, each round; the rate falls to nothing in it


def carried(asset: Asset, joint: tuple[np.ndarray, ...], q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Points x (n, 3) m of the link at q = 0, each moved to its q (n,) about its own joint (axis, point: (n, 3))."""
    from scipy.spatial.transform import Rotation

    axis, point = joint
    along = q[:, None] * axis
    if asset.joint_type == "prismatic":
        return x + along
    return point + Rotation.from_rotvec(along).apply(x - point) + asset.pitch * along


class Guide:
    """Says what to do in episodes whose draws it knows.

    Args:
        env: of n episodes, residual actions.  drawn: ``info["randomized"]`` of their reset.  ways: n of :class:`Way`.
    """

    def __init__(self, env: BatchedArticulationEnv, drawn: dict[str, np.ndarray], ways: list[Way]) -> None:
        self.task, self.asset, n = env.task, env.asset, env.num_envs
        joint, demo = self.asset.joint, self.asset.demo
        self.nominal = tuple(np.tile(np.array(joint[name], float), (n, 1)) for name in ("axis", "point"))
        self.drawn = tuple(np.array(drawn.get(name, value)) for name, value in
                           zip(("axis", "point"), self.nominal, strict=True))  # fmt: skip
        self.offset = np.array(drawn.get("hand", np.zeros((n, 3))))
        self.sign = np.sign(demo["q_demo_end"] - demo["q_start"])
        self.first, self.last, self.full, self.pace, self.follow = np.array(ways, float).T
        reference = self.asset.reference
        drives = self.asset.stroke_fraction(reference.q) > STARTED
        self.begin = reference.time[np.argmax(drives)] - np.where(self.first < 0, LEAD, 0.0)

    def act(self) -> np.ndarray:
        """(n, A) float32 residual actions for the next decision."""
        task, asset, reference = self.task, self.asset, self.asset.reference
        q = np.interp(task.time, reference.time, reference.q)
        stroke = asset.stroke_fraction(q)
        palm = task.path(task.time).mean(1)
        home = carried(asset, self.nominal, -q, palm)
        ahead = np.maximum((task.q - q) * self.sign, 0) * (stroke > STARTED)
        q = q + self.follow * ahead * self.sign
        there = carried(asset, self.drawn, q, home)
        onward = carried(asset, self.drawn, q + 1e-3 * self.sign, home) - there
        onward /= np.maximum(np.linalg.norm(onward, axis=1, keepdims=True), 1e-12)
        press = self.first + (self.last - self.first) * np.clip(stroke / self.full, 0, 1)
        shift = there - palm - self.offset + (press * (task.time >= self.begin))[:, None] * onward
        out = np.zeros((len(q), task.action_size), np.float32)
        out[:, :3] = np.clip(shift / task.translation, -1, 1)
        out[:, 7] = self.pace * (stroke > STARTED)
        return out


@dataclass(frozen=True)
class Played:
    """Episodes side by side: observed (T, n, D), advised (T, n, A), rewards (T, n), live (T, n) bool; won (n,) bool."""

    observed: np.ndarray
    advised: np.ndarray
    rewards: np.ndarray
    live: np.ndarray
    won: np.ndarray

    def returns(self, gamma: float) -> np.ndarray:
        """(T, n) discounted sums of what follows."""
        out, sums = np.zeros_like(self.rewards), np.zeros(len(self.won))
        for k in reversed(range(len(out))):
            sums = out[k] = np.where(self.live[k], self.rewards[k] + gamma * sums, 0.0)
        return out


def play(env: BatchedArticulationEnv, seed: int, ways: list[Way], policy: Policy | None = None) -> Played:
    """One episode in each simulation, driven by the policy or else by the guide, who advises in any case."""
    observation, info = env.reset(seed=seed)
    guide = Guide(env, info.get("randomized", {}), ways)
    live, won = np.ones(env.num_envs, bool), np.zeros(env.num_envs, bool)
    steps: list[tuple[np.ndarray, ...]] = []
    while live.any():
        advised = guide.act()
        before, was = observation, live.copy()
        action = advised if policy is None else policy.act(observation)
        observation, rewards, terminated, truncated, info = env.step(action)
        ended = live & (terminated | truncated)
        won[ended] = info["is_success"][ended]
        live = live & ~ended
        steps.append((before, advised, rewards, was))
    observed, advised, rewards_, lives = (np.array(x) for x in zip(*steps, strict=True))
    return Played(observed, advised, rewards_, lives, won)


def most_steps(config: Config, longest: int) -> int:
    """Environment steps that :func:`teach` makes at most, where an episode has ``longest``."""
    return (TRIALS * len(WAYS) + config.guide_episodes * (ROUNDS + 1)) * longest


def teach(model: PPO, asset: Asset, config: Config, normal: Normal) -> int:
    """Make a fresh policy imitate the guide, and its critic expect what the policy then gets.

    The way that succeeds most often in a few draws is the guide's; it drives in ``config.guide_episodes`` draws and
    comments the policy in as many fresh ones a round.

    Returns:
        environment steps simulated.
    """
    n = config.guide_episodes

    def batch(count: int) -> BatchedArticulationEnv:
        return BatchedArticulationEnv(asset, count, action=config.action, reward=config.reward,
                                      randomize=config.randomize, hold=config.hold)

    seed = SEED + 1000 * config.seed
    env = batch(TRIALS)
    tried = [play(env, seed, [way] * TRIALS) for way in WAYS]
    env.close()
    way = WAYS[int(np.argmax([run.won.mean() for run in tried]))]
    env, policy = batch(n), Policy(model.policy, normal, config.hold)
    generator = torch.Generator().manual_seed(config.seed)
    runs = [play(env, seed + TRIALS, [way] * n)]
    for k in range(1, ROUNDS + 1):
        _imitate(model, normal, runs, generator)
        runs.append(play(env, seed + TRIALS + k * n, [way] * n, policy))
    _imitate(model, normal, runs, generator)
    last = runs[-1]
    _fit(model, normal(last.observed[last.live]), last.returns(model.gamma)[last.live][:, None], generator, actor=False)
    env.close()
    return sum(run.live.size for run in tried + runs) * config.hold


def _imitate(model: PPO, normal: Normal, runs: list[Played], generator: torch.Generator) -> None:
    """Fit the policy's mean action to the advice in all runs."""
    observed = np.concatenate([run.observed[run.live] for run in runs])
    _fit(model, normal(observed), np.concatenate([run.advised[run.live] for run in runs]), generator, actor=True)


def _fit(model: PPO, x: np.ndarray, y: np.ndarray, generator: torch.Generator, actor: bool) -> None:
    """Least squares of the mean action, or of the value, on normalised observations x (N, D)."""
    policy = model.policy
    policy.set_training_mode(True)
    latent, head = ((policy.mlp_extractor.forward_actor, policy.action_net) if actor
                    else (policy.mlp_extractor.forward_critic, policy.value_net))  # fmt: skip
    parts = (policy.mlp_extractor.policy_net if actor else policy.mlp_extractor.value_net, head)
    optimiser = torch.optim.Adam([p for part in parts for p in part.parameters()], RATE)
    inputs, targets = torch.as_tensor(x), torch.as_tensor(y, dtype=torch.float32)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS * -(-len(inputs) // BATCH))
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(inputs), generator=generator).split(BATCH):
            loss = torch.nn.functional.mse_loss(head(latent(inputs[rows])), targets[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            falling.step()
    policy.set_training_mode(False)


__all__ = ["WAYS", "Guide", "Played", "Way", "carried", "most_steps", "play", "teach"]
