"""What a hinge's axis is parallel to: the directions of the straight edges of what is filmed.

A door that turns by ten degrees leaves its axis open by tens of degrees, but the hinges of furniture and devices go
along the edges of the boxes that they are part of, and in the picture edges of one direction meet in one point. So
the three directions at right angles in which most of the edges around the part go are sought (a triple by chance,
from pairs of edges; Coughlan and Yuille, "Manhattan World", 1999), several such triples as there may be a rotated box
beside, and each direction is asked as the joint's: how much worse the tracks keep to the best joint along it than to
the best joint of all. Against "none of them" stands how little of all directions the tracks leave open. A slide goes
where its tracks go, which is seen to a degree or two without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from reconstruct.joint.finish import Finished
from reconstruct.joint.models import VAGUE_DEG
from reconstruct.joint.photometric import Pictures
from reconstruct.joint.polish import (
    Bundle,
    Sightings,
    parallel_deg,
    place_points,
    polish,
    positions,
    radius_cost,
)
from reconstruct.joint.twist import Twist
from reconstruct.joint.uncertainty import Spread, compact, spread
from reconstruct.joint.weigh import LIKELY, apart_deg, log_odds_of_same_type

WORTH_DEG = 1.5
"""Standard deviation of an axis below which the tracks are believed as they are."""
PICTURES = 5
"""Frames, over the whole video, whose edges are looked at."""
LEAST_PX, MOST_PX = 18.0, 120.0
"""Length of an edge from which on it says where it goes, and beyond which it counts no more."""
AROUND = 0.5
"""How far beyond the part, over its size, edges are looked for."""
WITHIN_DEG = 0.7
"""Scale of the angle between an edge and the way to the point where those of its direction meet."""
PAIRS, KEPT, THIRDS = 1500, 400, 8
"""Pairs of edges that are drawn, how many of the directions they give are kept, and third edges for each."""
TRIPLES, APART_DEG = 8, 8.0
"""Triples of directions that are handed on, at most, and how far the one differs from the others."""
STEEPNESS = 10.0
"""Logarithm of a triple's weight by its share of the edges, over the best one's."""
ONE_DEG = 2.5
"""Directions so near to each other are one."""
ALONG = 0.5
"""Prior that the axis is along any of these edges."""
APART_STDS = 2.0
"""Standard deviations of its own axis by which the tracks contradict a direction that is more probable."""
AWAY, AWAY_PX = 1.5, 0.05
"""How many times worse, and by how many px, tracks may keep to the best joint along a direction than to the best of
all."""
ROUGH_TRACKS, ROUGH_FRAMES, ROUGH_STEPS, ROUGHLY, CLOSEST = 100, 24, 8, 2.0, 4
"""Tracks, frames and steps by which all directions are asked, how many times AWAY they may be by these, and how many of
the best are asked by all."""


@dataclass(frozen=True)
class Directions:
    """along: (K, 3) unit, camera frame, K >= 0.  weight: (K,) of each, their sum 1."""

    along: np.ndarray
    weight: np.ndarray


def edge_directions(pictures: Pictures, focal: float, box: np.ndarray, seed: int = 0) -> Directions:
    """The directions of the straight edges in and around a box of the picture.

    Args:
        pictures: of a resting camera, working px.  focal: working px.
        box: (2, 2) px from the principal point: lowest and highest x and y.
        seed: of the pairs of edges.
    """
    ends = _edges(pictures, box)
    none = Directions(np.zeros((0, 3)), np.zeros(0))
    if len(ends) < 6:
        return none
    edges = _Edges.of(ends, focal)
    found = _triples(edges, np.random.default_rng(seed))
    if not found:
        return none
    share = np.array([s for _, s in found])
    weight = np.exp(STEEPNESS * (share / share[0] - 1))
    weight = np.repeat(weight / weight.sum() / 3, 3)
    along, out, of = np.concatenate([R for R, _ in found]), [], []
    for d, w in zip(along, weight, strict=True):
        same = [k for k, o in enumerate(out) if abs(o @ d) > np.cos(np.radians(ONE_DEG))]
        if same:
            of[same[0]] += w
        else:
            out.append(d)
            of.append(w)
    return Directions(np.array(out), np.array(of))


@dataclass(frozen=True)
class _Edges:
    """Straight edges of pictures: middle (n, 2) and way (n, 2) at z = 1, normal (n, 3) of the plane through the camera,
    weight (n,)."""

    middle: np.ndarray
    way: np.ndarray
    normal: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, ends: np.ndarray, focal: float) -> _Edges:
        """ends: (n, 2, 2) px from the principal point."""
        ray = np.concatenate([ends / focal, np.ones((len(ends), 2, 1))], axis=2)
        normal = np.cross(ray[:, 0], ray[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        return cls(ray[..., :2].mean(1), (ray[:, 1] - ray[:, 0])[:, :2], normal, np.minimum(length, MOST_PX))

    def off_deg(self, along: np.ndarray) -> np.ndarray:
        """(..., n) angle in the picture between the edges and directions (..., 3)."""
        e = along[..., None, :2] - self.middle * along[..., None, 2:]
        cross = e[..., 0] * self.way[:, 1] - e[..., 1] * self.way[:, 0]
        return np.degrees(np.arctan2(np.abs(cross), np.abs(np.sum(e * self.way, axis=-1))))

    def share(self, triples: np.ndarray) -> np.ndarray:
        """(...,) of all edges, how much goes along one of three directions (..., 3, 3)."""
        kept = np.exp(-((self.off_deg(triples).min(axis=-2) / WITHIN_DEG) ** 2))
        return kept @ self.weight / self.weight.sum()


def _edges(pictures: Pictures, box: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px from the principal point: ends of the straight edges in a few frames, not on what is covered."""
    import cv2

    low, high = box
    beside = AROUND * float(np.max(high - low))
    h, w = pictures.grey.shape[1:]
    finder, out = cv2.createLineSegmentDetector(), [np.zeros((0, 2, 2))]
    for t in np.unique(np.linspace(0, len(pictures.grey) - 1, PICTURES).round().astype(int)):
        lines = finder.detect(np.ascontiguousarray(pictures.grey[t]))[0]
        if lines is None:
            continue
        ends = np.asarray(lines, float).reshape(-1, 2, 2)
        ends = ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > LEAST_PX]
        j, i = np.clip(ends.mean(1).round().astype(int), 0, [w - 1, h - 1]).T
        ends = ends[~pictures.covered[t, i, j]] - pictures.centre
        middle = ends.mean(1)
        out.append(ends[np.all((middle > low - beside) & (middle < high + beside), axis=1)])
    return np.concatenate(out)


