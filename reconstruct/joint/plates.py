"""Flat links that turn in their own plane: half of a pair of scissors, a lever, a lid that swivels.

All points of such a link lie in one plane, and the axis stands on it. A motion of ten degrees leaves a free link's
axis open by tens of degrees, because every point has a depth of its own; in one plane none has, and how the plane lies
is seen in how the circles are foreshortened that its points go on. Whether a link is such a plate is asked of its
tracks: all planes are tried, each by the one turn about one point of it that the tracks, laid into it, keep to best,
and the best of them are adjusted with the points bound to their plane. Of a link of any other shape some tracks then
miss their place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from reconstruct.joint.finish import Finished
from reconstruct.joint.hypotheses import perpendicular_basis
from reconstruct.joint.polish import Bundle, Sightings, anchor_of, cheapest, polish, residuals
from reconstruct.joint.twist import twist_of_joint
from reconstruct.joint.uncertainty import spread
from reconstruct.joint.weigh import APART_DEG as RIVAL_DEG
from reconstruct.joint.weigh import Rival, apart_deg, log_odds_of_same_type

WORTH_DEG = 1.5
"""Standard deviation of an axis below which the tracks are believed as they are."""
FEWEST = 20
"""Tracks: nearly any plane can be laid through fewer. 13 of a stapler's made a sure plate, 68 deg off; of scissors that
were found so the fewest are 26."""
FLAT = 0.03
"""Standard deviation, over the link's size, by which points of a plate leave its plane: it has a thickness."""
PLANES, STEEP = 500, 0.2
"""Directions of half a sphere that are tried as the plane's normal; and the cosine of its angle with the line of sight
below which a plane is seen on edge."""
TRACKS, FRAMES, ROUNDS = 120, 14, 4
"""Tracks and frames by which planes are tried, and rounds of weighing the tracks."""
APART_DEG, CLOSEST = 12.0, 4
"""How far planes that are adjusted differ from each other, and how many are."""
MISSED_PX = 3.0
"""Beyond which it counts no more by how much a track misses its place."""
AWAY, AWAY_PX = 1.15, 0.005
"""How many times worse, and by how many px, tracks may keep to a plate than to a link of any shape."""
STRAY, KEPT = 2.5, 0.7
"""Standard deviations of the noise beyond which a track strays from a plate, and the share that has to be left if such
are left out."""
PLATE = 0.85
"""Probability that a link is one whose tracks keep to one as well as that."""
SAME_DEG = 2.0
"""Planes so near to each other, once adjusted, are one."""
OWN_DEG = 1.0
"""Standard deviation of an axis on a plate whose upper and lower edge are taken for one."""


def as_plate(done: Finished) -> Finished:
    """A hinge with its link in one plane at right angles to it, where its tracks keep to that; else ``done``.

    Args:
        done: before a resting camera; of N tracks, some of which the answer may leave out.
    """
    b, sight, free = done.bundle, done.sight, done.axis_deg
    if sight.R is not None or b.kind != "revolute" or free < WORTH_DEG or len(done.members) < FEWEST:
        return done
    found: list[_Plate] = []
    for start in _starts(b, sight):
        plate = _plate(start, b, sight)
        if plate is not None and all(apart_deg(plate.bundle, o.bundle) > SAME_DEG for o in found):
            found.append(plate)
    if not found:
        return done
    # By all tracks: the one that the fewest stray from.
    whole = cheapest([o.whole for o in found], sight)
    best = next(o for o in found if o.whole is whole)
    others = [o for o in found if o is not best]
    less = [0.0, *(log_odds_of_same_type(whole, o.whole, sight) for o in others)]
    # A plane that is seen on edge shows less of itself.
    log_p = [best.odds - x + np.log(PLATE * _faces(o.bundle)) for o, x in zip((best, *others), less, strict=True)]
    log_p.append(np.log(1 - PLATE) + np.log(min(np.radians(free) ** 2 / 2, 1.0)))
    p = np.exp(np.array(log_p) - logsumexp(log_p))
    if p[0] < p.max():
        return done
    sure = spread(best.bundle, best.sight)
    # That it is no plate is left in doubt as the free joint has it; that it is the plate's mirror image, as a rival.
    off = max(free, apart_deg(best.bundle, b))
    axis_deg = float(np.sqrt(sure.axis_deg**2 + OWN_DEG**2 + p[-1] * off**2))
    if axis_deg >= free:
        return done
    rivals = [Rival(apart_deg(best.bundle, o.bundle), float(x), o.whole) for o, x in zip(others, p[1:-1], strict=True)]
    rival = max((r for r in rivals if r.apart_deg > RIVAL_DEG), key=lambda r: r.probability, default=None)
    return replace(done, bundle=best.bundle, sight=best.sight, members=done.members[best.kept],
                   spread=replace(sure, axis_deg=axis_deg), rival=rival, once=None)  # fmt: skip


