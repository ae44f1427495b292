"""Every way a joint may go, tried at the noise of the tracks: what small motions need.

The search judges in pixels. A lid that goes a few pixels is explained within those by hinges seventy degrees apart, and
what tells them from each other is a tenth of a pixel. Here bundle adjustments of few tracks in few frames start from a
flat link, from every direction that its middle may go and every way it may turn, and the field narrows as it becomes
clear who fits. Strays bend all of them alike: a sweep also tells which tracks stray, and the next goes without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations
from reconstruct.joint.finish import followers, states_of_all_frames
from reconstruct.joint.flow import Candidate, Flow, candidates, flow_of
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import Bundle, Sightings, place_points, polish, radius_cost, residuals, robust_loss
from reconstruct.joint.twist import Twist
from reconstruct.joint.view import View

SMALL = 0.06
"""Path of the fastest tracks, as a share of the image diagonal, up to which the search's pixels say too little."""
TRACKS, FRAMES = 100, 10
"""Of one adjustment."""
HINGES, SLIDES = 10, 5
"""Different ways to move that are tried, as the velocities rank them."""
ROUNDS = ((8, 10), (15, 6), (25, 4))
"""Steps of every round, and how many different ones go on."""
APART_DEG = 4.0
"""Axes of different ones."""
SHARP = 2.5
"""Standard deviations of the noise that the loss forgives at last: the tracks of the next body are not far off."""
EXACT_PX = 0.08
"""No track is asked to be more exact."""
RIVAL, RIVALS = 1.3, 3
"""Cost over the best one's up to which others of its type are handed on, so many at most."""
FEWEST, SWEEPS, SHARPER, CLEAN = 12, 3, 0.85, 0.85
"""Tracks; sweeps, each of which has to lower the noise to such a share of the last one's to count; and the share of the
tracks that follow already after which no other is worth its time."""


@dataclass(frozen=True)
class Swept:
    """What came out.

    Attributes:
        starts: per type, the best joint of the tracks `ids` in all frames, and others that cost little more.
        ids: (n,) tracks that follow the best one within their noise.
        share: of the tracks that were swept, that are among these.
    """

    starts: dict[str, list[Bundle]]
    ids: np.ndarray
    share: float

    @property
    def lead(self) -> Bundle:
        """The best one."""
        return next(iter(self.starts.values()))[0]


def sweep(
    paths: Paths, moving: np.ndarray, obs: Observations, members: np.ndarray, rivals: Sequence[Bundle], view: View,
    depths: Sequence[float] = (1.0,),
) -> Swept | None:
    """The joint that fits best at the noise of the tracks, whatever the search said.

    Args:
        paths: N tracks, px from the principal point.  moving: (m,) tracks that leave their place.
        obs: the search's observations, for its key frames.  members: (n,) tracks that the search took for the link.
        rivals: the search's joints, with these points and the states of the key frames; they compete.
        view: focal length, and the camera's path where it moves.
        depths: of the link that are tried, in the unit of that path.

    Returns:
        None if too few tracks follow any joint.
    """
    some = _evenly(len(obs.frames), FRAMES)
    keys = obs.frames[some]
    pool, found = members, None
    field = [replace(b, q=b.q[some] - b.q[some[0]]) for b in rivals]
    for _ in range(SWEEPS):
        ways = _ways(paths[pool], view, depths)
        # Tracks that follow any of them: what follows none is no evidence.
        good = np.unique(np.concatenate([np.zeros(0, int), *(w.flow.ids[w.joint.good] for w in ways)]))
        if len(good) < FEWEST:
            break
        pick = good[_evenly(len(good), TRACKS)]
        sight = view.sightings(paths[pool[pick]], keys, lasting=100.0)
        several = _narrowed([w.start(pick, keys, sight) for w in ways] + [placed_on(b, sight) for b in field], sight)
        lead = several[0]
        if found is not None and lead.sigma > SHARPER * found[0].sigma:
            break
        like = replace(sight, lasting=1.0)
        # Tracks picked by one type are no evidence for it: those that follow the best of the other count as well.
        each = {b.kind: b for b in reversed(several)}
        more = [followers(b, paths, moving, view, like)[0] for b in (lead, *(each[k] for k in each if k != lead.kind))]
        if len(more[0]) < FEWEST:
            break
        both = np.unique(np.concatenate(more))
        few_strays = np.isin(pool[pick], both).mean() > CLEAN
        pool, found, field = both, several, [lead]
        if few_strays:
            break
    if found is None:
        return None
    every = view.sightings(paths[pool], np.arange(paths.uv.shape[1]))
    sight = view.sightings(paths[pool], keys)
    starts: dict[str, list[Bundle]] = {}
    for b in found:
        first = starts.setdefault(b.kind, [])
        if not first or (b.cost < RIVAL * found[0].cost and len(first) < RIVALS):
            # Every joint has its own points: those of another would lead it into that one's optimum.
            first.append(states_of_all_frames(placed_on(b, sight), every, keys))
    return Swept(starts, pool, float(np.isin(members, pool).mean()))


