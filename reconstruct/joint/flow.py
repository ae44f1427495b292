"""Joints from velocities alone: every way the camera's centre may be carried along with the link, tried in turn.

A link that moves little shows each of its points a place x and a velocity u,

    u = rho (v_xy - x v_z) + B(x) w,

with the velocity v that the link would give to a point at the camera's centre, its turning w and the point's inverse
depth rho (Longuet-Higgins and Prazdny, 1980). For a given direction of v what is across v_xy - x v_z is free of the
depth, and linear in w (Heeger and Jepson, 1992). A slide has w = 0, a hinge w perpendicular to v: two numbers. So all
directions can be tried, each with a robust line fit, and no start is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.joint.paths import Paths, held

DIRECTIONS = 600
"""Of v, over half a sphere: 6 deg from one to the next."""
FLOOR_PX = 0.15
"""No track is asked to be more exact; drift is not seen in the scatter about its own path."""
ROUNDS, WIDE, NARROW = 14, 100.0, 0.6
"""Of the robust fit: how many, the first's scale in standard deviations, and each further one's over the last's."""
CUT = 3.0
"""Standard deviations at which a track counts as stray, and costs no more."""
DEEP = 3.0
"""Most and least depth of a point over the median's."""
FEW_FRAMES, PART = 8, 0.4
"""A track needs so many frames and so much of the path to have a velocity."""
ROUGH_PX = 1.0
"""RMS about its own path beyond which a track has none."""
NEXT_DEG, FINER_DEG = 9.0, (2.0, 0.7, 0.2)
"""Of the directions within NEXT_DEG of each other the best counts, brought to its optimum in these steps."""


@dataclass(frozen=True)
class Flow:
    """Velocities of tracks in the middle of the motion.

    Attributes:
        ids: (n,) indices of the tracks that have one.
        x, u: (n, 2) rays at z = 1 in the middle of the path; velocity over the whole path, in the same unit.
        cov: (n, 2, 2) of u.
        path: (T,) how far the motion has come in every frame, 0 to 1.
    """

    ids: np.ndarray
    x: np.ndarray
    u: np.ndarray
    cov: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class Candidate:
    """A joint as velocities show it, median depth of its points 1, in the camera's frame.

    Attributes:
        kind: "revolute" or "prismatic".  v: (3,) velocity at the camera's centre.  w: (3,) turning, rad; both over the
            whole path.
        depth: (n,) of every point of the flow, 1 where it is not told.  good: (n,) bool, tracks that follow.
        cost: of all tracks, each at most CUT squared.
    """

    kind: str
    v: np.ndarray
    w: np.ndarray
    depth: np.ndarray
    good: np.ndarray
    cost: float


def flow_of(paths: Paths, focal: float) -> Flow | None:
    """Velocities by a parabola through every track over the path that they have in common.

    Args:
        paths: N tracks, px from the principal point.  focal: px.

    Returns:
        None if no path is told.
    """
    enough = np.flatnonzero(paths.seen.sum(1) >= FEW_FRAMES)
    if len(enough) < FEW_FRAMES:
        return None
    some = paths[enough]
    seen = some.seen
    path = _common_path(some.moved(), seen)
    if path is None:
        return None
    at = np.stack([np.ones_like(path), path - 0.5, (path - 0.5) ** 2], axis=1)
    x = np.nan_to_num(some.uv)
    # The squared weight of either coordinate, (n, T, 2, 2): the same of both but for what slides.
    W = held(np.broadcast_to(np.eye(2), (*seen.shape, 2, 2)), some.slip)
    W = np.swapaxes(W, -1, -2) @ W * seen[..., None, None]
    normal = np.einsum("ti,tj,ntab->niajb", at, at, W, optimize=True).reshape(len(x), 6, 6)
    inverse = np.linalg.inv(normal + np.diag([1e-9, 1e-9, 1e-9, 1e-9, 1e-4, 1e-4]))
    right = np.einsum("ti,ntab,ntb->nia", at, W, x, optimize=True).reshape(len(x), 6, 1)
    along = (inverse @ right).reshape(len(x), 3, 2)
    off = held((x - np.einsum("ti,nia->nta", at, along)) * seen[..., None], some.slip)
    rough = np.sqrt(np.sum(off**2, axis=(1, 2)) / np.maximum(2 * seen.sum(1) - 6, 1))
    part = np.array([np.ptp(path[s]) for s in seen])
    good = (part > PART) & (rough < ROUGH_PX)
    floor = FLOOR_PX**2 * np.linalg.inv(W.sum(1) / seen.sum(1)[:, None, None])
    cov = (floor + rough[:, None, None] ** 2 * inverse[:, 2:4, 2:4]) / focal**2
    return Flow(enough[good], along[good, 0] / focal, along[good, 1] / focal, cov[good], path)