@dataclass(frozen=True)
class _Plate:
    """A joint whose link is a plate.

    Attributes:
        whole: with the points of all tracks.  kept: (N,) bool, those that do not stray from it.
        bundle, sight: by these.  odds: their logarithm against a link of any shape.
    """

    whole: Bundle
    kept: np.ndarray
    bundle: Bundle
    sight: Sightings
    odds: float


def _plate(start: Bundle, free: Bundle, sight: Sightings) -> _Plate | None:
    """The best plate from a start, or None if its tracks miss it by too much.

    Args:
        free: the link of any shape.  sight: observations of all tracks of both.
    """
    bound = replace(sight, flat=FLAT)
    whole = polish(start, bound, 20)
    # What clings to the outline, half on what lies behind it, follows with a point out of the plane.
    missed = np.sum(residuals(whole, bound) ** 2, axis=(1, 2)) / np.maximum(2 * sight.seen.sum(1), 1)
    kept = np.sqrt(missed) < STRAY * max(whole.sigma, 0.05)
    if kept.mean() < KEPT:
        kept[:] = True
    bound = bound.of(kept)
    b = polish(replace(whole, X=whole.X[kept]), bound)
    rest = replace(bound, flat=None)
    any_shape = polish(replace(free, X=free.X[kept]), rest)
    if b.sigma >= AWAY * any_shape.sigma + AWAY_PX:
        return None
    return _Plate(whole, kept, b, bound, log_odds_of_same_type(b, any_shape, rest))


def _faces(b: Bundle) -> float:
    """Cosine of the angle between a plate and the picture, as seen at its middle."""
    middle = np.median(b.X, axis=0)
    return max(abs(float(b.twist.axis @ middle)) / float(np.linalg.norm(middle)), 1e-3)


def _starts(b: Bundle, s: Sightings) -> list[Bundle]:
    """The joints of the planes that tracks keep to best, their points in them."""
    N, T = s.seen.shape
    f = s.focal * float(np.exp(b.log_focal))
    tracks = np.unique(np.linspace(0, N - 1, min(N, TRACKS)).round().astype(int))
    frames = np.unique(np.linspace(0, T - 1, min(T, FRAMES)).round().astype(int))
    some = np.ix_(tracks, frames)
    rays = np.concatenate([s.uv / f, np.ones((N, T, 1))], axis=2)
    middle = np.median(rays[s.seen], axis=0)
    tried = []
    for normal in half_sphere(PLANES):
        normal = normal * np.sign(normal @ middle)
        if normal @ middle < STEEP * np.linalg.norm(middle):
            continue
        z, front = _laid(rays[some], normal)
        seen = s.seen[some] & front
        if seen.sum() < KEPT * s.seen[some].sum():
            continue  # much of the link would be behind the camera's horizon of the plane
        turn = _turn(z, seen, normal, s.uv[some], f)
        if turn is not None:
            tried.append((turn[0], normal, turn[1]))
    tried.sort(key=lambda x: x[0])
    chosen: list[tuple[np.ndarray, complex]] = []
    for _, normal, centre in tried:
        if all(abs(normal @ other) < np.cos(np.radians(APART_DEG)) for other, _ in chosen):
            chosen.append((normal, centre))
        if len(chosen) == CLOSEST:
            break
    return [_joint(b, s.seen, rays, normal, centre) for normal, centre in chosen]


