"""The joint's state in frames that an adjustment has lost.

A robust loss has no slope far from its optimum: a state that has run off stays where it is. And where a tracker has
lost the link, but goes on saying where it is, the state runs off with what two or three of its tracks do next. Asked of
tracks without slip: those that measure what the picture holds are dropped where it is lost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.paths import held as along_held
from reconstruct.joint.paths import linked_frames
from reconstruct.joint.polish import HOLDERS, ROBUST_SIGMAS, Bundle, Sightings, positions, residuals

HOLDING = 0.25
"""A state is held by HOLDERS tracks near where the joint has them, and such a share of those that are seen."""
FEW = 0.5
"""Share of the tracks that a frame shows at best below which a frame without a state is the tracker's failure. Where
most are seen, that they agree on no state speaks against the joint."""
AROUND, STEP = 0.5, 1.5
"""How far beyond the stroke a lost state is looked for, over the stroke, and by how many scales of the loss apart."""
MOST_STATES, MOST_ASKED = 400, 150
"""States that are tried at most, and tracks that are asked."""


def held_frames(b: Bundle, s: Sightings, share: float = HOLDING) -> np.ndarray:
    """(T,) bool: frames whose state tracks of the link agree on.

    Args:
        b: the joint.  s: its observations.  share: of the tracks in sight that have to agree, HOLDERS at least.
    """
    seen = s.seen if s.link is None else s.seen & s.link[:, None]
    return near_tracks(b, s).sum(0) >= np.maximum(HOLDERS, share * seen.sum(0))


def near_tracks(b: Bundle, s: Sightings) -> np.ndarray:
    """(N, T) bool: sightings of the link where the joint has them."""
    near = s.seen & (np.linalg.norm(residuals(b, s), axis=-1) < ROBUST_SIGMAS * max(b.sigma, 0.05))
    return near if s.link is None else near & s.link[:, None]


def unlinked(b: Bundle, s: Sightings) -> np.ndarray:
    """(T,) bool: frames whose state no chain of tracks holds to the first one's.

    Points that other frames alone show turn about the axis with these frames' states as they like: HOLDERS tracks that
    both show say how far, or nothing does. Where one or two strays do, a covariance calls it known.

    Args:
        b: the joint.  s: its observations.
    """
    part = linked_frames(near_tracks(b, s), HOLDERS)
    return (part >= 0) & (part != part[np.argmax(part >= 0)])


def held_only(best: dict[str, Bundle], s: Sightings) -> tuple[dict[str, Bundle], Sightings]:
    """Joints with lost states found again, and the sightings without the frames in which few tracks are seen and no
    joint is held.

    What is seen there is not the link. These states, and those of frames that see nothing, are between those around.

    Args:
        best: joints of every type, of the same tracks.  s: their observations before a resting camera.
    """
    found = {kind: found_again(b, s) for kind, b in best.items()}
    count = s.seen.sum(0)
    held = np.logical_or.reduce([held_frames(b, s) for b in found.values()]) | (count > FEW * count.max())
    if not (s.seen.any(0) & ~held).any() or held.sum() < 2:
        return found, s
    every = np.arange(len(held))
    found = {kind: with_states(b, np.interp(every, every[held], b.q[held])) for kind, b in found.items()}
    return found, replace(s, seen=s.seen & held)


def in_sight_only(best: dict[str, Bundle], s: Sightings) -> tuple[dict[str, Bundle], Sightings]:
    """Joints and sightings before a moving camera without the frames in which few tracks of the link are seen, of which
    hardly any agree on a state: one or two strays. These states are between those around.

    Args:
        best: joints of every type with the camera's path, of the same tracks.  s: their sightings of link and scene.
    """
    assert s.link is not None
    count = (s.seen & s.link[:, None]).sum(0)
    held = np.logical_or.reduce([held_frames(b, s, 0.0) for b in best.values()]) | (count > FEW * count.max())
    if not (count.astype(bool) & ~held).any() or held.sum() < 2:
        return best, s
    every = np.arange(len(held))
    best = {kind: with_states(b, np.interp(every, every[held], b.q[held]), s.link) for kind, b in best.items()}
    return best, replace(s, seen=s.seen & (held | ~s.link[:, None]))


def found_again(b: Bundle, s: Sightings) -> Bundle:
    """The joint with the states that no track holds looked for along the stroke of those that are held.

    Args:
        b: the joint.  s: its observations before a resting camera.
    """
    held = held_frames(b, s)
    lost = np.flatnonzero(~held & s.seen.any(0))
    if not len(lost) or held.sum() < 2:
        return b
    low, high = float(b.q[held].min()), float(b.q[held].max())
    limit2 = (ROBUST_SIGMAS * max(b.sigma, 0.05)) ** 2
    ids = np.unique(np.linspace(0, len(b.X) - 1, min(len(b.X), MOST_ASKED)).round().astype(int))
    few, some = s.of(ids), replace(b, X=b.X[ids])

    def seen_at(q: np.ndarray) -> np.ndarray:
        """(n, len(q), 2) px."""
        at = positions(replace(some, q=q), few)[1]
        return few.focal * np.exp(b.log_focal) * at[..., :2] / np.maximum(at[..., 2:], 1e-3)

    ends = seen_at(np.array([low, high]))
    way = (1 + 2 * AROUND) * float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)))
    count = int(np.clip(way / (STEP * np.sqrt(limit2)), 10, MOST_STATES))
    tried = np.linspace(low - AROUND * (high - low), high + AROUND * (high - low), count)
    at, q = seen_at(tried), b.q.copy()
    for t in lost:
        on = few.seen[:, t]
        here = np.concatenate([at[on], seen_at(b.q[[t]])[on]], axis=1) - few.uv[on, None, t]
        along = None if few.slip is None else few.slip[on, None, t]
        r2 = np.sum(along_held(here, along) ** 2, axis=-1)
        cost = few.weight[on] @ (r2 / (r2 + limit2))
        if (k := int(np.argmin(cost))) < count:
            q[t] = tried[k]
    return with_states(b, q)


def with_states(b: Bundle, q: np.ndarray, link: np.ndarray | None = None) -> Bundle:
    """The same motion in states q (T,), path lengths as in :class:`Bundle`: the points are those of the first, which
    becomes 0 again.

    Args:
        link: (N,) bool, points that move; all of them when None.
    """
    R, p = (x[0] for x in b.twist.pose(q[:1]))
    X = (b.X - b.twist.anchor) @ R.T + p + b.twist.anchor
    return replace(b, q=q - q[0], X=X if link is None else np.where(link[:, None], X, b.X))
