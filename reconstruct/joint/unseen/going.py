"""What goes with a link whose joint is known: tracks by their depths, and its straight edges as lines in space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.flat_edges import edge_of
from reconstruct.joint.models import JointFit, joint_transform
from reconstruct.joint.paths import Paths, held
from reconstruct.joint.polish import HOLDERS
from reconstruct.joint.unseen.outline import MOST, SPACING_PX, WORTH, Outline
from reconstruct.video import Video

DEPTHS, BEYOND = 41, 0.5
"""Depths that are tried of a point, from the nearest to the farthest of the link's and so much of its size beyond."""
SCALE = 1.0
"""Of the loss, working px."""
LIFE, LOOKED_AT, GAIN = 4, 16, 3.0
"""Known frames that have to show a track, those that are looked at, and in how many of these at least it has to be
where the joint has it though it would not be if it rested."""
FOLLOWS, RATHER = 0.25, 3.0
"""Mean loss over the largest one up to which a track goes as the joint says, and how many times more it has to miss
where it would rest."""
FEWEST = 2
"""Lines that an outline has at least."""
STEPS, TOO_FAR = 6, 0.1
"""Of Gauss-Newton on a line's depths, and the largest one over what is changed."""

Pose = Callable[[np.ndarray], np.ndarray]
"""States (...,) to poses (..., 4, 4) from state 0, camera frame."""


