"""The project's own estimators on the benchmark's cases, their answers brought into the world of the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.articulation.bound import Bound
from benchmarks.articulation.motions import SIZE, pixel_rays
from benchmarks.articulation.noise import Given
from reconstruct.cues import Hands, ProviderInfo, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

PROVIDER = ProviderInfo("benchmark", "1", "Apache-2.0")


@dataclass(frozen=True)
class Answer:
    """What an estimator said, in the world of the truth.

    Attributes:
        verdict, reason: of the fit; verdict "failed" if it raised.
        type, probability: as stated.
        axis: (3,), point: (3,) or None, q: (T,) with q[0] = 0 in rad or m; None if refused.
        link_pose: (T, 4, 4) of the moving link relative to frame 0.
        std: "axis_deg", "point_m", "q" as stated, lengths in m.
        seconds: of the fit.
    """

    verdict: str
    reason: str
    type: str | None = None
    probability: dict[str, float] = field(default_factory=dict)
    axis: np.ndarray | None = None
    point: np.ndarray | None = None
    q: np.ndarray | None = None
    link_pose: np.ndarray | None = None
    std: dict = field(default_factory=dict)
    seconds: float = 0.0


def solve(given: Given, best: Bound | None, focal_known: bool = True, seed: int = 0) -> Answer:
    """Run the estimator that fits the row: with 3D tracks in rows 1 and 2, without depth in row 3; in rows 4
    and 5 as the pipeline does, which knows where the arms are."""
    begin = time.perf_counter()
    try:
        if given.depth is not None:
            fit = _with_depth(given, seed)
        else:
            given, fit = _without_depth(given, focal_known, seed)
    except Exception as error:  # whatever goes wrong is a failed case, not the end of the table
        return Answer("failed", f"{type(error).__name__}: {error}", seconds=time.perf_counter() - begin)
    seconds = time.perf_counter() - begin
    if fit.axis is None or fit.verdict == "refused":
        return Answer("refused", fit.reason, fit.type, fit.type_probability, seconds=seconds)
    scale, T_true_fit = 1.0, np.eye(4)
    if given.depth is None:
        registered = _registration(fit, given, best)
        if registered is None:
            return Answer("failed", "none of the points it takes for the link is on the link", fit.type,
                          fit.type_probability, seconds=seconds)  # fmt: skip
        scale, T_true_fit = registered
    R, t = T_true_fit[:3, :3], T_true_fit[:3, 3]
    place = lambda x: scale * (x @ R.T) + t  # noqa: E731
    q = _all_frames(fit, len(given.scene.shot.q))
    poses = fit.link_pose(q)
    T = np.tile(np.eye(4), (len(q), 1, 1))
    T[:, :3, :3] = R @ poses[:, :3, :3] @ R.T
    T[:, :3, 3] = scale * poses[:, :3, 3] @ R.T + t - np.einsum("tij,j->ti", T[:, :3, :3], t)
    unit = scale if fit.type == "prismatic" else 1.0
    std = dict(fit.std)
    std["point_m"] = scale * std.get("point_m", np.nan)
    std["q"] = unit * np.asarray(std.get("q", np.full(len(fit.q), np.nan)), float)
    if len(std["q"]) != len(q):
        std["q"] = np.interp(np.arange(len(q)), np.asarray(fit.frames, float), std["q"])
    point = None if fit.point is None else place(fit.point)
    return Answer(fit.verdict, fit.reason, fit.type, fit.type_probability, R @ fit.axis, point, q * unit, T, std,
                  seconds)  # fmt: skip


def _with_depth(given: Given, seed: int) -> JointFit:
    from reconstruct.joint.rigid import fit_rigid

    shot = given.scene.shot
    return fit_rigid(given.uv, given.visible, given.depth, shot.K, shot.T_world_camera, given.link, seed=seed)


def _without_depth(given: Given, focal_known: bool, seed: int) -> tuple[Given, JointFit]:
    """The joint, and the tracks that it is one of: of a clip maybe others than those given."""
    from reconstruct.joint.fit import fit_joint

    tracks = Tracks(given.uv.astype(np.float32), given.visible, given.scene.seed, PROVIDER, given.slip, given.shade,
                    given.cast)  # fmt: skip
    focal = float(given.scene.shot.K[0, 0]) if focal_known else None
    if given.hands is not None and given.frames is not None:
        return _of_pixels(given, given.hands, given.frames, tracks, focal, seed)
    T = given.uv.shape[1]
    frames = np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (T, SIZE[1], SIZE[0], 3))
    video = Video(Path("none.mp4"), "0" * 64, SIZE, np.arange(T) / 30, np.arange(T), T, frames, 1.0)
    return given, fit_joint(video, tracks, focal, seed)


def _of_pixels(given: Given, hands: Hands, frames: np.ndarray, tracks: Tracks, focal: float | None, seed: int
               ) -> tuple[Given, JointFit]:  # fmt: skip
    """As the pipeline does: a clip's pixels (T, h, w, 3) uint8 BGR, its tracks, focal length in px."""
    from benchmarks.articulation.pixels import video_of, with_tracks
    from reconstruct.joint.closer import unless_hands_hide_it
    from reconstruct.pipeline import joint_off_the_arm
    from reconstruct.providers.lk_tracks import CLOSE_PX, track_points

    video = video_of(frames, given.warp)

    def follow() -> Tracks:
        return track_points(video, hands, margin_px=CLOSE_PX)

    def ask(some: Tracks, margin_px: int | None = CLOSE_PX) -> JointFit:
        return joint_off_the_arm(video, some, hands, focal, seed, lambda _: None, margin_px)

    used, fit = unless_hands_hide_it(ask(tracks, None), video, tracks, hands, follow, ask)
    return given if used is tracks else with_tracks(given, used), fit


