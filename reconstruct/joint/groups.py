"""Rigid groups among tracks of one calibrated camera, and the camera's path against each of them.

A small neighbourhood of tracks is nearly a plane, and a plane's points are known once its slope is: inverse depth is
linear in the picture. So the search is over slopes, two numbers: for each, all poses follow one after the other from
known points (resection), and the slope under which all key frames fit is right. It does not matter whether the body is
flat, which is where two views with an essential matrix fail, and the mirror image that a plane in weak perspective has
is just another slope. From there the body grows: points from poses, poses from points, further tracks that fit, and a
bundle adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reconstruct.joint.paths import held, linked_frames
from reconstruct.joint.polish import noise
from reconstruct.joint.twist import skew

DAMPINGS = 10
"""Times ten, from next to none, in one step of an adjustment: a far start (a hinge for a body that is carried freely)
needs many, and without them that body was taken to follow no better."""
MIN_GROUP = 15
KEYS = 20
SEEDS = 18
PATCH = (14, 30)
"""Tracks of a neighbourhood: small ones lie on one body, large ones hold their slope better."""
TILTS_DEG = (25.0, 45.0, 60.0, 70.0, 78.0)
GROWN = 6
"""Neighbourhoods that are grown to bodies."""
POSE_HOLDERS = 6
"""Tracks that a frame must show for a body's pose to be held there: twice what a pose needs."""
LEAST_SEEN = 4
"""Frames that have to show a track for it to be a body's."""
FINISHED = 3
"""Bodies that are looked at in all frames."""
SLOW, SLOW_WINDOWS = 4.0, 5
"""A track belongs to a body if its mean residuals over fifths of the video have no more than so many times the power
that noise would leave. A second body that turns slowly against the first can be fitted to a pixel, not to its mean."""
CLEAR = 10.0
"""Log-likelihood by which a track has to prefer one of two bodies' paths to be held against it."""
ROUNDS = 20
"""Of that at most."""
WORST = 0.4
"""Share of a body's tracks among which a second body is looked for where it holds tracks of both."""
LOSS_SIGMAS = 4.0
"""Scale of a track's loss, in standard deviations of the noise."""


@dataclass(frozen=True)
class Rigid:
    """A rigid body and the camera's path about it.

    Attributes:
        R, t: (T, 3, 3), (T, 3) body to camera; the body's frame is the first camera, its median depth 1.
        X: (N, 3) points of all tracks (meaningful for members).
        members: (N,) bool.  sigma: noise of one coordinate, px.
        cost: (N,) mean loss of each track's observations under this motion, in [0, 1]; 1 where it is not seen.
        shown: (T,) bool, frames that show enough of the body to hold its pose; between them it is interpolated.
    """

    R: np.ndarray
    t: np.ndarray
    X: np.ndarray
    members: np.ndarray
    sigma: float
    cost: np.ndarray
    shown: np.ndarray


def two_bodies(uv: np.ndarray, focal: float, seed: int = 0, asked: np.ndarray | None = None, split: bool = False
               ) -> tuple[Rigid, Rigid] | None:  # fmt: skip
    """The two largest rigid groups, every track with the one that it fits better; None if there are none.

    The first is the one that is in sight for longer, of two in sight alike the larger one. Where the motion is small
    the first group found holds tracks of both bodies: what clearly fits one path better than the other is held against
    it alone, until no track changes sides (as the EM algorithm does; Dempster, Laird and Rubin, 1977).

    Args:
        uv: (N, T, 2) px from the principal point, NaN where not seen.  focal: px.
        asked: (N,) bool, tracks that may be in them; all when None.
        split: look for the second among the tracks that the first one's motion fits worst, however well, rather than
            among those that it does not fit.
    """
    asked = np.ones(len(uv), bool) if asked is None else asked
    one = rigid_group(uv, focal, asked, seed)
    if one is None:
        return None
    other = rigid_group(uv, focal, _fitting_worst(uv / focal, one, focal) if split else asked & ~one.members, seed)
    if other is None:
        return None
    if (apart := _told_apart(uv, focal, one, other, asked)) is None and split:
        return None
    one, other = apart or (one, other)
    # Begun from tracks of both, a body's path may have come to rest beside its optimum: searched again from its own.
    again = _larger(rigid_group(uv, focal, asked & ~other.members, seed), one)
    others = _larger(rigid_group(uv, focal, asked & ~one.members, seed), other)
    if again is not one or others is not other:
        one, other = _told_apart(uv, focal, again, others, asked) or (again, others)
    one, other = begun_beside(uv, focal, one, other, asked), begun_beside(uv, focal, other, one, asked)
    if one.shown.sum() < other.shown.sum():
        # Of a scene the camera's path is asked in every frame, a link may be out of sight for a while.
        return other, one
    return one, other