def _triples(edges: _Edges, rng: np.random.Generator) -> list[tuple[np.ndarray, float]]:
    """Rotations (3, 3) whose rows are directions at right angles, each with its share of the edges, best first."""
    n, p = len(edges.weight), edges.weight / edges.weight.sum()
    i, j = rng.choice(n, PAIRS, p=p), rng.choice(n, PAIRS, p=p)
    one = np.cross(edges.normal[i], edges.normal[j])
    size = np.linalg.norm(one, axis=1)
    one = one[size > 0.02] / size[size > 0.02, None]
    kept = np.exp(-((edges.off_deg(one) / WITHIN_DEG) ** 2)) @ edges.weight
    one = one[np.argsort(-kept)[:KEPT]]
    if not len(one):
        return []
    out = []
    for _ in range(THIRDS):
        two = np.cross(edges.normal[rng.choice(n, len(one), p=p)], one)
        size = np.linalg.norm(two, axis=1)
        a, b = one[size > 0.05], two[size > 0.05] / size[size > 0.05, None]
        out.append(np.stack([a, b, np.cross(a, b)], axis=1))
    triples = np.concatenate(out)
    share = edges.share(triples)
    chosen: list[np.ndarray] = []
    for k in np.argsort(-share):
        turned = [np.degrees(np.arccos(np.clip(np.abs(triples[k] @ o.T).max(1).min(), 0, 1))) for o in chosen]
        if not turned or min(turned) > APART_DEG:
            chosen.append(triples[k])
        if len(chosen) == TRIPLES:
            break
    fine = [_refined(R, edges) for R in chosen]
    return sorted(((R, float(edges.share(R))) for R in fine), key=lambda x: -x[1])


