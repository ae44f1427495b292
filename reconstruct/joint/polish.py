"""Maximum-likelihood bundle adjustment of one joint over all tracks and all frames.

Unknown: the twist (see twist.py), the state in every frame, every track's point in 3D and, where they are not given,
the focal length and the camera's pose in every frame, which tracks of the resting scene then hold. The points are
eliminated (Schur complement, 3 x 3 blocks), so that a step costs one dense solve in the number of frames. The loss is
Geman-McClure's with a scale that follows the measured noise: near to efficient for Gaussian noise, and stray
observations drop out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.joint.normal import Normal, normal_equations
from reconstruct.joint.paths import held
from reconstruct.joint.shape import Flat, Nearby, Reach, extent
from reconstruct.joint.twist import Twist

BEND = 0.1
"""Standard deviation of q's second difference over its range: weak, it decides only where few tracks are seen."""
WALK = 0.2
"""And of its first difference beside frames that nothing observes: what is out of sight comes to rest."""
ROBUST_SIGMAS = 4.0
"""Scale of the loss in standard deviations of the noise: 97 % efficient for Gaussian noise."""
HINGE_RADIUS, HINGE_SPREAD = 0.45, 0.5
"""Median distance of a hinge from the link's middle over the link's size, and the standard deviation of its logarithm.
The hinges of simulated furniture lie 0.34 to 0.64 link diagonals away (knobs less); texture on a part of the link only
makes it look smaller."""
HOLDERS = 3
"""Tracks that a frame must show near where the joint has them for its state to be part of the stroke."""
PARALLEL_DEG = 0.7
"""Standard deviation of an axis about what it is taken to be parallel to, to either side, for a known focal length."""
GAUGE = 0.4
"""Logarithm of the link's depth beyond which it is brought back to 1."""


@dataclass(frozen=True)
class Sightings:
    """Observations of one link, and of the resting scene where the camera's path is unknown.

    Attributes:
        uv: (N, T, 2) px from the principal point (0 where not seen).  seen: (N, T) bool.
        weight: (N,) of each track.
        focal: px.  focal_std: of its logarithm; 0 where it is known.
        R, t: (T, 3, 3), (T, 3) world to camera; None for a static camera, whose frame is the world then.
        frames: (T,) frame numbers; 0 .. T-1 when None.
        lasting: frames over which a track's error stays alike: so many observations weigh against a prior as one.
        link: (N,) bool, on the link (the others rest); all of them when None.
        relative: (N,) noise over that of the link's tracks; 1 when None.
        free: True if the camera's poses are unknown, R and t but a start; the world is the first camera then.
        slip: (N, T, 2) along what the picture holds badly, see paths.py; None if there is none.
        along: (3,) unit, world: what the axis is taken to be parallel to; None where nothing is known of it.
        flat: standard deviation, over the link's size, of its points' distances from one plane at right angles to the
            axis; None where nothing is known of them.
    """

    uv: np.ndarray
    seen: np.ndarray
    weight: np.ndarray
    focal: float
    focal_std: float = 0.0
    R: np.ndarray | None = None
    t: np.ndarray | None = None
    frames: np.ndarray | None = None
    lasting: float = 1.0
    link: np.ndarray | None = None
    relative: np.ndarray | None = None
    free: bool = False
    slip: np.ndarray | None = None
    along: np.ndarray | None = None
    flat: float | None = None

    def of(self, tracks: np.ndarray) -> Sightings:
        """Of some of the tracks of a link."""
        slip = None if self.slip is None else self.slip[tracks]
        return replace(self, uv=self.uv[tracks], seen=self.seen[tracks], weight=self.weight[tracks], slip=slip)

    @property
    def scaleless(self) -> bool:
        """True if nothing but the link's own depth can be the unit of length."""
        return self.R is None or self.free

    @property
    def bend(self) -> np.ndarray:
        """(T, T) sum of squared second differences of q, and of first ones beside frames that do not show the link, or
        the scene that a moving camera's path is known by."""
        T = self.seen.shape[1]
        f = np.arange(T) if self.frames is None else self.frames
        shown = [self.seen] if self.link is None else [self.seen[self.link], self.seen[~self.link]]
        f, blind = f / max(float(np.mean(np.diff(f))), 1e-9), ~np.all([x.any(0) for x in shown], axis=0)
        D, E = second_difference(f), np.diff(np.eye(T), axis=0) / np.sqrt(np.diff(f))[:, None]
        E = E[blind[1:] | blind[:-1]]
        return D.T @ D + (BEND / WALK) ** 2 * E.T @ E


