"""The pixels of hands and arms, from landmarks, the colour of this clip's skin and this clip's background.

Skin colour alone will not do: tables, floors and cabinets are skin coloured. A pixel counts as hand only where three
things agree: its colour is likelier under the skin seen between the landmarks than under the rest of the picture; it
differs from what is seen there when no hand is (where that was ever seen); and it is connected to the landmarks within
the hand's surroundings. In the cone behind the wrist, where only a forearm can be, the change alone is enough:
bracelets and sleeves belong to the arm too.

A hand that hardly moves shows no background. Where next to nothing else in the clip has the colour of its skin, that
tells it alone; and a sleeve is told by its own colours, learnt from what is seen behind the end of the bare arm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reconstruct.cues import HandTrack
from reconstruct.video import Video

LONG_SIDE = 480  # masks are made at this size, px
BINS = (12, 32, 32)  # Y, Cr, Cb
PALM = (0, 1, 5, 9, 13, 17)
FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
SURE_SCORE = 0.85  # landmarks at least this confident teach the skin colour
GAP_SECONDS = 1.0  # without landmarks a hand is carried on for at most this long, unless it stays at the border
SLEEVE = 0.5  # of what is seen behind the bare arm has to be of colours that are seen less elsewhere
CLEARLY = 3.0  # logarithm of how much likelier a colour is on the hand: parts that hide fingers are taught as skin too
ELSEWHERE = 0.2  # of the hands' area may be skin coloured elsewhere for colour alone to tell them
CHANGED = 14.0  # YCrCb distance from the background that counts as something else being there


def _palm_size(uv: np.ndarray) -> float:
    return float(max(np.linalg.norm(uv[9] - uv[0]), np.linalg.norm(uv[5] - uv[17]), 1.0))


def _draw_hand(shape: tuple[int, int], uv: np.ndarray, thickness: float) -> np.ndarray:
    """Palm polygon and fingers; thickness in palm sizes."""
    import cv2

    out = np.zeros(shape, np.uint8)
    width = max(1, round(thickness * _palm_size(uv)))
    points = np.round(uv).astype(np.int32)
    cv2.fillConvexPoly(out, cv2.convexHull(points[list(PALM)]), 1)
    for finger in FINGERS:
        cv2.polylines(out, [points[list(finger)]], False, 1, width)
    return out


def _surroundings(shape: tuple[int, int], uv: np.ndarray, reach: float = 0.35) -> np.ndarray:
    """The hand's dilated hull; reach in palm sizes."""
    import cv2

    out = np.zeros(shape, np.uint8)
    hull = cv2.convexHull(np.round(uv).astype(np.int32))
    cv2.fillConvexPoly(out, hull, 1)
    cv2.polylines(out, [hull], True, 1, max(1, round(2 * reach * _palm_size(uv))))
    return out


def _backwards(uv: np.ndarray) -> np.ndarray:
    """(2,) unit, from the knuckles to the wrist."""
    away = uv[0] - uv[[5, 9, 13, 17]].mean(0)
    return away / max(np.linalg.norm(away), 1e-6)


