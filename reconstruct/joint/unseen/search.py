"""Where an outline is in the pictures, from frame to frame."""

from __future__ import annotations

import numpy as np

from reconstruct.joint.unseen.going import Going
from reconstruct.joint.unseen.outline import Edges, Outline

AROUND, STROKES = 2.2, 3.0
"""How far beyond the known states others are looked for, rad; for a slide over the known stroke."""
STATES = (50, 1500)
"""That are tried, at least and at most; about one a px that the outline goes."""
REACH, LEAST_REACH, SPEED = 2.0, 0.02, 0.1
"""How far a state may be from the last one, over the largest step that is known, or over the known stroke at least; and
what of a share a step of this size costs."""
IN_SIGHT, SHOWN, AS_KNOWN = 0.3, 0.35, 0.6
"""Of an outline what has to be in sight in a state, the share of that on edges from which on the state is shown, and
that share over what it is where states are known."""
CLUTTER, LOOKS, APART_PX = 0.75, 12, 12.0
"""Of what is on edges in a state in known frames in which the link is elsewhere, by so many px at least, the quantile
that counts for nothing, and how many such frames are looked at."""
SAME_PX, LESS = 8.0, 0.5
"""Way of most of an outline up to which two states are nearly the same, and the share over the least one that is enough
for a state that an earlier outline has shown so."""
STRETCH = 0.5
"""How far beyond the states that an outline was made by it shows others, over their stroke, and over how many frames,
over their number."""
LONGEST = 8
"""Frames from one with a state to the next at most."""
ABOUT, ABOUT_SEEN = 2, 0.6
"""Frames to either side of one, and the share of these that has to show a state too."""


def states_shown(outline: Outline, edges: Edges, going: Going, q: np.ndarray, before: np.ndarray, earlier: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """States (T,) where the outline is in the pictures, and (T,) bool, where it shows one or one was known before.

    From either end of the known run outwards the path through the states is taken that sees most of the outline.

    Args:
        q: (T,) states so far.  before: (T,) bool, a run of frames whose states are known.
        earlier: (T,) bool, these and the frames whose states the outline was made by as well; where it shows nearly the
            same of them they count though it shows less.
    """
    there = np.flatnonzero(before)
    low, high, span = q[before].min(), q[before].max(), float(np.ptp(q[before]))
    beyond = STROKES * span if going.kind == "prismatic" else AROUND
    speed = outline.speed(going.pose, q[there[[0, -1]]], going.focal)
    count = int(np.clip((span + 2 * beyond) * speed, *STATES))
    tried = np.linspace(low - beyond, high + beyond, count)
    step = tried[1] - tried[0]
    largest = float(np.abs(np.diff(q[there])).max())
    reach = max(int(np.ceil(max(REACH * largest, LEAST_REACH * span) / step)), 2)

    def share(t: int, at: np.ndarray) -> np.ndarray:
        on, sight = edges.share(t, outline, going.pose, at, going.focal)
        return np.where(sight > IN_SIGHT, on, 0.0)

    # What is on edges while the link is elsewhere says nothing.
    looks = there[np.unique(np.linspace(0, len(there) - 1, min(len(there), LOOKS)).round().astype(int))]
    apart = np.abs(tried - q[looks, None]) * speed > APART_PX
    away = np.where(apart, [share(t, tried) for t in looks], np.nan)
    clutter = np.zeros(count)
    some = apart.any(0)
    clutter[some] = np.nanquantile(away[:, some], CLUTTER, axis=0)
    usual = np.median([share(t, q[[t]])[0] for t in looks])
    least = max(SHOWN, AS_KNOWN * float(usual))
    # A line is known by how it went, and no further on than that.
    stretch, ahead = STRETCH * float(np.ptp(q[earlier])), max(int(STRETCH * earlier.sum()), LONGEST)
    low, high = q[earlier].min() - stretch, q[earlier].max() + stretch
    first, final = np.flatnonzero(earlier)[[0, -1]] + [-ahead, ahead]
    q, found = q.copy(), before.copy()
    for frames in (range(there[-1] + 1, len(q)), range(there[0] - 1, -1, -1)):
        if not len(frames):
            continue
        start = there[-1] if frames[0] > there[-1] else there[0]
        shares = np.maximum([share(t, tried) - clutter for t in frames], 0.0)
        path = _best_path(shares, int(np.abs(tried - q[start]).argmin()), reach, SPEED * (step / largest) ** 2)
        same = earlier[frames] & (np.abs(tried[path] - q[frames]) * speed < SAME_PX)
        seen = shares[np.arange(len(path)), path] >= np.where(same, LESS * least, least)
        seen &= (low <= tried[path]) & (tried[path] <= high) & (first <= np.array(frames)) & (np.array(frames) <= final)
        seen, last = _not_alone(seen), start
        for t, k, row in zip(np.array(frames)[seen], path[seen], shares[seen], strict=True):
            if abs(t - last) > LONGEST:
                break
            q[t], found[t], last = _peak(tried, row, k), True, t
    return q, found


def _not_alone(seen: np.ndarray) -> np.ndarray:
    """(F,) without frames about which others are not seen: from a known one outwards."""
    known = np.concatenate([np.ones(ABOUT), seen])
    near = np.abs(np.subtract.outer(np.arange(len(known)), np.arange(len(known)))) <= ABOUT
    return seen & ((near @ known / near.sum(1))[ABOUT:] >= ABOUT_SEEN)


def _best_path(shares: np.ndarray, start: int, reach: int, cost: float) -> np.ndarray:
    """(F,) states of the path through F frames that sees most (Viterbi), from a state onwards.

    Args:
        shares: (F, S).  reach: states between one frame and the next, at most.  cost: of a squared step of one.
    """
    F, S = shares.shape
    total, back = np.full(S, -np.inf), np.zeros((F, S), int)
    total[start] = 0.0
    steps = np.arange(-reach, reach + 1)
    for f in range(F):
        padded = np.pad(total, reach, constant_values=-np.inf)
        near = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1) - cost * steps**2
        best = near.argmax(1)
        total, back[f] = near[np.arange(S), best] + shares[f], np.clip(np.arange(S) + steps[best], 0, S - 1)
    path, k = np.zeros(F, int), int(total.argmax())
    for f in range(F - 1, -1, -1):
        path[f], k = k, back[f, k]
    return path


def _peak(at: np.ndarray, value: np.ndarray, k: int) -> float:
    """Where a parabola through the values about the k-th has its top, near it."""
    if not 0 < k < len(at) - 1:
        return float(at[k])
    a, b, c = value[k - 1 : k + 2]
    bend = a - 2 * b + c
    return float(at[k] + (at[1] - at[0]) * np.clip((a - c) / (2 * bend) if bend < 0 else 0.0, -0.5, 0.5))
