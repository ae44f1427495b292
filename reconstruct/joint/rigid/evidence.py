"""Which joint: nested models of one family, judged by frames that did not take part in the fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from reconstruct.joint.rigid.bundle import State, loose, refine, residuals, weigh
from reconstruct.joint.rigid.normal import OWN, covariance, normal_equations
from reconstruct.joint.rigid.observe import Noise, Observations
from reconstruct.joint.rigid.twist import KINDS

PRIOR = {"prismatic": 0.48, "revolute": 0.48, "screw": 0.04}
TURN_PRIOR = 1.0
"""Total rotation of a hinge, rad: width of the prior in each of the two directions across the motion; the stroke
over the link's size where that is less."""
PITCH_PRIOR = 0.3
"""Shift along the axis over a screw's stroke, in sizes of the link."""
HOLDING = {"prismatic": {"revolute", "screw"}, "revolute": {"screw"}, "screw": set[str]()}
"""Types that have another as a special case."""


@dataclass(frozen=True)
class Evidence:
    """Per type.

    Attributes:
        probability: after calibration.
        heldout: half the squared residuals of held-out frames, corrected for correlated errors; lower is better.
        occam: logarithm of the prior's over the posterior's width in the parameters beyond a slide's.
    """

    probability: dict[str, float]
    heldout: dict[str, float]
    occam: dict[str, float]


def weigh_types(states: dict[str, State], obs: Observations, noise: Noise, inflation: float,
                lost: Collection[str] = (), folds: int = 2, blocks: int = 10) -> Evidence:  # fmt: skip
    """Probability of each type; `obs` holds only what agrees with the best one, so that nothing flips in or out.
    Types in `lost` are far behind and judged as they are.

    The frames are cut into blocks; each fold is fitted without every other block, and the left-out frames are then
    explained with the joint and the points fixed and only their states and depth errors free. A difference of these
    held-out likelihoods (over the inflation by correlated errors) is a data term that no type gets for free by its
    extra parameters, and none more than it gains where it is fitted; what it does not see, how improbable a priori it
    is that a hinge comes out as a slide, is the ratio of prior to posterior width (Savage-Dickey).
    """
    heldout = dict.fromkeys(states, 0.0)
    T = obs.seen.shape[1]
    block = (np.arange(T) * blocks // T) % folds
    for fold in range(folds):
        out = block == fold
        for kind, st in states.items():
            if kind not in lost:
                heldout[kind] += _heldout(st, obs, noise, out) / 2 / inflation
    fitted = {kind: weigh(residuals(st, obs, noise)[0], obs, np.inf)[1] / 2 / inflation for kind, st in states.items()}
    heldout |= {kind: fitted[kind] for kind in lost}  # not fitted again: by what it leaves where it was fitted
    for kind in KINDS:
        # No type is likelier than its best fit: what it gains beyond that over its own special case, the frames left
        # out happened to do. A light that goes 5 mm was a hinge by 63 nats, and fitted to all frames by 0.3.
        for more in HOLDING[kind] & states.keys() if kind in states else ():
            heldout[more] = max(heldout[more], heldout[kind] - max(fitted[kind] - fitted[more], 0.0))
    occam = {kind: _occam(st, obs, noise, inflation) for kind, st in states.items()}
    score = {kind: np.log(PRIOR[kind]) - heldout[kind] - occam[kind] for kind in states}
    top = max(score.values())
    total = sum(np.exp(v - top) for v in score.values())
    probability = {kind: float(np.exp(score[kind] - top) / total) for kind in KINDS if kind in score}
    return Evidence(probability, heldout, occam)


def _heldout(st: State, obs: Observations, noise: Noise, out: np.ndarray) -> float:
    """Squared residuals of the frames `out` under a joint and points fitted to the others."""
    keep = ~out
    keep[st.anchor] = True
    train = Observations(obs.uv, obs.log_depth, obs.seen & keep, obs.ranged & keep, obs.K, obs.T_camera_world, obs.link,
                         obs.basis)  # fmt: skip
    fitted, _ = refine(st, train, noise, np.inf, iterations=4)
    # Points that the other frames hardly see would carry their own error into the left-out ones.
    held = (train.seen.sum(1) >= 4)[:, None] & obs.seen & ~keep
    test = Observations(obs.uv, obs.log_depth, held, obs.ranged & held, obs.K, obs.T_camera_world, obs.link, obs.basis)
    d = fitted.twist.basis().shape[1]
    rows = d + OWN * np.arange(len(fitted.s))
    for _ in range(3):
        r, X, cam = residuals(fitted, test, noise)
        w, _ = weigh(r, test, np.inf)
        n = normal_equations(fitted, test, noise, r, X, cam, w, 0.0)
        s, field = fitted.s.copy(), fitted.field.copy()
        for t in np.flatnonzero(~keep):
            step = -np.linalg.solve(n.own[t] + 1e-9 * np.eye(OWN), n.g[rows[t] + np.arange(OWN)])
            s[t] += step[0]
            field[t] += step[1:]
        fitted = State(fitted.twist, s, fitted.points, field, fitted.anchor)
    r, _, _ = residuals(fitted, test, noise)
    return weigh(r, test, np.inf)[1]


def _occam(st: State, obs: Observations, noise: Noise, inflation: float) -> float:
    """Logarithm of prior over posterior width of the parameters that a slide does not have."""
    if st.twist.kind == "prismatic":
        return 0.0
    r, X, cam = residuals(st, obs, noise)
    w, _ = weigh(r, obs, None)
    n = normal_equations(st, obs, noise, r, X, cam, w, loose(st.s))
    cov = covariance(n, n.d + OWN * st.anchor)[0] * inflation
    stroke = float(np.ptp(st.s))
    B = st.twist.basis()
    v = st.twist.v / max(np.linalg.norm(st.twist.v), 1e-12)
    across = np.linalg.svd(v[None])[2][1:]  # two directions across the origin's motion
    turn = stroke * across @ B[:3] @ cov @ B[:3].T @ across.T
    sign, logdet = np.linalg.slogdet(turn + 1e-18 * np.eye(2))
    # Hinges lie about a link's size away: a small stroke is a small turn, and a hinge has no less a claim to it.
    usual = min(TURN_PRIOR, stroke / st.twist.size)
    width = 2 * np.log(usual) - 0.5 * logdet
    if st.twist.kind == "screw":
        w_hat = st.twist.w / max(np.linalg.norm(st.twist.w), 1e-12)
        grad = w_hat @ B[3:] + (st.twist.v / max(np.linalg.norm(st.twist.w), 1e-6)) @ B[:3]
        spread = stroke * np.sqrt(max(float(grad @ cov @ grad), 1e-18))
        width += np.log(PITCH_PRIOR * st.twist.size) - np.log(spread)
    return max(float(width), 0.0)