def _larger(new: Rigid | None, old: Rigid) -> Rigid:
    return old if new is None or new.members.sum() <= old.members.sum() else new


def begun_beside(uv: np.ndarray, focal: float, body: Rigid, other: Rigid, asked: np.ndarray) -> Rigid:
    """The body with its path searched from the other's, where that ends at a better one.

    Bodies with a joint between them go nearly alike before a camera that goes round both, and the path before one of
    them may have come to rest beside its optimum (a flatter body that turns more).

    Args:
        uv: (N, T, 2) px from the principal point, NaN where not seen.  focal: px.
        asked: (N,) bool, tracks that may be in it.
    """
    new = regrown(uv, focal, replace(other, members=body.members), body.members)
    # Held against its own tracks: what it could take from the other body would not tell which path is right.
    x, scale = uv[body.members] / focal, LOSS_SIGMAS * max(min(new.sigma, body.sigma), 0.25)
    seen = np.isfinite(x[..., 0])
    cost = [_track_cost(x, seen, b.R, b.t, b.X[body.members], focal, scale) * seen.sum(1) for b in (body, new)]
    better = 0.5 * LOSS_SIGMAS**2 * float(np.sum(cost[0] - cost[1]))
    return regrown(uv, focal, new, asked & ~other.members) if better > CLEAR else body


def _told_apart(uv: np.ndarray, focal: float, one: Rigid, other: Rigid, asked: np.ndarray
                ) -> tuple[Rigid, Rigid] | None:  # fmt: skip
    """Two bodies held against the tracks that clearly fit the one better than the other; None if these are too few."""
    count = np.isfinite(uv[..., 0]).sum(1)
    told = None
    for _ in range(ROUNDS):
        # What fits both (short tracks, points near the hinge) is not asked.
        better = 0.5 * LOSS_SIGMAS**2 * count * (other.cost - one.cost)
        mine, theirs = asked & (better > CLEAR), asked & (better < -CLEAR)
        if min((one.members & mine).sum(), (other.members & theirs).sum()) < MIN_GROUP:
            break
        before, told = told, (regrown(uv, focal, one, mine), regrown(uv, focal, other, theirs))
        one, other = told
        if before and all(np.array_equal(a.members, b.members) for a, b in zip(before, told, strict=True)):
            break
    return told


def _fitting_worst(x: np.ndarray, body: Rigid, focal: float) -> np.ndarray:
    """(N,) bool, the members whose residuals last longest; x: rays."""
    slow = _slow(x, np.isfinite(x[..., 0]), body.R, body.t, body.X, focal, max(body.sigma, 0.1))
    return body.members & (slow >= np.quantile(slow[body.members], 1 - WORST))