SPEAK = 0.02
"""Weight of the tracks seen in a frame over the most of any frame, from which on it has a say."""
STARTS = 8
"""Tracks whose own path is tried as that of all."""


def _common_path(uv: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """(T,) in [0, 1]: tracks as a place plus a velocity times this, robustly.

    From the longest track that goes far, which may be one that goes its own way, and from others of the longer half;
    that counts which leaves the least.
    """
    m, x = seen.astype(float), np.nan_to_num(uv)
    centred = (x - (np.sum(x, axis=1) / m.sum(1)[:, None])[:, None]) * m[..., None]
    spread, ways = np.linalg.eigh(np.einsum("nti,ntj->nij", centred, centred) / m.sum(1)[:, None, None])
    far = np.sqrt(spread[:, 1])
    long = np.flatnonzero(m.sum(1) >= np.median(m.sum(1)))
    spaced = long[np.argsort(far[long])][np.linspace(0, len(long) - 1, STARTS).round().astype(int)]
    tries = []
    for first in (int(np.argmax(m.sum(1) * np.minimum(far, np.quantile(far, 0.9)))), *spaced):
        here = np.flatnonzero(seen[first])
        start = np.interp(np.arange(uv.shape[1]), here, centred[first, here] @ ways[first, :, 1])
        if (found := _settled(start, x, m)) is not None:
            tries.append(found)
    if not tries:
        return None
    scale = min(np.median(r2) for _, r2 in tries)
    return min(tries, key=lambda found: float(np.sum(m.sum(1) * found[1] / (found[1] + scale))))[0]


def _settled(path: np.ndarray, x: np.ndarray, m: np.ndarray, rounds: int = 8) -> tuple[np.ndarray, np.ndarray] | None:
    """A start for the common path (T,) brought to its optimum, and (N,) mean squares that it leaves of the tracks."""
    T = len(path)
    for _ in range(rounds):
        if np.ptp(path) < 1e-9:
            return None
        path = (path - path.min()) / np.ptp(path)
        at = np.stack([np.ones(T), path], axis=1)
        normal = np.einsum("nt,ti,tj->nij", m, at, at) + 1e-6 * np.eye(2)
        line = np.linalg.solve(normal, np.einsum("nt,ti,ntk->nik", m, at, x))
        r2 = np.sum(((x - np.einsum("ti,nik->ntk", at, line)) * m[..., None]) ** 2, axis=(1, 2)) / m.sum(1)
        w = m / (1 + r2 / np.median(r2))[:, None] ** 2
        top = np.einsum("nt,ntk,nk->t", w, x - line[:, :1], line[:, 1])
        weight = np.einsum("nt,nk,nk->t", w, line[:, 1], line[:, 1])
        # Frames in which only strays are seen say nothing.
        told = np.flatnonzero((weight > 1e-6 * weight.max()) & (w.sum(0) > SPEAK * w.sum(0).max()))
        path = np.interp(np.arange(T), told, top[told] / weight[told])
    return (path - path.min()) / np.ptp(path), r2


def candidates(flow: Flow, hinges: int, slides: int) -> list[Candidate]:
    """The best joints of each type whose v are apart, best first."""
    way = _half_sphere(DIRECTIONS)
    out = []
    for kind, count in (("revolute", hinges), ("prismatic", slides)):
        cost = _tried(flow, kind, way)[0]
        alike = np.abs(way @ way.T) > np.cos(np.radians(NEXT_DEG))
        lowest = np.flatnonzero(cost <= np.min(np.where(alike, cost, np.inf), axis=1))
        best = way[lowest[np.argsort(cost[lowest])][: 2 * count]]
        for step in FINER_DEG:
            around = _around(best, step)  # (m, k, 3)
            costs = _tried(flow, kind, around.reshape(-1, 3))[0].reshape(around.shape[:2])
            best = around[np.arange(len(best)), np.argmin(costs, axis=1)]
        chosen: list[np.ndarray] = []
        for v in best[np.argsort(costs.min(axis=1))]:
            if len(chosen) < count and all(abs(v @ o) < np.cos(np.radians(NEXT_DEG)) for o in chosen):
                chosen.append(v)
        out += _judged(flow, kind, np.array(chosen))
    return sorted(out, key=lambda c: c.cost)


def _tried(flow: Flow, kind: str, way: np.ndarray) -> tuple[np.ndarray, ...]:
    """For every direction (D, 3) of v: cost (D,), w (D, 3), residual over std (D, n), whether the depth is one that a
    link may have (D, n), the inverse depth over the median's (D, n), and that (D,)."""
    x, u = flow.x, flow.u
    e = way[:, None, :2] - x[None] * way[:, None, 2:]  # (D, n, 2)
    size = np.maximum(np.linalg.norm(e, axis=-1), 1e-9)
    across = np.stack([-e[..., 1], e[..., 0]], axis=-1) / size[..., None]
    std = np.sqrt(np.einsum("dni,nij,dnj->dn", across, flow.cov, across, optimize=True))
    B = turning(x)
    y = np.einsum("dni,ni->dn", across, u) / std
    w = np.zeros((len(way), 3))
    if kind == "revolute":
        basis = np.linalg.svd(way[:, None, :])[2][:, 1:]  # (D, 2, 3), perpendicular to v
        A = np.einsum("dni,nij,dkj->dnk", across, B, basis, optimize=True) / std[..., None]
        z, scale = np.zeros((len(way), 2)), WIDE
        for _ in range(ROUNDS):
            weight = 1 / (1 + ((y - (A @ z[..., None])[..., 0]) / scale) ** 2) ** 2
            wA = weight[..., None] * A
            normal = np.swapaxes(wA, 1, 2) @ A
            normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-12 * np.eye(2)
            z = np.linalg.solve(normal, np.einsum("dnk,dn->dk", wA, y)[..., None])[..., 0]
            scale = max(NARROW * scale, 1.0)
        y = y - (A @ z[..., None])[..., 0]
        w = np.einsum("dk,dkj->dj", z, basis)
    told = np.einsum("nij,dnj->dni", np.linalg.inv(flow.cov), e, optimize=True)
    known = np.sum(told * e, axis=-1)
    rho = np.sum((u[None] - np.einsum("nij,dj->dni", B, w)) * told, axis=-1) / known
    near = np.abs(y) < CUT
    few = near.sum(1) < FEW_FRAMES
    middle = np.nanmedian(np.where(near | few[:, None], rho, np.nan), axis=1)
    rho, unsure = rho / middle[:, None], 1 / np.sqrt(known) / np.abs(middle[:, None])
    sane = (rho + unsure > 1 / DEEP) & (rho - unsure < DEEP)
    cost = np.sum(np.where(near & sane, y**2, CUT**2), axis=1)
    return np.where(few, np.inf, cost), w, y, sane, rho, middle


def _judged(flow: Flow, kind: str, way: np.ndarray) -> list[Candidate]:
    cost, w, y, sane, rho, middle = _tried(flow, kind, way)
    out = []
    for k in np.flatnonzero(np.isfinite(cost)):
        depth = np.where(rho[k] > 0, 1 / np.maximum(rho[k], 1e-3), 1.0)
        good = (np.abs(y[k]) < CUT) & sane[k]
        out.append(Candidate(kind, middle[k] * way[k], w[k], np.clip(depth, 1 / DEEP, DEEP), good, float(cost[k])))
    return out


def _around(way: np.ndarray, step_deg: float) -> np.ndarray:
    """(m, 19, 3) unit vectors: `way` (m, 3) and two rings about each, `step_deg` and twice that away."""
    frame = np.linalg.svd(way[:, None, :])[2][:, 1:]  # (m, 2, 3)
    rings = [np.zeros((1, 2))]
    for ring, count in ((1, 6), (2, 12)):
        a = 2 * np.pi * np.arange(count) / count
        rings.append(ring * np.tan(np.radians(step_deg)) * np.stack([np.cos(a), np.sin(a)], axis=1))
    out = way[:, None] + np.einsum("kj,mji->mki", np.concatenate(rings), frame)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def turning(x: np.ndarray) -> np.ndarray:
    """(n, 2, 3) velocity of the ray x (n, 2) by a turning about the camera's centre."""
    a, b = x[:, 0], x[:, 1]
    return np.stack([np.stack([-a * b, 1 + a * a, -b], -1), np.stack([-(1 + b * b), a * b, a], -1)], axis=1)


def _half_sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors with z > 0, evenly (Fibonacci)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
