"""Which type: the hinge contains the slide and the screw contains both, so the question is what the curvature is.

The slide is the hinge whose curvature w is zero. The odds are the ratio of the marginal likelihood with w free, over a
prior of where hinges are, to that with w = 0 (compare Dickey, 1971): the peak comes from the robust costs, the width
from the covariance of the bundle adjustment. The screw against the hinge is the same question about w's part along the
direction of motion.
"""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr

from reconstruct.joint.polish import HINGE_RADIUS, HINGE_SPREAD
from reconstruct.joint.twist import Twist

PRIOR = {"revolute": 0.6, "prismatic": 0.37, "screw": 0.03}


def log_odds_hinge(twist: Twist, covariance: np.ndarray, size: float, gain: float) -> float:
    """Logarithm of the Bayes factor of a hinge against a slide.

    Args:
        twist: of the hinge.  covariance: (3, 3) of its curvature.  size: of the link, in the twist's units.
        gain: log-likelihood at its best over the slide's at its best.
    """
    basis = _across(twist)
    w = basis.T @ twist.curvature
    P = np.linalg.inv(basis.T @ covariance @ basis + 1e-12 * np.eye(2) / size**2)
    # Polar quadrature over the prior: log-normal radius, any direction.
    z = np.linspace(-3.5, 3.5, 141)
    radius = 1.0 / (size * HINGE_RADIUS * np.exp(HINGE_SPREAD * z))
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    e = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum()
    d = radius[:, None, None] * e - w
    log = -0.5 * np.einsum("zai,ij,zaj->za", d, P, d) + np.log(weight)[:, None] - np.log(len(angle))
    # A sharp likelihood falls between the nodes: Laplace's approximation there.
    top = log.max()
    grid = float(top + np.log(np.exp(log - top).sum()))
    k = np.linalg.norm(w)
    zw = np.log(1.0 / (max(k, 1e-12) * size * HINGE_RADIUS)) / HINGE_SPREAD
    density = -0.5 * zw**2 - np.log(np.sqrt(2 * np.pi) * HINGE_SPREAD) - np.log(2 * np.pi * max(k, 1e-12) ** 2)
    laplace = float(density + np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(P)[1])
    sharp = np.sqrt(1.0 / np.linalg.eigvalsh(P)[-1]) < 0.1 * k
    return (laplace if sharp else grid) + gain


SCREW_ADVANCE = (0.08, 0.8)
"""Advance of a screw over its path: a hinge whose fit creeps by less along its axis is a hinge."""


def log_odds_screw(twist: Twist, covariance: np.ndarray, gain: float) -> float:
    """Logarithm of the Bayes factor of a screw against a hinge: advance uniform in SCREW_ADVANCE, of either sign.

    Args:
        twist, covariance: of the screw and its curvature.  gain: log-likelihood at its best over the hinge's.
    """
    d = twist.direction
    k = np.linalg.norm(twist.curvature)
    if k <= 0:
        return -np.inf
    share = float(twist.curvature @ d) / k
    std = float(np.sqrt(max(d @ covariance @ d, 1e-18))) / k
    lo, hi = SCREW_ADVANCE
    x = np.linspace(lo, hi, 400)
    log = np.concatenate([-0.5 * ((x - share) / std) ** 2, -0.5 * ((x + share) / std) ** 2])
    top = log.max()
    return float(top + np.log(np.exp(log - top).mean()) + gain)


def votes(for_one: np.ndarray, for_other: np.ndarray, cluster: np.ndarray) -> float:
    """By how many standard deviations the neighbourhoods of the link prefer one joint to another (Vuong, 1989).

    Args:
        for_one, for_other: (N,) cost of every track under either.  cluster: (N,) its neighbourhood.

    Returns:
        Positive for the first; 0 where there are too few neighbourhoods to vote.
    """
    by = np.bincount(cluster, for_other - for_one)
    n = len(by)
    spread = float(np.sqrt(n * np.var(by, ddof=1))) if n > 2 else 0.0
    return float(by.sum()) / spread if spread > 0 else 0.0


def majority(for_one: np.ndarray, for_other: np.ndarray, cluster: np.ndarray) -> float:
    """By how many standard deviations more neighbourhoods of the link have a median track that prefers one joint to
    another than the other way round (sign test).

    Args:
        for_one, for_other: (N,) cost of every track under either, N > 0.  cluster: (N,) its neighbourhood.

    Returns:
        Positive for the first.
    """
    sides = [np.sign(np.median((for_other - for_one)[cluster == k])) for k in np.unique(cluster)]
    return float(np.sum(sides) / np.sqrt(len(sides)))


def tempered(odds: float, z: float) -> float:
    """Log odds no surer than the votes `z` for the side that they favour.

    A likelihood believes that all tracks are of one body with independent errors. Where strays are among them a part of
    the tracks decides against the rest, by any number of nats; by how far the neighbourhoods agree does not grow so.
    """
    z = np.sign(odds) * z
    return float(np.sign(odds) * min(abs(odds), max(log_ndtr(z) - log_ndtr(-z), 0.0)))


def probabilities(log_odds: dict[str, float]) -> dict[str, float]:
    """Posterior of the types from log marginal likelihoods and the prior."""
    log = {k: v + np.log(PRIOR[k]) for k, v in log_odds.items()}
    top = max(log.values())
    p = {k: float(np.exp(max(v - top, -50.0))) for k, v in log.items()}
    return {k: v / sum(p.values()) for k, v in p.items()}


def or_by_prior(probability: dict[str, float]) -> dict[str, float]:
    """Probabilities of the types where what they were judged by is as likely no joint's motion at all, and says nothing
    of one then: the mean of either and the prior."""
    total = sum(PRIOR[k] for k in probability)
    return {k: (p + PRIOR[k] / total) / 2 for k, p in probability.items()}


def _across(twist: Twist) -> np.ndarray:
    """(3, 2) basis of the curvatures that a hinge may have: perpendicular to the motion."""
    from reconstruct.joint.hypotheses import perpendicular_basis

    return perpendicular_basis(twist.direction)
