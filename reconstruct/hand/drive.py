"""Which hand drives the part, and in which frames.

A hand drives the part in a frame if the part moves, the hand is at the part's picture, and the hand's landmarks move
over the picture as the part's surface does there. A hand that only passes by, holds the other link or presses a button
fails the last test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reconstruct.cues import Hands, HandTrack
from reconstruct.hand.skeleton import CONTACT, palm_pixels
from reconstruct.joint.models import JointFit

NEAR, BESIDE = 0.6, 1.5  # palm sizes between the nearest finger joint and the part's outline: at it, and beside it
AGREE = 0.5  # difference of the motions, relative to the part's own
BLINK = 0.15  # s without a hand between frames in which it is at the part
WINDOWS = (0.2, 0.4, 0.7, 1.0)  # s over which motion is compared, the shortest that shows enough of it


@dataclass(frozen=True)
class Drive:
    """The driving hand.

    Attributes:
        index: which of ``Hands.tracks``; None where no hand drives the part.
        near: (T,) bool, the hand is seen at the part.
        drives: (T,) bool, it is seen to drive it.
        attached: (T,) bool, it is at the part and moves (or rests) with it; short gaps are closed.
        beyond: no hand moves as the part's surface does, and this one's fingers as it would beyond its edge: weaker
            evidence.
    """

    index: int | None
    near: np.ndarray
    drives: np.ndarray
    attached: np.ndarray
    beyond: bool = False


def moving_frames(fit: JointFit, time: np.ndarray) -> np.ndarray:
    """(T,) bool, frames in which the joint moves at more than 3 % of its range a second, smoothed over 0.2 s."""
    rate = 1.0 / max(float(np.median(np.diff(time))), 1e-6)
    half = max(1, round(0.1 * rate))
    t = np.arange(len(fit.q))
    low, high = np.clip(t - half, 0, len(t) - 1), np.clip(t + half, 0, len(t) - 1)
    speed = np.abs(fit.q[high] - fit.q[low]) / np.maximum(time[high] - time[low], 1e-6)
    out = close_gaps(speed > max(0.03 * float(np.ptp(fit.q)), 1e-9), half)
    for a, b in runs(out):  # a flicker of one or two frames is noise of q
        out[a:b] = b - a > half
    return out


def close_gaps(flags: np.ndarray, length: int) -> np.ndarray:
    """Fill runs of False of at most this many frames between True ones."""
    out = flags.copy()
    on = np.flatnonzero(flags)
    for a, b in zip(on, on[1:], strict=False):
        if 1 < b - a <= length + 1:
            out[a:b] = True
    return out


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """Half-open (start, stop) of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _outside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Distance (n,) px from points to a convex outline, 0 inside."""
    import cv2

    hull = cv2.convexHull(outline.astype(np.float32))
    return np.array([max(0.0, -cv2.pointPolygonTest(hull, (float(u), float(v)), True)) for u, v in points])


def _affine(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 2) moved by the affine map that takes before (M, 2) to after (M, 2) best."""
    middle, size = before.mean(0), max(float(before.std()), 1e-9)
    A = np.column_stack([(before - middle) / size, np.ones(len(before))])
    # Seen edge-on the part says nothing about what is beside its line: no slope there.
    X = np.linalg.lstsq(A, after - before, rcond=0.1)[0]
    return points + np.column_stack([(points - middle) / size, np.ones(len(points))]) @ X


