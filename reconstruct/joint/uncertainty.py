"""Covariance of a polished joint: robust against errors that last in time and are shared by neighbours.

White noise would give the inverse of the Schur complement. Real track errors drift and are alike on neighbouring
points, so that the scores are summed over clusters of tracks first (the cluster-robust sandwich of Liang and Zeger,
1986); of both answers the larger variance is stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.joint.polish import (
    ROBUST_SIGMAS,
    Bundle,
    Sightings,
    frames_held,
    normal_equations,
    parallel_deg,
    positions,
    residuals,
    robust_loss,
)
from reconstruct.joint.shape import Flat, extent, seen_across
from reconstruct.joint.states import unlinked

CELL = 0.06
"""Edge of a cluster over the link's diagonal."""


@dataclass(frozen=True)
class Spread:
    """Standard deviations and covariances.

    Attributes:
        axis_deg: of the axis direction.  point: of the axis line across itself, in units of the link's mean depth.
        q: (T,) of the states, rad or units of the mean depth; the whole stroke where no chain of tracks holds one to
            that of the first frame.
        curvature: (3, 3) of the twist's curvature.  log_focal: of the focal length's logarithm.
        inflation: of the axis' variance over that of white noise.
        stroke: the stroke over its standard deviation, between the ends that tracks hold. States are relative to the
            first frame; where that does not show the link their own deviations say nothing of it.
    """

    axis_deg: float
    point: float
    q: np.ndarray
    curvature: np.ndarray
    log_focal: float
    inflation: float
    stroke: float


def clusters(b: Bundle, link: np.ndarray | None = None, cell: float = CELL) -> np.ndarray:
    """(N,) cluster number of each track: cells of space on the link, and on what rests beside it."""
    link = np.ones(len(b.X), bool) if link is None else link
    own = b.X[link]
    size = extent(own, 0.1)
    key = np.floor((b.X - np.median(own, axis=0)) / max(cell * size, 1e-9)).astype(int)
    key = np.concatenate([key, link[:, None]], axis=1)
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def compact(X: np.ndarray, reach: float = 2.5) -> np.ndarray:
    """(N,) bool: points within `reach` link sizes of the link's middle.

    A stray track that the joint happens to explain is placed far in front of or behind the link; the link's size is
    read across the line of sight, where strays count as everything else.
    """
    middle = np.median(X, axis=0)
    size = extent(seen_across(X, middle[2]), 0.1)
    return np.linalg.norm(X - middle, axis=1) < reach * max(size, 1e-6)


def shared_error(r: np.ndarray, seen: np.ndarray, cluster: np.ndarray) -> float:
    """Intraclass correlation of the residuals (N, T, 2) within clusters, in [0, 1]."""
    count = cluster.max() + 1
    total = np.zeros((count, *r.shape[1:]))
    np.add.at(total, cluster, r)
    square, members = np.zeros((count, r.shape[1])), np.zeros((count, r.shape[1]))
    r2 = np.sum(r**2, axis=-1)
    np.add.at(square, cluster, r2)
    np.add.at(members, cluster, seen.astype(float))
    pairs = np.sum(total**2, axis=-1) - square
    norm = np.sum((np.maximum(members, 1) - 1) * square)
    return float(np.clip(pairs.sum() / norm, 0, 1)) if norm > 0 else 0.0


