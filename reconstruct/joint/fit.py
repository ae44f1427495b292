"""One joint from point tracks of a static camera, without depth: the public entry of this room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.bundle import Observations, State, refine, reprojection, solve_depths, transport
from reconstruct.joint.evidence import free_motion, type_probability
from reconstruct.joint.focal import DEFAULT_FOCAL, estimate_focal
from reconstruct.joint.models import JointFit
from reconstruct.joint.select import explained, key_frames, motion_stretches, observations, search
from reconstruct.joint.uncertainty import joint_std
from reconstruct.joint.world import assumed_up, world_from_camera
from reconstruct.video import Video

MOVING_SHARE = 0.012
"""A track moves if its extent exceeds this share of the image diagonal."""
MIN_INLIERS = 8
FREE_SHARE = 1 / 3
"""A joint is refuted if this share of the points that move most follow a free rigid body but not the joint. Real hinges
and slides, with flexing parts, drifting tracks and an imperfect camera, stay under a fifth; a lid that is lifted away
leaves more than half."""


def fit_joint(
    video: Video,
    tracks: Tracks,
    focal_px: float | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> JointFit:
    """Joint type, axis, states and the moving link's points from tracks of one static camera.

    Args:
        video: stabilised video (sizes, times; no pixel is read).
        tracks: point tracks of everything that moves, hands excluded as far as known.
        focal_px: focal length in full px; the video's own or a typical one when None.
        seed: of the random subsets.
        progress: called with the done share.

    Returns:
        A JointFit up to scale (median depth of the link = 1), or one with verdict "refused".
    """
    rng = np.random.default_rng(seed)
    tell = progress or (lambda _: None)
    uv = video.to_work(np.where(tracks.visible[..., None], tracks.uv, np.nan))
    h, w = video.frames.shape[1:3]
    known = focal_px or video.focal_px
    full, focal_std = known or DEFAULT_FOCAL * max(video.size), 0.02
    camera = _Camera(full * video.scale, np.array([(w - 1) / 2, (h - 1) / 2]), float(np.hypot(h, w)))

    found = _consensus(uv, camera, rng, lambda x: tell(0.85 * x))
    note = ""
    if found.refusal and found.scattered:
        # Several parts may have moved one after the other: look at one stretch of motion at a time.
        stretches = motion_stretches(uv[_moving(uv, camera)], video.time)
        tries = [
            _consensus(_only(uv, span), camera, rng, lambda _: None) for span in stretches[:3] if len(stretches) > 1
        ]
        tries = [t for t in tries if not t.refusal]
        if tries:
            found = max(tries, key=lambda t: t.explained)
            note = f"; no joint explains the whole video: the dominant of {len(stretches)} stretches of motion is taken"
    if found.refusal:
        return JointFit("refused", found.refusal, tracks=len(uv), inliers=len(found.members),
                        type_probability=found.probability)  # fmt: skip
    tell(0.9)

    # Directions that the data hardly hold (an axis towards the camera) converge slowly: finish on the link alone.
    s, own = found.state, found.link
    if not known:
        factor, focal_std = estimate_focal(s, own)
        full, camera = full * factor, replace(camera, focal=camera.focal * factor)
        own = replace(own, xy=own.xy / factor, px=own.px / factor)
    s = refine(s, own, scales=(4.0, 2.0), iterations=60)
    T = len(video)
    dense = _all_frames(uv[found.members], camera, own, T)
    s = replace(s, q=np.interp(np.arange(T), own.frames, s.q))
    s = refine(replace(s, depth=_redepth(s, dense).depth), dense, scales=(2.0,), iterations=6, smooth=0.3)
    std = joint_std(s, dense, focal_std) | {"focal_px": focal_std * full}
    tell(1.0)
    return _result(video, s, dense, found.members, full, found.probability, std, len(uv), note)


@dataclass(frozen=True)
class _Camera:
    """focal: working px.  centre: (2,) working px.  diagonal: of the working frame, px."""

    focal: float
    centre: np.ndarray
    diagonal: float


@dataclass(frozen=True)
class _Consensus:
    """The best joint of both types and the tracks that follow it, or why there is none.

    Attributes:
        state: with depths of `link`.  link: key-frame observations of the tracks that follow it.
        members: (n,) indices of these tracks.  probability: of the types.
        explained: motion of all tracks that it explains.
        refusal: a sentence, or "".  scattered: True if too few tracks agree on anything.
    """

    state: State | None = None
    link: Observations | None = None
    members: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    probability: dict[str, float] = field(default_factory=dict)
    explained: float = 0.0
    refusal: str = ""
    scattered: bool = False


def _moving(uv: np.ndarray, camera: _Camera) -> np.ndarray:
    """Indices of the tracks that leave their place."""
    extent = np.zeros(len(uv))
    some = np.isfinite(uv[..., 0]).sum(1) > 1
    if some.any():
        extent[some] = np.linalg.norm(np.nanmax(uv[some], axis=1) - np.nanmin(uv[some], axis=1), axis=-1)
    return np.flatnonzero(extent > MOVING_SHARE * camera.diagonal)


def _consensus(uv: np.ndarray, camera: _Camera, rng: np.random.Generator, tell: Callable[[float], None]) -> _Consensus:
    moving = _moving(uv, camera)
    if len(moving) < MIN_INLIERS:
        return _Consensus(refusal=f"nothing moves: {len(moving)} of {len(uv)} tracks leave their place")
    keys = key_frames(uv[moving])
    if len(keys) < 6:
        return _Consensus(refusal="the motion is too short: fewer than six distinct states")
    focal, centre, diagonal = camera.focal, camera.centre, camera.diagonal
    obs, _ = observations(uv[moving], focal, centre, keys, 260, rng, diagonal)
    if len(obs.ref) < MIN_INLIERS:
        return _Consensus(refusal=f"only {len(obs.ref)} moving tracks last long enough")
    best: dict[str, State] = {}
    for s in search(obs, rng, progress=lambda x: tell(0.9 * x)):
        best.setdefault(s.kind, s)
    if not best:
        return _Consensus(refusal="no tracks move together for long enough to draw a joint", scattered=True)
    probability = type_probability(best, obs)
    s = best[max(probability, key=lambda kind: probability[kind])]

    # All moving tracks, not just the sample of the search, for the consensus set.
    every, ids = observations(uv[moving], focal, centre, keys, 900, rng, diagonal)
    s = refine(_redepth(s, every), every, scales=(3.0, 2.0), iterations=8)
    total, share = explained(s, every)
    follows = share > 0.5
    few = follows.sum() < MIN_INLIERS
    link = Observations(every.xy[follows], every.seen[follows], every.ref[follows], every.weight[follows], every.px,
                        every.frames)  # fmt: skip
    return _Consensus(replace(s, depth=s.depth[follows]), link, moving[ids[follows]], probability, total,
                      _why_refused(s, every, follows) or "", bool(few))  # fmt: skip


def _only(uv: np.ndarray, span: slice) -> np.ndarray:
    """Tracks as seen in some frames only."""
    out = np.full_like(uv, np.nan)
    out[:, span] = uv[:, span]
    return out


def _redepth(s: State, obs: Observations) -> State:
    return solve_depths(replace(s, depth=np.ones(len(obs.ref))), obs)


def _why_refused(s: State, obs: Observations, link: np.ndarray) -> str | None:
    """A sentence if the best joint is not believable."""
    if link.sum() < MIN_INLIERS:
        return f"no joint: only {int(link.sum())} tracks agree with the best one ({s.kind})"
    free = free_motion(s, obs)
    if free is not None and free.unexplained > FREE_SHARE:
        return (
            f"the part moves as a free body, not about one joint: {free.unexplained:.0%} of its points that move most "
            f"do not follow the best joint ({s.kind}; median residual {free.joint_px:.1f} px against "
            f"{free.free_px:.1f} px for a free rigid body, working pixels)"
        )
    return None


def _all_frames(uv: np.ndarray, camera: _Camera, keyed: Observations, T: int) -> Observations:
    """Observations of the link's tracks (n, T, 2) in every frame, with the reference frames of the keyed ones."""
    seen = np.isfinite(uv[..., 0])
    xy = np.where(seen[..., None], (uv - camera.centre) / camera.focal, 0.0)
    return Observations(xy, seen, keyed.frames[keyed.ref], keyed.weight, 1.0 / camera.focal, np.arange(T))


