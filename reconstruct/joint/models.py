"""Kinematics of one joint, and the result of fitting one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

VAGUE_DEG = 10.0
"""Standard deviation of an axis beyond which the joint is not called certain."""


def joint_transform(
    kind: str, axis: np.ndarray, point: np.ndarray | None, q: np.ndarray | float, pitch: float | None = None
) -> np.ndarray:
    """Pose of the moving link at state q relative to q = 0.

    Args:
        kind: "revolute", "prismatic" or "screw".
        axis: (3,) unit direction, world.
        point: (3,) a point on the axis, world (None for prismatic).
        q: (...,) rad (revolute, screw) or m (prismatic).
        pitch: m/rad (screw).

    Returns:
        (..., 4, 4) transforms that map the link's points at q = 0 to those at q, both in the world.
    """
    q = np.asarray(q, float)
    axis = np.asarray(axis, float)
    T = np.zeros((*q.shape, 4, 4))
    T[..., 3, 3] = 1.0
    if kind == "prismatic":
        T[..., :3, :3] = np.eye(3)
        T[..., :3, 3] = q[..., None] * axis
        return T
    if kind not in ("revolute", "screw"):
        raise ValueError(f"unknown joint type {kind!r}; known: revolute, prismatic, screw")
    R = Rotation.from_rotvec(q.reshape(-1, 1) * axis).as_matrix().reshape(*q.shape, 3, 3)
    c = np.asarray(point, float)
    T[..., :3, :3] = R
    T[..., :3, 3] = c - R @ c
    if kind == "screw":
        T[..., :3, 3] += (pitch or 0.0) * q[..., None] * axis
    return T


@dataclass(frozen=True)
class JointFit:
    """A joint, its states, and the moving link's points.

    Attributes:
        verdict: "ok", "ambiguous" or "refused"; reason: one sentence.
        type: "revolute", "prismatic", "screw" or None; type_probability: per type.
        axis: (3,) unit, world.  point: (3,) on the axis nearest to the link, world (None if prismatic).
        q: (T,) state in every working frame, rad or m; q[0] = 0 is the geometry's reference state.
        K: (3, 3) full px.  T_camera_world: (4, 4) of the (stabilised, static) camera.
        points: (M, 3) moving link's points at q = 0, world.
        point_track: (M,) index of each point's track in Tracks.
        metric, scale_source: as in the contract; lengths are in units of the median depth otherwise.
        std: {"axis_deg", "point_m", "q": (T,)}; with depth also "covariance", (6, 6) of the axis (rad, across it) and
            the point on it or (3, 3) of a slide's axis, and "covariance_q", (6, T) or (3, T) of these with q.
        image_line: (2, 2) full px.
        residual_px: median over inlier observations, full px.  inliers, tracks: counts.
        moving_frames: (T,) bool, the frames in which the part moves.
        further: joints of other links of the same object, each on the static one, in the same world and scale.
        alone_deg: standard deviation of the axis by its tracks alone, where edges of the picture gave it; else None.
        members: (n,) indices of all tracks that it was fitted to, also of those that slid along an edge and are no
            points; None with depth.
    """

    verdict: str
    reason: str
    type: str | None = None
    type_probability: dict[str, float] = field(default_factory=dict)
    axis: np.ndarray | None = None
    point: np.ndarray | None = None
    pitch: float | None = None
    q: np.ndarray | None = None
    frames: np.ndarray | None = None
    K: np.ndarray | None = None
    T_camera_world: np.ndarray | None = None
    points: np.ndarray | None = None
    point_track: np.ndarray | None = None
    metric: bool = False
    scale_source: str = "none"
    std: dict = field(default_factory=dict)
    image_line: np.ndarray | None = None
    residual_px: float | None = None
    inliers: int = 0
    tracks: int = 0
    moving_frames: np.ndarray | None = None
    further: tuple[JointFit, ...] = ()
    alone_deg: float | None = None
    members: np.ndarray | None = None

    @property
    def unit(self) -> str:
        return "m" if self.type == "prismatic" else "rad"

    def link_pose(self, q: np.ndarray | float) -> np.ndarray:
        """(..., 4, 4) link transform at q relative to q = 0, world."""
        return joint_transform(self.type, self.axis, self.point, q, self.pitch)

    def project(self, xyz_world: np.ndarray) -> np.ndarray:
        """(..., 3) world -> (..., 2) full px."""
        x = xyz_world @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]
        x = x @ self.K.T
        return x[..., :2] / x[..., 2:]


def placed(fit: JointFit, T_new_old: np.ndarray, factor: float = 1.0) -> JointFit:
    """The same joint in another world, all lengths first multiplied by factor; ``further`` and uncertainties too."""
    R, t = T_new_old[:3, :3], T_new_old[:3, 3]
    T = np.array(fit.T_camera_world, float)
    T[:3, 3] *= factor
    slide = fit.type == "prismatic"
    return replace(
        fit, axis=R @ fit.axis, point=None if fit.point is None else factor * R @ fit.point + t,
        pitch=None if fit.pitch is None else fit.pitch * factor, q=fit.q * factor if slide else fit.q,
        points=None if fit.points is None else factor * fit.points @ R.T + t,
        T_camera_world=T @ np.linalg.inv(T_new_old), std=placed_std(fit.std, R, factor, slide),
        further=tuple(placed(other, T_new_old, factor) for other in fit.further))  # fmt: skip


def placed_std(std: dict, R: np.ndarray, factor: float, slide: bool) -> dict:
    """Uncertainties of a joint whose world is turned by R (3, 3) after all lengths grew by factor; a copy."""
    out = dict(std)
    if out.get("point_m") is not None:
        out["point_m"] = out["point_m"] * factor
    along = factor if slide else 1.0
    if out.get("q") is not None:
        out["q"] = np.asarray(out["q"]) * along
    if out.get("covariance") is not None:
        C = np.asarray(out["covariance"], float)
        G = np.kron(np.diag([1.0, factor]), R)[: len(C), : len(C)]
        out["covariance"], out["covariance_q"] = G @ C @ G.T, along * G @ np.asarray(out["covariance_q"], float)
    return out