def lasting_error(r: np.ndarray, seen: np.ndarray, most: int = 40) -> float:
    """Integrated autocorrelation time of the residuals (N, T, 2), frames; 1 for white noise.

    The sum of the autocorrelations up to the first that is not positive (Geyer's initial sequence, 1992).
    """
    total, norm = 1.0, np.sum(r**2) / max(seen.sum(), 1)
    for k in range(1, min(most, r.shape[1] // 2)):
        both = seen[:, k:] & seen[:, :-k]
        if both.sum() < 50:
            break
        c = np.sum(r[:, k:] * r[:, :-k]) / both.sum() / max(norm, 1e-12)
        if c < 0.02:
            break
        total += 2 * c
    return float(total)


def frame_noise(r: np.ndarray, seen: np.ndarray, least: float) -> np.ndarray:
    """(T,) standard deviation of one coordinate in each frame, from the median residual of its tracks."""
    r2 = np.where(seen, np.sum(r**2, axis=-1), np.nan)
    out = np.full(seen.shape[1], np.inf)
    some = seen.sum(0) >= 3
    out[some] = np.sqrt(np.nanmedian(r2[:, some], axis=0) / (2 * np.log(2)))
    return np.maximum(out, least)


WINDOWS = (5, 11, 25)


def strayed(r: np.ndarray, seen: np.ndarray, sigma: float, lasting: float) -> np.ndarray:
    """(N, T) bool: stretches of tracks that have left their point, too slowly for single residuals to show it.

    Sums of the residuals (N, T, 2) over windows of frames against what noise would make of them that lasts `lasting`
    frames; the limit is the largest that noise alone would reach once in all of them. The noise is that of the frame
    (sigma at least): where all tracks err, in fast motion or because the model does, none of them has strayed.
    """
    N, T = seen.shape
    r = r / frame_noise(r, seen, sigma)[:, None]
    limit = 2 * np.log(max(seen.sum(), 2))
    total = np.concatenate([np.zeros((N, 1, 2)), np.cumsum(np.where(seen[..., None], r, 0.0), axis=1)], axis=1)
    count = np.concatenate([np.zeros((N, 1)), np.cumsum(seen, axis=1)], axis=1)
    out = np.zeros((N, T), bool)
    for n in WINDOWS:
        if n > T:
            break
        if n < 2 * lasting:
            continue  # a mean over so few frames says no more than one of them, which the loss has seen to
        m = count[:, n:] - count[:, :-n]
        power = np.sum((total[:, n:] - total[:, :-n]) ** 2, axis=-1)
        power /= np.maximum(m * np.minimum(m, lasting), 1)
        bad = (power > limit) & (m >= 0.5 * n)
        for k in range(n):
            out[:, k : T - n + 1 + k] |= bad
    return out & seen


def shared_weights(rho: float, cluster: np.ndarray) -> np.ndarray:
    """(N,) weights of tracks whose errors correlate by rho within a cluster: 1 / (1 + rho (m - 1)) (Kish, 1965)."""
    m = np.bincount(cluster)[cluster]
    return 1.0 / (1.0 + rho * (m - 1))


def spread(b: Bundle, s: Sightings) -> Spread:
    """Covariances at the optimum."""
    world, cam = positions(b, s)
    r = residuals(b, s, cam)
    _, w = robust_loss(r, s, ROBUST_SIGMAS * max(b.sigma, 0.05))
    n = normal_equations(b, s, world, cam, r, w)
    T = s.seen.shape[1]
    A = n.lead
    link = np.ones(len(b.X), bool) if s.link is None else s.link
    G = n.Z.shape[1]
    tw = b.twist
    Flat.of(b, s, b.sigma).add(n, b)
    S, _, inv = n.reduced(0.0)
    if s.focal_std > 0:
        S[G, G] += b.sigma**2 * s.lasting / s.focal_std**2
    if s.along is not None:
        J = np.cross(s.along, tw.axis_by_step(n.Z), axisb=0).T
        S[:G, :G] += b.sigma**2 * s.lasting / np.radians(parallel_deg(s)) ** 2 * J.T @ J
    # Gauges: q[0], the first camera, and the scale about its centre.
    S, _ = n.held(S, np.zeros(len(S)), T)
    v0 = tw.direction - np.cross(tw.curvature, tw.anchor)
    if s.scaleless:
        rate = tw.direction @ v0
        null = np.zeros(len(S))
        null[:G] = n.Z.T @ np.concatenate([v0 - tw.direction * rate, -tw.curvature * rate])
        null[A : A + T] = b.q * rate
        if s.free:
            null[A + T :] = np.concatenate([np.zeros_like(b.t), b.t], axis=1).ravel()
        null /= np.linalg.norm(null)
        S = S + np.trace(S) * np.outer(null, null)
    B = np.linalg.inv(S + 1e-12 * np.trace(S) / len(S) * np.eye(len(S)))
    scores = n.scores - np.einsum("pni,nij,nj->np", n.C, inv, n.gp)
    cluster = clusters(b, link)
    groups = np.zeros((cluster.max() + 1, len(S)))
    np.add.at(groups, cluster, scores)
    used = max(len(groups) - 1, 1)
    half = groups @ B.T * np.sqrt(len(groups) / used)  # sandwich = half' half
    freedom = max(1.0 - (3 * len(b.X) + len(S)) / max(2 * s.seen.sum(), 1), 0.1)
    white = b.sigma**2 * s.lasting

    def variance(L: np.ndarray) -> np.ndarray:
        """(k, P) functionals -> (k,) variances."""
        plain = white * np.einsum("kp,pq,kq->k", L, B, L)
        return np.maximum(plain, np.sum((half @ L.T) ** 2, axis=0) / freedom)

    by_d, by_w = np.zeros((3, len(S))), np.zeros((3, len(S)))
    by_d[:, :G], by_w[:, :G] = n.Z[:3], n.Z[3:]
    # Mean depth of the link's points, the unit of length; each as much as it counts, and none that strayed: nothing
    # holds the depth of a track that the joint happens to explain.
    share = w.sum(1) * link
    share[link] *= compact(b.X[link])
    share /= max(float(share.sum()), 1e-12)
    unit = float(share @ b.X[:, 2])
    by_unit = -np.einsum("n,nj,pnj->p", share, inv[:, 2], n.C, optimize=True)
    own = white * float(share**2 @ inv[:, 2, 2])
    by_q = np.zeros((T, len(S)))
    by_q[np.arange(T), A + np.arange(T)] = 1.0
    if not s.scaleless:
        by_unit, own = np.zeros_like(by_unit), 0.0
    if b.kind == "prismatic":
        axis = by_d
        point = 0.0
        q = (by_q - np.outer(b.q, by_unit) / unit) / unit
        q_var = variance(q) + own * (b.q / unit**2) ** 2
        path = b.q / unit
    else:
        k = np.linalg.norm(tw.curvature)
        a = tw.axis
        axis = (np.eye(3) - np.outer(a, a)) @ by_w / k
        moment = np.cross(tw.curvature, tw.direction)
        turned = np.cross(by_w.T, tw.direction).T + np.cross(tw.curvature, by_d.T).T
        c = tw.point
        by_c = turned / k**2 - 2 * np.outer(moment, tw.curvature @ by_w) / k**4
        # The line nearest to the link's middle, across itself: the axis turns about the anchor's foot.
        by_c = (np.eye(3) - np.outer(a, a)) @ (by_c - np.outer(c, by_unit) / unit) / unit
        point = float(np.sqrt(variance(by_c).sum() + own * (np.sum(c**2) - (c @ a) ** 2) / unit**4))
        q = k * by_q + np.outer(b.q, a @ by_w)
        q_var = variance(q)
        path = b.q * k
    axis_var = variance(axis)
    plain = b.sigma**2 * np.einsum("kp,pq,kq->k", axis, B, axis).sum()
    curvature = by_w @ B @ by_w.T * white
    robust = (half @ by_w.T).T @ (half @ by_w.T) / freedom
    if np.trace(robust) > np.trace(curvature):
        curvature = robust
    focal = float(np.sqrt(variance(np.eye(len(S))[G : G + 1])[0])) if s.focal_std > 0 else 0.0
    q_std = np.where(unlinked(b, s), _widest(b), np.sqrt(np.minimum(q_var, _widest(b) ** 2)))
    q_std[0] = 0.0
    inflation = float(axis_var.sum() / max(plain, 1e-30))
    shown = frames_held(s, w)
    low, high = shown[np.argmin(path[shown])], shown[np.argmax(path[shown])]
    stroke = float((path[high] - path[low]) / max(np.sqrt(variance(q[high : high + 1] - q[low : low + 1])[0]), 1e-12))
    return Spread(float(np.degrees(np.sqrt(axis_var.sum()))), point, q_std, curvature, focal, inflation, stroke)


def _widest(b: Bundle) -> float:
    span = max(np.ptp(b.q), 1e-9)
    return span if b.kind == "prismatic" else span * float(np.linalg.norm(b.twist.curvature))
