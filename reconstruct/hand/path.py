"""Approach and retreat: the hand stays clear of the link except while it holds it."""

from __future__ import annotations

import numpy as np

from reconstruct.hand.grip import penetration
from reconstruct.hand.shape import LinkShape

STANDOFF = 0.04  # m between the grip and where the hand waits
CLEAR = 0.004  # m
STEPS = np.arange(0.0, 0.41, 0.01)


def exit_direction(shape: LinkShape, grip: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Unit direction (3,), link frame, along which the hand leaves the grip without sweeping the link.

    Among directions that get clear soonest, the one nearest to where the hand was seen to come from.
    """
    grid = np.array(np.meshgrid(*[[-1, 0, 1]] * 3)).reshape(3, -1).T.astype(float)
    grid = grid[np.linalg.norm(grid, axis=1) > 0]
    grid /= np.linalg.norm(grid, axis=1, keepdims=True)
    hope = towards / max(np.linalg.norm(towards), 1e-9)
    best, chosen = np.inf, hope
    start = penetration(shape, grip)
    for u in np.vstack([grid, hope]):
        cost = 0.0
        for h in (0.01, 0.02, 0.04, 0.07):
            cost += np.maximum(penetration(shape, grip + h * u) - (start if h < 0.015 else 0.0), 0).sum() / 0.01
        cost -= 0.5 * float(u @ hope)
        if cost < best:
            best, chosen = cost, u
    return chosen


def clear_path(shape: LinkShape, pose: np.ndarray, world: np.ndarray, attached: np.ndarray, away: np.ndarray,
               rate: float) -> np.ndarray:
    """Move the hand along ``away`` in the frames in which it is not attached, so far that it is clear of the link.

    Args:
        pose: (T, 4, 4) of the link.  world: (T, 21, 3).  attached: (T,).  away: (3,) link frame.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    n = len(world)
    direction = pose[:, :3, :3] @ away
    frames = np.flatnonzero(attached)
    t = np.arange(n)
    since = np.abs(t[:, None] - frames[None]).min(1) / rate
    # At the grip's edge 0, at a fifth of a second STANDOFF.
    lift = np.where(attached, 0.0, STANDOFF * np.clip(since / 0.2, 0, 1))
    need = np.zeros(n)
    for k in np.flatnonzero(~attached):
        link = (world[k] - pose[k, :3, 3]) @ pose[k, :3, :3]
        for h in STEPS:
            if penetration(shape, link + max(h, 0) * away).max() <= 0 and (
                    penetration(shape, link + (h + CLEAR) * away).max() <= 0):
                need[k] = h
                break
        else:
            need[k] = STEPS[-1]
    # The last frames before contact slide along the exit direction into the grip.
    window = max(1, round(0.2 * rate))
    need = gaussian_filter1d(maximum_filter1d(need, 2 * window + 1), 0.4 * window, mode="nearest")
    lift = np.maximum(lift, np.where(attached, 0.0, need * np.clip(since / 0.2, 0, 1)))
    return world + lift[:, None, None] * direction[:, None]