def _registration(fit: JointFit, given: Given, best: Bound | None) -> tuple[float, np.ndarray] | None:
    """Scale and pose that take a fit up to scale into the true world: both see the same first camera.

    The scale is the weighted median ratio of depths, true over fitted, of the moving points of the fit, in rows 4 and 5
    of the link's surface where these were seeded; None if it has no point that is right.
    """
    shot, scene = given.scene.shot, given.scene
    T_world_camera = shot.T_world_camera[0]
    T_camera_fit = np.asarray(fit.T_camera_world, float)
    ratio, weight = np.ones(1), np.ones(1)
    if fit.points is not None and fit.point_track is not None and given.row in (4, 5):
        ratio = _ratios_at_seeds(fit, given)
        weight = np.ones(len(ratio))
    elif fit.points is not None and fit.point_track is not None:
        ids = np.asarray(fit.point_track, int)
        on = scene.moving[ids] & ~given.wrong[ids].any(1)
        ids, points = ids[on], fit.points[on]
        z_fit = points @ T_camera_fit[2, :3] + T_camera_fit[2, 3]
        z_true = (scene.points[ids] - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        ratio = z_true / z_fit
        weight = best.scale_weight[ids] if best is not None else np.ones(len(ids))
        ok = np.isfinite(ratio) & (ratio > 0)
        ratio, weight = ratio[ok], weight[ok] + 1e-12
    if len(ratio) == 0:
        return None
    order = np.argsort(ratio)
    share = np.cumsum(weight[order]) / weight.sum()
    scale = float(ratio[order][np.searchsorted(share, 0.5)])
    # x_true = R_wc (scale * (R_cf x + t_cf)) + t_wc
    out = np.eye(4)
    out[:3, :3] = T_world_camera[:3, :3] @ T_camera_fit[:3, :3]
    out[:3, 3] = scale * T_world_camera[:3, :3] @ T_camera_fit[:3, 3] + T_world_camera[:3, 3]
    return scale, out


RIM_PX = 2.0
"""How far beside the link the seed of a point on its rim may lie."""


def _ratios_at_seeds(fit: JointFit, given: Given) -> np.ndarray:
    """(m,) depths of the link's surface over those of the fit's points, where and when their tracks were seeded.

    A point on an edge may slide along it afterwards, and half of those on a rim are seeded beside it.
    """
    shot, model = given.scene.shot, given.scene.model
    first = shot.T_world_camera[0]
    ids = np.asarray(fit.point_track, int)
    frame, uv = given.scene.seed[ids], given.filmed
    T_fit, T_camera = fit.link_pose(_all_frames(fit, len(shot.q))[frame]), np.asarray(fit.T_camera_world, float)
    world = np.einsum("nij,nj->ni", T_fit[:, :3, :3], fit.points) + T_fit[:, :3, 3]
    z_fit, z_true = world @ T_camera[2, :3] + T_camera[2, 3], np.full(len(ids), np.nan)
    turns = np.arange(8) * np.pi / 4
    beside = np.concatenate([np.zeros((1, 2)), RIM_PX * np.stack([np.cos(turns), np.sin(turns)], axis=1)])
    for f in np.unique(frame):
        rows, camera = np.flatnonzero(frame == f), shot.T_world_camera[f]
        rays = pixel_rays(uv[ids[rows], f][:, None] + beside, shot.K, camera)
        distance, geom = model.cast(float(shot.q[f]), camera[:3, 3], rays.reshape(-1, 3))
        on = ((geom >= 0) & model.moving_geoms[geom]).reshape(len(rows), -1)
        X = camera[:3, 3] + rays * np.where(on, distance.reshape(on.shape), 0.0)[..., None]
        depth = ((X - first[:3, 3]) @ first[:3, 2])[np.arange(len(rows)), on.argmax(1)]
        z_true[rows] = np.where(on.any(1), depth, np.nan)
    ratio = z_true / z_fit
    return ratio[np.isfinite(ratio) & (ratio > 0)]


def _all_frames(fit: JointFit, T: int) -> np.ndarray:
    q = np.asarray(fit.q, float)
    if len(q) != T:
        q = np.interp(np.arange(T), np.asarray(fit.frames, float), q)
    return q - q[0]