@dataclass(frozen=True)
class Bundle:
    """A fitted joint.

    Attributes:
        kind: "revolute", "prismatic" or "screw".  twist: the joint.  q: (T,) path length at the anchor, q[0] = 0.
        X: (N, 3) points at q = 0, world.  log_focal: correction of the focal length's logarithm.
        cost: robust cost in px^2.  sigma: noise of one coordinate of the link's tracks, px.
        R, t: world to camera where the poses are fitted too, else None.
    """

    kind: str
    twist: Twist
    q: np.ndarray
    X: np.ndarray
    log_focal: float = 0.0
    cost: float = np.inf
    sigma: float = 1.0
    R: np.ndarray | None = None
    t: np.ndarray | None = None

    def scaled(self, by: float) -> Bundle:
        """The same in another unit of length; by: new units that the old one is long."""
        tw = self.twist
        twist = Twist(tw.anchor * by, tw.direction, tw.curvature / by)
        return replace(self, twist=twist, q=self.q * by, X=self.X * by, t=None if self.t is None else self.t * by)


def parallel_deg(s: Sightings) -> float:
    """Standard deviation, to either side, of an axis about what it is taken to be parallel to.

    Where edges meet is known in px; a focal length that is wrong by a hundredth turns a direction that is 45 deg from
    the line of sight by half of that, and the usual one by half of that again.
    """
    return float(np.hypot(PARALLEL_DEG, np.degrees(s.focal_std) / 4))


