"""A plate that turns in its plane, by its straight edges alone: thin parts that points are lost on.

How a straight edge goes is seen across itself only, and by how it turns: two numbers a frame. In a plane that turns
about one point of it, all edges turn by one angle, which their pictures do not (a circle is foreshortened), and keep
their distances from that point. For a plane that is given, the angles of all edges give the turn, and distances that
are kept give the point, by linear equations: so all planes are tried, each by one edge's turn at a time, and what other
edges follow it counts. Where axes are likely, and how far people open things, counts too: planes seen nearly on edge
explain a small motion by next to no turn.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from reconstruct.joint.plates import FLAT, STEEP, half_sphere, in_plane
from reconstruct.joint.upright import log_prior

PLANES, SEEDS, BATCH = 500, 6, 50
"""Directions of half a sphere that are tried as the plane's normal, edges by whose turn each is tried, and how many at
once."""
EDGES, FRAMES = 40, 64
"""At most: edges with most motion, frames evenly."""
SIGMA, LIMIT = 0.12, 0.36
"""Noise of an edge, px across, and the scale of the loss."""
LOOKS = 4.0
"""Independent looks at an edge in a film: its errors (blur, what lies behind) last."""
ROUGH, COARSE = 2.0, 3.0
"""Scales of the loss, px, that turns and then places begin with."""
ANGLES, PLACES, ALONE, SHRINK = 5, 10, 2, 0.6
"""Rounds by angles alone, rounds with places, the first of which leave the states alone, and by how much the scale
shrinks in each."""
AGREES = 0.3
"""Share of its frames in which an edge turns as the seed does, to have a say."""
TURN_DEG, TURN_SPREAD = 40.0, 1.0
"""Median of how far people open things, and the standard deviation of its logarithm."""
MODES, MODE_DEG, SAME_DEG, LESS = 12, 12.0, 6.0, 12.0
"""Best planes that differ by so much, which are looked at closely; how near they are one then; and by how much less of
a logarithm they are left out."""
STEP_DEG, LEAST_DEG, CURVED_DEG = 4.0, 0.3, 2.0
"""Steps by which they are improved, first and last, and over which the log-probability's curvature is read."""
OWN_DEG = 1.5
"""Standard deviation of a plane besides: the edges of a plate are those of its upper and its lower side."""
WIDEST_DEG = 8.0
"""The same along one direction at most: beyond, other planes are told apart."""


@dataclass(frozen=True)
class Lines:
    """Straight edges as they go.

    Attributes:
        middle: (E, T, 2) px from the principal point.  along: (E, T, 2) unit.  length: (E, T) px. 0 where not seen.
    """

    middle: np.ndarray
    along: np.ndarray
    length: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(E, T) bool."""
        return self.length > 0

    def __getitem__(self, rows: np.ndarray) -> Lines:
        """Some edges."""
        return Lines(self.middle[rows], self.along[rows], self.length[rows])

    def at(self, frames: np.ndarray) -> Lines:
        """In some frames."""
        return Lines(self.middle[:, frames], self.along[:, frames], self.length[:, frames])

    def motion(self) -> np.ndarray:
        """(E, T) px^2 from where each edge is in the middle of its life: across, and by turning about its middle."""
        out = np.zeros(self.length.shape)
        for i, seen in enumerate(self.seen):
            t = np.flatnonzero(seen)
            if not len(t):
                continue
            a = self.along[i, t]
            mid = len(t) // 2
            across = (self.middle[i, t] - self.middle[i, t[mid]]) @ np.array([-a[mid, 1], a[mid, 0]])
            turn = np.unwrap(np.arctan2(a[:, 1], a[:, 0]))
            turned = (turn - np.median(turn)) * _lever(self.length[i, t])
            out[i, t] = (across - np.median(across)) ** 2 + turned**2
        return out


def _lever(length: np.ndarray) -> np.ndarray:
    """RMS distance of an edge's points from its middle."""
    return length / np.sqrt(12)


