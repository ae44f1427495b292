"""The pixels of hands and bare arms, from landmarks, the colour of this clip's skin and this clip's background.

Skin colour alone will not do: tables, floors and cabinets are skin coloured. A pixel counts as hand only where three
things agree: its colour is likelier under the skin seen between the landmarks than under the rest of the picture; it
differs from what is seen there when no hand is (where that was ever seen); and it is connected to the landmarks within
the hand's surroundings. In the cone behind the wrist, where only a forearm can be, the change alone is enough:
bracelets and sleeves belong to the arm too.
"""

from __future__ import annotations

import numpy as np

from reconstruct.cues import HandTrack
from reconstruct.video import Video

LONG_SIDE = 480  # masks are made at this size, px
BINS = (12, 32, 32)  # Y, Cr, Cb
PALM = (0, 1, 5, 9, 13, 17)
FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
SURE_SCORE = 0.85  # landmarks at least this confident teach the skin colour
GAP_SECONDS = 1.0  # without landmarks a hand is carried on for at most this long, unless it stays at the border
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


def _surroundings(shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """The hand's dilated hull."""
    import cv2

    out = np.zeros(shape, np.uint8)
    hull = cv2.convexHull(np.round(uv).astype(np.int32))
    cv2.fillConvexPoly(out, hull, 1)
    cv2.polylines(out, [hull], True, 1, max(1, round(0.7 * _palm_size(uv))))
    return out


def _forearm(shape: tuple[int, int], uv: np.ndarray) -> np.ndarray:
    """The cone behind the wrist in which the forearm can be."""
    import cv2

    out = np.zeros(shape, np.uint8)
    size = _palm_size(uv)
    knuckles = uv[[5, 9, 13, 17]].mean(0)
    back = (uv[0] - knuckles) / max(np.linalg.norm(uv[0] - knuckles), 1e-6)
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


def _at_border(mask: np.ndarray) -> np.ndarray:
    """Components that touch the image border."""
    frame = np.zeros(mask.shape, bool)
    frame[[0, -1]] = frame[:, [0, -1]] = True
    return _connected(mask, frame)


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
    """(T, h, w) bool at working size: hands and bare arms; all False if no hand was seen."""
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
        if t % 4 == 0:
            rest += np.bincount(_bins(ycc[t][(near[t] | arm[t]) == 0]), minlength=len(rest))
    if not skin.any():
        return out
    is_skin = _log_density(skin) - _log_density(rest) > 0.0
    background, known = _background(ycc, near | arm)

    def candidates(t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Skin that is not known to be background; skin known to be new; anything new that is no mere shadow."""
        colour = is_skin[_bins(ycc[t])]
        difference = ycc[t] - background
        changed = np.linalg.norm(difference, axis=-1) > CHANGED
        other_hue = np.linalg.norm(difference[..., 1:], axis=-1) > 6.0
        solid = known & changed & (other_hue | (difference[..., 0] < -50.0))
        return colour & (changed | ~known), colour & changed & known, solid

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
    _carry_on(masks, hands, candidates, video.time, kernel)
    grow = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    for t in range(n):
        if masks[t].any():
            big = cv2.resize(cv2.dilate(masks[t], grow), (width, height), interpolation=cv2.INTER_NEAREST)
            out[t] = big.astype(bool)
    return out


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
