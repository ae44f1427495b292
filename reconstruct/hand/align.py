"""From hands in the picture to a demonstration that drives the part in physics.

One view leaves the hand's depth open, and millimetres decide between pushing, missing and sweeping the part away. What
settles it is that a hand which drives a part is nearly still in the part's frame: there the frames of a stroke are
many looks at one pose. That pose, moved as little as the evidence allows, becomes a grip (:mod:`.grip`) and is carried
with the part; before and after, the hand follows what was seen, clear of the part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from reconstruct.cues import HandReference, Hands, LinkMasks
from reconstruct.geometry import Geometry
from reconstruct.hand.drive import Drive, close_gaps, find_drive, moving_frames, runs
from reconstruct.hand.grip import (
    ACROSS_STD,
    HALF_HAND,
    PRESS,
    RADII,
    RAY_STD,
    Grip,
    Sighting,
    find_grips,
    pushing_spheres,
)
from reconstruct.hand.holds import Part, assumed_handle
from reconstruct.hand.path import clear_path, exit_direction
from reconstruct.hand.pnp import hand_positions
from reconstruct.hand.shape import LinkShape, drive_direction
from reconstruct.hand.skeleton import ADULT_SIZE_STD, HAND_SIZE_STD, TIPS, bone_lengths, with_bone_lengths
from reconstruct.joint.models import JointFit
from reconstruct.video import Video

ONSET = 0.1  # s before the part moves in which a touching hand begins to press
MAX_BACK = 0.03  # m by which a waiting hand stays back from its grip at most
OWN_SHARE = 0.05  # of the stroke, in which the hand must be seen to drive for these frames to say how it holds the part
FOUND_SECONDS = 0.15  # a hand that holds on so soon after it is found was holding on before
DEPTH_FLOOR, ACROSS_FLOOR = 0.01, 0.005  # m, least standard deviations of an aligned hand
TIPS_STD = 0.005  # m of a finger tip: landmark noise of 4 % of a palm, and the 4 mm by which tips are pressed in
REST_STD = 0.015  # m, how still a driving hand's tips are in the link's frame
SURFACE_STD = 0.008  # m, of the geometry's surface: where a hand measured in space meets it
HANDLE_COST = 6.0  # of assuming a handle, beside a grip's squared standard deviations
DOUBT = 2.0  # standard deviations: a grip farther from where the hand was seen speaks against the geometry


@dataclass(frozen=True)
class Seen:
    """The driving hand as seen: camera (T, 21, 3) m with gaps filled, valid (T,) where it was not filled."""

    camera: np.ndarray
    valid: np.ndarray


def _smooth(x: np.ndarray, sigma: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(x, max(sigma, 1e-3), axis=0, mode="nearest")


def _fill(x: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Linear in time between valid frames, constant beyond them."""
    t = np.arange(len(x))
    flat = x.reshape(len(x), -1)
    out = np.stack([np.interp(t, t[valid], column[valid]) for column in flat.T], axis=1)
    return out.reshape(x.shape)


def observe(hands: Hands, index: int, K: np.ndarray, rate: float) -> Seen:
    """Landmarks of one hand in the camera's frame, gaps filled, depth and shape smoothed, image place kept."""
    hand = hands.tracks[index]
    camera, _ = hand_positions(hand, K)
    valid = np.isfinite(camera[:, 0, 0])
    camera = _fill(camera, valid)
    if hand.placed is not None:  # measured: nothing to smooth but the noise that it has
        return Seen(_smooth(camera, 0.03 * rate), valid)
    # Depth errs in bursts of frames, the image place does not: smooth the depth alone, along the rays.
    depth = np.log(camera[..., 2].mean(1))
    half = max(1, round(0.15 * rate))
    median = np.array([np.median(depth[max(0, t - half) : t + half + 1]) for t in range(len(depth))])
    slow = _smooth(median, 0.12 * rate)
    camera = camera * np.exp(slow - depth)[:, None, None]
    centre = camera.mean(1, keepdims=True)
    # Filling and smoothing shorten bones; the depth's factor has already changed them all alike.
    lengths = np.median(bone_lengths(camera[valid]), axis=0)
    shape = with_bone_lengths(_smooth(camera - centre, 0.06 * rate), lengths)
    return Seen(_smooth(centre, 0.03 * rate) + shape - shape.mean(1, keepdims=True), valid)


