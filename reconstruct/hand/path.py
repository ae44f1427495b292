"""Approach and retreat: the hand stays clear of the link except while it holds it."""

from __future__ import annotations

import numpy as np

from reconstruct.hand.grip import penetration
from reconstruct.hand.shape import LinkShape

STANDOFF = 0.04  # m between the grip and where the hand waits
SLIDE, BLEND = 0.2, 0.4  # s: along the exit direction into or out of the grip; from there to what was seen
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


def clear_path(shape: LinkShape, pose: np.ndarray, world: np.ndarray, held: np.ndarray, attached: np.ndarray,
               away: np.ndarray, rate: float) -> np.ndarray:
    """Approach and retreat along ``away`` next to the grip; elsewhere as seen, moved along ``away`` until clear.

    Args:
        pose: (T, 4, 4) of the link.
        world: (T, 21, 3) m, the hand as seen.  held: (T, 21, 3) m, the grip carried with the link.
        attached: (T,) frames in which the hand is in its grip.
        away: (3,) unit exit direction, link frame.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    n = len(world)
    direction = (pose[:, :3, :3] @ away)[:, None]
    frames = np.flatnonzero(attached)
    since = np.abs(np.arange(n)[:, None] - frames[None]).min(1) / rate
    out_of_grip = np.clip(since / SLIDE, 0.0, 1.0)
    seen = np.clip((since - SLIDE) / BLEND, 0.0, 1.0)
    seen = (seen**2 * (3 - 2 * seen))[:, None, None]
    path = held + (STANDOFF * out_of_grip)[:, None, None] * direction
    path = (1 - seen) * path + seen * world
    need = np.zeros(n)
    for k in np.flatnonzero(since > SLIDE):
        link = (path[k] - pose[k, :3, 3]) @ pose[k, :3, :3]
        blocked = [penetration(shape, link + (h + CLEAR) * away).max() > 0 for h in STEPS]
        # The last blocked place along the way decides: what lies before it may be the link's other side.
        need[k] = STEPS[min(int(np.flatnonzero(blocked)[-1]) + 1, len(STEPS) - 1)] if any(blocked) else 0.0
    window = max(1, round(SLIDE * rate))
    need = gaussian_filter1d(maximum_filter1d(need, 2 * window + 1), 0.4 * window, mode="nearest")
    return path + (need * out_of_grip)[:, None, None] * direction
