"""Point tracks by pyramidal Lucas-Kanade from many reference frames, in both directions of time.

One reference frame is a lottery: a closed door may have no texture where the open one has a rack of
corners. Corners are therefore seeded in every reference frame, wherever the picture ever changes and some
in what changing places enclose, and followed forwards and backwards through the whole video. Every step is
checked by tracking back, and each point is re-registered against the last frame in which it was well anchored
(affine.py), so that errors do not pile up frame by frame. Where it no longer looks like that, beyond what the pixels'
noise explains, another track begins. The grain of even paint is followed by wider windows, and no further than it is
recognised.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reconstruct.cues import Hands, ProviderInfo, Tracks
from reconstruct.joint.photometric import Pictures
from reconstruct.providers.affine import HALF, SPREAD, register
from reconstruct.providers.seeds import even_exposure, pixel_noise, reference_frames, seeds
from reconstruct.providers.shade import BY_THEN, one_colour, rest_beneath
from reconstruct.video import Video

WINDOW, WIDE_WINDOW, WIDE_HALF = 15, 31, 14
"""Side of the window that points are followed in, px; the same of points on faint surfaces, and half the side of the
window that these are registered in."""
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
MARGIN_PX, CLOSE_PX = 5, -3
"""By how much the mask of hands, which reaches a few px beyond them, is grown for points to be followed off them; and
shrunk to follow points up to their rims, along which some slide then. Working px."""
SHADOW_PX = 2.0
"""Extent of a track, working px, from which on it may be a shadow's."""


def pictures_of(video: Video, hands: Hands | None = None, margin_px: int = MARGIN_PX) -> Pictures:
    """The frames as points are followed in them: of even exposure, and nothing under hands.

    Args:
        margin_px: working px by which the mask of hands is grown, or shrunk if negative.
    """
    import cv2

    h, w = video.frames.shape[1:3]
    covered = np.zeros((len(video), h, w), bool)
    if hands is not None and hands.mask is not None:
        k = np.ones((2 * abs(margin_px) + 1,) * 2, np.uint8)
        change = cv2.dilate if margin_px >= 0 else cv2.erode
        covered = np.stack([change(m.astype(np.uint8), k) for m in hands.mask]) > 0
    return Pictures(np.stack(even_exposure(video)), covered, np.array([(w - 1) / 2, (h - 1) / 2]))


def track_points(
    video: Video,
    hands: Hands | None = None,
    references: np.ndarray | None = None,
    per_reference: int = 220,
    progress: Callable[[float], None] | None = None,
    margin_px: int = MARGIN_PX,
) -> Tracks:
    """Seed and follow corners, and the grain of faint surfaces.

    Args:
        video: stabilised video.
        hands: pixels under hands are neither seeded nor followed.
        references: (R,) frames in which to seed; chosen from the picture change when None.
        per_reference: at most this many corners a reference frame.
        progress: called with the done share in [0, 1].
        margin_px: as of :func:`pictures_of`.

    Returns:
        Tracks in full px; points that are lost or under a hand are not visible.
    """
    import cv2

    references = reference_frames(video, hands) if references is None else np.asarray(references)
    seen = pictures_of(video, hands, margin_px)
    grey, covered = seen.grey, seen.covered
    noise = pixel_noise(grey)
    start, reference, wide = seeds(video, grey, covered, references, noise, per_reference)
    T = len(video)
    uv = np.full((len(start), T, 2), np.nan, np.float32)
    uv[np.arange(len(start)), reference] = start
    lost = np.zeros((len(start), T), bool)
    done = 0
    for order in (range(T), range(T - 1, -1, -1)):
        _follow(grey, list(order), uv, lost, reference, wide, covered, noise)
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


def _follow(
    grey: np.ndarray, order: list[int], uv: np.ndarray, lost: np.ndarray, reference: np.ndarray, wide: np.ndarray,
    covered: np.ndarray, noise: float,
) -> None:  # fmt: skip
    """Extend all tracks along `order` and note where they lose their anchors (uv and lost, in place); each starts when
    its reference frame comes up. The `wide` ones end there."""
    h, w = grey[0].shape
    alive = np.zeros(len(uv), bool)
    anchor = reference.copy()
    shape = np.tile(np.eye(2), (len(uv), 1, 1))
    velocity = np.zeros((len(uv), 2), np.float32)
    for s, t in zip(order[:-1], order[1:], strict=True):
        alive |= reference == s
        ids = np.flatnonzero(alive)
        if not len(ids):
            continue
        n, good = uv[ids, s] + velocity[ids], np.zeros(len(ids), bool)
        for broad in (False, True):
            some = wide[ids] == broad
            if some.any():
                window = WIDE_WINDOW if broad else WINDOW
                n[some], good[some] = _step(grey[s], grey[t], uv[ids[some], s], n[some], window)
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
        broad, fine = ids[wide[ids]], ids[~wide[ids]]
        worse = fine[~_anchored(grey, fine, t, uv, anchor, shape, noise, HALF)]
        lost[worse, t] = True
        anchor[worse], shape[worse] = s, np.eye(2)
        _anchored(grey, worse, t, uv, anchor, shape, noise, HALF)
        # Of grain that does not look like itself only noise is left.
        worse = broad[~_anchored(grey, broad, t, uv, anchor, shape, noise, WIDE_HALF)]
        uv[worse, t], alive[worse] = np.nan, False
        velocity[ids] = uv[ids, t] - uv[ids, s]


def _step(before: np.ndarray, after: np.ndarray, p: np.ndarray, guess: np.ndarray,
          window: int) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Points (n, 2) float32 one frame on, and (n,) bool whether they lead back."""
    import cv2

    lk = dict(winSize=(window, window), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    p, guess = p.reshape(-1, 1, 2), guess.reshape(-1, 1, 2)
    n, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, p, guess.copy(), **lk)
    b, ok2, _ = cv2.calcOpticalFlowPyrLK(after, before, n, p.copy(), **lk)
    good = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(b - p, axis=-1).ravel() < FB_PX)
    return n.reshape(-1, 2), good


def _anchored(grey: np.ndarray, ids: np.ndarray, t: int, uv: np.ndarray, anchor: np.ndarray, shape: np.ndarray,
              noise: float, half: int) -> np.ndarray:  # fmt: skip
    """Register points in frame t against their anchor frames, in place; (n,) bool where that succeeded."""
    place, turned = uv[ids, t].astype(float), shape[ids]
    before = place.copy()
    alike = register(grey, anchor[ids], uv[ids, anchor[ids]].astype(float), t, place, turned, noise, half)
    stretch = np.linalg.svd(turned, compute_uv=False)
    fine = (alike > ALIKE) & (np.linalg.norm(place - before, axis=-1) < ANCHOR_PX)
    fine &= (stretch[:, 0] < STRETCH) & (stretch[:, 1] > 1 / STRETCH)
    uv[ids[fine], t] = place[fine]
    shape[ids[fine]] = turned[fine]
    return fine