def half_sphere(count: int) -> np.ndarray:
    """(count, 3) unit directions, evenly over half a sphere (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def in_plane(normal: np.ndarray) -> np.ndarray:
    """(2, 3) unit, at right angles to each other and to a normal: turned about it the first becomes the other."""
    e = perpendicular_basis(normal)[:, 0]
    return np.stack([e, np.cross(normal, e)])


def _laid(rays: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (..., 3) meet the plane at distance 1 with this normal, as complex numbers in it; and whether they
    do so well before the camera's horizon of it."""
    d = rays @ normal
    X = rays / np.where(np.abs(d) < 1e-3, 1e-3, d)[..., None] @ in_plane(normal).T
    return X[..., 0] + 1j * X[..., 1], d > 0.02


def _turn(z: np.ndarray, seen: np.ndarray, normal: np.ndarray, uv: np.ndarray, f: float
          ) -> tuple[float, complex] | None:  # fmt: skip
    """By how many px (RMS) tracks in a plane miss the best turn about one point of it, and that point; None where too
    few are seen together.

    Args:
        z, seen: (N, T) places in the plane.  uv: (N, T, 2) px from the principal point.
    """
    first = int(np.argmax(seen.sum(0)))
    both = seen & seen[:, [first]]
    both[:, first] = False
    if both.sum() < 8:
        return None
    a, W, basis = z[:, [first]], both.astype(float), in_plane(normal)
    off = np.zeros(1)
    for _ in range(ROUNDS):
        total = W.sum(0) + 1e-9
        ma, mb = (W * a).sum(0) / total, (W * z).sum(0) / total
        u = np.sum(W * np.conj(a - ma) * (z - mb), axis=0)
        u = u / np.maximum(np.abs(u), 1e-12)
        # From turns about one point: (1 - u) centre = mb - u ma.
        centre = np.sum(total * np.conj(1 - u) * (mb - u * ma)) / max(np.sum(total * np.abs(1 - u) ** 2), 1e-12)
        u = np.sum(W * np.conj(a - centre) * (z - centre), axis=0)
        u = u / np.maximum(np.abs(u), 1e-12)
        goes = centre + u * (a - centre)
        X = normal + goes.real[..., None] * basis[0] + goes.imag[..., None] * basis[1]
        off = np.linalg.norm(f * X[..., :2] / np.maximum(X[..., 2:], 1e-3) - uv, axis=-1)
        W = both / (1 + (off / (2 * max(np.median(off[both]), 0.05))) ** 2) ** 2
    return float(np.sqrt(np.mean(np.minimum(off[both], MISSED_PX) ** 2))), complex(centre)


def _joint(b: Bundle, seen: np.ndarray, rays: np.ndarray, normal: np.ndarray, centre: complex) -> Bundle:
    """The joint about a point of a plane, with the points of all tracks in it.

    Args:
        seen: (N, T).  rays: (N, T, 3).  centre: in the plane at distance 1.
    """
    laid, front = _laid(rays, normal)
    seen = seen & front
    z = np.where(seen, laid - centre, 0.0)
    T = z.shape[1]
    first = int(np.argmax(seen.sum(0)))
    u, x, known = np.ones(T, complex), z[:, first].copy(), seen[:, first].copy()
    for _ in range(3):
        for t in np.argsort(np.abs(np.arange(T) - first), kind="stable"):
            turned = np.sum(z[known, t] * np.conj(x[known]))
            u[t] = turned / abs(turned) if abs(turned) > 0 else u[max(t - 1, 0)]
        x = (z * np.conj(u)).sum(1) / np.maximum(seen.sum(1), 1)
        known = seen.any(1)
    q = np.unwrap(np.angle(u))
    x = x * u[0]
    basis = in_plane(normal)
    point = normal + centre.real * basis[0] + centre.imag * basis[1]
    X = point + x.real[:, None] * basis[0] + x.imag[:, None] * basis[1]
    unit = max(float(np.median(X[:, 2])), 1e-6)
    X, point = X / unit, point / unit
    twist, speed = twist_of_joint("revolute", normal, point, anchor_of("revolute", X, normal, point))
    return replace(b, twist=twist, q=(q - q[0]) * speed, X=X)