def _result(
    video: Video,
    s: State,
    obs: Observations,
    members: np.ndarray,
    full_focal: float,
    probability: dict[str, float],
    std: dict,
    tracks: int,
    note: str,
) -> JointFit:
    """World frame, signs, units and the contract's fields."""
    X, _ = transport(s, obs)
    r = np.linalg.norm(np.where(obs.seen[..., None], reprojection(X, obs), np.nan), axis=-1)
    rays = obs.ref_rays
    # Points at q = 0: pull every track's own reference back.
    zero = replace(s, q=np.concatenate([s.q, [0.0]]))
    extra = replace(
        obs,
        xy=np.concatenate([obs.xy, np.zeros((len(rays), 1, 2))], axis=1),
        seen=np.concatenate([obs.seen, np.zeros((len(rays), 1), bool)], axis=1),
        frames=np.arange(len(s.q) + 1),
    )
    points = transport(zero, extra)[0][:, -1]
    unit = float(np.median(X[..., 2][obs.seen]))
    q, axis = s.q.copy(), s.axis.copy()
    far = int(np.argmax(np.abs(q)))
    if q[far] < 0:
        q, axis = -q, -axis
    points = points / unit
    pivot = None
    if s.kind == "prismatic":
        q = q / unit
        origin = np.median(points, axis=0)
    else:
        c = s.point / unit
        pivot = c + axis * float(np.median((points - c) @ axis))
        origin = pivot
    moved = X[:, far] / unit
    up, how = assumed_up(s.kind, axis, points, moved)
    T_world_camera = world_from_camera(up, axis, origin)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    K = np.array([[full_focal, 0, (video.size[0] - 1) / 2], [0, full_focal, (video.size[1] - 1) / 2], [0, 0, 1.0]])
    p = max(probability.values())
    verdict, reason = "ok", f"{len(members)} tracks agree; {how}{note}"
    if p < 0.9:
        verdict = "ambiguous"
        names = " and ".join(sorted(probability, key=probability.get, reverse=True))
        reason = (
            f"{names} explain the motion almost equally well (p = {p:.2f}); a longer motion would tell; {how}{note}"
        )
    std = dict(std, point_m=std["point"] / unit, q=std["q"] / (unit if s.kind == "prismatic" else 1.0))
    std.pop("point")
    fit = JointFit(
        verdict,
        reason,
        s.kind,
        probability,
        R @ axis,
        None if pivot is None else R @ pivot + t,
        None,
        q,
        video.index,
        K,
        np.linalg.inv(T_world_camera),
        points @ R.T + t,
        members,
        False,
        "none",
        std,
        residual_px=float(np.nanmedian(r)) / video.scale,
        inliers=len(members),
        tracks=tracks,
        moving_frames=_moving_frames(q, video.time),
    )
    return replace(fit, image_line=image_line(fit))


def _moving_frames(q: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(T,) frames in which |dq/dt| exceeds 4 % of the range a second, and 10 % of its upper quartile."""
    rate = np.abs(np.gradient(q, time))
    return rate > max(0.04 * np.ptp(q), 0.1 * np.quantile(rate, 0.95))


def image_line(fit: JointFit) -> np.ndarray:
    """(2, 2) full px: the axis along the link's extent, or the slide from its start to its far end."""
    if fit.type == "prismatic":
        start = np.median(fit.points, axis=0)
        ends = np.stack([start, start + fit.axis * fit.q[int(np.argmax(np.abs(fit.q)))]])
    else:
        along = (fit.points - fit.point) @ fit.axis
        lo, hi = np.quantile(along, [0.05, 0.95])
        if hi - lo < 1e-6:
            lo, hi = lo - 0.02, hi + 0.02
        ends = fit.point + np.outer([lo, hi], fit.axis)
    return fit.project(ends)