def _to_world(fit: JointFit, camera: np.ndarray) -> np.ndarray:
    T = fit.T_camera_world
    return (camera - T[:3, 3]) @ T[:3, :3]


def _to_link(pose: np.ndarray, world: np.ndarray) -> np.ndarray:
    """World points (T, N, 3) -> link frame, pose (T, 4, 4)."""
    return np.einsum("tji,tnj->tni", pose[:, :3, :3], world - pose[:, None, :3, 3])


def _from_link(pose: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Link-frame points (N, 3) or (T, N, 3) -> world (T, N, 3)."""
    x = np.broadcast_to(x, (len(pose), *x.shape[-2:]))
    return np.einsum("tij,tnj->tni", pose[:, :3, :3], x) + pose[:, None, :3, 3]


def _tip_spread(fit: JointFit, camera: np.ndarray, use: np.ndarray) -> float:
    """Median distance, m, of finger tips from their middle place in the link's frame."""
    tips = _to_link(fit.link_pose(fit.q[use]), _to_world(fit, camera[use]))[:, TIPS]
    return float(np.median(np.linalg.norm(tips - np.median(tips, axis=0), axis=-1)))


def depth_factor(fit: JointFit, shape: LinkShape, camera: np.ndarray, use: np.ndarray) -> tuple[float, float]:
    """Common factor on the hand's distance that puts it at the link and at rest in the link's frame.

    Args:
        camera: (T, 21, 3) m.  use: frames in which the hand drives the link.

    Returns:
        The factor (the hand grows with it, its image stays) and the spread of the tips in the link's frame, m.
    """
    pose = fit.link_pose(fit.q[use])
    best = (np.inf, 1.0, 0.0)
    for log in np.linspace(-0.45, 0.45, 61):
        link = _to_link(pose, _to_world(fit, camera[use] * np.exp(log)))
        tips = link[:, TIPS]
        middle = np.median(tips, axis=0)
        spread = np.median(np.linalg.norm(tips - middle, axis=-1))
        gap = max(0.0, float(np.sort(shape.distance(middle)[0])[:3].mean()) - RADII[4])
        # Inside is as wrong as outside.
        sunk = max(0.0, -float(np.median(shape.distance(link.mean(1))[0])))
        cost = (log / HAND_SIZE_STD) ** 2 + (spread / REST_STD) ** 2 + (gap / 0.01) ** 2 + (sunk / 0.02) ** 2
        if cost < best[0]:
            best = (cost, float(np.exp(log)), float(spread))
    return best[1], best[2]


def rest_pose(link: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The pose (21, 3) a hand has in the link's frame while it drives it.

    Args:
        link: (n, 21, 3) m poses in the link's frame.
        motion: (n,) how much the joint moves in each: where the hand holds on in two places one after the other, the
            place that moves the link more is taken.
    """
    tips = link[:, TIPS].mean(1)
    near = np.linalg.norm(tips[:, None] - tips[None], axis=-1) < 0.04
    chosen = near[int((near @ motion).argmax())]
    return with_bone_lengths(np.median(link[chosen], axis=0), np.median(bone_lengths(link[chosen]), axis=0))


def _carried(drive: Drive, valid: np.ndarray, moving: np.ndarray, rate: float) -> np.ndarray:
    """Frames in which the hand is not seen but must still be holding on: out of the picture while the part moves."""
    out = np.zeros(len(valid), bool)
    reach = max(1, round(FOUND_SECONDS * rate))
    for a, b in runs(~valid):
        # Lost at the part is holding it; found at the part was holding it only if it is holding it then.
        before = a > 0 and drive.attached[:a].any() and drive.near[max(0, a - 3) : a].any()
        after = b < len(valid) and drive.attached[b : b + reach].any() and drive.near[b : b + 3].any()
        if before and moving[a:b].any():
            out[a : a + int(np.flatnonzero(moving[a:b])[-1]) + 1] = True
        if before and after:
            out[a:b] = True
        if after and not before and a == 0:  # held from the start, seen only later
            out[a:b] = True
    return out


def align_hand(video: Video, hands: Hands, fit: JointFit, geometry: Geometry, masks: LinkMasks | None = None
               ) -> HandReference:
    """The demonstration: the driving hand in the world, where it can push the part.

    The grip is chosen by what the video shows and the geometry allows; no simulation is looked at, so that a replay of
    the reference is a test of it and not a result of having been selected for.

    Args:
        video: working frames (times only are used).
        hands: hands of the same frames.
        fit: metric joint.
        geometry: both links; the moving one's collision parts are what the hand meets.
        masks: of the links; accepted for symmetry with the other stages, the geometry carries what is needed.

    Returns:
        The reference. Where no hand drives the part, ``hand_valid`` and ``contact`` are all False, the landmarks
        rest away from the part, and the notes say why.
    """
    time = video.time
    rate = 1.0 / max(float(np.median(np.diff(time))), 1e-6)
    shape = LinkShape(geometry.moving)
    moving = moving_frames(fit, time)
    points = shape.points if fit.points is None else np.concatenate([shape.points, fit.points])
    drive = find_drive(hands, fit, time, points)
    if drive.index is None:
        why = "no hand was seen" if not hands.tracks else "no hand moves with the part while it moves"
        return _absent(video, fit, shape, f"{why}: the demonstration holds no hand that drives the part")
    hand = hands.tracks[drive.index]
    notes: list[str] = []
    seen = observe(hands, drive.index, fit.K, rate)
    sign = _stroke_sign(fit.q)
    forward = np.maximum(sign * np.gradient(fit.q), 0.0)
    use = drive.drives & seen.valid
    if forward[use].sum() < OWN_SHARE * forward.sum():
        # What is replayed is the stroke; a hand that is seen to drive only its way back may hold it otherwise.
        use = drive.attached & drive.near & (forward > 0) & moving & seen.valid
    if use.sum() < 3:
        return _absent(video, fit, shape, "the driving hand's position could not be computed")
    measured = hand.placed is not None
    if measured:
        factor, spread = 1.0, _tip_spread(fit, seen.camera, use)
        sighting = Sighting.measured(float(np.hypot(hand.placed_std or 0.0, SURFACE_STD)))
        notes.append(f"hand taken where it was measured in space; its tips stay within {1e3 * spread:.0f} mm in the "
                     "part's frame while it drives it")
    else:
        sighting = Sighting()
        factor, spread = depth_factor(fit, shape, seen.camera, use)
        notes.append(f"hand depth times {factor:.2f} puts it at the part; it then stays within {1e3 * spread:.0f} mm "
                     f"in the part's frame while it drives it")
    if drive.beyond:
        notes.append("no hand moves as the part's surface does: this one's fingers move as it would beyond its edge")
    world = _to_world(fit, seen.camera * factor)
    pose = fit.link_pose(fit.q)
    carried = _carried(drive, hand.valid, moving, rate)
    attached = close_gaps(drive.attached | carried, round(0.2 * rate))
    if carried.any():
        notes.append(f"hand not seen in {int((carried & moving).sum())} frames in which the part moves: "
                     "assumed to hold on, carried with the part")
    weight = forward[use] if forward[use].sum() > 0 else np.abs(np.gradient(fit.q))[use]
    rest = rest_pose(_to_link(pose[use], world[use]), weight)
    key = int(np.flatnonzero(use)[weight.argmax()])
    centre = -fit.T_camera_world[:3, :3].T @ fit.T_camera_world[:3, 3]
    ray = pose[key, :3, :3].T @ (world[key].mean(0) - centre)
    ray = ray / np.linalg.norm(ray)
    grip, shape, holds = _choose(shape, fit, sign, rest, ray, sighting, notes)
    still = _from_link(pose, grip.pose)
    if measured:  # what the hand does in the part's frame was measured too; only its correction is common to all frames
        own = _to_link(pose, world)
        for a, b in runs(attached):
            own[a:b] = _smooth(own[a:b], 0.1 * rate)
        still = _from_link(pose, own + (grip.pose - rest))
    held = still - _waiting(shape, fit, pose, grip, moving, sign, rate)
    joints = _assemble(shape, world, held, pose, attached, grip, rate)
    notes.append(f"{grip.kind}: {grip.pushing} contact spheres on faces that look against the motion; hand moved by "
                 f"{1e3 * np.linalg.norm(grip.shift):.0f} mm and {np.degrees(grip.turn):.0f} deg from where it was "
                 "seen")
    if grip.hidden > 1:
        notes.append("the part would hide this hand from the camera: the geometry lacks what the hand really held")
    return HandReference(time.copy(), fit.q.copy(), joints, seen.valid & ~carried, attached & moving, hand.side,
                         tuple(notes), _uncertainty(grip, ray, rate, hand.placed_std if measured else None), holds)


def _choose(shape: LinkShape, fit: JointFit, sign: float, rest: np.ndarray, ray: np.ndarray, sighting: Sighting,
            notes: list[str]) -> tuple[Grip, LinkShape, tuple[Part, ...]]:  # fmt: skip
    """The grip nearest to the evidence, the link as it is then, and what had to be added to the link for it."""
    grips = find_grips(shape, fit, sign, rest, ray, sighting=sighting)
    if not grips or sighting.off(grips[0], ray) > DOUBT or grips[0].hidden > 1:
        handle = assumed_handle(shape, fit, sign, rest, ray)
        if handle is not None:
            parts, moved = handle
            more = shape.with_parts(parts)
            held = find_grips(more, fit, sign, moved, ray, sighting=sighting)
            # Its shift is from where the hand was seen, not from where it is clear.
            held = [replace(grip, shift=grip.shift + (moved - rest).mean(0)) for grip in held]
            held = [grip for grip in held if grip.hidden <= 1 and sighting.off(grip, ray) <= DOUBT]
            if held and (not grips or held[0].cost + HANDLE_COST < grips[0].cost):
                notes.append("no face of the part that the hand could have moved it by lies where the hand was seen: a "
                             "handle is assumed before its finger tips")
                return held[0], more, parts
    if not grips:
        notes.append("no face of the part looks against its motion within the hand's reach: pose left as seen")
        return Grip(rest, "as seen", np.zeros(3), 0.0, 0, 0, 0.0), shape, ()
    return grips[0], shape, ()


def _uncertainty(grip: Grip, ray: np.ndarray, rate: float, measured: float | None) -> dict[str, float]:
    """What stays open about the demonstrated hand, standard deviations.

    Observation and contact disagree by how far the hand had to be moved to its grip; that is what either may be off
    by, and never less than what the landmarks themselves are. Along the link's motion contact has settled where the
    hand is, up to the tips' own error; across it only observation has: the whole hand's offset is that.
    """
    along = float(grip.shift @ ray)
    aside = float(np.linalg.norm(grip.shift - along * ray))
    depth, across, size = DEPTH_FLOOR, ACROSS_FLOOR, ADULT_SIZE_STD
    if measured is not None:
        depth, across, size = measured, measured, min(ADULT_SIZE_STD, measured / HALF_HAND)
    depth, across = (min(float(np.hypot(depth, along)), RAY_STD), min(float(np.hypot(across, aside)), ACROSS_STD))
    return {"depth": depth, "across": across, "size": size, "time": 1.0 / rate, "tips": TIPS_STD,
            "offset": float(np.hypot(across, TIPS_STD))}


def _stroke_sign(q: np.ndarray) -> float:
    from taa_envs.asset import demonstration

    demo = demonstration(q)
    return float(np.sign(demo["q_demo_end"] - demo["q_start"]))


def _waiting(shape: LinkShape, fit: JointFit, pose: np.ndarray, grip: Grip, moving: np.ndarray, sign: float,
             rate: float) -> np.ndarray:  # fmt: skip
    """(T, 1, 3) m by which the hand is back from its grip: until the part moves it touches and does not press.

    The joint's own motion says when the push begins; a hand that pressed while it waited would push too early.
    """
    onset = int(np.argmax(moving)) if moving.any() else 0
    onset = max(onset, round(ONSET * rate))  # a video that begins with the push begins with a touch all the same
    early = np.clip((onset - np.arange(len(pose))) / max(ONSET * rate, 1.0), 0.0, 1.0)
    direction = drive_direction(fit, grip.pose[TIPS].mean(0), sign)
    # Back by the press, and on until nothing else of the hand pushes: a grip may hold the link with more than its tips.
    back = PRESS + 0.001
    while back < MAX_BACK and pushing_spheres(shape, fit, sign, grip.pose - back * direction).any():
        back += 0.001
    return (back * early * early * (3 - 2 * early))[:, None, None] * (pose[:, :3, :3] @ direction)[:, None]


def _assemble(shape: LinkShape, world: np.ndarray, held: np.ndarray, pose: np.ndarray, attached: np.ndarray, grip: Grip,
              rate: float) -> np.ndarray:
    """World landmarks (T, 21, 3): the grip (``held``) while attached, as seen and clear of the link otherwise."""
    n = len(world)
    out, offset = world.copy(), np.zeros_like(world)
    stretches = runs(attached)
    for a, b in stretches:
        offset[a:b] = held[a:b] - world[a:b]
    free = ~attached
    # The correction fades with the distance in time from the grip.
    t = np.arange(n)
    if stretches:
        anchor = np.flatnonzero(attached)
        left = anchor[np.clip(np.searchsorted(anchor, t, "right") - 1, 0, len(anchor) - 1)]
        right = anchor[np.clip(np.searchsorted(anchor, t, "left"), 0, len(anchor) - 1)]
        fade = 1.5 * rate
        wl = np.where(left <= t, np.exp(-np.abs(t - left) / fade), 0.0)
        wr = np.where(right >= t, np.exp(-np.abs(t - right) / fade), 0.0)
        total = np.maximum(wl + wr, 1e-9)
        blend = (wl**2 / total)[:, None, None] * offset[left] + (wr**2 / total)[:, None, None] * offset[right]
        offset[free] = blend[free]
    out = world + offset
    out[attached] = held[attached]
    if not free.any() or not stretches:
        return out
    away = exit_direction(shape, grip.pose, _to_link(pose, world)[free].mean((0, 1)) - grip.pose.mean(0))
    return clear_path(shape, pose, out, held, attached, away, rate)


def _absent(video: Video, fit: JointFit, shape: LinkShape, note: str) -> HandReference:
    n = len(video.time)
    # A reference must be finite: an open hand, well away from everything the link sweeps.
    far = shape.centre + np.array([0.0, 0.0, 3.0 * shape.size + 0.5])
    joints = np.zeros((21, 3))
    for f in range(5):
        for j in range(4):
            joints[1 + 4 * f + j] = (0.02 * (f - 2), 0.05 + 0.025 * j, 0.0)
    nobody = np.zeros(n, bool)
    return HandReference(video.time.copy(), fit.q.copy(), np.broadcast_to(joints + far, (n, 21, 3)).copy(), nobody,
                         nobody.copy(), "right", (note,))


__all__ = ["align_hand", "depth_factor", "observe", "rest_pose"]