def rigid_group(uv: np.ndarray, focal: float, candidates: np.ndarray, seed: int = 0) -> Rigid | None:
    """The largest rigid group among tracks.

    Args:
        uv: (N, T, 2) px from the principal point, NaN where not seen.
        focal: px.
        candidates: (N,) bool.

    Returns:
        None if no group of MIN_GROUP tracks is found.
    """
    rng = np.random.default_rng(seed)
    x = uv / focal
    keys = np.unique(np.linspace(0, uv.shape[1] - 1, KEYS).round().astype(int))
    xk = x[:, keys]
    seen = np.isfinite(xk[..., 0]) & candidates[:, None]
    long = np.flatnonzero(seen.sum(1) >= max(6, 0.5 * len(keys)))
    if len(long) < MIN_GROUP:
        long = np.flatnonzero(seen.sum(1) >= 6)
    if len(long) < MIN_GROUP:
        return None
    starts: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
    spread = farthest(xk[long], min(SEEDS, len(long)), rng)
    for n, seed_track in enumerate(long[spread]):
        patch, r = neighbours(xk, seen, seed_track, PATCH[n % len(PATCH)])
        if len(patch) < 8:
            continue
        for R, t in paths_of_patch(xk[patch], seen[patch], r, focal):
            X = triangulated(xk, seen, R, t)
            loss = _track_cost(xk, seen, R, t, X, focal, 6.0)
            starts.append((float(np.sum((1 - loss) * seen.sum(1))), R, t, patch))
    starts.sort(key=lambda s: -s[0])
    grown = [g for g in (_grow(xk, seen, R, t, patch, focal) for _, R, t, patch in starts[:GROWN]) if g is not None]
    grown.sort(key=lambda g: -g[0])
    best: Rigid | None = None
    for _, R, t, members in grown[:FINISHED]:
        body = _whole(x, candidates, keys, R, t, members, focal)
        if body is not None and (best is None or body.members.sum() > best.members.sum()):
            best = body
    return best


def regrown(uv: np.ndarray, focal: float, body: Rigid, candidates: np.ndarray) -> Rigid:
    """The same body from other tracks."""
    x = uv / focal
    T = uv.shape[1]
    keys = np.unique(np.linspace(0, T - 1, KEYS).round().astype(int))
    return _whole(x, candidates, keys, body.R[keys], body.t[keys], body.members & candidates, focal) or body