def edge_of(slip: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """(N,) which edge each track is of; arguments as of :func:`lines_of`."""
    first = slip[np.arange(len(slip)), reference]
    return np.unique(np.column_stack([reference, first]), axis=0, return_inverse=True)[1].ravel()


def lines_of(uv: np.ndarray, slip: np.ndarray, reference: np.ndarray, apart: float) -> tuple[Lines, np.ndarray]:
    """The edges that tracks are points of.

    Args:
        uv: (N, T, 2) px from the principal point, NaN where not seen.  slip: (N, T, 2) unit, along the edge.
        reference: (N,) frames in which the edges were longest.  apart: px between neighbouring points.

    Returns:
        E edges, and (N,) which of them each track is of.
    """
    of = edge_of(slip, reference)
    E, T = int(of.max(initial=-1)) + 1, uv.shape[1]
    middle, along, length = np.zeros((E, T, 2)), np.zeros((E, T, 2)), np.zeros((E, T))
    for e in range(E):
        p, s = uv[of == e], slip[of == e]
        seen = np.isfinite(p[..., 0])
        t = np.flatnonzero(seen.any(0))
        count = seen[:, t].sum(0)
        middle[e, t] = np.where(seen[:, t, None], p[:, t], 0.0).sum(0) / count[:, None]
        along[e, t] = s[seen[:, t].argmax(0), t]
        length[e, t] = apart * count
    return Lines(middle, along, length), of


@dataclass(frozen=True)
class EdgePlate:
    """A plate that edges follow.

    Attributes:
        normal: (3,) unit, camera frame, away from the camera.  point: (3,) of the axis, in the plane at distance 1.
        q: (T,) rad about the normal; between frames that no edge shows interpolated.
        log_p: logarithm of its probability, but for a constant.
        std_deg: of the normal, other plates not counted.
        follows: (E,) bool, edges that go with it.  share: of the motion of all edges, what it explains.
    """

    normal: np.ndarray
    point: np.ndarray
    q: np.ndarray
    log_p: float
    std_deg: float
    follows: np.ndarray
    share: float


def plates_of(lines: Lines, focal: float) -> list[EdgePlate]:
    """The plates that most edges follow, the most probable first; none where there are none.

    Args:
        lines: that move.  focal: px.
    """
    T = lines.length.shape[1]
    frames = np.unique(np.linspace(0, T - 1, min(T, FRAMES)).round().astype(int))
    some = lines.at(frames)
    worth = _loss(some.motion()).sum(1)
    ids = np.argsort(-worth)[:EDGES]
    ids = ids[worth[ids] > 0]
    if not len(ids):
        return []
    search = _Search(some[ids], focal)
    grid = [n for n in half_sphere(PLANES) if n[2] > STEEP]
    tried = search.best(grid, range(min(SEEDS, len(ids))))
    modes = _apart((search.improved(p) for p in _apart(tried, MODE_DEG)[:MODES]), SAME_DEG)
    out = []
    for p in modes:
        if p.log_p < modes[0].log_p - LESS or not p.known.any():
            continue
        follows = np.zeros(len(lines.length), bool)
        follows[ids] = p.gain > 0
        known = np.flatnonzero(p.known)
        q = np.interp(np.arange(T), frames[known], np.unwrap(p.q[known]))
        basis = in_plane(p.normal)
        point = p.normal + p.centre.real * basis[0] + p.centre.imag * basis[1]
        share = float(np.maximum(p.gain, 0).sum() / worth[ids].sum())
        out.append(EdgePlate(p.normal, point, q, p.log_p, search.std_deg(p), follows, share))
    return out


def _apart(planes: Iterable[_Plane], deg: float) -> list[_Plane]:
    """The most probable planes, best first, of those that are nearer to each other than so many deg."""
    out: list[_Plane] = []
    for p in sorted(planes, key=lambda p: -p.log_p):
        if all(abs(p.normal @ o.normal) < np.cos(np.radians(deg)) for o in out):
            out.append(p)
    return out


def _loss(square: np.ndarray) -> np.ndarray:
    return LIMIT**2 * square / (LIMIT**2 + square)


def _weight(square: np.ndarray, scale: float) -> np.ndarray:
    return 1 / (1 + square / scale**2) ** 2


@dataclass(frozen=True)
class _Plane:
    """A plane and its best turn.

    Attributes:
        normal: (3,).  log_p: logarithm of its probability, but for a constant.  seed: the edge it was found by.
        centre: of the turn, in the plane at distance 1.  q: (T,) rad.  known: (T,) bool.
        gain: (E,) px^2 by which edges follow it better than they rest.
    """

    normal: np.ndarray
    log_p: float
    seed: int
    centre: complex
    q: np.ndarray
    known: np.ndarray
    gain: np.ndarray


class _Search:
    """Planes by the turns of edges.

    Args:
        lines: E edges in T frames.  focal: px.
    """

    def __init__(self, lines: Lines, focal: float):
        self.lines, self.focal = lines, focal
        motion = lines.motion()
        self.rest = _loss(motion)
        size = np.sqrt(motion.sum(1) / np.maximum(lines.seen.sum(1), 1))
        self.tells = np.log1p(size / SIGMA) * 2 * SIGMA**2 / LIMIT**2
        ray = np.append(np.median(lines.middle[lines.seen], axis=0) / focal, 1.0)
        self.view = ray / np.linalg.norm(ray)
        self.lasting = max(lines.length.shape[1] / LOOKS, 1.0)

    def best(self, normals: Iterable[np.ndarray], seeds: Iterable[int]) -> list[_Plane]:
        """Of each plane the turn that most follows."""
        normals, seeds = np.array(list(normals)), list(seeds)
        out: list[_Plane] = []
        for k in range(0, len(normals), BATCH):
            laid = self._laid(normals[k : k + BATCH])
            some = [self._turned(laid, seed) for seed in seeds]
            out += [max((s[j] for s in some), key=lambda p: p.log_p) for j in range(len(laid.normal))]
        return out

    def improved(self, p: _Plane) -> _Plane:
        """By steps to all sides."""
        step = np.radians(STEP_DEG)
        while step > np.radians(LEAST_DEG):
            there = max(self.best(_around(p.normal, step), [p.seed]), key=lambda x: x.log_p, default=p)
            if there.log_p > p.log_p:
                p = there
            else:
                step /= 2
        return p

    def std_deg(self, best: _Plane) -> float:
        """Standard deviation of the normal by the log-probability's curvature."""
        h, a = np.radians(CURVED_DEG), np.arange(8) * np.pi / 4
        basis, drop = in_plane(best.normal), np.full(8, np.inf)
        for p in self.best(_around(best.normal, h, a), [best.seed]):
            x, y = basis @ p.normal
            drop[round(np.arctan2(y, x) / (np.pi / 4)) % 8] = best.log_p - p.log_p
        # Beyond what is seen on edge there is nothing: as on the other side.
        pairs = drop.reshape(2, 4)
        along = np.where(np.isfinite(pairs), pairs, pairs[::-1]).sum(0)
        along = np.where(np.isfinite(along), along, 0.0) / h**2  # second derivatives along four lines, 45 deg apart
        H = np.array([[along[0], (along[1] - along[3]) / 2], [(along[1] - along[3]) / 2, along[2]]])
        values = np.maximum(np.linalg.eigvalsh(H), np.radians(WIDEST_DEG) ** -2)
        return float(np.hypot(np.degrees(np.sqrt(np.sum(1 / values))), OWN_DEG))

    def _log_prior(self, normal: np.ndarray, q: np.ndarray, known: np.ndarray) -> float:
        """Where axes are likely, how much of itself a plate shows, and how far people open things."""
        turn = float(np.ptp(np.unwrap(q[known]))) if known.any() else 0.0
        far = np.log(max(turn, 1e-3) / np.radians(TURN_DEG)) / TURN_SPREAD
        return log_prior(normal) + float(np.log(max(float(normal @ self.view), 1e-3))) - float(far**2) / 2

    def _laid(self, normals: np.ndarray) -> _Laid:
        """The edges in planes at distance 1."""
        lines = self.lines
        basis = np.stack([in_plane(n) for n in normals])  # (K, 2, 3)

        def at(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            ray = np.concatenate([p / self.focal, np.ones((*p.shape[:2], 1))], axis=2)
            depth = np.einsum("etj,kj->ket", ray, normals)
            x = np.einsum("etj,kij->keti", ray, basis) / np.where(depth > 0.02, depth, 1.0)[..., None]
            return x[..., 0] + 1j * x[..., 1], depth

        z, depth = at(lines.middle)
        seen = lines.seen & (depth > 0.02)
        way = at(lines.middle + lines.along)[0] - z
        length = np.where(seen, np.abs(way), 1.0)
        along = np.where(seen, way / length, 1.0)
        # Px across the edge for a step across it in the plane.
        h = 1e-4
        X = normals[:, None, None] + np.einsum("keti,kij->ketj", _parts(z), basis)
        Y = X + h * np.einsum("keti,kij->ketj", _parts(1j * along), basis)
        moved = self.focal * (Y[..., :2] / Y[..., 2:] - X[..., :2] / X[..., 2:]) / h
        across = np.stack([-lines.along[..., 1], lines.along[..., 0]], axis=-1)
        px = np.where(seen, np.abs(np.sum(moved * across, axis=-1)), 1.0)
        return _Laid(normals, z, along, seen, px, _lever(lines.length) * length * px)

    def _turned(self, laid: _Laid, seed: int) -> list[_Plane]:
        """The turn about one point of each plane that begins with one edge's."""
        q, beta, known, say = _by_angles(laid, seed)
        z, lever = laid.z, laid.lever
        seen = laid.seen & known[:, None] & say
        middle = np.array([np.median(a[s]) if s.any() else 0 for a, s in zip(z, seen, strict=True)])
        away = [np.abs(a[s] - m) for a, s, m in zip(z, seen, middle, strict=True)]
        thick = FLAT * np.array([2 * np.quantile(a, 0.8) if len(a) else 1.0 for a in away])[:, None]
        centre, w, scale = np.zeros(len(z), complex), seen.astype(float), COARSE
        for k in range(PLACES):
            along = np.exp(1j * (q[:, None] + beta[..., None]))
            place = _placed(z, 1j * along, w * laid.px**2, centre, SIGMA**2 * self.lasting / thick**2)
            centre = place[0]
            off, angle, arm = _missed(laid, along, place)
            if k >= ALONE:
                # Then the states, by places and angles.
                v = _weight(off**2 + angle**2, scale) * seen
                weight = (v * (arm**2 + lever**2)).sum(1)
                q = q - (v * (off * arm - angle * lever)).sum(1) / np.maximum(weight, 1e-12)
                angle = np.angle(laid.along * np.exp(-1j * (q[:, None] + beta[..., None]))) * lever
                beta = beta + (v * angle * lever).sum(2) / np.maximum((v * lever**2).sum(2), 1e-12)
                off, angle, _ = _missed(laid, np.exp(1j * (q[:, None] + beta[..., None])), place)
            scale = max(LIMIT, scale * SHRINK)
            w = _weight(off**2 + angle**2, scale) * seen
        height = place[2]
        cost = np.where(seen, _loss(off**2 + angle**2), self.rest)
        gain = ((self.rest - cost) * self.lines.seen).sum(2) - (height / thick) ** 2 * SIGMA**2 * self.lasting
        worth = (np.maximum(gain, 0) @ self.tells) / (2 * SIGMA**2 * self.lasting)
        prior = np.array([self._log_prior(*x) for x in zip(laid.normal, q, known, strict=True)])
        rows = zip(laid.normal, worth + prior, centre, q, known, gain, strict=True)
        return [_Plane(n, float(a), seed, complex(c), turn, there, g) for n, a, c, turn, there, g in rows]


@dataclass(frozen=True)
class _Laid:
    """Edges in K planes.

    Attributes:
        normal: (K, 3).  z, along: (K, E, T) middle and unit direction, complex.  seen: (K, E, T) bool.
        px: (K, E, T) px across for a step across.  lever: (K, E, T) px across for a turn about the middle.
    """

    normal: np.ndarray
    z: np.ndarray
    along: np.ndarray
    seen: np.ndarray
    px: np.ndarray
    lever: np.ndarray


def _by_angles(laid: _Laid, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States by what turns as one edge does, robustly.

    Returns:
        (K, T) rad, (K, E) rad, each edge's direction at 0, (K, T) bool, where states are known, and (K, E, 1) bool,
        which edges turn so.
    """
    along, seen, lever = laid.along, laid.seen, laid.lever
    turn, scale = np.where(seen[:, seed], along[:, seed], 0), ROUGH
    first, w, say = np.zeros(seen.shape[:2], complex), np.zeros(seen.shape), np.zeros((*seen.shape[:2], 1))
    for k in range(ANGLES):
        known = np.abs(turn) > 0
        both = seen & known[:, None]
        relative = np.where(both, along * np.conj(turn)[:, None], 0)
        if k == 0:
            first = relative.sum(2)
            for _ in range(3):
                first = _unit(first)
                off = np.abs(relative - first[..., None]) * lever
                first = (_weight(off**2, scale) * both * relative).sum(2)
        else:
            first = (w * lever**2 * relative).sum(2)
        started = np.abs(first) > 0
        first = _unit(first)
        off = np.angle(relative * np.conj(first)[..., None]) * lever
        w = _weight(off**2, scale) * (both & started[..., None])
        say = np.clip(w.sum(2) / np.maximum(both.sum(2), 1) - AGREES, 0, 1)[..., None]
        v = np.where(known[:, None], w, seen) * say**2 * lever**2
        turn = _unit((v * np.conj(first)[..., None] * along).sum(1))
        scale = max(ROUGH * SHRINK**2, scale * SHRINK)
    return np.angle(turn), np.angle(first), np.abs(turn) > 0, say > 0


def _missed(laid: _Laid, along: np.ndarray, place: tuple[np.ndarray, np.ndarray, np.ndarray]
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """(K, E, T) px each: by how much edges miss their places and their angles, and what a turn changes the first by.

    Args:
        along: (K, E, T) the edges' directions as the turn has them.  place: as of :func:`_placed`.
    """
    centre, distance, height = place
    arm = np.conj(along) * (laid.z - (centre[:, None] * (1 - height))[..., None])
    angle = np.angle(laid.along * np.conj(along)) * laid.lever
    return (arm.imag - distance[..., None]) * laid.px, angle, -arm.real * laid.px


def _placed(z: np.ndarray, normal: np.ndarray, w: np.ndarray, about: np.ndarray, stiff: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The points (K,) from which edges keep their distances (K, E), and their heights (K, E) over the plane.

    What is a share h nearer to the camera than the plane turns about the point laid h nearer to the plane's origin.

    Args:
        z, normal: (K, E, T) middles, and what each edge faces.  w: (K, E, T) weights.
        about: (K,) the points so far.  stiff: (K, 1) weight of a squared height.
    """
    toward = (np.conj(normal) * about[:, None, None]).real
    columns = np.stack([normal.real, normal.imag, np.ones_like(w), -toward], axis=-1)
    y = (np.conj(normal) * z).real
    N = np.einsum("ket,keta,ketb->keab", w, columns, columns, optimize=True)
    g = np.einsum("ket,keta,ket->kea", w, columns, y, optimize=True)
    N[..., 2, 2] += 1e-9
    N[..., 3, 3] += stiff
    inverse = np.linalg.inv(N[..., 2:, 2:])
    cross = N[..., :2, 2:] @ inverse
    S = (N[..., :2, :2] - cross @ N[..., 2:, :2]).sum(1)
    S += (1e-9 * np.trace(S, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(2)
    right = (g[..., :2] - np.einsum("keab,keb->kea", cross, g[..., 2:])).sum(1)
    c = np.linalg.solve(S, right[..., None])[..., 0]
    own = np.einsum("keab,keb->kea", inverse, g[..., 2:] - np.einsum("keab,kb->kea", N[..., 2:, :2], c))
    return c[:, 0] + 1j * c[:, 1], own[..., 0], own[..., 1]


def _parts(z: np.ndarray) -> np.ndarray:
    return np.stack([z.real, z.imag], axis=-1)


def _unit(z: np.ndarray) -> np.ndarray:
    """Complex numbers of absolute value 1; 0 where next to nothing is left."""
    size = np.abs(z)
    return np.where(size > 1e-9, z / np.maximum(size, 1e-12), 0)


def _around(normal: np.ndarray, by: float, azimuths: np.ndarray | None = None) -> list[np.ndarray]:
    """Directions so many rad off, to several sides, that are not seen on edge."""
    basis = in_plane(normal)
    a = np.arange(6) * np.pi / 3 if azimuths is None else azimuths
    out = np.cos(by) * normal + np.sin(by) * (np.cos(a)[:, None] * basis[0] + np.sin(a)[:, None] * basis[1])
    return [n for n in out if n[2] > STEEP / 2]