def _evidence(hand: HandTrack, fit: JointFit, time: np.ndarray, surface: np.ndarray, moving: np.ndarray, beyond: bool
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one hand: apart (T,) from the part in palm sizes (NaN unseen); moves with it (T,) and otherwise (T,).

    Neither of the last two holds where the part moves too little to tell. surface (M, 3): points of the link at q = 0.
    beyond: fingers may also move as the part's picture would if it went on to where they are.
    """
    n = len(time)
    away, agree, differ = np.full(n, np.nan), np.zeros(n, bool), np.zeros(n, bool)
    pose = fit.link_pose(fit.q)
    picture = [fit.project(surface @ pose[t, :3, :3].T + pose[t, :3, 3]) for t in range(n)]
    for t in np.flatnonzero(hand.valid):
        away[t] = _outside(hand.uv[t, CONTACT], picture[t]).min() / max(float(palm_pixels(hand.uv[t])), 1.0)
    rate = 1.0 / max(float(np.median(np.diff(time))), 1e-6)
    spans = np.unique(np.round(0.5 * np.array(WINDOWS) * rate).astype(int).clip(1))
    for t in np.flatnonzero((away < BESIDE) & moving):
        size = float(palm_pixels(hand.uv[t]))
        gap = np.linalg.norm(hand.uv[t, CONTACT][:, None] - picture[t][None], axis=-1)
        # Each finger joint against the surface beside it: a hand that turns with a lid moves differently everywhere.
        beside = np.argsort(gap, axis=1)[:, : min(3, gap.shape[1])]
        close = gap.min(1) < BESIDE * size
        for half in spans:
            a, b = max(0, t - half), min(n - 1, t + half)
            a, b = a + int(np.argmax(hand.valid[a : t + 1])), b - int(np.argmax(hand.valid[t : b + 1][::-1]))
            part = np.median(picture[b][beside] - picture[a][beside], axis=1)
            stride = np.linalg.norm(part, axis=1)
            tell = close & (stride > 0.25 * size)
            if tell.sum() < 3:  # too little motion to tell a moving hand from a resting one: look longer
                continue
            own = hand.uv[b, CONTACT] - hand.uv[a, CONTACT]
            agrees = np.linalg.norm(own - part, axis=1) < AGREE * stride
            if beyond:
                onward = _affine(picture[a], picture[b], hand.uv[a, CONTACT]) - hand.uv[a, CONTACT]
                reach = np.maximum(np.linalg.norm(onward, axis=1), stride)
                agrees |= np.linalg.norm(own - onward, axis=1) < AGREE * reach
            agree[t] = np.mean(agrees[tell]) >= 0.3
            unit, own = part[tell] / stride[tell, None], own[tell] / stride[tell, None]
            # Faster or slower along the part's way is doubt; standing still or going elsewhere is contradiction.
            along = (own * unit).sum(1)
            aside = np.linalg.norm(own - along[:, None] * unit, axis=1)
            differ[t] = np.mean((along < 0.3) | (aside > 1.0)) > 0.6
            break
    return away, agree, differ


def _extend(attached: np.ndarray, moving: np.ndarray, near: np.ndarray, beside: np.ndarray, differ: np.ndarray
            ) -> np.ndarray:
    """Over the neighbouring frames of one movement.

    Something set the part in motion, so a hand that is at it from the beginning and is seen to drive it later did. The
    end is another matter: a part can go on after it was let go.
    """
    out = attached.copy()
    for a, b in runs(attached):
        while a > 0 and moving[a - 1] and (near[a - 1] or (beside[a - 1] and not differ[a - 1])):
            a -= 1
        while b < len(out) and moving[b] and beside[b] and not differ[b]:
            b += 1
        out[a:b] = True
    return out


def _majority(flags: np.ndarray, among: np.ndarray, half: int) -> np.ndarray:
    """Flags that hold in most of the ``among`` frames around."""
    votes = np.convolve((flags & among).astype(float), np.ones(2 * half + 1), "same")
    total = np.convolve(among.astype(float), np.ones(2 * half + 1), "same")
    return among & (votes > 0.5 * np.maximum(total, 1))


def _rest(attached: np.ndarray, moving: np.ndarray, near: np.ndarray, hand: HandTrack) -> np.ndarray:
    """Over the neighbouring frames in which part and hand both stay where they are."""
    out = attached.copy()
    for a, b in runs(attached):
        for edge, step in ((a, -1), (b - 1, 1)):
            t = edge + step
            while 0 <= t < len(out) and not moving[t] and near[t] and hand.valid[edge]:
                shift = np.median(hand.uv[t, CONTACT] - hand.uv[edge, CONTACT], axis=0)
                if np.linalg.norm(shift) > 0.25 * palm_pixels(hand.uv[edge]):
                    break
                out[t] = True
                t += step
    return out


def find_drive(hands: Hands, fit: JointFit, time: np.ndarray, surface: np.ndarray | None = None) -> Drive:
    """The hand that drives the part.

    Args:
        hands: all hands.
        fit: the joint (metric or not).
        time: (T,) s.
        surface: (M, 3) points of the moving link at q = 0, world; default the fit's.
    """
    n = len(time)
    nobody = np.zeros(n, bool)
    surface = fit.points if surface is None else surface
    if not hands.tracks or surface is None or len(surface) < 3:
        return Drive(None, nobody, nobody, nobody)
    moving = moving_frames(fit, time)
    rate = 1.0 / max(float(np.median(np.diff(time))), 1e-6)
    # Evidence weighs as much as the joint moves meanwhile.
    motion = np.abs(np.gradient(fit.q))
    half = max(2, round(0.15 * rate))
    # A hand on the part moves as the surface under it. Fingers beyond the part's edge move farther; what they would do
    # there is a guess that other motions meet too, so it is asked only where no hand moves as the surface does.
    for beyond in (False, True):
        best, best_motion = None, 0.0
        for i, hand in enumerate(hands.tracks):
            away, agree, differ = _evidence(hand, fit, time, surface, moving, beyond)
            near = away < NEAR
            drives = _majority(agree, near & moving, half)
            differ = _majority(differ, (away < BESIDE) & moving, half)
            driven = float(motion[drives].sum())
            if driven > best_motion:
                best, best_motion = (i, near, drives, away < BESIDE, differ), driven
        if best is not None and best_motion >= 0.05 * float(motion.sum()) and best[2].sum() >= 3:
            break
    else:
        return Drive(None, nobody, nobody, nobody)
    index, near, drives, beside, differ = best
    valid = hands.tracks[index].valid
    # A hand that is missed for a moment is meanwhile where it was.
    blink = round(BLINK * rate)
    near, beside = (flags | (close_gaps(flags, blink) & ~valid) for flags in (near, beside))
    attached = _extend(close_gaps(drives, 4), moving, near, beside, differ)
    # Between two driven stretches a hand that never leaves the part rests on it.
    stretches = runs(attached)
    for (_, a), (b, _) in zip(stretches, stretches[1:], strict=False):
        seen = valid[a:b]
        if not (seen & ~near[a:b]).any() and (near[a:b].sum() >= 0.8 * seen.sum()):
            attached[a:b] = True
    attached = _rest(attached, moving, near, hands.tracks[index])
    return Drive(index, near, drives, attached, beyond)
