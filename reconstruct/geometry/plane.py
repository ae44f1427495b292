"""The dominant plane of the moving link: the frame in which its outline is drawn.

Most moving links that a hand drives are flat in the large (a door, a lid, a drawer's front, an arm
seen from its side). Even where one is not, its image motion is close to that of a plane, so that the
plane serves as the common chart of all frames. The 3D points of a joint fit are noisy along the rays
(badly so when the axis points at the camera), so the plane is judged in pixels: every track's ray is
cut with the plane at one frame, moved with the joint, and compared with the track everywhere else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

BESIDE, BESIDE_PX = 3.0, 1.0
"""By how many times the median error, and by how many full px at least, the plane misses tracks that are not on it."""
OBLIQUE = 2.0
"""A plane oblique to the hinge must explain the tracks this many times as well as one along or across it."""


@dataclass(frozen=True)
class LinkPlane:
    """A plane fixed to the moving link.

    Attributes:
        pose: (4, 4) plane frame to world at q = 0; columns are in-plane u, v, normal n, origin. The
            normal points to the side that the camera saw in most frames.
        kind: "holds the axis", "across the axis" (normal parallel to it) or "free".
        residual_px: robust mean error of the tracks when each point is put onto the plane, full px.
        spread: (M,) signed distance of every fitted point to the plane, world units.
        inlier: (M,) bool, points whose tracks the plane explains.
        beside: (M,) bool, points whose tracks it misses by far more than most: they are on the link, not on its face.
        extent: size of the inliers in the plane (their 2D bounding box's diagonal), world units.
        facing: (T,) cosine between the normal and the direction to the camera in every frame.
    """

    pose: np.ndarray
    kind: str
    residual_px: float
    spread: np.ndarray
    inlier: np.ndarray
    beside: np.ndarray
    extent: float
    facing: np.ndarray

    def to_plane(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) world at q = 0 -> (..., 3) plane coordinates (u, v, n)."""
        return (np.asarray(xyz, float) - self.pose[:3, 3]) @ self.pose[:3, :3]

    def to_world(self, uvn: np.ndarray) -> np.ndarray:
        """(..., 2 or 3) plane coordinates -> (..., 3) world at q = 0."""
        uvn = np.asarray(uvn, float)
        if uvn.shape[-1] == 2:
            uvn = np.concatenate([uvn, np.zeros((*uvn.shape[:-1], 1))], axis=-1)
        return uvn @ self.pose[:3, :3].T + self.pose[:3, 3]


def keep_points(fit: JointFit, plane: LinkPlane, good: np.ndarray) -> tuple[JointFit, LinkPlane]:
    """The fit and the plane without some of the points; the plane itself stays, as a chart must not jump."""
    few = good & plane.inlier
    good = good if few.sum() >= 3 else good | plane.inlier
    return (replace(fit, points=np.asarray(fit.points)[good], point_track=np.asarray(fit.point_track)[good]),
            replace(plane, inlier=plane.inlier[good], beside=plane.beside[good], spread=plane.spread[good]))


def working_matrix(video: Video, scale: float = 1.0) -> np.ndarray:
    """(3, 3) full px -> px of the working frame shrunk once more by ``scale``."""
    s = video.scale * scale
    return np.array([[s, 0, 0.5 * s - 0.5], [0, s, 0.5 * s - 0.5], [0, 0, 1.0]])


def homography(fit: JointFit, plane: LinkPlane, q: np.ndarray | float, offset: float = 0.0) -> np.ndarray:
    """(..., 3, 3) plane coordinates (u, v, 1) at height ``offset`` over the plane -> full px, at state q."""
    P = fit.T_camera_world @ fit.link_pose(q) @ plane.pose
    H = np.stack([P[..., :3, 0], P[..., :3, 1], P[..., :3, 3] + offset * P[..., :3, 2]], axis=-1)
    return fit.K @ H


def apply_homography(H: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(3, 3), (..., 2) -> (..., 2); NaN where the point is behind the camera."""
    x = np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], axis=-1) @ H.T
    z = x[..., 2:]
    return np.where(z > 1e-9, x[..., :2] / np.where(z > 1e-9, z, 1.0), np.nan)


def camera_centre(fit: JointFit) -> np.ndarray:
    """(3,) world."""
    T = fit.T_camera_world
    return -T[:3, :3].T @ T[:3, 3]


class _PlaneJudge:
    """Robust reprojection error of all tracks for a plane n.x = d (world, q = 0)."""

    def __init__(self, fit: JointFit, tracks: Tracks, frames: int = 24) -> None:
        self.fit = fit
        # Frames spread over q, so that slow parts of the motion do not outvote fast ones.
        order = np.argsort(fit.q, kind="stable")
        targets = np.linspace(fit.q.min(), fit.q.max(), frames)
        pick = np.unique(order[np.clip(np.searchsorted(fit.q[order], targets), 0, len(order) - 1)])
        idx = np.asarray(fit.point_track, int)
        self.uv = tracks.uv[idx][:, pick]
        self.seen = tracks.visible[idx][:, pick] & np.isfinite(self.uv).all(-1)
        self.pose = fit.link_pose(fit.q[pick])
        self.camera = camera_centre(fit)
        # Rays and camera centre of every frame in link coordinates (q = 0): there the link is still.
        rays = np.concatenate([np.nan_to_num(self.uv), np.ones((*self.uv.shape[:-1], 1))], -1)
        rays = rays @ np.linalg.inv(fit.K).T @ fit.T_camera_world[:3, :3]
        inv = np.linalg.inv(self.pose)
        self.rays = np.einsum("tij,mtj->mti", inv[:, :3, :3], rays)
        self.centres = inv[:, :3, :3] @ self.camera + inv[:, :3, 3]
        self.lever = 1.0
        if fit.type != "prismatic":
            arm = np.cross(np.asarray(fit.points) - fit.point, fit.axis)
            self.lever = max(float(np.median(np.linalg.norm(arm, axis=1))), 1e-12)
        self.unit = max(2.0, 2.0 * float(fit.residual_px or 1.0))

    def errors(self, normal: np.ndarray, d: float) -> np.ndarray:
        """(M,) median pixel error of every point; inf where it cannot be judged."""
        cosine = np.einsum("mti,i->mt", self.rays, normal)
        size = np.linalg.norm(self.rays, axis=-1)
        frontal = np.where(self.seen, np.abs(cosine) / size, -1.0)
        m = np.arange(len(frontal))
        ref = np.argmax(frontal, axis=1)
        ok = frontal[m, ref] > 0.05
        along = (d - self.centres[ref] @ normal) / np.where(ok, cosine[m, ref], 1.0)
        ok &= along > 0
        point = self.centres[ref] + along[:, None] * self.rays[m, ref]
        moved = np.einsum("tij,mj->mti", self.pose[:, :3, :3], point) + self.pose[:, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.linalg.norm(self.fit.project(moved) - self.uv, axis=-1)
        miss = np.where(self.seen, miss, np.nan)
        miss[m, ref] = np.nan
        ok &= np.isfinite(miss).sum(1) >= 2
        out = np.full(len(frontal), np.inf)
        out[ok] = np.nanmedian(miss[ok], axis=1)
        return out

    def cost(self, normal: np.ndarray, d: float) -> float:
        """Mean error truncated at four units, px: the plane that most points lie on, and that a link which
        reaches its hinge can be drawn on: a parallel to the axis far from it (a door's rim) counts for less."""
        miss = float(np.minimum(self.errors(normal, d), 4 * self.unit).mean())
        if self.fit.type == "prismatic":
            return miss
        along = abs(float(normal @ self.fit.axis))
        off = abs(d - float(normal @ self.fit.point)) / self.lever
        return miss + self.unit * (1 - along) * max(off - 0.1, 0.0) * 3


def _candidates(fit: JointFit, points: np.ndarray, rng: np.random.Generator) -> list[tuple[str, np.ndarray, float]]:
    """Planes worth judging: (kind, unit normal, offset)."""
    out: list[tuple[str, np.ndarray, float]] = []
    axis = fit.axis / np.linalg.norm(fit.axis)
    centre = np.median(points, axis=0)
    side = np.linalg.svd(axis[None])[2][1:]
    for angle in np.linspace(0, np.pi, 36, endpoint=False):
        normal = np.cos(angle) * side[0] + np.sin(angle) * side[1]
        for level in np.quantile(points @ normal, [0.1, 0.25, 0.5, 0.75, 0.9]):
            out.append(("holds the axis", normal, float(level)))
    for level in np.quantile(points @ axis, [0.1, 0.3, 0.5, 0.7, 0.9]):
        out.append(("across the axis", axis, float(level)))
    for _ in range(120 if len(points) >= 3 else 0):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length > 1e-3 * np.linalg.norm(points - centre, axis=1).mean() ** 2:
            out.append(("free", normal / length, float(a @ normal / length)))
    return out


def fit_plane(tracks: Tracks, fit: JointFit) -> LinkPlane:
    """The plane that explains most of the link's tracks.

    A plane through or across the axis wins over a free one unless that is clearly better: mechanisms
    are built so, and the data often say nothing about one of the three numbers.
    """
    points = np.asarray(fit.points, float)
    judge = _PlaneJudge(fit, tracks)
    scored = [(judge.cost(n, d), kind, n, d) for kind, n, d in _candidates(fit, points, np.random.default_rng(0))]
    best: dict[str, tuple[float, np.ndarray, float]] = {}
    for cost, kind, n, d in scored:
        if kind not in best or cost < best[kind][0]:
            best[kind] = (cost, n, d)
    axis = fit.axis / np.linalg.norm(fit.axis)
    refined = {kind: _polish(judge, kind, axis, *b) for kind, b in best.items()}
    lowest = min(v[0] for v in refined.values())
    order = ["holds the axis", "across the axis", "free"]
    if fit.type == "prismatic":
        # A slide prefers neither of the two: a drawer's front lies across it, a suitcase handle along it.
        order.sort(key=lambda k: (k == "free", refined[k][0] if k in refined else np.inf))
    if "free" in refined and fit.type != "prismatic" and 0.2 < abs(float(refined["free"][1] @ axis)) < 0.95:
        # Oblique to its hinge: two faces of one body far more often than one face that really lies so.
        others = [refined[k][0] for k in refined if k != "free"]
        lowest = min(others) if min(others) <= OBLIQUE * lowest else lowest
    kind = next(k for k in order if k in refined and refined[k][0] <= 1.15 * lowest + 0.1 * judge.unit)
    cost, normal, d = refined[kind]

    errors = judge.errors(normal, d)
    spread = points @ normal - d
    inlier = errors <= max(3 * judge.unit, 1.5 * float(np.median(errors)))
    if inlier.sum() < 3:
        inlier = errors <= np.sort(errors)[min(2, len(errors) - 1)]
    beside = errors > max(BESIDE * float(np.median(errors)), BESIDE_PX)
    on = points[inlier] - spread[inlier, None] * normal
    origin = np.median(on, axis=0)
    u = axis - (axis @ normal) * normal
    if np.linalg.norm(u) < 0.3:
        # Across the axis: take the direction in which the points lie farthest apart.
        u = np.linalg.svd(on - origin)[2][0]
        u = u - (u @ normal) * normal
    u /= np.linalg.norm(u)
    centre = fit.link_pose(fit.q) @ np.append(origin, 1.0)
    normals = fit.link_pose(fit.q)[:, :3, :3] @ normal
    to_camera = camera_centre(fit) - centre[:, :3]
    facing = np.einsum("ti,ti->t", normals, to_camera) / np.linalg.norm(to_camera, axis=1)
    # The faced side counts by how squarely it was seen, among frames in which the points were seen.
    if np.sum(facing * np.abs(facing)) < 0:
        normal, facing, spread = -normal, -facing, -spread
    v = np.cross(normal, u)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([u, v, normal, origin], axis=1)
    flat = (on - origin) @ pose[:3, :2]
    extent = float(np.linalg.norm(np.ptp(flat, axis=0)))
    return LinkPlane(pose, kind, cost, spread, inlier, beside, extent, facing)


def _polish(judge: _PlaneJudge, kind: str, axis: np.ndarray, cost: float, normal: np.ndarray,
            d: float) -> tuple[float, np.ndarray, float]:
    """Improve a candidate within its kind by a direct search (the cost is truncated, so no gradients)."""
    from scipy.optimize import minimize

    pivot = normal * d
    reach = max(float(np.linalg.norm(judge.centres[0] - pivot)), 1e-9)
    side = np.linalg.svd(normal[None])[2][1:]
    turn = np.cross(axis, normal)

    def plane(x: np.ndarray) -> tuple[np.ndarray, float]:
        if kind == "across the axis":
            return normal, d + x[0] * reach
        n = normal + (x[1] * turn if kind == "holds the axis" else x[1] * side[0] + x[2] * side[1])
        n = n / np.linalg.norm(n)
        return n, float(base @ n) + x[0] * reach

    base = np.median(np.asarray(judge.fit.points), axis=0)
    base = base - (base @ normal - d) * normal
    size = {"across the axis": 1, "holds the axis": 2, "free": 3}[kind]
    simplex = np.vstack([np.zeros(size), np.diag(np.r_[0.01, np.full(size - 1, 0.05)])])
    found = minimize(lambda x: judge.cost(*plane(x)), np.zeros(size), method="Nelder-Mead",
                     options={"initial_simplex": simplex, "maxiter": 120, "xatol": 1e-4, "fatol": 1e-3})
    if found.fun < cost:
        return float(found.fun), *plane(found.x)
    return cost, normal, d
