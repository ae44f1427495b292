"""Found states by all that shows them at once, and how well they are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.joint.unseen.going import Going, Pose, trust
from reconstruct.joint.unseen.outline import Outline

PASSES, SETTLED = 6, 1e-3
"""Steps of the adjustment at most, and the one over the stroke that ends it."""
DEPTH_STEPS, DEEPER = 4, 0.2
"""Of a track's depth within each, and the largest one of its logarithm."""
TRACKS = 200
"""Tracks in it."""
NOISE_PX, LAST = 0.2, 4.0
"""Noise of a track, working px, and independent looks at it in a film: its errors last."""
EDGE_PX, GROWS = 1.0, 0.2
"""Noise of an outline, working px, and by how much its state's grows with the way from those that it was made by: lines
that are known by a short way are off in depth."""


def settled(q: np.ndarray, before: np.ndarray, known: np.ndarray, outline: Outline, going: Going, std: dict
            ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The states that were found, by the outline and all tracks at once, and standard deviations of all known ones,
    relative to the first frame.

    Args:
        q: (T,).  before, known: (T,) bool, those that stay as they are, and those and the ones found.
        std: of the joint, as of :class:`JointFit`.
    """
    free, T, seen_at = np.flatnonzero(known & ~before), len(q), q.copy()
    beyond = np.maximum(np.maximum(q - q[before].max(), q[before].min() - q), 0.0)
    sigma = np.array([EDGE_PX / outline.speed(going.pose, q[[t]], going.focal) for t in range(T)])
    # An outline that is a little off is so in all of its pictures.
    alike = max(len(free), 1)
    shown = np.where(known & ~before, 1 / (alike * (sigma**2 + (GROWS * beyond) ** 2)), 0.0)
    q = q.copy()
    for _ in range(PASSES):
        H, g = _normal(_rows(going, q, known, ()), T, 0)
        H, g = H + np.diag(shown), g + shown * (q - seen_at)
        step = np.linalg.solve(H[np.ix_(free, free)], -g[free])
        q[free] += step
        if np.abs(step).max() < SETTLED * np.ptp(q):
            break
    P, rest = len(going.varied), int(np.flatnonzero(known)[0])
    H, _ = _normal(_rows(going, q, known, going.varied), T, P)
    # What the outline says is of the frames that it was made by, taken together.
    own = np.where(before, 1 / max(before.sum(), 1), 0.0)
    H[:T, :T] += np.diag(shown) - np.outer(shown, own) - np.outer(own, shown) + shown.sum() * np.outer(own, own)
    H += np.diag(np.concatenate([np.full(T, 1 / np.ptp(q) ** 2), np.ones(P)]))
    some = np.delete(np.arange(T + P), rest)
    out = np.zeros(T)
    out[some[: T - 1]] = np.sqrt(np.diag(np.linalg.inv(H[np.ix_(some, some)])))[: T - 1]
    if before[0]:
        out[before] = np.asarray(std["q"])[before]
    return q, out


def _rows(going: Going, q: np.ndarray, known: np.ndarray, varied: tuple[Pose, ...]) -> list[_Row]:
    """Of the tracks that follow what is needed for the normal equations."""
    ids = np.flatnonzero((going.paths.seen & known).any(1))
    laid = going.laid(ids, q, known)
    ids, laid = ids[laid.follows], laid.of(laid.follows)
    pick = np.unique(np.linspace(0, len(ids) - 1, min(len(ids), TRACKS)).round().astype(int))
    ids, laid = ids[pick], laid.of(pick)
    # Two numbers say where a line is, however many points it has.
    count = np.bincount(going.line[ids] + 1)[going.line[ids] + 1]
    share = np.where(going.line[ids] < 0, 1.0, np.minimum(1.0, 2 / count))
    weight = share / (NOISE_PX**2 * max(len(q) / LAST, 1.0))
    start = laid.X[np.arange(len(ids)), laid.cost.argmin(1)]
    return [_row(going, *x, q, known, varied) for x in zip(ids, laid.first, start, weight, strict=True)]


def _row(going: Going, i: int, first: int, X: np.ndarray, weight: float, q: np.ndarray, known: np.ndarray,
         varied: tuple[Pose, ...]) -> _Row:  # fmt: skip
    """Of track i, which is put on its ray in a frame at about X (3,)."""
    frames, ray, d = np.flatnonzero(going.paths.seen[i] & known), X / X[2], float(X[2])
    h, dq = 1e-4, 1e-4 * np.ptp(q)

    def miss(d: float, more: float = 0.0, pose: Pose | None = None) -> np.ndarray:
        at = (d * ray)[None, None]
        return going.residuals(np.array([i]), q[[first]], at, frames, q[frames] + more, pose)[0, 0]

    for _ in range(DEPTH_STEPS):
        r = miss(d)
        J = (miss(d * (1 + h)) - r) / h
        w = trust(r)
        step = -(w @ np.sum(J * r, 1)) / max(w @ np.sum(J * J, 1), 1e-12)
        d *= float(np.exp(np.clip(step, -DEEPER, DEEPER)))
    r = miss(d)
    by_depth, by_q = (miss(d * (1 + h)) - r) / h, (miss(d, dq) - r) / dq
    return _Row(int(first), frames, r, by_depth, by_q, [miss(d, pose=p) - r for p in varied], weight * trust(r))


@dataclass(frozen=True)
class _Row:
    """One track in m frames: where it is put on its ray, its residuals (m, 2) px, their derivatives by the depth's
    logarithm and by the state less the first one's, their changes by the joints that vary, and weights (m,)."""

    first: int
    frames: np.ndarray
    r: np.ndarray
    by_depth: np.ndarray
    by_q: np.ndarray
    varied: list[np.ndarray]
    weight: np.ndarray


def _normal(rows: list[_Row], T: int, P: int) -> tuple[np.ndarray, np.ndarray]:
    """(T + P, T + P) and (T + P,) of T states and P joints that vary, the depths eliminated."""
    H, g = np.zeros((T + P, T + P)), np.zeros(T + P)
    for x in rows:
        at = np.concatenate([x.frames, [x.first], np.arange(T, T + P)])
        m = len(x.frames)
        J = np.zeros((m, 2, len(at)))
        J[np.arange(m), :, np.arange(m)] = x.by_q
        J[:, :, m] = -x.by_q
        for k, other in enumerate(x.varied):
            J[:, :, m + 1 + k] = other
        w = x.weight[:, None]
        d2 = float(np.sum(w * x.by_depth**2)) + 1e-9
        cross = np.einsum("mi,mik->k", w * x.by_depth, J)
        N = np.einsum("mik,mil->kl", w[..., None] * J, J, optimize=True) - np.outer(cross, cross) / d2
        n = np.einsum("mi,mik->k", w * x.r, J) - cross * float(np.sum(w * x.by_depth * x.r)) / d2
        np.add.at(H, (at[:, None], at[None]), N)
        np.add.at(g, at, n)
    return H, g