def positions(b: Bundle, s: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Points in all frames: world and camera frame, (N, T, 3) each."""
    R, p = b.twist.pose(b.q)
    y = np.einsum("tij,nj->nti", R, b.X - b.twist.anchor)
    world = y + p + b.twist.anchor
    if s.link is not None:
        world[~s.link] = b.X[~s.link, None]
    camera, shift = (s.R, s.t) if b.R is None else (b.R, b.t)
    if camera is None:
        return world, world
    return world, np.einsum("tij,ntj->nti", camera, world) + shift


def residuals(b: Bundle, s: Sightings, cam: np.ndarray | None = None) -> np.ndarray:
    """(N, T, 2) px, as far as the picture holds them (paths.py); 0 where not seen."""
    cam = positions(b, s)[1] if cam is None else cam
    z = np.maximum(cam[..., 2:], 1e-3)
    r = held(s.focal * np.exp(b.log_focal) * cam[..., :2] / z - s.uv, s.slip)
    r = np.where(cam[..., 2:] < 1e-3, 1e3, r)
    return np.where(s.seen[..., None], r, 0.0)


def second_difference(frames: np.ndarray) -> np.ndarray:
    """(T-2, T) second differences for uneven spacing."""
    T = len(frames)
    h0, h1 = np.diff(frames)[:-1], np.diff(frames)[1:]
    D = np.zeros((max(T - 2, 0), T))
    k = np.arange(max(T - 2, 0))
    D[k, k], D[k, k + 1], D[k, k + 2] = 2 / (h0 * (h0 + h1)), -2 / (h0 * h1), 2 / (h1 * (h0 + h1))
    return D


def noise(r: np.ndarray, seen: np.ndarray) -> float:
    """Standard deviation of one coordinate from the median residual, px."""
    r2 = np.sum(r**2, axis=-1)[seen]
    return float(np.sqrt(max(np.median(r2) / (2 * np.log(2)), 1e-6))) if len(r2) else 1.0


def link_noise(r: np.ndarray, s: Sightings) -> float:
    """That of the link's tracks, px: a scene that rests may be far more exact, and is no measure of them."""
    return noise(r, s.seen) if s.link is None else noise(r[s.link], s.seen[s.link])


def robust_loss(r: np.ndarray, s: Sightings, scale: float) -> tuple[float, np.ndarray]:
    """Cost, and the weight (N, T) of every squared residual in the linear problem that has the same gradient."""
    by = np.ones(len(r)) if s.relative is None else 1 / s.relative**2
    g = scale**2 / (scale**2 + by[:, None] * np.sum(r**2, axis=-1))
    w = s.weight[:, None] * s.seen
    return float(np.sum(w * scale**2 * (1 - g))), w * by[:, None] * g**2


def track_costs(r: np.ndarray, s: Sightings, scale: float) -> np.ndarray:
    """(N,) part of each track in the cost of :func:`robust_loss`."""
    by = np.ones(len(r)) if s.relative is None else 1 / s.relative**2
    g = scale**2 / (scale**2 + by[:, None] * np.sum(r**2, axis=-1))
    return s.weight * np.sum(s.seen * scale**2 * (1 - g), axis=1)


@dataclass(frozen=True)
class _Priors:
    """What is known besides the pictures, as squares in px^2.

    Attributes:
        focal: weight of the focal length's logarithm; 0 where it is known.
        bend: (T, T) of q's second differences.
        radius, log_turn: weight of a hinge's radius, and the logarithm of the turn that the path at hand is expected to
            be; 0 for a slide.
        ends: the frames with the least and the most path of those that tracks hold. Measured from the first frame,
            which may show nothing of the link, a hinge would get its radius by a path that nothing contradicts.
        reach: of the link's points.
        flat: of the same.  nearby: of the resting scene's.
        along, parallel: what the axis is parallel to, and the weight of the sine of the angle between them.
    """

    focal: float
    bend: np.ndarray
    radius: float
    log_turn: float
    ends: tuple[int, int]
    reach: Reach
    flat: Flat
    nearby: Nearby
    along: np.ndarray | None = None
    parallel: float = 0.0

    @classmethod
    def of(cls, b: Bundle, s: Sightings, sigma: float, hold: float = 1.0, w: np.ndarray | None = None) -> _Priors:
        """Small motions say little about how far away a hinge is, and strays bend that first.

        Its radius over the link's size is the path over the turn over the size. Path and size scale together, so that
        the turn bears the prior: it is the number that no change of scale touches.

        Args:
            b: the joint at hand.  s: observations.  sigma: their noise, px.
            hold: how much more than it is worth the radius counts.
            w: (N, T) weights of the robust loss; worked out when None.
        """
        if w is None:
            w = robust_loss(residuals(b, s), s, ROBUST_SIGMAS * max(sigma, 0.05))[1]
        focal = sigma**2 * s.lasting / s.focal_std**2 if s.focal_std > 0 else 0.0
        parallel = 0.0 if s.along is None else sigma**2 * s.lasting / np.radians(parallel_deg(s)) ** 2
        held = frames_held(s, w)
        bend = s.bend * (sigma / (BEND * max(float(np.ptp(b.q[held])), 1e-9))) ** 2
        ends = int(held[np.argmin(b.q[held])]), int(held[np.argmax(b.q[held])])
        path = float(b.q[ends[1]] - b.q[ends[0]])
        X = b.X if s.link is None else b.X[s.link]
        size = extent(X)
        reach, flat, nearby = Reach.of(b, s, sigma), Flat.of(b, s, sigma), Nearby.of(b, s, sigma)
        if b.kind == "prismatic" or path <= 0 or size <= 0:
            return cls(focal, bend, 0.0, 0.0, ends, reach, flat, nearby, s.along, parallel)
        radius = hold * sigma**2 * s.lasting / HINGE_SPREAD**2
        log_turn = float(np.log(path / (HINGE_RADIUS * size)))
        return cls(focal, bend, radius, log_turn, ends, reach, flat, nearby, s.along, parallel)

    def cost(self, b: Bundle) -> float:
        """Without the radius, which is weighed apart where types are compared."""
        aside = 0.0 if self.along is None else float(np.sum(np.cross(self.along, b.twist.axis) ** 2))
        return self.focal * b.log_focal**2 + float(b.q @ self.bend @ b.q) + self.parallel * aside

    def of_points(self, b: Bundle) -> float:
        """Of where the points lie."""
        return self.reach.cost(b.X) + self.flat.cost(b) + self.nearby.cost(b.X)

    def radius_cost(self, b: Bundle) -> float:
        """Of the radius alone."""
        return self.radius * (self.turn(b) - self.log_turn) ** 2 if self.radius else 0.0

    def turn(self, b: Bundle) -> float:
        """Its logarithm."""
        return float(np.log(max(np.linalg.norm(b.twist.curvature) * self._path(b), 1e-9)))

    def _path(self, b: Bundle) -> float:
        return float(b.q[self.ends[1]] - b.q[self.ends[0]])

    def add(self, n: Normal, b: Bundle) -> None:
        """Into the normal equations."""
        A, T, G = n.lead, len(b.q), n.Z.shape[1]
        if self.focal:
            n.H[G, G] += self.focal
            n.g[G] += self.focal * b.log_focal
        n.H[A : A + T, A : A + T] += self.bend
        n.g[A : A + T] += self.bend @ b.q
        if self.along is not None:
            J = np.cross(self.along, b.twist.axis_by_step(n.Z), axisb=0).T
            n.H[:G, :G] += self.parallel * J.T @ J
            n.g[:G] += self.parallel * J.T @ np.cross(self.along, b.twist.axis)
        for H, g in (self.reach.slopes(b.X), self.nearby.slopes(b.X)):
            n.Hp[...] += H
            n.gp[...] += g
        self.flat.add(n, b)
        k2 = float(b.twist.curvature @ b.twist.curvature)
        if self.radius and k2 > 0:
            row = np.zeros(len(n.g))
            row[:G] = n.Z[3:].T @ b.twist.curvature / k2
            row[A + self.ends[0]], row[A + self.ends[1]] = np.array([-1, 1]) / self._path(b)
            n.H[...] += self.radius * np.outer(row, row)
            n.g[...] += self.radius * (self.turn(b) - self.log_turn) * row


def frames_held(s: Sightings, w: np.ndarray) -> np.ndarray:
    """(k,) frames whose state tracks hold, of the link and, before a moving camera, of the scene too: by the robust
    loss's weights (N, T), or with slip wherever they are seen, as such tracks end where they are lost; all of them
    where these are too few.

    Where a tracker has lost everything a state may run off for nothing: in units of its own path it would not be bent,
    and of a hinge that is far away it would be what makes it near.
    """
    near, least = (w > 0.25 * s.weight[:, None], HOLDERS) if s.slip is None else (s.seen, 1)
    bodies = [near] if s.link is None else [near[s.link], near[~s.link]]
    held = np.flatnonzero(np.all([body.sum(0) >= least for body in bodies], axis=0))
    return held if len(held) > 1 else np.arange(near.shape[1])


def radius_cost(b: Bundle, s: Sightings) -> float:
    """px^2 that the radius of a hinge costs beyond what the tracks do: many times as far away as links are large is a
    slide, bent by strays."""
    return _Priors.of(b, s, b.sigma).radius_cost(b)


def cheapest(bundles: Sequence[Bundle], s: Sightings) -> Bundle:
    """The one that costs least (px^2, priors included), all by the smallest noise among them.

    Each one's own cost is by a loss as wide as its own noise, and a wider loss charges more for every stray.

    Args:
        bundles: joints of one type, at least one, each with the points (N, 3) of the same tracks.
        s: observations of these tracks.
    """
    limit = ROBUST_SIGMAS * max(min(b.sigma for b in bundles), 0.05)

    def cost(b: Bundle) -> float:
        priors = _Priors.of(b, s, b.sigma)
        return robust_loss(residuals(b, s), s, limit)[0] + priors.cost(b) + priors.radius_cost(b)

    return min(bundles, key=cost)


def polish(b: Bundle, s: Sightings, iterations: int = 15, scale: float | None = None, sharpen: bool = True,
           hold: float = 1.0) -> Bundle:  # fmt: skip
    """Levenberg-Marquardt from a good start.

    Args:
        b: start.  s: observations.
        scale: of the loss, px; from the measured noise when None.
        sharpen: measure the noise again half-way.
        hold: how much more than it is worth the prior of a hinge's radius counts.
    """
    T = s.seen.shape[1]
    b = regauged(b, s)
    world, cam = positions(b, s)
    r = residuals(b, s, cam)
    for stage in range(2 if sharpen else 1):
        sigma = link_noise(r, s)
        limit = scale or ROBUST_SIGMAS * max(sigma, 0.05) * (2.0 if sharpen and stage == 0 else 1.0)
        damping = 1e-4
        loss, w = robust_loss(r, s, limit)
        for _ in range(iterations):
            priors = _Priors.of(b, s, sigma, hold, w)
            cost = loss + priors.cost(b) + priors.radius_cost(b) + priors.of_points(b)
            n = normal_equations(b, s, world, cam, r, w)
            priors.add(n, b)
            better = False
            for _ in range(5):
                S, rhs, inv = n.reduced(damping)
                # States that nothing observes stay where they are.
                S, rhs = n.held(S, rhs, T)
                S = S + damping * np.diag(np.diag(S)) + 1e-10 * np.trace(S) / len(S) * np.eye(len(S))
                try:
                    step = -np.linalg.solve(S, rhs)
                except np.linalg.LinAlgError:
                    damping *= 10
                    continue
                dX = -np.einsum("nij,nj->ni", inv, n.gp + (step @ n.C.reshape(len(step), -1)).reshape(-1, 3))
                trial = _stepped(b, n, step, dX, s.focal_std > 0)
                world_t, cam_t = positions(trial, s)
                r_t = residuals(trial, s, cam_t)
                loss_t, w_t = robust_loss(r_t, s, limit)
                cost_t = loss_t + priors.cost(trial) + priors.radius_cost(trial) + priors.of_points(trial)
                if cost_t < cost:
                    better = cost - cost_t > 1e-7 * cost
                    b, world, cam, r, w, loss = trial, world_t, cam_t, r_t, w_t, loss_t
                    damping = max(damping / 10, 1e-9)
                    break
                damping = max(damping * 10, 1e-6)
            if not better:
                break
            if (same := regauged(b, s)) is not b:
                b = same
                world, cam = positions(b, s)
    return replace(b, cost=loss + _Priors.of(b, s, sigma).cost(b), sigma=link_noise(r, s))


def regauged(b: Bundle, s: Sightings) -> Bundle:
    """The same motion with the link at depth 1 and the anchor at its middle, if they have gone elsewhere.

    Nothing in the pictures of a resting camera holds the scale, nor does a scene whose points and cameras are unknown;
    steps along it carry the link away from the anchor, and seen from far off every twist looks the same.
    """
    X = b.X if s.link is None else b.X[s.link]
    tw, unit = b.twist, float(np.median(X[:, 2]))
    # A link behind the camera has no depth to be brought to 1.
    if not s.scaleless or unit <= 1e-9:
        return b
    away = anchor_of(b.kind, X, tw.axis, tw.anchor if b.kind == "prismatic" else tw.point)
    size = extent(X, 0.1)
    if abs(np.log(unit)) < GAUGE and np.linalg.norm(tw.anchor - away) < max(size, 1e-9):
        return b
    velocity = tw.direction + np.cross(tw.curvature, away - tw.anchor)
    speed = float(np.linalg.norm(velocity))
    if speed < 1e-12:
        return b
    twist = Twist(away / unit, velocity / speed, tw.curvature / speed * unit)
    shift = None if b.t is None else b.t / unit
    return replace(b, twist=twist, q=b.q * speed / unit, X=b.X / unit, t=shift)


def anchor_of(kind: str, X: np.ndarray, axis: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(3,) the middle of a link's points (N, 3), or beside it where the axis goes through the middle (a knob)."""
    middle = np.median(X, axis=0)
    if kind == "prismatic":
        return middle
    across = (X - point) - np.outer((X - point) @ axis, axis)
    radius = float(np.sqrt(np.median(np.sum(across**2, axis=1))))
    out = np.median(across, axis=0)
    if np.linalg.norm(out) < 0.3 * radius:
        far = across[np.argmax(np.linalg.norm(across, axis=1))]
        return middle - out + far * radius / np.linalg.norm(far)
    return middle


def _stepped(b: Bundle, n: Normal, step: np.ndarray, dX: np.ndarray, focal: bool) -> Bundle:
    T, A, G = len(b.q), n.lead, n.Z.shape[1]
    limit = 0.5 * np.linalg.norm(b.X, axis=1, keepdims=True)
    size = np.linalg.norm(dX, axis=1, keepdims=True)
    X = b.X + dX * np.minimum(1.0, limit / np.maximum(size, 1e-12))
    q = b.q + step[A : A + T]
    twist = b.twist.moved(n.Z @ step[:G], b.kind)
    log_focal = b.log_focal + (float(step[G]) if focal else 0.0)
    b = replace(b, twist=twist, q=q - q[0], X=X, log_focal=log_focal)
    if len(step) == A + T:
        return b
    by_camera = step[A + T :].reshape(T, 6).copy()
    by_camera[0] = 0.0
    return replace(b, R=Rotation.from_rotvec(by_camera[:, :3]).as_matrix() @ b.R, t=b.t + by_camera[:, 3:])


def place_points(b: Bundle, s: Sightings, rounds: int = 6) -> Bundle:
    """Every track's point for a given motion: robust Gauss-Newton on each alone, from the depth of the others.

    Args:
        b: joint and states; its X are the starts, (N, 3).
        s: observations of N tracks.
    """
    limit = ROBUST_SIGMAS * max(b.sigma, 0.05)
    for k in range(rounds):
        world, cam = positions(b, s)
        r = residuals(b, s, cam)
        _, w = robust_loss(r, replace(s, weight=np.ones(len(s.weight))), limit * (8.0, 4.0, 2.0, 1.0)[min(k, 3)])
        f = s.focal * np.exp(b.log_focal)
        z = np.maximum(cam[..., 2], 1e-3)
        P = np.zeros((*z.shape, 2, 3))
        P[..., 0, 0] = P[..., 1, 1] = f / z
        P[..., 0, 2], P[..., 1, 2] = -f * cam[..., 0] / z**2, -f * cam[..., 1] / z**2
        P = held(P, s.slip)
        camera = s.R if b.R is None else b.R
        J = (P if camera is None else P @ camera) @ b.twist.pose(b.q)[0]
        if s.link is not None:
            J[~s.link] = (P if camera is None else P @ camera)[~s.link]
        H = np.einsum("nt,ntij,ntik->njk", w, J, J, optimize=True)
        g = np.einsum("nt,ntij,nti->nj", w, J, r, optimize=True)
        H += (1e-4 * np.trace(H, axis1=1, axis2=2) / 3 + 1e-12)[:, None, None] * np.eye(3)
        for more in (Reach.of(b, s, b.sigma).slopes(b.X), Flat.of(b, s, b.sigma).slopes(b)):
            H, g = H + more[0], g + more[1]
        # What no frame shows has nothing but the prior of its depth.
        H += (1e-9 * np.trace(H, axis1=1, axis2=2))[:, None, None] * np.eye(3)
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        limit_step = 0.4 * np.linalg.norm(b.X, axis=1)
        step *= np.minimum(1, limit_step / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
        b = replace(b, X=b.X + step)
    return b
