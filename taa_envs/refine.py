"""Refinement of a demonstrated hand by sampling: the third rung of the replay ladder.

The open-loop replay takes the demonstration as it was reconstructed. Here a few smooth corrections of it
(:mod:`taa_envs.corrections`: depth, size, timing, finger tips ...) are searched so that the replay follows the
demonstrated joint, by the cross-entropy method (Rubinstein and Kroese, 2004): draw corrections, replay them all, move
the distribution to the best. Every correction stays within :data:`BOUND` standard deviations of what the asset states.
The object's joint stays passive: only the hand's targets change, and what is found is again an open-loop replay.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from taa_envs.asset import Asset, Reference
from taa_envs.corrections import NAMES, Corrections
from taa_envs.replay import ReplayResult, replay, simulate
from taa_envs.rollouts import OutOfTime, Rollout, Rollouts
from taa_envs.scene import build_scene
from taa_envs.simulation import Diverged, HandPath

BOUND = 2.0  # standard deviations
POPULATION, ELITE, GENERATIONS = 24, 6, 8
SPREAD, LEAST_SPREAD = 0.8, 0.15  # of the first draws, and below which no direction is given up
KEEP = 0.3  # of the old distribution in each move
DEEP = 0.01  # m of overlap that is nothing to be avoided
GOOD = 1.15  # score of the worst of the elite at which the search ends; 1.2 is perfect
FINALISTS = 4
SHIFT, DELAY = 0.005, 0.02  # m and s, the disturbances against which finalists are tried
CONTROL_LIMIT = 0.05  # progress that no control may make


@dataclass(frozen=True)
class Refinement:
    """What a refinement found.

    Attributes:
        hand: its name.  parameters: name -> value in its unit.  std: name -> stated deviation.
        stated: whether the asset stated all deviations.
        before, after: replays with the demonstration and with the corrected one.
        reference: the corrected demonstration.
        rollouts: how many were simulated.  seconds: wall time.  seed: of the draws.
    """

    hand: str
    parameters: dict[str, float]
    std: dict[str, float]
    stated: bool
    before: ReplayResult
    after: ReplayResult
    reference: Reference
    rollouts: int
    seconds: float
    seed: int

    @property
    def changed(self) -> bool:
        """Whether a correction was found that is better than none."""
        return any(self.parameters.values())

    def as_dict(self) -> dict:
        """JSON-ready record, without the arrays."""
        return {"hand": self.hand, "changed": self.changed, "parameters": self.parameters, "std": self.std,
                "std_stated_by_asset": self.stated, "bound_std": BOUND, "before": self.before.as_dict(),
                "after": self.after.as_dict(), "rollouts": self.rollouts, "seconds": round(self.seconds, 2),
                "seed": self.seed}


def score(asset: Asset, rollout: Rollout) -> float:
    """How well a replay follows the demonstration; 1.2 is perfect, an unstable one is -inf.

    Progress less final error, half the mean lag behind the demonstrated joint, motion the wrong way and overlap deeper
    than :data:`DEEP`, plus a fifth of the fraction of driven frames in which the hand really pushed.
    """
    if rollout.diverged:
        return -np.inf
    end = asset.demo["demo_end_frame"]
    fraction = asset.stroke_fraction(rollout.q)
    lag = float(np.abs(fraction[:-1] - asset.stroke_fraction(asset.reference.q[:end + 1])).mean())
    wanted = asset.reference.contact[:end + 1]
    pushed = float(rollout.contact[wanted].mean()) if wanted.any() else 0.0
    deep = min(max(0.0, rollout.penetration / DEEP - 1.0), 2.0)
    return float(np.clip(fraction[-1], 0, 1) - asset.final_q_error(rollout.q[-1]) - 0.5 * lag
                 - max(0.0, -float(fraction.min())) + 0.2 * pushed - 0.2 * deep)


def disturbed(path: HandPath) -> list[HandPath]:
    """The path moved by +-:data:`SHIFT` along x, y, z of the asset frame, and early and late by :data:`DELAY`."""
    moved = [HandPath(path.time, path.joints + sign * SHIFT * axis) for axis in np.eye(3) for sign in (1, -1)]
    return [*moved, HandPath(path.time + DELAY, path.joints), HandPath(path.time - DELAY, path.joints)]


def refine(asset: Asset, hand: str = "points", *, seed: int = 0, seconds: float = 60.0, threads: int = 0,
           progress: Callable[[float], None] | None = None) -> Refinement:
    """Search for a correction of the demonstration with which its replay follows the demonstrated joint.

    Args:
        asset: as loaded; its own demonstration is the start.
        hand: name of the hand that replays.
        seed: of the draws.
        seconds: of wall time for all of it. What is running when they are up, less what a last replay of the result
            takes, is given up: on a busy machine fewer corrections are tried. Only the replay of the demonstration is
            always made. The result of a seed can depend on it.
        threads: 0 for one a core.
        progress: told the share that is done.

    Returns:
        The best correction. Where none is better than the demonstration itself, or only by answering to the controls
        of the replay too, the demonstration.

    Raises:
        AssetError, UnknownHand: the scene cannot be built.
        Diverged: the replay of the demonstration itself is unstable.
    """
    begin = time.monotonic()
    before = replay(asset, hand)
    check = time.monotonic() - begin  # what a replay with its controls costs; the result needs one more
    deadline = begin + seconds - 1.2 * check
    scene = build_scene(asset, hand)
    corrections = Corrections.of(asset)
    runs = Rollouts(scene, POPULATION, threads)
    rng = np.random.default_rng(seed)
    n = len(NAMES)
    mean, spread = np.zeros(n), np.full(n, SPREAD)
    tried: list[tuple[float, np.ndarray]] = []
    start, count = 0.0, 0
    for generation in range(GENERATIONS):
        began = time.monotonic()
        draws = np.clip(mean + spread * rng.standard_normal((POPULATION, n)), -BOUND, BOUND)
        if generation == 0:
            draws[0] = 0.0
        try:
            done = runs.run([corrections.path(z) for z in draws], deadline)
        except OutOfTime:
            break
        count += POPULATION
        # Of two that replay alike the one nearer to what was seen is better.
        scores = np.array([score(asset, r) for r in done]) - 0.01 * (draws**2).mean(1)
        if generation == 0:
            start = float(scores[0])
        tried += [(float(s), z) for s, z in zip(scores, draws, strict=True) if np.isfinite(s)]
        tried.sort(key=lambda item: -item[0])
        elite = np.array([z for _, z in tried[:ELITE]])
        if len(elite):
            mean = KEEP * mean + (1 - KEEP) * elite.mean(0)
            spread = np.maximum(KEEP * spread + (1 - KEEP) * elite.std(0), LEAST_SPREAD)
        if progress:
            progress((generation + 1) / (GENERATIONS + 1))
        now = time.monotonic()
        if now + 3.0 * (now - began) > deadline:  # the finalists take two more
            break
        if len(tried) >= ELITE and tried[ELITE - 1][0] > GOOD:
            break
    found = [z for s, z in tried[:FINALISTS] if s > start + 1e-3 and z.any()]
    best, after = np.zeros(n), before
    if found:
        # Not the luckiest: the one that still works when the hand is off by millimetres and milliseconds.
        paths = [disturbed(corrections.path(z)) for z in (*found, np.zeros(n))]
        each = len(paths[0])
        try:
            done = runs.run([p for group in paths for p in group], deadline)
            count += len(done)
            worth = [float(np.mean([max(score(asset, r), -1.0) for r in done[k * each:(k + 1) * each]]))
                     for k in range(len(paths))]
        except OutOfTime:  # then the luckiest will have to do
            worth = [0.0] * len(paths)
        nominal = [s for s, z in tried[:FINALISTS] if s > start + 1e-3 and z.any()]
        order = np.argsort([-(a + b) for a, b in zip(nominal, worth[:-1], strict=True)])
        limit = max(CONTROL_LIMIT, *before.controls.values()) if before.controls else CONTROL_LIMIT
        for k in order:
            if nominal[k] + worth[k] <= start + worth[-1] or time.monotonic() > deadline + 0.2 * check:
                break
            result = replay(replace(asset, reference=corrected(asset, corrections.path(found[k]))), hand)
            if max(result.controls.values()) <= limit and result.joint_progress >= before.joint_progress - 1e-3:
                best, after = found[k], result
                break
    if progress:
        progress(1.0)
    values = {name: float(v) * corrections.std[name] for name, v in zip(NAMES, best, strict=True)}
    reference = corrected(asset, corrections.path(best)) if best.any() else asset.reference
    return Refinement(hand, values, corrections.std, corrections.stated, before, after, reference, count,
                      time.monotonic() - begin, seed)


def corrected(asset: Asset, path: HandPath) -> Reference:
    """The asset's demonstration with another hand path, on the same frames."""
    joints = np.stack([path.at(float(t)) for t in asset.reference.time])
    return replace(asset.reference, hand_joints=joints)


def robustness(asset: Asset, hand: str = "points") -> dict[str, float]:
    """Progress of the replay under the disturbances of :func:`disturbed`: the ``mean`` and the ``worst``; 0 where the
    simulation becomes unstable."""
    scene = build_scene(asset, hand)
    done = []
    for path in disturbed(HandPath(asset.reference.time, asset.reference.hand_joints)):
        try:
            done.append(float(asset.progress(simulate(scene, path).q[-1])))
        except Diverged:
            done.append(0.0)
    return {"mean": float(np.mean(done)), "worst": float(np.min(done))}


__all__ = ["Refinement", "corrected", "disturbed", "refine", "robustness", "score"]