def farthest(xk: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Indices of tracks that lie far from each other in some picture (farthest-point sampling)."""
    filled = np.nan_to_num(xk - np.nanmean(xk, axis=1, keepdims=True)) + np.nanmean(xk, axis=1, keepdims=True)
    flat = filled.reshape(len(xk), -1)
    chosen = [int(rng.integers(len(xk)))]
    gap = np.full(len(xk), np.inf)
    for _ in range(count - 1):
        gap = np.minimum(gap, np.linalg.norm(flat - flat[chosen[-1]], axis=1))
        # Strays are far from everything: of the far ones, a random one.
        far = np.argsort(-gap)[: max(2, len(gap) // 4)]
        chosen.append(int(rng.choice(far)))
    return np.array(chosen)


def neighbours(xk: np.ndarray, seen: np.ndarray, track: int, count: int) -> tuple[np.ndarray, int]:
    """Tracks that stay near one in all pictures, and the key frame that sees most of them."""
    both = seen & seen[track]
    enough = both.sum(1) >= max(5, 0.6 * seen[track].sum())
    gap = np.where(both, np.linalg.norm(np.nan_to_num(xk - xk[track]), axis=-1), 0.0).max(1)
    gap[~enough] = np.inf
    order = np.argsort(gap)[:count]
    order = order[np.isfinite(gap[order])]
    return order, int(np.argmax(seen[order].sum(0))) if len(order) else 0


def paths_of_patch(x: np.ndarray, seen: np.ndarray, r: int, focal: float, keep: int = 2):
    """The camera's path about a nearly flat patch: the best slopes' (R, t), the patch's depth about 1.

    Args:
        x: (n, K, 2) rays.  seen: (n, K) bool.  r: key frame in which the slope is written.
    """
    use = seen[:, r]
    x, seen = np.nan_to_num(x[use]), seen[use]
    if len(x) < 6:
        return []
    K = x.shape[1]
    tilt = np.tan(np.radians(TILTS_DEG))
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    slopes = (tilt[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)).reshape(-1, 2)
    slopes = np.concatenate([[[0.0, 0.0]], slopes])
    middle = np.median(x[:, r], axis=0)
    inverse = 1 + (x[:, r] - middle) @ slopes.T  # (n, S)
    slopes, inverse = slopes[(inverse > 0.2).all(0)], inverse[:, (inverse > 0.2).all(0)]
    if not len(slopes):
        return []
    X = np.concatenate([x[:, r], np.ones((len(x), 1))], axis=1)[None] / inverse.T[..., None]  # (S, n, 3)
    S = len(slopes)
    R, t = np.tile(np.eye(3), (S, K, 1, 1)), np.zeros((S, K, 3))
    loss = np.zeros((S, K))
    for order in (range(r + 1, K), range(r - 1, -1, -1)):
        at = r
        for k in order:
            R[:, k], t[:, k] = R[:, at], t[:, at]
            if seen[:, k].sum() >= 5:
                R[:, k], t[:, k], loss[:, k] = resect(X, x[None, :, k], seen[None, :, k], R[:, k], t[:, k], focal, 5)
            at = k
    counted = seen.sum(0) >= 5
    total = loss[:, counted].mean(1)
    best = []
    for s in np.argsort(total):
        if all(np.linalg.norm(slopes[s] - slopes[b]) > 0.5 * (1 + np.linalg.norm(slopes[b])) for b in best):
            best.append(int(s))
        if len(best) == keep:
            break
    out = []
    for s in best:
        points, rotation, shift = X[s], R[s], t[s]
        for _ in range(3):
            points = triangulated(x, seen, rotation, shift, points)
            rotation, shift, _ = resect(points[None], x.swapaxes(0, 1), seen.T, rotation, shift, focal, 3)
        out.append((rotation, shift))
    return out


def resect(X: np.ndarray, x: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray, focal: float, rounds: int,
           scale: float = 4.0, slip: np.ndarray | None = None):  # fmt: skip
    """Many poses from known points at once: robust Gauss-Newton from nearby starts.

    Args:
        X: (B or 1, n, 3) points.  x: (B or 1, n, 2) rays.  seen: (B or 1, n) bool.
        R, t: (B, 3, 3), (B, 3) starts.  scale: of the loss, px.  slip: (B, n, 2) as in paths.py.

    Returns:
        R, t, and (B,) mean loss in [0, 1] (Geman-McClure).
    """
    x = np.nan_to_num(x)
    for _ in range(rounds):
        Y = X @ np.swapaxes(R, -1, -2) + t[:, None]
        z = np.maximum(Y[..., 2], 1e-2)
        r = held((Y[..., :2] / z[..., None] - x) * focal, slip)
        w = seen * (scale**2 / (scale**2 + np.sum(r**2, axis=-1))) ** 2
        P = np.zeros((*z.shape, 2, 3))
        P[..., 0, 0] = P[..., 1, 1] = focal / z
        P[..., 0, 2], P[..., 1, 2] = -focal * Y[..., 0] / z**2, -focal * Y[..., 1] / z**2
        J = held(np.concatenate([P @ -skew(Y - t[:, None]), P], axis=-1), slip)
        flat = J.reshape(len(J), -1, 6)
        wJ = (w[..., None, None] * J).reshape(len(J), -1, 6)
        H = np.swapaxes(wJ, 1, 2) @ flat
        g = (np.swapaxes(wJ, 1, 2) @ r.reshape(len(r), -1, 1))[..., 0]
        diagonal = np.einsum("bii->bi", H)
        H = H + (1e-6 * diagonal + 1e-9 * diagonal.max(1, keepdims=True) + 1e-9)[..., None] * np.eye(6)
        d = -np.linalg.solve(H, g[..., None])[..., 0]
        d *= np.minimum(1, 0.3 / np.maximum(np.abs(d).max(1, keepdims=True), 1e-9))
        R, t = Rotation.from_rotvec(d[:, :3]).as_matrix() @ R, t + d[:, 3:]
    Y = X @ np.swapaxes(R, -1, -2) + t[:, None]
    r2 = np.sum(held((Y[..., :2] / np.maximum(Y[..., 2:], 1e-2) - x) * focal, slip) ** 2, axis=-1)
    loss = np.sum(seen * r2 / (scale**2 + r2), axis=1) / np.maximum(np.sum(seen + 0 * r2, axis=1), 1)
    return R, t, loss


def triangulated(x: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray, X: np.ndarray | None = None,
                  px: float = 0.006, slip: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
    """(N, 3) points from poses: linear over all frames, reweighted by depth and residual.

    Args:
        px: scale of the residual's weight, ray units.  X: starts; from the rays alone when None.
        slip: (N, K, 2) as in paths.py.
    """
    x = np.nan_to_num(x)
    rows = held(x[..., :, None] * R[None, :, 2:3] - R[None, :, :2], slip)  # (N, K, 2, 3): row . X = t_xy - x t_z
    rhs = held(t[None, :, :2] - x * t[None, :, 2:], slip)
    for sweep in range(3 if X is None else 2):
        w = seen.astype(float)
        if X is not None:
            Y = np.einsum("kij,nj->nki", R, X) + t
            z = np.maximum(Y[..., 2:], 1e-2)
            e2 = np.sum(held(Y[..., :2] / z - x, slip) ** 2, axis=-1)
            w = w / z[..., 0] ** 2 / (1 + e2 / (px * (4.0, 2.0, 1.0)[min(sweep, 2)]) ** 2) ** 2
        wr = w[..., None, None] * rows
        A = wr.reshape(len(x), -1, 3).swapaxes(1, 2) @ rows.reshape(len(x), -1, 3)
        b = (wr.reshape(len(x), -1, 3).swapaxes(1, 2) @ (-rhs).reshape(len(x), -1, 1))[..., 0]
        # x (R2 X + tz) = R X + t  ->  (x R2 - R01) X = t01 - x tz
        b = -b
        damp = (1e-9 * np.trace(A, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
        X = np.linalg.solve(A + damp, b[..., None])[..., 0]
    return X


def _residuals2(x: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray, X: np.ndarray, focal: float):
    """(N, K) squared px, 0 where not seen; huge behind the camera."""
    Y = np.einsum("kij,nj->nki", R, X) + t
    r2 = np.sum(((Y[..., :2] / np.maximum(Y[..., 2:], 1e-2) - np.nan_to_num(x)) * focal) ** 2, axis=-1)
    return np.where(seen, np.where(Y[..., 2] > 1e-2, r2, 1e6), 0.0)


def _track_cost(x, seen, R, t, X, focal, scale: float) -> np.ndarray:
    r2 = _residuals2(x, seen, R, t, X, focal)
    count = seen.sum(1)
    cost = np.sum(np.where(seen, r2 / (scale**2 + r2), 0.0), axis=1) / np.maximum(count, 1)
    return np.where(count >= LEAST_SEEN, cost, 1.0)


def _members(x, seen, R, t, X, focal, px: float) -> np.ndarray:
    r2 = np.where(seen, _residuals2(x, seen, R, t, X, focal), np.nan)
    out = np.zeros(len(x), bool)
    enough = seen.sum(1) >= LEAST_SEEN
    out[enough] = np.nanmedian(r2[enough], axis=1) < px**2
    return out


def _slow(x: np.ndarray, seen: np.ndarray, R: np.ndarray, t: np.ndarray, X: np.ndarray, focal: float,
          sigma: float) -> np.ndarray:  # fmt: skip
    """(N,) median power of the residuals' means over stretches of the video, 1 for white noise."""
    Y = np.einsum("kij,nj->nki", R, X) + t
    r = (Y[..., :2] / np.maximum(Y[..., 2:], 1e-2) - np.nan_to_num(x)) * focal
    use = seen & (np.sum(r**2, axis=-1) < (6 * sigma) ** 2)
    r = np.where(use[..., None], r, 0.0)
    cuts = np.linspace(0, x.shape[1], SLOW_WINDOWS + 1).round().astype(int)[:-1]
    total, count = np.add.reduceat(r, cuts, axis=1), np.add.reduceat(use, cuts, axis=1)
    power = np.sum(total**2, axis=-1) / (np.maximum(count, 1) * sigma**2) / (2 * np.log(2))
    enough = count >= 0.3 * np.diff([*cuts, x.shape[1]])
    out = np.full(len(x), np.inf)
    some = enough.any(1)
    out[some] = np.nanmedian(np.where(enough, power, np.nan)[some], axis=1)
    return out


def _grow(x, seen, R, t, patch, focal) -> tuple[float, np.ndarray, np.ndarray, np.ndarray] | None:
    """Poses and members that agree, grown from one neighbourhood outwards; scored by explained observations."""
    members = np.zeros(len(x), bool)
    members[patch] = True
    sigma = 1.0
    for k in range(7):
        m = np.flatnonzero(members)
        if len(m) > 100:
            m = m[np.linspace(0, len(m) - 1, 100).round().astype(int)]
        P = triangulated(x[m], seen[m], R, t)
        for _ in range(2):
            R, t, _ = resect(P[None], x[m].swapaxes(0, 1), seen[m].T, R, t, focal, 3)
            P = triangulated(x[m], seen[m], R, t, P)
        R, t, _, sigma = adjust(x[m], seen[m], R, t, P, focal, iterations=4)
        X = triangulated(x, seen, R, t)
        # What a small neighbourhood leaves open is small near it: the body grows as its path becomes known.
        limit = max(2.5 * sigma, (3.0, 2.5, 2.0)[min(k, 2)])
        members = _members(x, seen, R, t, X, focal, limit)
        if members.sum() < MIN_GROUP // 2:
            return None
    loss = _track_cost(x, seen, R, t, X, focal, 4 * sigma)
    return float(np.sum(np.clip(1 - 2 * loss, 0, 1) * seen.sum(1))), R, t, members


def _whole(x, candidates, keys, R, t, members, focal) -> Rigid | None:
    """From key frames to all frames."""
    R, t = between(R, t, keys, x.shape[1])
    seen = np.isfinite(x[..., 0])
    some = seen & candidates[:, None]
    sigma = 1.0
    for k in range(6):
        m = np.flatnonzero(members)
        if len(m) < MIN_GROUP:
            return None
        if len(m) > 150:
            m = m[np.linspace(0, len(m) - 1, 150).round().astype(int)]
        P = triangulated(x[m], seen[m], R, t)
        if k == 0:
            for _ in range(2):
                R, t, _ = resect(P[None], x[m].swapaxes(0, 1), seen[m].T, R, t, focal, 2)
                P = triangulated(x[m], seen[m], R, t, P)
        R, t, P, sigma = adjust(x[m], seen[m], R, t, P, focal, iterations=8)
        X = triangulated(x, seen, R, t)
        fits = _members(x, some, R, t, X, focal, max(2.5 * sigma, 1.0)) & (X[:, 2] > 0.02)
        slow = _slow(x, some, R, t, X, focal, max(sigma, 0.1))
        # Real errors last: then the better half sets the measure. Of two bodies in one it is nearer to one of them.
        usual = max(float(np.median(slow[fits])) if fits.any() else 1.0, 1.0)
        members = fits & (slow < (1.0, 1.0, SLOW)[min(k, 2)] * usual)
    # The first camera is the frame, the body's median depth the unit.
    X = X @ R[0].T + t[0]
    t = t - np.einsum("tij,jk,k->ti", R, R[0].T, t[0])
    R = R @ R[0].T
    unit = float(np.median(X[members, 2]))
    if unit <= 0:
        return None
    cost = _track_cost(x, seen, R, t, X, focal, LOSS_SIGMAS * max(sigma, 0.25))
    members, shown = _in_one_piece(seen, members)
    if shown.sum() < 2 or members.sum() < MIN_GROUP:
        return None
    R, t = between(R[shown], t[shown], np.flatnonzero(shown), len(R))
    return Rigid(R, t / unit, X / unit, members, sigma, cost, shown)


def _in_one_piece(seen: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) members and (T,) frames of the largest part of a body whose frames chains of tracks hold to each other.

    What is in sight before a gap and what is after it fit one path whatever lies between them: a lid's outer face, and
    its inner one.
    """
    part = linked_frames(seen[members], POSE_HOLDERS)
    shown = part >= 0
    if shown.any():
        shown = part == np.argmax(np.bincount(part[shown], weights=seen[members].sum(0)[shown]))
    return members & (seen[:, shown].sum(1) >= LEAST_SEEN), shown


def between(R: np.ndarray, t: np.ndarray, known: np.ndarray, T: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 3, 3), (T, 3) of all frames from those (k, 3, 3), (k, 3) of the frames ``known`` (k,): between the ones
    around, and beyond the outermost like these."""
    every = np.clip(np.arange(T), known[0], known[-1])
    turned = Slerp(known, Rotation.from_matrix(R))(every).as_matrix()
    return turned, np.stack([np.interp(every, known, t[:, k]) for k in range(3)], axis=1)


def adjust(x, seen, R, t, X, focal, iterations: int = 8, slip=None):
    """Robust bundle adjustment of all poses but the first, and points (Schur complement).

    Args:
        x: (N, T, 2) rays.  seen: (N, T) bool.  R, t: (T, 3, 3), (T, 3) body to camera.  X: (N, 3).
        slip: (N, T, 2) as in paths.py.

    Returns:
        R, t, X and the noise of one coordinate, px.
    """
    T = len(R)
    x, P = np.nan_to_num(x), X.copy()
    N = len(x)
    damping = 1e-7  # the weak direction (a flatter body that turns more) is this weak

    def project(R, t, P):
        Y = np.einsum("tij,nj->nti", R, P) + t
        r = held((Y[..., :2] / np.maximum(Y[..., 2:], 1e-3) - x) * focal, slip)
        return Y, np.where(seen[..., None], r, 0.0)

    Y, r = project(R, t, P)
    sigma = 1.0
    for step in range(iterations):
        r2 = np.sum(r**2, axis=-1)
        sigma = max(noise(r, seen), 0.01)
        scale = 4.0 * sigma * (2.0 if step < 2 else 1.0)
        g = scale**2 / (scale**2 + r2)
        w, cost = seen * g**2, float(np.sum(seen * scale**2 * (1 - g)))
        z = np.maximum(Y[..., 2], 1e-3)
        J = np.zeros((N, T, 2, 3))
        J[..., 0, 0] = J[..., 1, 1] = focal / z
        J[..., 0, 2], J[..., 1, 2] = -focal * Y[..., 0] / z**2, -focal * Y[..., 1] / z**2
        J = held(J, slip)
        Jc = np.concatenate([J @ -skew(Y - t), J], axis=-1)  # (N, T, 2, 6)
        Jx = J @ R
        wJc = w[..., None, None] * Jc
        Hc = np.einsum("ntia,ntib->tab", wJc, Jc, optimize=True)
        gc = np.einsum("ntia,nti->ta", wJc, r)
        Hx = np.einsum("nt,ntia,ntib->nab", w, Jx, Jx, optimize=True)
        gx = np.einsum("nt,ntia,nti->na", w, Jx, r, optimize=True)
        C = np.swapaxes(wJc, -1, -2) @ Jx  # (N, T, 6, 3)
        for _ in range(DAMPINGS):
            inv = np.linalg.inv(Hx + (damping * np.einsum("nii->ni", Hx) + 1e-9)[..., None] * np.eye(3))
            flat = C.reshape(N, 6 * T, 3)
            CI = flat @ inv
            S = -np.tensordot(CI, flat, axes=([0, 2], [0, 2]))
            for k in range(T):
                S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += Hc[k]
            rhs = gc.ravel() - np.einsum("npj,nj->p", CI, gx)
            typical = np.trace(S) / len(S)
            S[:6], S[:, :6], rhs[:6] = 0.0, 0.0, 0.0  # the first camera is the frame
            S += np.diag(damping * np.abs(np.diag(S)) + 1e-12 * typical + typical * (np.arange(len(S)) < 6))
            dc = -np.linalg.solve(S, rhs)
            dx = -np.einsum("nab,nb->na", inv, gx + np.einsum("ntab,ta->nb", C, dc.reshape(T, 6)))
            turn = Rotation.from_rotvec(dc.reshape(T, 6)[:, :3]).as_matrix()
            R2, t2, P2 = turn @ R, t + dc.reshape(T, 6)[:, 3:], P + dx
            Y2, r_2 = project(R2, t2, P2)
            cost2 = float(np.sum(seen * scale**2 * (1 - scale**2 / (scale**2 + np.sum(r_2**2, axis=-1)))))
            if cost2 < cost:
                R, t, P, Y, r = R2, t2, P2, Y2, r_2
                damping = max(damping / 10, 1e-9)
                break
            damping *= 10
        else:
            break
    return R, t, P, sigma