def _forearm(shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """The cone behind the wrist in which the forearm can be."""
    import cv2

    out = np.zeros(shape, np.uint8)
    size = _palm_size(uv)
    back = _backwards(uv)
    side = np.array([-back[1], back[0]])
    far = uv[0] + 3.0 * max(shape) * back
    spread = np.tan(np.deg2rad(35.0)) * 3.0 * max(shape)
    cone = np.stack([uv[0] + 0.8 * size * side, far + spread * side, far - spread * side, uv[0] - 0.8 * size * side])
    cv2.fillConvexPoly(out, np.round(np.clip(cone, -1e4, 1e4)).astype(np.int32), 1)
    return out


def _bins(ycc: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 -> flat histogram index."""
    i = (ycc.astype(np.int32) * BINS) >> 8
    return (i[..., 0] * BINS[1] + i[..., 1]) * BINS[2] + i[..., 2]


def _log_density(counts: np.ndarray) -> np.ndarray:
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(counts.reshape(BINS).astype(float), (0.8, 0.8, 0.8))
    return np.log(smooth / max(smooth.sum(), 1.0) + 1e-6).ravel()


def _connected(candidates: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Components of the candidates that overlap the seed."""
    import cv2

    _, labels = cv2.connectedComponents(candidates.astype(np.uint8))
    touched = np.unique(labels[seed.astype(bool) & candidates.astype(bool)])
    return np.isin(labels, touched[touched > 0])


def _rim(shape: tuple[int, ...]) -> np.ndarray:
    """(h, w) bool, the picture's outermost pixels."""
    rim = np.zeros(shape, bool)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    return rim


def _at_border(mask: np.ndarray) -> np.ndarray:
    """Components that touch the image border."""
    return _connected(mask, _rim(mask.shape))


def _large(mask: np.ndarray, area: float) -> np.ndarray:
    """Components of at least this many pixels."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return mask & (stats[labels, cv2.CC_STAT_AREA] >= area)


def _background(ycc: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median picture of the frames in which a pixel is uncovered, and where there were enough of those."""
    pick = np.linspace(0, len(ycc) - 1, min(len(ycc), 40)).round().astype(int)
    stack = ycc[pick].astype(np.float32)
    stack[covered[pick].astype(bool)] = np.nan
    known = np.isfinite(stack[..., 0]).sum(0) >= 4
    median = np.zeros(ycc.shape[1:], np.float32)
    median[known] = np.nanmedian(stack[:, known], axis=0)
    return median, known


def hand_mask(video: Video, tracks: tuple[HandTrack, ...]) -> np.ndarray:
    """(T, h, w) bool at working size: hands and arms, sleeves included; all False if no hand was seen."""
    import cv2

    n, height, width = video.frames.shape[:3]
    out = np.zeros((n, height, width), bool)
    if not tracks:
        return out
    k = min(1.0, LONG_SIDE / max(height, width))
    shape = (round(height * k), round(width * k))
    ycc = np.empty((n, *shape, 3), np.uint8)
    for t in range(n):
        small = cv2.resize(video.frames[t], shape[::-1], interpolation=cv2.INTER_AREA)
        ycc[t] = cv2.cvtColor(small, cv2.COLOR_BGR2YCrCb)
    hands = [[(video.to_work(x.uv[t]) + 0.5) * k - 0.5 for x in tracks if x.valid[t]] for t in range(n)]
    near, arm = np.zeros((n, *shape), np.uint8), np.zeros((n, *shape), np.uint8)
    skin, rest = np.zeros(np.prod(BINS)), np.zeros(np.prod(BINS))
    for t in range(n):
        for uv in hands[t]:
            near[t] |= _surroundings(shape, uv)
            arm[t] |= _forearm(shape, uv)
        for x in tracks:
            if x.valid[t] and x.score[t] >= SURE_SCORE:
                inside = _draw_hand(shape, (video.to_work(x.uv[t]) + 0.5) * k - 0.5, 0.12).astype(bool)
                skin += np.bincount(_bins(ycc[t][inside]), minlength=len(skin))
        # Where no hand was found one may be all the same.
        if hands[t]:
            rest += np.bincount(_bins(ycc[t][(near[t] | arm[t]) == 0]), minlength=len(rest))
    if not skin.any():
        return out
    odds = _log_density(skin) - _log_density(rest)
    is_skin, is_clearly = odds > 0.0, odds > CLEARLY
    background, known = _background(ycc, near | arm)
    alone = _tells_alone(is_clearly, ycc, near, arm, hands)

    def differing(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is not known to be background; what is known to be new; the same without mere shadows."""
        difference = ycc[t] - background
        changed = np.linalg.norm(difference, axis=-1) > CHANGED
        other_hue = np.linalg.norm(difference[..., 1:], axis=-1) > 6.0
        new = known & changed
        return changed | ~known, new, new & (other_hue | (difference[..., 0] < -50.0))

    def candidates(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Skin that is not known to be background; skin known to be new; anything new that is no mere shadow."""
        colour = is_skin[_bins(ycc[t])]
        loose, new, solid = differing(t)
        skin = is_clearly[_bins(ycc[t])] & alone
        return (colour & loose) | skin, (colour & new) | skin, solid

    masks = np.zeros((n, *shape), np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    bridge = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (11, 11))
    for t in range(n):
        if not hands[t]:
            continue
        loose, _, solid = candidates(t)
        seed = np.zeros(shape, np.uint8)
        for uv in hands[t]:
            seed |= _draw_hand(shape, uv, 0.2)
        agreed = (loose & ((near[t] | arm[t]) > 0)) | (solid & (arm[t] > 0))
        allowed = cv2.morphologyEx(agreed.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        allowed = np.maximum(allowed, cv2.morphologyEx(allowed, cv2.MORPH_CLOSE, bridge) & arm[t])
        mask = _connected(allowed | seed, seed).astype(np.uint8)
        masks[t] = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel)
    _add_sleeves(masks, hands, arm, known, ycc, rest, differing)
    if alone:
        _add_tips(masks, hands, lambda t: is_clearly[_bins(ycc[t])])
    _carry_on(masks, hands, candidates, video.time, kernel)
    grow = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    for t in range(n):
        if masks[t].any():
            big = cv2.resize(cv2.dilate(masks[t], grow), (width, height), interpolation=cv2.INTER_NEAREST)
            out[t] = big.astype(bool)
    return out


def _tells_alone(is_skin: np.ndarray, ycc: np.ndarray, near: np.ndarray, arm: np.ndarray, hands: list) -> bool:
    """Whether nothing but hands and arms is skin coloured in this clip, so that colour alone tells them.

    A hand that rests, or hardly moves, is the only background that is ever seen there.
    """
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    hand = elsewhere = 0
    for t in np.flatnonzero([len(h) > 0 for h in hands]):
        colour = is_skin[_bins(ycc[t])]
        hand += int((colour & (near[t] > 0)).sum())
        away = colour & ((near[t] | arm[t]) == 0)
        elsewhere += int(cv2.morphologyEx(away.astype(np.uint8), cv2.MORPH_OPEN, kernel).sum())
    return elsewhere <= ELSEWHERE * hand


def _arm_end(mask: np.ndarray, cone: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Wrist, direction in which the arm goes on, and how far along that it is in the mask, px."""
    size = _palm_size(uv)
    back = _backwards(uv)
    v, u = np.nonzero(mask & cone)
    away = np.stack([u, v], axis=-1) - uv[0]
    if not len(away):
        return uv[0], back, 0.0
    far = np.linalg.norm(away, axis=1)
    tip = away[far >= np.quantile(far, 0.9)].mean(0)
    if np.linalg.norm(tip) > 0.5 * size:
        back = tip / np.linalg.norm(tip)
    return uv[0], back, float(max(np.quantile(away @ back, 0.98), 0.0))


def _add_sleeves(masks: np.ndarray, hands: list, arm: np.ndarray, known: np.ndarray, ycc: np.ndarray,
                 rest: np.ndarray, candidates: Callable) -> None:  # fmt: skip
    """Sleeves where no background was ever seen: this clip's colours behind the bare arm, as far as the picture's rim.

    Args:
        rest: histogram of the colours that are seen where no hand or arm can be.
        candidates: of a frame, (h, w) bool each: what is not known to be background, what is new, what is no shadow.
    """
    import cv2

    shape = masks.shape[1:]
    v, u = np.mgrid[: shape[0], : shape[1]]
    rim = _rim(shape)
    sleeve = np.zeros(np.prod(BINS))
    for t, mask in enumerate(masks > 0):
        for uv in hands[t]:
            cone = _forearm(shape, uv) > 0
            if not mask.any() or (mask & cone & rim).any():
                continue
            wrist, back, end = _arm_end(mask, cone, uv)
            along = (u - wrist[0]) * back[0] + (v - wrist[1]) * back[1]
            beside = np.abs((u - wrist[0]) * back[1] - (v - wrist[1]) * back[0])
            size = _palm_size(uv)
            behind = cone & ~mask & (along > end - 0.1 * size) & (along < end + 0.6 * size) & (beside < 0.35 * size)
            sleeve += np.bincount(_bins(ycc[t][behind & ~known]), minlength=len(sleeve))
    if not sleeve.any():
        return
    is_sleeve = _log_density(sleeve) - _log_density(rest) > 0.0
    if sleeve[is_sleeve].sum() < SLEEVE * sleeve.sum():
        return
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    bridge = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (11, 11))
    for t in range(len(masks)):
        if not masks[t].any():
            continue
        loose, _, solid = candidates(t)
        new = (((is_sleeve[_bins(ycc[t])] & loose) | solid) & (arm[t] > 0)).astype(np.uint8)
        new = cv2.morphologyEx(cv2.morphologyEx(new, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, bridge) & arm[t]
        grown = _at_border(_connected(new, cv2.dilate(masks[t], bridge)))
        both = masks[t] | grown.astype(np.uint8)
        masks[t] |= cv2.morphologyEx(both, cv2.MORPH_CLOSE, bridge) & (arm[t] | masks[t])


def _add_tips(masks: np.ndarray, hands: list, colour: Callable[[int], np.ndarray]) -> None:
    """Fingers that come in over the picture's rim beside a hand that reaches out of it: small skin-coloured patches."""
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    for t in range(len(masks)):
        if not _at_border(masks[t]).any():
            continue
        for uv in hands[t]:
            around = cv2.dilate(masks[t], kernel, iterations=3) > 0
            skin = cv2.morphologyEx((colour(t) & ~around).astype(np.uint8), cv2.MORPH_OPEN, kernel)
            patches = _at_border(skin) & ~_large(skin > 0, 0.5 * _palm_size(uv) ** 2)
            masks[t] |= _connected(patches, _surroundings(masks[t].shape, uv, 1.5)).astype(np.uint8)


def _carry_on(masks: np.ndarray, hands: list, candidates, time: np.ndarray, kernel: np.ndarray) -> None:
    """Frames without landmarks, outwards from those with: changed skin pixels that continue the last mask."""
    import cv2

    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (25, 25))
    for order in (range(len(masks)), range(len(masks) - 1, -1, -1)):
        last, since = None, None
        for t in order:
            if hands[t]:
                last, since = masks[t], time[t]
                continue
            if last is None or not last.any():
                continue
            _, strict, _ = candidates(t)
            strict = cv2.morphologyEx(strict.astype(np.uint8), cv2.MORPH_OPEN, kernel)
            mask = _connected(strict, cv2.dilate(last, reach)) & (cv2.dilate(last, reach, iterations=3) > 0)
            mask = _large(mask, 0.15 * last.sum())
            if abs(time[t] - since) > GAP_SECONDS:
                mask = _at_border(mask)
            masks[t] |= mask.astype(np.uint8)
            last = mask.astype(np.uint8)
