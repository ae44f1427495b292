"""Photometric bundle adjustment of one joint: the grey values of a link's faces in all frames at once.

Unknown: the twist, the state in every frame, a plane for every face and, where it is not given, the focal length. The
picture of the faces themselves, and how light falls on them in every frame (a surface of second order and the contrast
of that picture), are linear and eliminated by alternating projections. After Alismail, Browning and Lucey,
"Photometric bundle adjustment for vision-based SLAM" (ACCV 2016), and Engel, Koltun and Cremers, "Direct sparse
odometry" (PAMI 2018), with one joint in place of free cameras and planes in place of points.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from reconstruct.joint.twist import Twist
from reconstruct.joint.uncertainty import Spread

BLUR = 1.0
"""Standard deviation, px, by which pictures are smoothed: between raw pixels bilinear reading smoothes noise, and whole
pixels would be avoided."""
LOSS = 2.5
"""Scale of the loss (Geman-McClure) in standard deviations of the grey values' noise."""
LEAST_NOISE = 0.05
SHADINGS = 7
"""Of a face in a frame: level, two slopes, three curvatures, contrast."""
PROJECTIONS = 3
STEPS, DONE = 25, 3e-6
"""Steps at most, and the share of the cost below which a step's gain ends them."""
LEAST_INVERSE = 0.05
"""Inverse depth, in that of the link, below which a plane has left it."""
BLOCK = 24
"""Side, px, of the neighbourhoods whose errors are taken to be shared."""
MODEL = 2.0
"""Errors over what noise explains, of rendered links (docs/notes/joint.md): faces are not quite plane, light moves on
them in more than seven ways, and pixels beside them go along now and then."""


@dataclass(frozen=True)
class Pictures:
    """What the tracks were followed in.

    Attributes:
        grey: (T, h, w) uint8.  covered: (T, h, w) bool, under hands.  centre: (2,) px, the principal point.
    """

    grey: np.ndarray
    covered: np.ndarray
    centre: np.ndarray


@dataclass(frozen=True)
class Surface:
    """A joint before a resting camera, and the faces of the link that it moves.

    Attributes:
        kind: "revolute".  twist: in the camera's frame.  q: (T,) path length at its anchor.
        log_focal: correction of the focal length's logarithm.
        planes: (F, 3) a, b, c of inverse depths a + b x + c y in one frame, x and y in focal lengths from the centre.
        frame: that frame, an index into q: the faces' pixels are named by where they are there.
    """

    kind: str
    twist: Twist
    q: np.ndarray
    log_focal: float
    planes: np.ndarray
    frame: int

    def inverse_depths(self, xy: np.ndarray, face: np.ndarray, focal: float) -> np.ndarray:
        """(N,) of pixels xy (N, 2), px from the centre, on faces (N,)."""
        xy = xy / (focal * np.exp(self.log_focal))
        return self.planes[face, 0] + np.sum(self.planes[face, 1:] * xy, axis=1)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _read(images: np.ndarray, covered: np.ndarray, at: np.ndarray, slopes: bool,
          value: np.ndarray, right: np.ndarray, down: np.ndarray) -> None:  # fmt: skip
    """Grey values and their derivatives at (T, N, 2) places by bilinear interpolation; NaN outside or covered."""
    T, N = at.shape[0], at.shape[1]
    h, w = images.shape[1], images.shape[2]
    for t in range(T):
        for n in range(N):
            x, y = at[t, n, 0], at[t, n, 1]
            if not (x >= 2.0 and y >= 2.0 and x < w - 3.0 and y < h - 3.0):
                value[t, n] = np.nan
                continue
            i, j = int(y), int(x)
            a, b = y - i, x - j
            if covered[t, int(y + 0.5), int(x + 0.5)]:
                value[t, n] = np.nan
                continue
            im = images[t]
            value[t, n] = (1 - a) * ((1 - b) * im[i, j] + b * im[i, j + 1]) + a * (
                (1 - b) * im[i + 1, j] + b * im[i + 1, j + 1])  # fmt: skip
            if slopes:
                r0 = (1 - b) * (im[i, j + 1] - im[i, j - 1]) + b * (im[i, j + 2] - im[i, j])
                r1 = (1 - b) * (im[i + 1, j + 1] - im[i + 1, j - 1]) + b * (im[i + 1, j + 2] - im[i + 1, j])
                right[t, n] = 0.5 * ((1 - a) * r0 + a * r1)
                d0 = (1 - a) * (im[i + 1, j] - im[i - 1, j]) + a * (im[i + 2, j] - im[i, j])
                d1 = (1 - a) * (im[i + 1, j + 1] - im[i - 1, j + 1]) + a * (im[i + 2, j + 1] - im[i, j + 1])
                down[t, n] = 0.5 * ((1 - b) * d0 + b * d1)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _project(R: np.ndarray, p: np.ndarray, X: np.ndarray, f: float, centre: np.ndarray, out: np.ndarray) -> None:
    """Pixels (T, N, 2) of points X (N, 3) carried by R (T, 3, 3) and p (T, 3), by a camera of focal length f."""
    for t in range(len(R)):
        r, o = R[t], p[t]
        for n in range(len(X)):
            x, y, z = X[n, 0], X[n, 1], X[n, 2]
            scale = f / max(r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + o[2], 1e-3)
            out[t, n, 0] = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + o[0]) * scale + centre[0]
            out[t, n, 1] = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + o[1]) * scale + centre[1]


