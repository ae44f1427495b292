"""Point tracks by pyramidal Lucas-Kanade from many reference frames, in both directions of time.

One reference frame is a lottery: a closed door may have no texture where the open one has a rack of
corners. Corners are therefore seeded in every reference frame, wherever the picture ever changes and some
in what changing places enclose, and followed forwards and backwards through the whole video. Every step is
checked by tracking back, and each point is re-registered against the last frame in which it was well anchored
(affine.py), so that errors do not pile up frame by frame. Where it no longer looks like that, beyond what the pixels'
noise explains, another track begins.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reconstruct.cues import Hands, ProviderInfo, Tracks
from reconstruct.joint.photometric import Pictures
from reconstruct.providers.affine import SPREAD, register
from reconstruct.providers.shade import BY_THEN, one_colour, rest_beneath
from reconstruct.video import Video

WINDOW = 15
FB_PX = 0.7
"""Forward-backward distance above which a step counts as lost, working px."""
ANCHOR_PX = 2.0
"""How far re-registration against the anchor may move a point before the anchor counts as outdated, working px."""
ALIKE, STRETCH = 0.8, 2.0
"""Correlation with the anchor frame, and stretch of its neighbourhood, up to which it stays the anchor."""
LEAST_PIECE = 8
"""Frames for which a point has to be followed after it lost its anchor; what is shorter is mostly no point at all."""
EDGE = 0.1
"""Ratio of the structure tensor's eigenvalues below which errors along an edge pile up."""
CHANGE_GREY = 18.0
SHADOW_PX = 2.0
"""Extent of a track, working px, from which on it may be a shadow's."""
INNER_SEEDS, INNER_EVERY = 120, 3
"""Seeds in what changing pixels enclose, in every third reference frame."""


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

    The median over the picture and time; between whole numbers it is interpolated.
    """
    if len(grey) < 2:
        return 0.0
    changes = np.abs(np.diff(grey[:, ::2, ::2].astype(np.int16), axis=0))
    below = np.cumsum(np.bincount(changes.ravel(), minlength=256)) / changes.size
    # A change of k stands for k - 1/2 to k + 1/2.
    middle = float(np.interp(0.5, np.r_[0.0, below], np.r_[0.0, np.arange(len(below)) + 0.5]))
    return middle / (0.6745 * np.sqrt(2))


def pictures_of(video: Video, hands: Hands | None = None) -> Pictures:
    """The frames as points are followed in them: of even exposure, and nothing under hands."""
    import cv2

    h, w = video.frames.shape[1:3]
    covered = np.zeros((len(video), h, w), bool)
    if hands is not None and hands.mask is not None:
        k = np.ones((11, 11), np.uint8)
        covered = np.stack([cv2.dilate(m.astype(np.uint8), k) for m in hands.mask]) > 0
    return Pictures(np.stack(even_exposure(video)), covered, np.array([(w - 1) / 2, (h - 1) / 2]))


def change_region(video: Video, dilate: int = 9) -> np.ndarray:
    """(h, w) bool, pixels whose smoothed brightness ever differs clearly from another time's."""
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
    """(h, w) bool, what the pieces of a region enclose, without the region: a door of even colour that opens a little
    changes the picture at its rim only, but the points near its hinge hold the axis best."""
    import cv2

    out = np.zeros(region.shape, np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
    for k in range(1, len(stats)):
        y, x = np.nonzero(labels == k)
        cv2.fillConvexPoly(out, cv2.convexHull(np.stack([x, y], axis=1).astype(np.int32)), 1)
    return (out > 0) & ~region


def track_points(
    video: Video,
    hands: Hands | None = None,
    references: np.ndarray | None = None,
    per_reference: int = 220,
    progress: Callable[[float], None] | None = None,
) -> Tracks:
    """Seed and follow corners.

    Args:
        video: stabilised video.
        hands: pixels under hands are neither seeded nor followed.
        references: (R,) frames in which to seed; chosen from the picture change when None.
        per_reference: at most this many seeds a reference frame.
        progress: called with the done share in [0, 1].

    Returns:
        Tracks in full px; points that are lost or under a hand are not visible.
    """
    import cv2

    references = reference_frames(video, hands) if references is None else np.asarray(references)
    region = change_region(video)
    seen = pictures_of(video, hands)
    grey, covered = seen.grey, seen.covered
    noise = pixel_noise(grey)
    seeds, frames = [], []
    inner = enclosed(region)
    for k, r in enumerate(references):
        free = ~covered[r]
        p = _corners(grey[r], region & free, per_reference)
        if k % INNER_EVERY == 0:
            p = np.concatenate([p, _corners(grey[r], inner & free, INNER_SEEDS)])
        seeds.append(p)
        frames.append(np.full(len(p), r))
    start = np.concatenate(seeds) if seeds else np.zeros((0, 2), np.float32)
    reference = np.concatenate(frames).astype(int) if frames else np.zeros(0, int)
    T = len(video)
    uv = np.full((len(start), T, 2), np.nan, np.float32)
    uv[np.arange(len(start)), reference] = start
    lost = np.zeros((len(start), T), bool)
    done = 0
    for order in (range(T), range(T - 1, -1, -1)):
        _follow(grey, list(order), uv, lost, reference, covered, noise)
        done += 1
        if progress:
            progress(done / 2)
    uv, reference = pieces(uv, reference, lost)
    return Tracks(video.to_full(uv).astype(np.float32), np.isfinite(uv[..., 0]), reference,
                  ProviderInfo("lk", cv2.__version__, "Apache-2.0"), slip_of(grey, uv),
                  *shadows(video, uv, covered))  # fmt: skip


def pieces(uv: np.ndarray, reference: np.ndarray, lost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tracks cut where their point no longer looked like itself: what goes on from there may be another point.

    A corner that one surface's rim makes with what lies behind slides along both, and looks like the frame before all
    the time. Of rendered films nine tenths of the right observations are in tracks that never lost their anchor.

    Args:
        uv: (N, T, 2) px, NaN where not seen.  reference: (N,) frames in which tracks start, both ways.
        lost: (N, T) bool, frames in which the anchor was lost on the way there.

    Returns:
        (M, T, 2) px and (M,) frames in which these start. First the N tracks up to where their anchors were lost, then
        what was followed from there, the last frame before it included, for LEAST_PIECE frames and more.
    """
    T = uv.shape[1]
    frame, seen = np.arange(T), np.isfinite(uv[..., 0])
    later = frame > reference[:, None]
    number = np.cumsum(lost & later, axis=1) - np.cumsum((lost & ~later)[:, ::-1], axis=1)[:, ::-1]
    out, start = [np.where((number == 0)[..., None], uv, np.nan)], [reference]
    for n in range(number.min(initial=0), number.max(initial=0) + 1):
        own = seen & (number == n)
        rows = np.flatnonzero(own.sum(1) + 1 >= LEAST_PIECE)
        if n == 0 or not len(rows):
            continue
        own = own[rows]
        anchor = own.argmax(1) - 1 if n > 0 else T - own[:, ::-1].argmax(1)
        own[np.arange(len(rows)), anchor] = True
        out.append(np.where(own[..., None], uv[rows], np.nan))
        start.append(anchor)
    return np.concatenate(out), np.concatenate(start)


def shadows(video: Video, uv: np.ndarray, covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool each, ``shade`` and ``cast`` as in :class:`Tracks`; the second is asked of what moves only.

    Args:
        uv: (N, T, 2) working px, NaN where not seen.  covered: (T, h, w) bool, under a hand.
    """
    shade = one_colour(video.frames, uv)
    cast = np.zeros(len(uv), bool)
    extent = np.linalg.norm(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=-1)
    moves = np.flatnonzero(shade & (extent > SHADOW_PX))
    cast[moves] = rest_beneath(video.frames, uv[moves], covered) >= BY_THEN
    return shade, cast


def slip_of(grey: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """How far points may slide along the edges that they are on (the aperture problem).

    The structure tensor of a window as wide as the registration's says by how much less a point is held along one
    direction than across it. White noise alone would make the standard deviations go with the root of the
    eigenvalues; as errors pile up from anchor to anchor, they grow faster on edges (docs/notes/joint.md).

    Args:
        grey: (T, h, w) uint8.  uv: (N, T, 2) px of these, NaN where not seen.

    Returns:
        (N, T, 2) float32 as in :class:`Tracks`, 0 where not seen.
    """
    import cv2

    out = np.zeros(uv.shape, np.float32)
    h, w = grey.shape[1:]
    for t, picture in enumerate(grey):
        seen = np.flatnonzero(np.isfinite(uv[:, t, 0]))
        if not len(seen):
            continue
        x, y = np.round(uv[seen, t]).astype(int).T
        x, y = x.clip(0, w - 1), y.clip(0, h - 1)
        gx, gy = (cv2.Scharr(picture, cv2.CV_32F, *d) for d in ((1, 0), (0, 1)))
        a, b, c = (cv2.GaussianBlur(g, (0, 0), SPREAD)[y, x] for g in (gx * gx, gx * gy, gy * gy))
        half, mean = np.hypot((a - c) / 2, b), (a + c) / 2
        share = np.clip(mean - half, 0, None) / np.maximum(mean + half, 1e-6)
        worth = np.sqrt(share) * np.minimum(1, share / EDGE)
        along = 0.5 * np.arctan2(2 * b, a - c) + np.pi / 2
        out[seen, t] = np.sqrt(1 - worth)[:, None] * np.stack([np.cos(along), np.sin(along)], axis=-1)
    return out


def _corners(grey: np.ndarray, mask: np.ndarray, count: int) -> np.ndarray:
    """(N, 2) float32 corners: strongest first with spacing, weak ones allowed down to the noise level."""
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


def _follow(
    grey: np.ndarray, order: list[int], uv: np.ndarray, lost: np.ndarray, reference: np.ndarray, covered: np.ndarray,
    noise: float,
) -> None:  # fmt: skip
    """Extend all tracks along `order` and note where they lose their anchors (uv and lost, in place); each starts when
    its reference frame comes up."""
    import cv2

    h, w = grey[0].shape
    lk = dict(winSize=(WINDOW, WINDOW), maxLevel=3)
    flags = dict(flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    alive = np.zeros(len(uv), bool)
    anchor = reference.copy()
    shape = np.tile(np.eye(2), (len(uv), 1, 1))
    velocity = np.zeros((len(uv), 2), np.float32)
    for s, t in zip(order[:-1], order[1:], strict=True):
        alive |= reference == s
        ids = np.flatnonzero(alive)
        if not len(ids):
            continue
        p = uv[ids, s].reshape(-1, 1, 2)
        n, ok, _ = cv2.calcOpticalFlowPyrLK(grey[s], grey[t], p, p + velocity[ids, None], **flags, **lk)
        b, ok2, _ = cv2.calcOpticalFlowPyrLK(grey[t], grey[s], n, p.copy(), **flags, **lk)
        good = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(b - p, axis=-1).ravel() < FB_PX)
        n = n.reshape(-1, 2)
        x, y = n[:, 0], n[:, 1]
        good &= (x > 4) & (y > 4) & (x < w - 5) & (y < h - 5)
        inside = good.copy()
        inside[good] = covered[t][y[good].round().astype(int), x[good].round().astype(int)]
        good &= ~inside
        alive[ids[~good]] = False
        ids, n = ids[good], n[good]
        uv[ids, t] = n
        # Against each point's anchor frame, with the shear since then; where it no longer looks alike, the last frame
        # becomes the anchor.
        fine = _anchored(grey, ids, t, uv, anchor, shape, noise)
        lost[ids[~fine], t] = True
        anchor[ids[~fine]], shape[ids[~fine]] = s, np.eye(2)
        _anchored(grey, ids[~fine], t, uv, anchor, shape, noise)
        velocity[ids] = uv[ids, t] - uv[ids, s]


def _anchored(grey: np.ndarray, ids: np.ndarray, t: int, uv: np.ndarray, anchor: np.ndarray, shape: np.ndarray,
              noise: float) -> np.ndarray:  # fmt: skip
    """Register points in frame t against their anchor frames, in place; (n,) bool where that succeeded."""
    place, turned = uv[ids, t].astype(float), shape[ids]
    before = place.copy()
    alike = register(grey, anchor[ids], uv[ids, anchor[ids]].astype(float), t, place, turned, noise)
    stretch = np.linalg.svd(turned, compute_uv=False)
    fine = (alike > ALIKE) & (np.linalg.norm(place - before, axis=-1) < ANCHOR_PX)
    fine &= (stretch[:, 0] < STRETCH) & (stretch[:, 1] > 1 / STRETCH)
    uv[ids[fine], t] = place[fine]
    shape[ids[fine]] = turned[fine]
    return fine