def _refined(R: np.ndarray, edges: _Edges, rounds: int = 5) -> np.ndarray:
    """A triple (3, 3) turned to where the edges along it fit it best."""
    from scipy.spatial.transform import Rotation

    for _ in range(rounds):
        off = edges.off_deg(R)
        d = R[off.argmin(axis=0)]
        root = np.sqrt(edges.weight * np.exp(-((off.min(axis=0) / WITHIN_DEG) ** 2)))
        A = np.cross(d, edges.normal) * root[:, None]
        turn = np.linalg.lstsq(A, -np.sum(edges.normal * d, axis=1) * root, rcond=None)[0]
        R = R @ Rotation.from_rotvec(turn).as_matrix().T
    return R


def along_edges(done: Finished, pictures: Pictures) -> Finished:
    """A joint whose axis goes along edges of the picture, where these hold it better than its tracks, or are more
    probable and further from what these say than they may be; else ``done``, known no better than it is far from a more
    probable one.

    Args:
        done: before a resting camera, of all frames of the video.  pictures: of the same frames.
    """
    b, sight, free = done.bundle, done.sight, done.axis_deg
    if sight.R is not None or b.kind != "revolute" or free < WORTH_DEG:
        return done
    cam = positions(b, sight)[1]
    xy = (sight.focal * np.exp(b.log_focal) * cam[..., :2] / np.maximum(cam[..., 2:], 1e-3))[sight.seen]
    box = np.quantile(xy, [0.02, 0.98], axis=0)
    given = edge_directions(pictures, sight.focal * float(np.exp(b.log_focal)), box)
    if not len(given.along):
        return done
    asked = _asked(b, sight, given)
    if not asked:
        return done
    log_p = np.array([a.log_p for a in asked])
    # The mass of all other directions: how much of the half sphere the tracks leave open.
    none = np.log(1 - ALONG) + np.log(min(np.radians(free) ** 2 / 2, 1.0))
    p = np.exp(np.append(log_p, none) - logsumexp(np.append(log_p, none)))
    k = int(np.argmax(p))
    if k == len(asked):
        return done
    best, away = asked[k], apart_deg(asked[k].bundle, b)
    apart = np.array([*(apart_deg(best.bundle, a.bundle) for a in asked), max(free, away)])
    sure = spread(best.bundle, best.sight)
    others = np.sqrt(np.sum(np.delete(p * apart**2, k)))
    axis_deg = float(np.hypot(np.sqrt(2) * parallel_deg(sight), others))
    if away > APART_STDS * free:
        # An axis so far from a more probable one is known no better than the two of them are apart.
        own = float(np.sqrt(p @ (np.append([apart_deg(a.bundle, b) for a in asked], free) ** 2)))
        if axis_deg >= own:
            return replace(done, spread=replace(_scaled(done.spread, own / free), axis_deg=own))
        free = max(free, away / APART_STDS)
    elif axis_deg >= free:
        return done
    alone = _scaled(done.spread, axis_deg / max(free, 1e-9))
    sure = replace(sure, axis_deg=axis_deg, q=np.maximum(sure.q, alone.q), point=max(sure.point, alone.point),
                   stroke=alone.stroke)  # fmt: skip
    words = f"its tracks alone hold the axis to {free:.0f} deg only"
    doubt = words if done.rival is not None and done.rival.probability > LIKELY or free > VAGUE_DEG else ""
    return replace(done, bundle=best.bundle, sight=best.sight, spread=sure, rival=None, once=None, doubt=doubt,
                   alone_deg=free)  # fmt: skip