class Reader:
    """The smoothed pictures of some frames, and where a surface's points are seen in them.

    Args:
        pictures: of a whole video.  frames: (T,) of them.  focal: px.
    """

    def __init__(self, pictures: Pictures, frames: np.ndarray, focal: float) -> None:
        import cv2

        self.images = np.stack([cv2.GaussianBlur(pictures.grey[t].astype(np.float32), (0, 0), BLUR) for t in frames])
        self.covered = pictures.covered[frames]
        self.centre, self.focal = pictures.centre, focal

    def of(self, frames: np.ndarray) -> Reader:
        """Of some of the frames."""
        some = copy(self)
        some.images, some.covered = self.images[frames], self.covered[frames]
        return some

    def places(self, s: Surface, xy: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """(T, N, 2) px at which points are seen that are seen at xy (N, 2), px from the centre, in the surface's frame.

        Args:
            inverse: (N,) their inverse depths there.
        """
        f = self.focal * np.exp(s.log_focal)
        X = np.concatenate([xy / f, np.ones((len(xy), 1))], axis=1) / inverse[:, None]
        R, p = s.twist.pose(s.q - s.q[s.frame])
        out = np.empty((len(R), len(X), 2))
        _project(R, p + s.twist.anchor - R @ s.twist.anchor, X, f, np.asarray(self.centre, float), out)
        return out

    def read(self, at: np.ndarray, slopes: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grey values at (T, N, 2) px, and their derivatives to the right and down, (T, N) each; NaN where not seen."""
        out = [np.zeros(at.shape[:2], np.float32) for _ in range(3)]
        _read(self.images, self.covered, at.astype(np.float32), slopes, *out)
        return out[0], out[1], out[2]


class Adjustment:
    """The grey values of faces' pixels, T frames by N pixels, and the joint that explains them.

    Args:
        reader: of the pictures.  xy: (N, 2) the pixels in the surface's frame, px from the centre.  face: (N,) theirs.
        share: of the faces' pixels that these are.
        focal_std: of the focal length's logarithm; 0 where it is known.
        q_std: (T,) by which states may leave where they start: what holds those whose frames show nothing.
    """

    def __init__(self, reader: Reader, xy: np.ndarray, face: np.ndarray, share: float, focal_std: float,
                 q_std: np.ndarray) -> None:  # fmt: skip
        self.reader, self.xy, self.face = reader, xy, face
        # So many pixels weigh against a prior as one: smoothing has made the errors of neighbours alike.
        self.alike = MODEL**2 * max(1.0, 4 * np.pi * BLUR**2 * share)
        self.focal_std, self.q_std = focal_std, q_std
        self.groups = []
        for k in np.unique(face):
            on = np.flatnonzero(face == k)
            x, y = ((xy[on] - xy[on].mean(0)) / np.maximum(xy[on].std(0), 1e-6)).T
            # The last is the face's own picture: light that falls on it from another side changes its contrast.
            basis = np.stack([np.ones(len(on)), x, y, x * x, x * y, y * y, 0 * x], axis=1).astype(np.float32)
            self.groups.append((on, basis))

    def places(self, s: Surface, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """(T, N, 2) px at which the faces' points are seen that are seen ``shift`` beside the pixels."""
        xy = self.xy + shift
        return self.reader.places(s, xy, s.inverse_depths(xy, self.face, self.reader.focal))

    def slopes(self, s: Surface, gx: np.ndarray, gy: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (T, N) of the faces' own picture as each frame shows it.

        Those of a single frame are noise as much as paint, and normal matrices of them claim to know what they do not.
        """
        h = 0.5
        a, c = np.moveaxis((self.places(s, (h, 0.0)) - self.places(s, (-h, 0.0))) / (2 * h), -1, 0)
        b, d = np.moveaxis((self.places(s, (0.0, h)) - self.places(s, (0.0, -h))) / (2 * h), -1, 0)
        total = np.maximum(w.sum(0), 1e-6)
        x, y = (w * (a * gx + c * gy)).sum(0) / total, (w * (b * gx + d * gy)).sum(0) / total
        det = a * d - b * c
        det = np.where(np.abs(det) > 1e-3, det, 1e-3)
        return (d * x - c * y) / det, (a * y - b * x) / det

    def shading(self, w: np.ndarray) -> list[np.ndarray]:
        """Inverses (T, 7, 7) of the normal matrices of every face's shading, by weights (T, N)."""
        out, one = [], np.eye(SHADINGS)
        for on, B in self.groups:
            A = w[:, on] @ (B[:, :, None] * B[:, None]).reshape(len(on), -1)
            A = A.reshape(-1, SHADINGS, SHADINGS).astype(float)
            ridge = 1e-4 * np.trace(A, axis1=1, axis2=2) / SHADINGS + 1e-3
            out.append(np.linalg.inv(A + ridge[:, None, None] * one))
        return out

    def draw(self, v: np.ndarray, w: np.ndarray) -> None:
        """Let shading change the contrast of the faces' own picture, as grey values v by weights w, (T, N), show it."""
        even = self.without(v, w, self.shading(w), own=False)
        own = (w * even).sum(0) / np.maximum(w.sum(0), 1e-6)
        for on, B in self.groups:
            B[:, -1] = (own[on] - own[on].mean()) / max(float(own[on].std()), 1e-6)

    def without(self, v: np.ndarray, w: np.ndarray, shading: list[np.ndarray], own: bool = True) -> np.ndarray:
        """(T, N) less what the faces' picture (own) and each frame's shading explain, by weights (T, N)."""
        out, total = v, np.maximum(w.sum(0), 1e-6)
        picture = np.zeros(v.shape[1], v.dtype)
        for _ in range(PROJECTIONS if own else 1):
            if own:
                picture = picture + (w * (out - picture)).sum(0) / total if out is not v else (w * v).sum(0) / total
            out = v.copy()
            for (on, B), inverse in zip(self.groups, shading, strict=True):
                c = np.einsum("tij,tj->ti", inverse, (w[:, on] * (v[:, on] - picture[on])) @ B)
                out[:, on] -= c.astype(v.dtype) @ B.T
        return out - (w * out).sum(0) / total if own else out

    def read(self, s: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Grey values (0 where not seen), their derivatives to the right and down, and where they are seen, (T, N)."""
        v, gx, gy = self.reader.read(self.places(s))
        seen = np.isfinite(v)
        return np.where(seen, v, 0.0), gx, gy, seen

    def settle(self, v: np.ndarray, seen: np.ndarray, noise: float | None, w: np.ndarray | None = None
               ) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
        """Residuals (T, N), robust weights, and the noise where it is not given."""
        w = seen.astype(np.float32) if w is None else w * seen
        for _ in range(2 if noise else 4):
            r = self.without(v, w, self.shading(w))
            scale = noise or max(float(1.4826 * np.median(np.abs(r[seen]))), LEAST_NOISE)
            w = (seen / (1 + (r / (LOSS * scale)) ** 2) ** 2).astype(np.float32)
        return self.without(v, w, self.shading(w)), w, scale

    def moved(self, s: Surface, Z: np.ndarray, step: np.ndarray) -> Surface:
        """A step (P,) of the twist (G), the focal length where it is unknown, the planes (3 F) and the states (T)."""
        G, F = Z.shape[1], s.planes.size
        at = G + (self.focal_std > 0)
        return replace(s, twist=s.twist.moved(Z @ step[:G], s.kind), planes=s.planes + step[at : at + F].reshape(-1, 3),
                       log_focal=s.log_focal + (float(step[G]) if self.focal_std > 0 else 0.0),
                       q=s.q + step[at + F :])  # fmt: skip

    def normal(self, s: Surface, Z: np.ndarray, start: Surface, r: np.ndarray, w: np.ndarray, gx: np.ndarray,
               gy: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Gauss-Newton matrix (P, P), gradient (P,), and every pixel's part of the gradient, (N, P).

        Args:
            Z: (6, G) the twist's tangent.  start: whose states hold those that nothing shows.
            r, w, gx, gy: (T, N) residuals, weights, and the pictures' derivatives.  noise: of grey values.
        """
        T = len(s.q)
        P = Z.shape[1] + (self.focal_std > 0) + s.planes.size
        places = self.places(s)
        shading = self.shading(w)
        gx, gy = self.slopes(s, gx, gy, w)
        J = np.empty((P, *r.shape), np.float32)
        for k in range(P):
            step = np.zeros(P + T)
            step[k] = 1e-3
            d = (self.places(self.moved(s, Z, step)) - places) / 1e-3
            J[k] = self.without((gx * d[..., 0] + gy * d[..., 1]).astype(np.float32), w, shading)
        h = 1e-3 * max(float(np.ptp(s.q)), 1e-9)
        d = (self.places(replace(s, q=_but(s.q + h, s.q, s.frame))) - places) / h
        # A frame's state touches that frame alone, and the faces' own picture a little.
        Jq = self.without((gx * d[..., 0] + gy * d[..., 1]).astype(np.float32), w, shading, own=False)
        H, g = np.zeros((P + T, P + T)), np.zeros(P + T)
        wJ = (w * J).reshape(P, -1)
        H[:P, :P] = wJ @ J.reshape(P, -1).T
        g[:P] = wJ @ r.ravel()
        wJq = w * Jq
        H[:P, P:] = np.einsum("ptn,tn->pt", J, wJq)
        H[P:, :P] = H[:P, P:].T
        M = wJq / np.sqrt(np.maximum(w.sum(0), 1e-6))
        H[P:, P:] = np.diag(np.sum(wJq * Jq, axis=1)) - M @ M.T
        g[P:] = np.sum(wJq * r, axis=1)
        scores = np.concatenate([np.sum(w * J * r, axis=1).T, (wJq * r).T], axis=1)
        # What is known besides.
        white = noise**2 * self.alike
        prior = white / np.maximum(self.q_std, 1e-9) ** 2
        H[P:, P:] += np.diag(prior)
        g[P:] += prior * (s.q - start.q)
        if self.focal_std > 0:
            G = Z.shape[1]
            H[G, G] += white / self.focal_std**2
            g[G] += white / self.focal_std**2 * s.log_focal
        return H, g, scores

    def solve(self, s: Surface, steps: int = STEPS) -> tuple[Surface, float]:
        """Levenberg-Marquardt with weights that follow the residuals.

        Args:
            s: start.  steps: at most.

        Returns:
            The surface, and the noise of one smoothed pixel, grey values.
        """
        start, damping = s, 1e-3
        v, gx, gy, seen = self.read(s)
        self.draw(v, seen.astype(np.float32))
        r, w, noise = self.settle(v, seen, None)
        for _ in range(steps):
            Z = s.twist.tangent(s.kind)
            H, g, _ = self.normal(s, Z, start, r, w, gx, gy, noise)
            still = len(g) - len(s.q) + s.frame
            H[still], H[:, still], g[still] = 0.0, 0.0, 0.0
            H[still, still] = 1.0
            cost, better = _mean_square(r, w), False
            for _ in range(6):
                D = np.diag(H)
                step = -np.linalg.solve(H + np.diag(damping * D + 1e-12 * D.max()), g)
                trial = self.moved(s, Z, step)
                if np.min(trial.inverse_depths(self.xy, self.face, self.reader.focal)) < LEAST_INVERSE:
                    damping *= 8
                    continue
                new = self.read(trial)
                by = w * new[3]
                less = _mean_square(self.without(new[0], by, self.shading(by)), by)
                if less < cost and new[3].sum() > 0.9 * seen.sum():
                    better = cost - less > DONE * cost
                    s, (v, gx, gy, seen) = trial, new
                    r, w, _ = self.settle(v, seen, noise, w)
                    damping = max(damping / 5, 1e-7)
                    break
                damping *= 8
            if not better:
                break
        return s, noise


def _mean_square(r: np.ndarray, w: np.ndarray) -> float:
    return float(np.sum(w * r * r) / max(float(w.sum()), 1e-9))


def _but(values: np.ndarray, others: np.ndarray, k: int) -> np.ndarray:
    out = values.copy()
    out[k] = others[k]
    return out


def _summary(s: Surface, xy: np.ndarray, face: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axis (3,), its point nearest to the faces' middle (3,) and states (T,); the faces' mean depth is the unit."""
    inverse = s.inverse_depths(xy, face, focal)
    X = np.concatenate([xy / (focal * np.exp(s.log_focal)), np.ones((len(xy), 1))], axis=1) / inverse[:, None]
    unit = float(np.mean(X[:, 2]))
    tw, middle = s.twist, X.mean(0) / unit
    c = tw.point / unit
    return tw.axis, c + tw.axis * (tw.axis @ (middle - c)), (s.q - s.q[0]) * float(np.linalg.norm(tw.curvature))


def spread_of(a: Adjustment, s: Surface) -> Spread:
    """Covariances at the optimum: of white noise as smoothing left it, and of blocks that err each in its own way.

    Of both the larger variance is stated, times MODEL squared; units as in :class:`Spread`, of the faces' mean depth.
    """
    v, gx, gy, seen = a.read(s)
    r, w, noise = a.settle(v, seen, None)
    Z = s.twist.tangent(s.kind)
    H, g, scores = a.normal(s, Z, s, r, w, gx, gy, noise)
    P, T = len(g) - len(s.q), len(s.q)
    still = P + s.frame
    H[still], H[:, still] = 0.0, 0.0
    H[still, still] = np.trace(H) / len(H)
    tw = s.twist
    # Nothing holds the scale.
    v0 = tw.direction - np.cross(tw.curvature, tw.anchor)
    rate = tw.direction @ v0
    null = np.zeros(len(g))
    null[: Z.shape[1]] = Z.T @ np.concatenate([v0 - tw.direction * rate, -tw.curvature * rate])
    null[P - s.planes.size : P] = -s.planes.ravel()
    null[P:] = (s.q - s.q[s.frame]) * rate
    null /= np.linalg.norm(null)
    B = np.linalg.inv(H + np.trace(H) * np.outer(null, null))
    key = np.floor(a.xy / BLOCK).astype(int)
    block = np.unique(np.concatenate([key, a.face[:, None]], axis=1), axis=0, return_inverse=True)[1].ravel()
    sums = np.zeros((block.max() + 1, len(g)))
    np.add.at(sums, block, scores)
    sums[:, still] = 0.0
    half = sums @ B * np.sqrt(len(sums) / max(len(sums) - 1, 1))
    white = noise**2 * a.alike
    base = _summary(s, a.xy, a.face, a.reader.focal)
    rows = [np.zeros((len(x), len(g))) for x in base]
    sizes = np.concatenate([np.full(P, 1e-5), np.full(T, 1e-5 * max(float(np.ptp(s.q)), 1e-9))])
    for k in range(len(g)):
        step = np.zeros(len(g))
        step[k] = sizes[k]
        for row, x, y in zip(rows, base, _summary(a.moved(s, Z, step), a.xy, a.face, a.reader.focal), strict=True):
            row[:, k] = (y - x) / sizes[k]

    def variance(L: np.ndarray) -> np.ndarray:
        plain = white * np.einsum("kp,pq,kq->k", L, B, L)
        return np.maximum(plain, MODEL**2 * np.sum((half @ L.T) ** 2, axis=0))

    axis = variance(rows[0])
    plain = noise**2 * np.einsum("kp,pq,kq->k", rows[0], B, rows[0]).sum()
    by_w = np.zeros((3, len(g)))
    by_w[:, : Z.shape[1]] = Z[3:]
    curvature = white * by_w @ B @ by_w.T
    G = Z.shape[1]
    focal = float(np.sqrt(variance(np.eye(len(g))[G : G + 1])[0])) if a.focal_std > 0 else 0.0
    q = np.sqrt(variance(rows[2]))
    q[0] = 0.0
    low, high = int(np.argmin(base[2])), int(np.argmax(base[2]))
    ends = np.sqrt(variance(rows[2][high : high + 1] - rows[2][low : low + 1])[0])
    stroke = float((base[2][high] - base[2][low]) / max(ends, 1e-12))
    return Spread(float(np.degrees(np.sqrt(axis.sum()))), float(np.sqrt(variance(rows[1]).sum())), q, curvature, focal,
                  float(axis.sum() / max(plain, 1e-30)), stroke)  # fmt: skip
