"""Where points are seeded to be followed: in which frames, in which part of the picture, and on what.

Corners hold a point best. A dark surface of even paint has none, only its grain, which with the pixels' own noise is
fainter than that of brighter pixels: points are spread over it and followed by wide windows. Hardly any of those that
move is a shadow's, as there is no edge about their seeds (docs/notes/joint.md, "Grain").
"""

from __future__ import annotations

import numpy as np

from reconstruct.cues import Hands
from reconstruct.providers.affine import SPREAD
from reconstruct.video import Video

CHANGE_GREY = 18.0
INNER_SEEDS, INNER_EVERY = 120, 3
"""Seeds in what changing pixels enclose, in every third reference frame."""
FAINT, LEAST_NOISE = 1.0, 0.7
"""Variance of the grey values about a point over the square of the noise of the picture's median pixel, up to which its
surface is faint, and the least noise that counts. Up to 3, by each brightness's own noise, what moves of a wall's stain
and of soft shadows comes in as well."""
GRAIN_SEEDS, GRAIN_APART, GRAIN_BLOCK = 240, 9, 29
"""Seeds on faint surfaces in a reference frame, the px between them, and the side of the block whose structure ranks
them."""


def reference_frames(video: Video, hands: Hands | None = None, count: int = 18) -> np.ndarray:
    """(R,) working frames, spread evenly over picture change outside hands (first and last included)."""
    import cv2

    size = (video.frames.shape[2] // 4, video.frames.shape[1] // 4)
    free = [np.ones(size[::-1], bool)] * len(video)
    if hands is not None:
        grow = np.ones((7, 7), np.uint8)
        free = [cv2.dilate(cv2.resize(m.astype(np.uint8), size), grow) == 0 for m in hands.mask]
    small = [cv2.resize(g, size, interpolation=cv2.INTER_AREA).astype(np.int16) for g in even_exposure(video)]
    change = np.zeros(len(video))
    for t in range(1, len(video)):
        d = np.abs(small[t] - small[t - 1])
        change[t] = np.mean(np.clip(d - 8, 0, 24) * (free[t] & free[t - 1]))
    total = np.cumsum(change + 0.05 * change.mean() + 1e-6)
    wanted = np.linspace(total[0], total[-1], count)
    return np.unique(np.searchsorted(total, wanted).clip(0, len(video) - 1))


def even_exposure(video: Video) -> list[np.ndarray]:
    """T grey frames (h, w) uint8 with the exposure of the median picture.

    An exposure that jumps drags points along edges. Gain and offset of each frame against the temporal median are
    fitted robustly (what moves is a minority of the pixels); frames that agree within 3 % are left as they are.
    """
    import cv2

    grey = [cv2.cvtColor(f, cv2.COLOR_BGR2GRAY) for f in video.frames]
    size = (grey[0].shape[1] // 8, grey[0].shape[0] // 8)
    small = np.stack([cv2.resize(g, size, interpolation=cv2.INTER_AREA) for g in grey]).reshape(len(grey), -1)
    typical = np.median(small[:: max(1, len(grey) // 40)], axis=0)
    # Saturated pixels say nothing about the gain.
    usable = (typical > 8) & (typical < 247)
    out = []
    for g, row in zip(grey, small.astype(float), strict=True):
        use = usable & (row > 4) & (row < 251)
        if use.sum() < 50 or np.std(row[use]) < 4:
            out.append(g)
            continue
        x, y, w = row[use], typical[use], np.ones(use.sum())
        gain, offset = 1.0, 0.0
        for _ in range(8):
            gain, offset = np.polyfit(x, y, 1, w=np.sqrt(w))
            w = 1 / (1 + ((gain * x + offset - y) / 6.0) ** 2)
        same = abs(gain - 1) < 0.03 and abs(offset + (gain - 1) * x.mean()) < 4
        out.append(g if same else np.clip(gain * g.astype(np.float32) + offset, 0, 255).astype(np.uint8))
    return out


def pixel_noise(grey: np.ndarray) -> float:
    """Standard deviation, grey values, of what a pixel's value changes by from frame to frame where nothing moves.

    The median over the picture and time of frames (T, h, w) uint8; between whole numbers it is interpolated.
    """
    if len(grey) < 2:
        return 0.0
    changes = np.abs(np.diff(grey[:, ::2, ::2].astype(np.int16), axis=0))
    below = np.cumsum(np.bincount(changes.ravel(), minlength=256)) / changes.size
    # A change of k stands for k - 1/2 to k + 1/2.
    middle = float(np.interp(0.5, np.r_[0.0, below], np.r_[0.0, np.arange(len(below)) + 0.5]))
    return middle / (0.6745 * np.sqrt(2))


def change_region(video: Video, dilate: int = 9) -> np.ndarray:
    """(h, w) bool, working pixels whose smoothed brightness ever differs clearly from another time's."""
    import cv2

    step = max(1, len(video) // 80)
    low = high = None
    for f in even_exposure(video)[::step]:
        g = cv2.GaussianBlur(f, (0, 0), 1.5)
        low = g if low is None else np.minimum(low, g)
        high = g if high is None else np.maximum(high, g)
    region = (high.astype(np.int16) - low) > CHANGE_GREY
    region = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.dilate(region, np.ones((2 * dilate + 1,) * 2, np.uint8)) > 0


def enclosed(region: np.ndarray) -> np.ndarray:
    """(h, w) bool, what the pieces of a region (h, w) bool enclose, without the region: a door of even colour that
    opens a little changes the picture at its rim only, but the points near its hinge hold the axis best."""
    import cv2

    out = np.zeros(region.shape, np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
    for k in range(1, len(stats)):
        y, x = np.nonzero(labels == k)
        cv2.fillConvexPoly(out, cv2.convexHull(np.stack([x, y], axis=1).astype(np.int32)), 1)
    return (out > 0) & ~region


def corners(grey: np.ndarray, mask: np.ndarray, count: int) -> np.ndarray:
    """(N, 2) float32 px, at most so many corners of a picture (h, w) uint8 within the mask (h, w) bool: strongest first
    with spacing, weak ones allowed down to the noise level."""
    import cv2

    strength = cv2.cornerMinEigenVal(grey, 7)
    strength[~mask] = 0
    noise = np.median(cv2.cornerMinEigenVal(cv2.GaussianBlur(grey, (0, 0), 3), 7)) + 1e-7
    local = strength == cv2.dilate(strength, np.ones((9, 9), np.uint8))
    y, x = np.nonzero(local & (strength > max(8e-6, 4 * noise)))
    order = np.argsort(-strength[y, x])[: 4 * count]
    y, x = y[order], x[order]
    # Half of the seeds go to the strongest corners, half are spread over cells so that weak surfaces get some.
    cell = (y // 48) * 1000 + x // 48
    rank = np.zeros(len(y), int)
    seen: dict[int, int] = {}
    for i, c in enumerate(cell):
        rank[i] = seen.get(c, 0)
        seen[c] = rank[i] + 1
    pick = np.argsort(rank, kind="stable")[:count]
    p = np.stack([x[pick], y[pick]], axis=-1).astype(np.float32)
    if len(p):
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.02)
        p = cv2.cornerSubPix(grey, p.reshape(-1, 1, 2).copy(), (4, 4), (-1, -1), criteria).reshape(-1, 2)
    return p


def faint_surface(grey: np.ndarray, noise: float) -> np.ndarray:
    """(h, w) bool, pixels about which a picture (h, w) uint8 varies by no more than the noise, grey values."""
    import cv2

    g = grey.astype(np.float32)
    mean, square = (cv2.GaussianBlur(x, (0, 0), SPREAD) for x in (g, g * g))
    return square - mean**2 < FAINT * max(noise, LEAST_NOISE) ** 2


def grain(grey: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(N, 2) float32 px of a faint surface in a picture (h, w) uint8, spread over the mask (h, w) bool."""
    import cv2

    p = cv2.goodFeaturesToTrack(grey, GRAIN_SEEDS, 1e-9, GRAIN_APART, mask=mask.astype(np.uint8), blockSize=GRAIN_BLOCK)
    return np.zeros((0, 2), np.float32) if p is None else p.reshape(-1, 2)


def seeds(video: Video, grey: np.ndarray, covered: np.ndarray, references: np.ndarray, noise: float,
          per_reference: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Where points are followed from.

    Args:
        grey: (T, h, w) uint8, of even exposure.  covered: (T, h, w) bool, under hands: nothing is seeded there.
        references: (R,) frames.  noise: of the pixels, grey values.  per_reference: at most this many corners of each.

    Returns:
        (N, 2) float32 working px, (N,) frames, and (N,) bool, which of them are on faint surfaces.
    """
    region = change_region(video)
    inner = enclosed(region)
    points, frames, faint = [np.zeros((0, 2), np.float32)], [np.zeros(0, int)], [np.zeros(0, bool)]
    for k, r in enumerate(references):
        free, even = ~covered[r], faint_surface(grey[r], noise)
        found = [corners(grey[r], region & free, per_reference)]
        changing = region
        if k % INNER_EVERY == 0:
            found.append(corners(grey[r], inner & free, INNER_SEEDS))
            changing = region | inner
        found.append(grain(grey[r], even & changing & free))
        p = np.concatenate(found)
        x, y = p.round().astype(int).T
        points.append(p)
        frames.append(np.full(len(p), r))
        faint.append(even[y.clip(0, even.shape[0] - 1), x.clip(0, even.shape[1] - 1)])
    return np.concatenate(points), np.concatenate(frames), np.concatenate(faint)