@dataclass(frozen=True)
class Going:
    """A joint in the camera's frame, and all tracks that may go with it.

    Attributes:
        kind: of the joint.  pose: of its link.  varied: of joints that are off by a standard deviation in one way each.
        paths: N tracks, working px from the principal point.  focal: working px.
        line: (N,) the straight edge that each is on; -1 for points.
        depths: (DEPTHS,) that the link's points may have.
    """

    kind: str
    pose: Pose
    varied: tuple[Pose, ...]
    paths: Paths
    focal: float
    line: np.ndarray
    depths: np.ndarray

    @classmethod
    def of(cls, fit: JointFit, video: Video, points: Tracks, edges: Tracks) -> Going:
        """Of a joint up to scale, all point tracks and straight edges, without what is seen to be a shadow's."""
        h, w = video.frames.shape[1:3]
        C = np.asarray(fit.T_camera_world)
        axis = C[:3, :3] @ fit.axis
        point = None if fit.point is None else C[:3, :3] @ fit.point + C[:3, 3]
        across = np.linalg.svd(axis[None])[2][1:]

        def pose(turned: np.ndarray, moved: np.ndarray | None) -> Pose:
            return lambda q: joint_transform(fit.type, turned / np.linalg.norm(turned), moved, q, fit.pitch)

        off = np.radians(fit.std["axis_deg"]) / np.sqrt(2)
        varied = [pose(axis + off * e, point) for e in across]
        if point is not None:
            varied += [pose(axis, point + fit.std["point_m"] / np.sqrt(2) * e) for e in across]
        both = [_uncast(t) for t in (points, edges)]
        uv = np.concatenate([video.to_work(np.where(t.visible[..., None], t.uv, np.nan)) for t in both])
        slip = np.concatenate([np.zeros(t.uv.shape) if t.slip is None else t.slip for t in both])
        N = len(points.uv)
        line = edge_of(slip[N:], edges.reference)
        z = (fit.points @ C[:3, :3].T + C[:3, 3])[:, 2]
        near, far = np.quantile(z, [0.05, 0.95])
        size = float(np.linalg.norm(np.quantile(fit.points, 0.95, axis=0) - np.quantile(fit.points, 0.05, axis=0)))
        depths = np.linspace(max(near - BEYOND * size, 0.1 * near), far + BEYOND * size, DEPTHS)
        return cls(fit.type, pose(axis, point), tuple(varied), Paths(uv - [(w - 1) / 2, (h - 1) / 2], slip),
                   fit.K[0, 0] * video.scale, np.concatenate([np.full(N, -1), line]), depths)  # fmt: skip

    def residuals(self, ids: np.ndarray, first: np.ndarray, X: np.ndarray, frames: np.ndarray, q: np.ndarray,
                  pose: Pose | None = None) -> np.ndarray:  # fmt: skip
        """(n, k, m, 2) px by which points X (n, k, 3), where they are in state first (n,), miss their tracks in
        frames (m,) or (n, m) of states q, of the same shape."""
        frames, q = np.broadcast_to(frames, (len(ids), frames.shape[-1])), np.broadcast_to(q, (len(ids), q.shape[-1]))
        G = (pose or self.pose)(q - first[:, None])
        Y = np.einsum("nmij,nkj->nkmi", G[..., :3, :3], X) + G[:, None, :, :3, 3]
        p = self.focal * Y[..., :2] / np.maximum(Y[..., 2:], 1e-6)
        rows = ids[:, None]
        r = p - self.paths.uv[rows, frames][:, None]
        return held(r, np.broadcast_to(self.paths.slip[rows, frames][:, None], r.shape))

    def rays(self, ids: np.ndarray, first: np.ndarray) -> np.ndarray:
        """(n, 3) of depth 1 through tracks (n,) in a frame (n,) of each."""
        place = np.nan_to_num(self.paths.uv[ids, first])
        return np.concatenate([place / self.focal, np.ones((len(ids), 1))], axis=1)

    def together(self, members: np.ndarray, q: np.ndarray) -> np.ndarray:
        """(T,) bool: the most frames that the joint's own tracks (n,) hold together in its states (T,)."""
        T = len(q)
        laid = self.laid(members, q, np.ones(T, bool))
        X = laid.X[np.arange(len(members)), laid.cost.argmin(1)]
        r = self.residuals(members, q[laid.first], X[:, None], np.arange(T), q)[:, 0]
        near = np.sum(np.nan_to_num(r, nan=np.inf) ** 2, axis=-1) < SCALE**2
        linked = (near[:, 1:] & near[:, :-1]).sum(0) >= HOLDERS
        run = np.concatenate([[0], np.cumsum(~linked)])
        return run == np.argmax(np.bincount(run, near.sum(0)))

    def laid(self, ids: np.ndarray, q: np.ndarray, known: np.ndarray) -> Laid:
        """Tracks (n,) at all depths, by frames whose states (T,) are known."""
        shown = self.paths.seen[ids] & known
        total = shown.sum(1)
        count = np.minimum(total, LOOKED_AT)
        order = np.argsort(~shown, axis=1, kind="stable")
        step = np.maximum(total - 1, 0)[:, None] / np.maximum(count - 1, 1)[:, None]
        nth = np.minimum(np.arange(LOOKED_AT), np.maximum(count - 1, 0)[:, None])
        frames = np.take_along_axis(order, (nth * step).round().astype(int), axis=1)
        valid = (np.arange(LOOKED_AT) < count[:, None])[:, None]
        first = frames[np.arange(len(ids)), count // 2]
        X = self.depths[:, None] * self.rays(ids, first)[:, None]
        r = self.residuals(ids, q[first], X, frames, q[frames])
        cost = np.where(valid, loss(np.nan_to_num(r)), 0.0).sum(2)
        rest = np.where(valid[:, 0], loss(np.nan_to_num(self._from(ids, first, frames))), 0.0).sum(1)
        return Laid(first, X, cost, _follows(cost.min(1), rest, count))

    def _from(self, ids: np.ndarray, first: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """(n, m, 2) px by which tracks (n,) are off in frames (n, m) from where they are in a frame (n,) of each."""
        off = self.paths.uv[ids[:, None], frames] - self.paths.uv[ids, first][:, None]
        return held(off, self.paths.slip[ids[:, None], frames])

    def outline(self, q: np.ndarray, known: np.ndarray) -> Outline | None:
        """The straight edges that go as the joint says in frames whose states (T,) are known, as lines in space, or
        None if there are hardly any."""
        found = []
        shown = self.paths.seen & known
        for line in range(self.line.max(initial=-1) + 1):
            ids = np.flatnonzero((self.line == line) & shown.any(1))
            if len(ids) and (some := self._in_space(ids, q, shown[ids])) is not None:
                found.append((*some, np.full(len(some[0]), line)))
        if len(found) < FEWEST:
            return None
        X, along, line = (np.concatenate(x) for x in zip(*found, strict=True))
        weight = np.minimum(1.0, WORTH / np.bincount(line)[line])
        pick = np.unique(np.linspace(0, len(X) - 1, min(len(X), MOST)).round().astype(int))
        return Outline(X[pick], along[pick], weight[pick], line[pick])

    def _in_space(self, ids: np.ndarray, q: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """(k, 3) points in state 0 and (k, 3) direction of one edge by tracks (n,) along it, or None if it does not go
        as the joint says.

        Args:
            q: (T,).  shown: (n, T) bool, frames with known states that show them.
        """
        middle = np.flatnonzero(shown.any(0)).mean()
        ref = int(np.argmax(shown.sum(0) - 1e-3 * np.abs(np.arange(shown.shape[1]) - middle)))
        ids, shown = ids[shown[:, ref]], shown[shown[:, ref]]
        frames = np.flatnonzero(shown.any(0))
        if len(frames) < LIFE:
            return None
        frames = frames[np.unique(np.linspace(0, len(frames) - 1, min(len(frames), LOOKED_AT)).round().astype(int))]
        ends = self._ends(ids, ref, frames, q, shown[:, frames])
        if ends is None:
            return None
        uv, way = self.paths.uv[ids, ref][[0, -1]], self.paths.slip[ids[0], ref]
        length = float(np.linalg.norm(uv[1] - uv[0]))
        way = uv[1] - uv[0] if length > 0 else way / max(np.linalg.norm(way), 1e-9)
        more = SPACING_PX / max(length, 1.0)
        s = np.arange(-more, 1 + 1.5 * more, more)[:, None]
        P = np.column_stack([(uv[0] + s * way) / self.focal, np.ones(len(s))])
        P /= np.maximum((1 - s) * ends[0] + s * ends[1], 1e-6)
        back = self.pose(-q[[ref]])[0]
        return P @ back[:3, :3].T + back[:3, 3], np.gradient(P, axis=0) @ back[:3, :3].T

    def _ends(self, ids: np.ndarray, ref: int, frames: np.ndarray, q: np.ndarray, seen: np.ndarray
              ) -> np.ndarray | None:  # fmt: skip
        """(2,) inverse depths in one frame of the first and the last of an edge's tracks (n,), or None if it does not
        go as the joint says in some frames (m,) of states q[frames], seen (n, m) in these."""
        first, ray, uv = np.full(len(ids), ref), self.rays(ids, np.full(len(ids), ref)), self.paths.uv[ids, ref]
        way = uv[-1] - uv[0]
        share = (uv - uv[0]) @ way / max(float(way @ way), 1e-12)

        def miss(ends: np.ndarray) -> np.ndarray:
            # Inverse depths go linearly along a straight line's picture.
            inverse = (1 - share) * ends[0] + share * ends[1]
            r = self.residuals(ids, q[first], (ray / inverse[:, None])[:, None], frames, q[frames])[:, 0]
            return np.where(seen[..., None], np.nan_to_num(r), 0.0)

        r = self.residuals(ids, q[first], self.depths[:, None] * ray[:, None], frames, q[frames])
        cost = np.where(seen[:, None], loss(np.nan_to_num(r)), 0.0).sum(2)
        a, b = 1 / self.depths[:, None], 1 / self.depths
        step = self.depths[1] - self.depths[0]
        total = np.where((len(ids) > 1) | np.eye(DEPTHS, dtype=bool), 0.0, np.inf)
        for c, s in zip(cost, share, strict=True):
            total += c[((1 / ((1 - s) * a + s * b) - self.depths[0]) / step).round().astype(int)]
        ends = 1 / self.depths[list(np.unravel_index(int(total.argmin()), total.shape))]
        if len(ids) > 1:
            ends = _least(miss, ends)
        rest = self._from(ids, first, np.tile(frames, (len(ids), 1)))
        lost = [float(loss(np.where(seen[..., None], np.nan_to_num(x), 0.0)).sum()) for x in (miss(ends), rest)]
        return ends if _follows(*(np.array([x]) for x in (*lost, seen.sum())))[0] else None


@dataclass(frozen=True)
class Laid:
    """Tracks at all depths.

    Attributes:
        first: (n,) the frame in which each is put on its ray.  X: (n, DEPTHS, 3) there, camera frame.
        cost: (n, DEPTHS) loss, px^2.  follows: (n,) bool, which go as the joint says.
    """

    first: np.ndarray
    X: np.ndarray
    cost: np.ndarray
    follows: np.ndarray

    def of(self, rows: np.ndarray) -> Laid:
        """Some of the tracks."""
        return Laid(self.first[rows], self.X[rows], self.cost[rows], self.follows[rows])


def _least(miss: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Robust Gauss-Newton of a few numbers."""
    for _ in range(STEPS):
        r, h = miss(x), 1e-4 * np.abs(x)
        J = np.stack([(miss(x + np.eye(len(x))[k] * h[k]) - r) / h[k] for k in range(len(x))], axis=-1)
        w = trust(r)[..., None]
        A = np.einsum("nmik,nmil->kl", w[..., None] * J, J)
        step = np.linalg.solve(A + (1e-6 * np.trace(A) + 1e-12) * np.eye(len(x)), -np.einsum("nmik,nmi->k", J, w * r))
        x = x + np.clip(step, -TOO_FAR * np.abs(x), TOO_FAR * np.abs(x))
    return x


def _follows(best: np.ndarray, rest: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Whether tracks go as the joint says, by their losses in so many frames under it and where they would rest."""
    gains = (rest - best > GAIN * SCALE**2) & (rest > RATHER * best)
    return (count >= LIFE) & (best < FOLLOWS * SCALE**2 * count) & gains


def loss(r: np.ndarray) -> np.ndarray:
    """Of residuals (..., 2) px."""
    square = np.sum(r**2, axis=-1)
    return SCALE**2 * square / (SCALE**2 + square)


def trust(r: np.ndarray) -> np.ndarray:
    """Weight by the same loss."""
    return 1 / (1 + np.sum(r**2, axis=-1) / SCALE**2) ** 2


def _uncast(tracks: Tracks) -> Tracks:
    """Without what is seen to be the edge of a shadow."""
    return tracks if tracks.cast is None else replace(tracks, visible=tracks.visible & ~tracks.cast[:, None])
