"""The joint of a plate that straight edges show to turn in its plane, with the points that go with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from reconstruct.cues import Tracks
from reconstruct.joint.finish import Finished, followers
from reconstruct.joint.fit import DEFAULT_FOCAL, KNOWN_STD, PRIOR_STD
from reconstruct.joint.flat_edges import LOOKS, EdgePlate, lines_of, plates_of
from reconstruct.joint.models import JointFit
from reconstruct.joint.paths import Paths
from reconstruct.joint.plates import FLAT, in_plane
from reconstruct.joint.polish import Bundle, anchor_of, place_points, polish
from reconstruct.joint.result import MIN_INLIERS, result_of
from reconstruct.joint.twist import twist_of_joint
from reconstruct.joint.uncertainty import spread
from reconstruct.joint.view import View
from reconstruct.video import Video

SHARE, LEAST_DEG, FEWEST = 0.6, 5.0, 4
"""Of the motion of all edges what a plate has to explain, the turn by which it has to, and edges that have to follow:
lids and doors leave more, or turn by a degree."""
NEAR_DEG = 20.0
"""Axes so near to each other are told apart by no one."""
POINT_PX, POINT_LASTS = 0.2, 2.0
"""Noise of points, at least (that of edges is less), and frames for which their errors last: they are lost soon."""
TELLS = 0.1
"""Log-probability that a point which follows a plate adds to it: most do so on edges that it has already."""
PLATE = {"revolute": 0.95, "prismatic": 0.05}
"""What edges that follow a plate say of the joint's type."""


@dataclass(frozen=True)
class FlatFit:
    """fit: the joint.  probability: that the axis is within NEAR_DEG of it rather than one of the other plates'.
    share: of the motion of all edges what it explains."""

    fit: JointFit
    probability: float
    share: float


def fit_flat(video: Video, points: Tracks, edges: Tracks, focal_px: float | None = None) -> FlatFit | None:
    """The hinge of a plate that turns in its plane, or None where straight edges do not show one.

    Args:
        video: of a resting camera.
        points: point tracks, N of them.  edges: moving straight edges, as of :mod:`reconstruct.providers.edge_tracks`;
            what is ``cast`` is left out.
        focal_px: focal length in full px; the video's own or a typical one when None.

    Returns:
        A joint as one of N + M tracks, first the points.
    """
    from reconstruct.providers.edge_tracks import STEP_PX

    h, w = video.frames.shape[1:3]
    known = focal_px or video.focal_px
    full = known or DEFAULT_FOCAL * max(video.size)
    view = View(full * video.scale, 0.0 if known else PRIOR_STD)
    centre, N = np.array([(w - 1) / 2, (h - 1) / 2]), len(points.uv)
    if edges.cast is not None:
        edges = replace(edges, visible=edges.visible & ~edges.cast[:, None])
    on_points, on_edges = (_paths(video, t) - centre for t in (points, edges))
    if not on_edges.seen.any():
        return None
    lines, of = lines_of(on_edges.uv, on_edges.slip, edges.reference, STEP_PX)
    frames = np.arange(on_edges.uv.shape[1])
    lasting = max(len(frames) / LOOKS, 1.0)
    tried = []
    for plate in plates_of(lines, view.focal):
        if plate.follows.sum() < FEWEST:
            continue
        rows = np.flatnonzero(plate.follows[of])
        like = replace(view.sightings(on_edges[rows], frames, lasting), flat=FLAT, along=plate.normal)
        b = polish(_bundle(plate, on_edges[rows], edges.reference[rows], view.focal), like, 20)
        own = replace(like, lasting=POINT_LASTS)
        ids, X = followers(replace(b, sigma=max(b.sigma, POINT_PX)), on_points, np.arange(N), view, own)
        tried.append(_Tried(plate, rows, b, ids, X))
    if not tried:
        return None
    weight = np.array([t.plate.log_p + TELLS * len(t.ids) for t in tried])
    p = np.exp(weight - logsumexp(weight))
    best = tried[int(np.argmax(p))]
    plate = best.plate
    if plate.share < SHARE or np.ptp(plate.q) < np.radians(LEAST_DEG) or len(best.ids) < MIN_INLIERS:
        return None
    apart = np.array([_apart_deg(plate.normal, t.plate.normal) for t in tried])
    axis_deg = float(np.sqrt(np.sum(p * (np.array([t.plate.std_deg for t in tried]) ** 2 + apart**2))))
    every = Paths(*(np.concatenate([getattr(on_points, k)[best.ids], getattr(on_edges, k)[best.rows]])
                    for k in ("uv", "slip")))  # fmt: skip
    sight = replace(view.sightings(every, frames, lasting), flat=FLAT, along=plate.normal)
    b = polish(place_points(replace(best.bundle, X=np.concatenate([best.X, best.bundle.X])), sight), sight, 20)
    # Point and states are known as well as the axis, compared to what they are beside an axis that tracks alone hold.
    by_tracks, sure = spread(b, replace(sight, along=None)), spread(b, sight)
    ratio = axis_deg / max(by_tracks.axis_deg, 1e-9)
    sure = replace(sure, axis_deg=axis_deg, point=max(sure.point, ratio * by_tracks.point),
                   q=np.maximum(sure.q, np.minimum(ratio, 1) * by_tracks.q))  # fmt: skip
    done = Finished(b, sight, np.concatenate([best.ids, N + best.rows]), sure, PLATE, view)
    note = "; the link is taken as a plate that turns in its plane"
    fit = result_of(video, done, full, N + len(on_edges), note, KNOWN_STD if known else None)
    return FlatFit(fit, float(p[apart < NEAR_DEG].sum()), plate.share)


@dataclass(frozen=True)
class _Tried:
    """A plate that edges follow.

    Attributes:
        rows: (m,) the edges' tracks that do.  bundle: its joint by these.
        ids: (k,) points that follow it too.  X: (k, 3) where these are.
    """

    plate: EdgePlate
    rows: np.ndarray
    bundle: Bundle
    ids: np.ndarray
    X: np.ndarray


def _apart_deg(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(np.arccos(min(1.0, abs(float(one @ other))))))


def _paths(video: Video, tracks: Tracks) -> Paths:
    """Working px."""
    return Paths(video.to_work(np.where(tracks.visible[..., None], tracks.uv, np.nan)), tracks.slip)


def _bundle(plate: EdgePlate, edges: Paths, reference: np.ndarray, focal: float) -> Bundle:
    """The joint with the edges' points in the plate's plane, mean depth 1."""
    basis, rows = in_plane(plate.normal), np.arange(len(edges))
    ray = np.concatenate([edges.uv[rows, reference] / focal, np.ones((len(edges), 1))], axis=1)
    arm = (ray / (ray @ plate.normal)[:, None] - plate.point) @ basis.T
    z = (arm[:, 0] + 1j * arm[:, 1]) * np.exp(-1j * (plate.q[reference] - plate.q[0]))
    X = plate.point + z.real[:, None] * basis[0] + z.imag[:, None] * basis[1]
    unit = max(float(np.median(X[:, 2])), 1e-6)
    X, point = X / unit, plate.point / unit
    twist, speed = twist_of_joint("revolute", plate.normal, point, anchor_of("revolute", X, plate.normal, point))
    return Bundle("revolute", twist, (plate.q - plate.q[0]) * speed, X)