def _scaled(of: Spread, by: float) -> Spread:
    """An axis so many times less sure, and as much its place and states."""
    return replace(of, axis_deg=by * of.axis_deg, point=by * of.point, q=by * of.q)


@dataclass(frozen=True)
class _Asked:
    """The best joint along a direction, its observations, and the logarithm of its probability, but for the sum."""

    bundle: Bundle
    sight: Sightings
    log_p: float


def _asked(b: Bundle, sight: Sightings, given: Directions) -> list[_Asked]:
    """The joints along the directions that are near to the best, by all tracks; best first."""
    N, T = sight.uv.shape[:2]
    tracks = np.unique(np.linspace(0, N - 1, min(N, ROUGH_TRACKS)).round().astype(int))
    frames = np.unique(np.linspace(0, T - 1, min(T, ROUGH_FRAMES)).round().astype(int))
    some = sight.of(tracks)
    numbers = frames if some.frames is None else some.frames[frames]
    slip = None if some.slip is None else some.slip[:, frames]
    some = replace(some, uv=some.uv[:, frames], seen=some.seen[:, frames], frames=numbers, slip=slip)
    rough = replace(b, X=b.X[tracks], q=b.q[frames] - b.q[frames[0]])
    first = []
    free = polish(rough, some, ROUGH_STEPS)
    for along, weight in zip(given.along, given.weight, strict=True):
        for start in _turned(rough, along):
            x = _held(start, some, along, ROUGH_STEPS)
            if x is not None and x.sigma < ROUGHLY * AWAY * free.sigma + AWAY_PX:
                first.append((_log_odds(x, free, some) + np.log(ALONG * weight), x, along, weight))
    # Turning either way is asked, and counts once.
    first.sort(key=lambda f: -f[0])
    once = [f for k, f in enumerate(first) if all(f[2] is not g[2] for g in first[:k])]
    out = []
    for _, x, along, weight in once[:CLOSEST]:
        q, middle = np.interp(np.arange(T), frames, x.q), np.median(x.X, axis=0)
        start = replace(b, twist=x.twist, q=q - q[0], X=np.tile(middle, (N, 1)))
        whole = _held(start, sight, along)
        if whole is not None and whole.sigma < AWAY * b.sigma + AWAY_PX:
            gain = _log_odds(whole, b, sight)
            out.append(_Asked(whole, replace(sight, along=along), gain + np.log(ALONG * weight)))
    return sorted(out, key=lambda a: -a.log_p)


def _log_odds(one: Bundle, other: Bundle, sight: Sightings) -> float:
    """Of two joints by their tracks, and by how far away hinges are."""
    radius = (radius_cost(one, sight) - radius_cost(other, sight)) / (2 * other.sigma**2 * sight.lasting)
    return log_odds_of_same_type(one, other, sight) - radius


def _held(start: Bundle, sight: Sightings, along: np.ndarray, steps: int = 15) -> Bundle | None:
    """The best joint along a direction from a start, or None if its points make no sense as those of one link."""
    sight = replace(sight, along=along)
    out = polish(place_points(start, sight), sight, steps)
    sane = compact(out.X) & (out.X[:, 2] > 0)
    return out if sane.mean() > 0.8 else None


def _turned(b: Bundle, along: np.ndarray) -> Sequence[Bundle]:
    """The joint with its axis along a direction, turning either way, its points all at the link's middle."""
    t, X = b.twist, np.tile(np.median(b.X, axis=0), (len(b.X), 1))
    d = t.direction - (t.direction @ along) * along
    size = float(np.linalg.norm(d))
    if size < 0.2:
        return []
    k = float(np.linalg.norm(t.curvature))
    return [replace(b, X=X, twist=Twist(t.anchor, d / size, sign * k * along)) for sign in (1.0, -1.0)]
