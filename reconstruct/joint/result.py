"""What is said of a finished joint: why it is not believed, or the result in a world, with signs and units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.evidence import bridged, looser
from reconstruct.joint.finish import Finished
from reconstruct.joint.models import VAGUE_DEG, JointFit
from reconstruct.joint.polish import Bundle, Sightings, positions, residuals
from reconstruct.joint.uncertainty import compact
from reconstruct.joint.weigh import LIKELY, SCREW_TURN_DEG, turn_deg
from reconstruct.joint.world import assumed_up, world_from_camera
from reconstruct.video import Video

MIN_INLIERS = 8
BRIDGED_SHARE, BRIDGED_ERROR = 0.3, 0.3
LOOSER, RESTLESS = 2.75, 3.0
"""A joint is refuted if its own points follow a free body so many times better, and miss the joint by so many times
what points at rest leave their place: a stabilised hand-held camera moves everything, and a free body with it."""
FREELY = "the part moves as a free body"
"""What a reason says of a joint that a body which is carried refutes."""
SLID_PX = 2.0
"""Working px, median, that a track may have slid along its edge for its point to be handed on."""


def why_not_believed(done: Finished, restlessness: float = np.inf) -> str | None:
    """A sentence if the finished joint is not one.

    Args:
        restlessness: px, what points at rest leave their place by.
    """
    bundle = done.once or done.bundle
    turn = turn_deg(bundle)
    if bundle.kind == "screw" and turn < SCREW_TURN_DEG:
        return (
            f"{FREELY}: it turns by {turn:.0f} deg and advances along that axis, which any "
            f"body does that is carried a short way (a screw is believed from {SCREW_TURN_DEG:.0f} deg on)"
        )
    b = bridged(bundle, done.sight)
    if b.supported < BRIDGED_SHARE:
        return f"too few tracks last through the motion: {1 - b.supported:.0%} of the stroke is seen by hardly any"
    if b.error > BRIDGED_ERROR:
        return (
            f"no joint: from one state to the next the best one ({bundle.kind}) misses {b.error:.0%} of the way "
            "that its own points go"
        )
    misses = bundle.sigma > RESTLESS * restlessness
    times = looser(bundle, done.sight) if misses else None
    if times is not None and times > LOOSER:
        return (
            f"{FREELY}: its points follow one {times:.2g} times more exactly than the best joint "
            f"({bundle.kind})"
        )
    return None


def result_of(
    video: Video, done: Finished, full_focal: float, tracks: int, note: str, focal_std: float | None
) -> JointFit:
    """World frame, signs, units and the contract's fields."""
    b, sight, probability = done.bundle, done.sight, done.probability
    world, cam = positions(b, sight)
    seen = sight.seen
    r = np.linalg.norm(residuals(b, sight, cam), axis=-1)[seen]
    unit = float(np.median(cam[..., 2][seen]))
    full_focal *= float(np.exp(b.log_focal))
    turns = b.kind != "prismatic"
    rate = float(np.linalg.norm(b.twist.curvature)) if turns else 1.0 / unit
    q, axis = b.q * rate, b.twist.axis
    far = int(np.argmax(np.abs(q)))
    if q[far] < 0:
        q, axis = -q, -axis
    points, stays = b.X / unit, stay(b, sight)
    pivot, origin = None, np.median(points, axis=0)
    if turns:
        c = b.twist.point / unit
        pivot = origin = c + axis * float(np.median((points - c) @ axis))
    moved = world[:, far] / unit
    up, how = assumed_up(b.kind, axis, points, moved)
    T_world_camera = world_from_camera(up, axis, origin)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    K = np.array([[full_focal, 0, (video.size[0] - 1) / 2], [0, full_focal, (video.size[1] - 1) / 2], [0, 0, 1.0]])
    p = max(probability.values())
    if done.lost:
        note = f"{note}; in {done.lost} of {len(q)} frames its tracks agree on no state"
    verdict, reason = "ok", f"{len(done.members)} tracks agree; {how}{note}"
    if p < 1 - LIKELY:
        verdict = "ambiguous"
        names = " and ".join(sorted(probability, key=probability.get, reverse=True))
        reason = (
            f"{names} explain the motion almost equally well (p = {p:.2f}); a longer motion would tell; {how}{note}"
        )
    sure = done.spread
    rival, axis_deg = done.rival, done.axis_deg
    if verdict == "ok" and done.doubt:
        verdict, reason = "ambiguous", f"{done.doubt}; {how}{note}"
    if verdict == "ok" and rival is not None and rival.probability > LIKELY:
        verdict = "ambiguous"
        reason = (
            f"another axis, {rival.apart_deg:.0f} deg off, explains the motion almost equally well "
            f"(p = {rival.probability:.2f}); a longer motion would tell; {how}{note}"
        )
    if verdict == "ok" and axis_deg > VAGUE_DEG:
        verdict = "ambiguous"
        reason = (
            f"{len(done.members)} tracks hold the axis to {axis_deg:.0f} deg only; a longer motion, or more of "
            f"the part in view, would tell; {how}{note}"
        )
    std = {"axis_deg": axis_deg, "point_m": sure.point, "q": sure.q,
           "focal_px": full_focal * (sure.log_focal if focal_std is None else focal_std)}  # fmt: skip
    fit = JointFit(
        verdict,
        reason,
        b.kind,
        probability,
        R @ axis,
        None if pivot is None else R @ pivot + t,
        b.twist.pitch / unit if b.kind == "screw" else None,
        q,
        video.index,
        K,
        np.linalg.inv(T_world_camera),
        (points @ R.T + t)[stays],
        done.members[stays],
        False,
        "none",
        std,
        residual_px=float(np.median(r)) / video.scale,
        inliers=len(done.members),
        tracks=tracks,
        moving_frames=moving_frames(q, video.time),
    )
    return replace(fit, image_line=image_line(fit), alone_deg=done.alone_deg, members=done.members)


def stay(b: Bundle, s: Sightings) -> np.ndarray:
    """(N,) bool: points near the others whose tracks stayed on them; where these are hardly any all near the others, or
    at last all.

    What slides along an edge has a say in the joint, but is in no one place of the link; nor is a track that is
    explained only far before or behind it.
    """
    near = compact(b.X) & (b.X[:, 2] > 0)
    off = np.linalg.norm(residuals(b, replace(s, slip=None)), axis=-1)
    out = near & s.seen.any(1)
    out[out] = np.nanmedian(np.where(s.seen, off, np.nan)[out], axis=1) < SLID_PX
    for kept in (out, near):
        if kept.sum() >= MIN_INLIERS:
            return kept
    return np.ones(len(near), bool)


def moving_frames(q: np.ndarray, time: np.ndarray) -> np.ndarray:
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