@dataclass(frozen=True)
class _Way:
    """A joint as the velocities of tracks show it that are seen from the first camera's place at one depth."""

    joint: Candidate
    flow: Flow
    depth: float

    def start(self, pick: np.ndarray, keys: np.ndarray, sight: Sightings) -> Bundle:
        """In the frames `keys`, with the points of the tracks ``pick`` (n,), of which ``sight`` is in these frames."""
        at = np.searchsorted(self.flow.ids, pick).clip(max=len(self.flow.ids) - 1)
        known = self.flow.ids[at] == pick
        b = start_of(self.joint, self.flow, at[known], keys).scaled(self.depth)
        return b if known.all() else placed_on(b, sight)


def _ways(paths: Paths, view: View, depths: Sequence[float]) -> list[_Way]:
    """Every way to move that velocities show, with the link at any of these depths."""
    out = []
    for depth in depths:
        flow = flow_of(view.at_first(paths, depth), view.focal)
        if flow is not None and len(flow.ids) >= FEWEST:
            out += [_Way(c, flow, depth) for c in candidates(flow, HINGES, SLIDES)]
    return out


def _evenly(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def start_of(c: Candidate, flow: Flow, pick: np.ndarray, keys: np.ndarray) -> Bundle:
    """The joint that has these velocities in the middle of the path, in the frames `keys`."""
    X = np.concatenate([flow.x[pick], np.ones((len(pick), 1))], axis=1) * c.depth[pick, None]
    anchor = np.median(X[c.good[pick]], axis=0)
    velocity = c.v + np.cross(c.w, anchor)
    speed = max(float(np.linalg.norm(velocity)), 1e-9)
    twist = Twist(anchor, velocity / speed, c.w / speed)
    back, shift = twist.pose(np.array([speed * (flow.path[keys[0]] - 0.5)]))
    q = speed * (flow.path[keys] - flow.path[keys[0]])
    return Bundle(c.kind, twist, q, (X - anchor) @ back[0].T + anchor + shift[0])


def placed_on(b: Bundle, sight: Sightings) -> Bundle:
    """The joint with points of other tracks, of which the sightings are in its frames."""
    return place_points(replace(b, X=np.tile(np.median(b.X, axis=0), (len(sight.uv), 1))), sight)


def _narrowed(field: list[Bundle], sight: Sightings) -> list[Bundle]:
    """The different ones that fit best, best first; `sigma` is the noise of the tracks that follow the best."""
    if not field:
        return []
    for steps, go_on in ROUNDS:
        field = [polish(b, sight, iterations=steps, sharpen=False) for b in field]
        field = _different(field, sight, 4.0 * float(np.quantile([b.sigma for b in field], 0.1)), go_on)
    limit = SHARP * max(_own_noise(field[0], sight), EXACT_PX)
    field = [polish(b, sight, iterations=10, scale=limit, sharpen=False) for b in field]
    field = _different(field, sight, limit, len(field))
    return [replace(b, sigma=max(_own_noise(field[0], sight), EXACT_PX)) for b in field]


def _different(field: list[Bundle], sight: Sightings, limit: float, count: int) -> list[Bundle]:
    """The best of those that are not alike, the best slide among them."""
    order = np.argsort([robust_loss(residuals(b, sight), sight, limit)[0] + radius_cost(b, sight) for b in field])
    out: list[Bundle] = []
    for b in (field[k] for k in order):
        alike = any(b.kind == o.kind and abs(b.twist.axis @ o.twist.axis) > np.cos(np.radians(APART_DEG)) for o in out)
        if not alike and (len(out) < count or (b.kind == "prismatic" and all(o.kind != b.kind for o in out))):
            out.append(b)
    return out


def _own_noise(b: Bundle, sight: Sightings) -> float:
    """Noise of one coordinate, px, over the tracks that follow: those within three times of it."""
    r = np.where(sight.seen, np.linalg.norm(residuals(b, sight), axis=-1), np.nan)
    own = np.nanmedian(r[sight.seen.any(1)], axis=1) / np.sqrt(2 * np.log(2))
    sigma = b.sigma
    for _ in range(5):
        near = own[own < 3 * sigma]
        if len(near) < FEWEST:
            break
        sigma = float(np.median(near))
    return sigma
