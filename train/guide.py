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
from taa_envs.scene import CONTROL_PERIOD
from taa_envs.vector import BatchedArticulationEnv
from train.config import Config
from train.policy import Policy
from train.vec import Normal


class Way(NamedTuple):
    """How a guide drives.

    first, last: m by which it presses along the link's motion when that begins, and later. Less than nothing: it holds
    back by so much, from :data:`LEAD` before.  full: share of the stroke at which it presses by ``last``.  pace: of
    the reference's clock while it drives, an action.  follow: whether it goes after a link that runs ahead of the
    reference.  foresee: s by which it looks ahead at where the link goes.  wait: m by which the link may lag at the
    hand before the clock stands.  inward: m towards a hinge.
    """

    first: float
    last: float
    full: float = 1.0
    pace: float = 0.0
    follow: bool = False
    foresee: float = 0.0
    wait: float = np.inf
    inward: float = 0.0


# A link that the arriving hand flings coasts ahead of it, which is no success: a hand that comes late and slowly flings
# less, one that goes after the link goes on driving it, and one that waits for a heavy link keeps hold of it. A hand
# that reaches further in than the person's does not slip off a lid's edge when it errs. What is best depends on the
# joint.
WAYS = (Way(0.01, 0.05, pace=-0.15, inward=0.03), Way(-0.02, 0.04, 0.5, -0.3, True, inward=0.02),
        Way(-0.04, 0.03, 0.5, -0.5, True, foresee=0.2, wait=0.06))  # fmt: skip
LEAD = 0.6  # s
STAND = -2 / 3  # action at which the reference's clock stands
TRIALS = 64  # draws in which each way is tried
SLIP = 0.05  # of an action of 1: so clumsy, up to here, is the guide in the trials. Its pupil will be
USED = (0, 1, 2, 7)  # numbers of an action by which the guide works: translation and the clock
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
        self.first, self.last, self.full, self.pace, self.follow, self.foresee, self.wait, self.inward = (
            np.array(ways, float).T)
        reference = self.asset.reference
        drives = self.asset.stroke_fraction(reference.q) > STARTED
        self.begin = reference.time[np.argmax(drives)] - np.where(self.first < 0, LEAD, 0.0)
        self.period = env.hold * CONTROL_PERIOD  # s between decisions
        self.was = self.task.q.copy()

    def act(self) -> np.ndarray:
        """(n, A) float32 residual actions for the next decision."""
        task, asset, reference = self.task, self.asset, self.asset.reference
        q = np.interp(task.time, reference.time, reference.q)
        stroke = asset.stroke_fraction(q)
        started = stroke > STARTED
        palm = task.path(task.time).mean(1)
        home = carried(asset, self.nominal, -q, palm)
        arm = np.linalg.norm(self._onward(q, home), axis=1)
        speed = np.maximum((task.q - self.was) * self.sign, 0) / self.period
        self.was = task.q.copy()
        lead = ((task.q - q) * self.sign + self.foresee * speed) * started
        lag = np.maximum(-lead, 0) * arm
        q = q + self.follow * np.maximum(lead, 0) * self.sign
        there = carried(asset, self.drawn, q, home)
        onward = self._onward(q, home)
        onward /= np.maximum(np.linalg.norm(onward, axis=1, keepdims=True), 1e-12)
        press = self.first + (self.last - self.first) * np.clip(stroke / self.full, 0, 1)
        shift = there - palm - self.offset + (press * (task.time >= self.begin))[:, None] * onward
        if asset.joint_type != "prismatic":
            shift += self.inward[:, None] * self._inward(there)
        out = np.zeros((len(q), task.action_size), np.float32)
        out[:, :3] = np.clip(shift / task.translation, -1, 1)
        out[:, USED[-1]] = np.maximum(self.pace - (self.pace - STAND) * np.minimum(lag / self.wait, 1), STAND) * started
        return out

    def _onward(self, q: np.ndarray, home: np.ndarray) -> np.ndarray:
        """(n, 3) m a rad or m, which way and how fast the palm moves with the drawn joint."""
        step = 1e-3 * self.sign
        return (carried(self.asset, self.drawn, q + step, home) - carried(self.asset, self.drawn, q, home)) / 1e-3

    def _inward(self, x: np.ndarray) -> np.ndarray:
        """(n, 3) unit vectors from points x (n, 3) m to the drawn axis."""
        axis, point = self.drawn
        off = point - x
        off -= (off * axis).sum(1, keepdims=True) * axis
        return off / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-12)


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


def play(env: BatchedArticulationEnv, seed: int, ways: list[Way], policy: Policy | None = None,
         slip: np.ndarray | float = 0.0) -> Played:  # fmt: skip
    """One episode in each simulation, driven by the policy or else by the guide, who advises in any case.

    slip: (n,) standard deviation of what the driver errs by in a whole episode, in each number of its action that the
    guide uses; half as much comes anew with every decision.
    """
    rng = np.random.default_rng(seed)
    spread = np.broadcast_to(slip, env.num_envs)[:, None] * np.isin(np.arange(env.task.action_size), USED)
    habit = spread * rng.normal(size=spread.shape)
    observation, info = env.reset(seed=seed)
    guide = Guide(env, info.get("randomized", {}), ways)
    live, won = np.ones(env.num_envs, bool), np.zeros(env.num_envs, bool)
    steps: list[tuple[np.ndarray, ...]] = []
    while live.any():
        advised = guide.act()
        before, was = observation, live.copy()
        action = advised if policy is None else policy.act(observation)
        if np.any(spread):
            action = np.clip(action + habit + 0.5 * spread * rng.normal(size=spread.shape), -1, 1).astype(np.float32)
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

    The way that succeeds most often in a few draws, most of them with clumsy hands, is the guide's; it drives in
    ``config.guide_episodes`` draws and comments the policy in as many fresh ones a round.

    Returns:
        environment steps simulated.
    """
    n = config.guide_episodes

    def batch(count: int) -> BatchedArticulationEnv:
        return BatchedArticulationEnv(asset, count, action=config.action, reward=config.reward,
                                      randomize=config.randomize, hold=config.hold)

    seed = SEED + 1000 * config.seed
    env = batch(TRIALS)
    tried = [play(env, seed, [way] * TRIALS, slip=np.linspace(0, SLIP, TRIALS)) for way in WAYS]
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
