"""The joint from whole faces of the link: every pixel of them, in every frame, by one joint and one plane a face.

A tracker's window is held by the few edges in it, and on even paint by some tenths of a pixel that err alike over the
whole face: a lid that turns by ten degrees and goes three pixels leaves its axis open by tens of degrees. All of the
face's faint grain, registered at once with no freedom but the joint's, one state a frame and the face's plane, holds it
to a degree (photometric.py). Which pixels are a face's is asked of them: what goes along with the joint and a plane
through the tracks' points, in every part of the motion, and is not explained by resting.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from reconstruct.joint.finish import Finished
from reconstruct.joint.photometric import LEAST_INVERSE, STEPS, Adjustment, Pictures, Reader, Surface, spread_of
from reconstruct.joint.polish import HOLDERS, Bundle, Sightings, link_noise, place_points, positions, residuals
from reconstruct.joint.states import unlinked
from reconstruct.joint.uncertainty import compact

WORTH_DEG = 0.5
"""Standard deviation of an axis below which the tracks are believed as they are."""
WINDOW, STRIP = 5, 3
"""Side, px, of the windows around pixels that are asked whether they go along; and the width below which what does is
left out: beside an edge that passes."""
MARGIN = 24
"""How far, px, beyond its tracks a link is looked for."""
PARTS, WENT_PX, SEEN, NEAR_PX = 6, 1.0, 0.4, 0.7
"""Parts of the motion in each of which a pixel must go along; how far, px, it must have gone to be asked; the share of
frames that must show it; and how far the link goes between pictures that are taken for one."""
SAME, BETTER, CLEARLY = 2.0, 0.25, 0.1
"""Mean squared difference over the noise's up to which a window goes along, by how much better it must than at rest,
and better with a further plane than with the first."""
COVERED = 25.0
"""The same beyond which how different a window is says no more."""
FACES, LEAST_ON_FACE, DRAWS = 3, 12, 300
"""Planes that are sought among the link's points at most, points on one, and triples drawn for each."""
STEEP = 1.5
"""Inverse depth's change over the link's picture, over itself, beyond which a plane is seen on edge."""
LEAST_PIXELS, LEAST_OF_PLANE = 3000, 300
"""Pixels below which faces are not registered (of bars some pixels wide a fifth is not theirs), and of one plane."""
MOST_PIXELS, MOST_SAMPLES, MOST_FRAMES = 8000, 500_000, 80
"""Pixels that are registered, times frames, and frames; further frames' states follow from those."""
MOST_ASKED = 48
"""Frames, evenly over the states, that say which pixels go along."""
ROUNDS, ROUGHLY = 3, 8
"""How often the pixels are asked, and steps after which the first answers are good enough to ask again."""
LOOSE = 10.0
"""Standard deviations of the tracks' states that hold a state whose frame shows nothing of the faces."""
AWAY, AWAY_PX = 1.5, 0.15
"""How many times worse the tracks may keep to the new joint, and the noise, px, up to which they may in any case."""
BESIDE = 0.2
"""How far before and behind the faces a point may lie, over the faces' size."""


def by_faces(done: Finished, pictures: Pictures, seed: int = 0) -> Finished:
    """A hinge as the link's faces hold it, where that is more exact than what its tracks say; else ``done``.

    Args:
        done: before a resting camera, of all frames of the video.  pictures: of the same frames.
        seed: of the pixels that are used.
    """
    b, sight = done.bundle, done.sight
    if sight.R is not None or b.kind != "revolute" or done.spread.axis_deg < WORTH_DEG:
        return done
    T = len(b.q)
    frames = np.unique(np.linspace(0, T - 1, min(T, MOST_FRAMES)).round().astype(int))
    slip = None if sight.slip is None else sight.slip[:, frames]
    some, few = replace(b, q=b.q[frames]), replace(sight, uv=sight.uv[:, frames], seen=sight.seen[:, frames], slip=slip)
    frame = template_frame(some, few)
    planes, xy = planes_of(some, few, frame, seed)
    if not len(planes):
        return done
    reader = Reader(pictures, frames, sight.focal)
    grid, inside = _surroundings(xy, pictures.centre, pictures.grey.shape[1:])
    radius = 1 / max(float(np.linalg.norm(b.twist.curvature)), 1e-9)
    held = LOOSE * np.maximum(done.spread.q[frames] * radius, 0.02 * np.ptp(b.q))
    rng = np.random.default_rng(seed)
    s = Surface(b.kind, b.twist, some.q, b.log_focal, planes, frame)
    for k in range(ROUNDS):
        face = belonging(s, reader, grid, inside)
        count = np.bincount(face[face >= 0], minlength=len(s.planes))
        face[np.isin(face, np.flatnonzero(count < LEAST_OF_PLANE))] = -1
        px = grid[face >= 0]
        if len(px) < LEAST_PIXELS:
            return done
        used, on = np.unique(face[face >= 0], return_inverse=True)
        face[face >= 0] = on.ravel()
        s = replace(s, planes=s.planes[used])
        pick = np.sort(rng.permutation(len(px))[: min(MOST_PIXELS, MOST_SAMPLES // len(frames))])
        share = len(pick) / len(px)
        adjustment = Adjustment(reader, px[pick], face[face >= 0][pick], share, sight.focal_std, held)
        s, _ = adjustment.solve(s, STEPS if k == ROUNDS - 1 else ROUGHLY)
    sure = spread_of(adjustment, s)
    turned = abs(float(s.twist.axis @ b.twist.axis))
    apart = float(np.degrees(np.arccos(min(turned, 1.0)))) / 1.96
    if apart > np.hypot(sure.axis_deg, done.spread.axis_deg):
        # One of the two is wrong. Faces have been the right ones, but nothing here tells that they are.
        sure = replace(sure, axis_deg=max(sure.axis_deg, apart))
    elif not sure.axis_deg < done.spread.axis_deg:
        return done
    every = np.arange(T)
    q = b.q + np.interp(every, frames, (s.q - s.q[0]) - (some.q - some.q[0]))
    out = place_points(replace(b, twist=s.twist, q=q - q[0], log_focal=s.log_focal), sight)
    sigma = link_noise(residuals(out, sight), sight)
    if sigma > max(AWAY * b.sigma, AWAY_PX):
        return done
    out, kept = _onto_faces(replace(out, sigma=sigma), sight, frames[frame], s, grid, face)
    # A state that is far off when the face is first drawn is not found: where no tracks hold it to the first they say
    # how well it is known, and so of all of them where no tracks show that, from which they are measured.
    unseen = sight.seen.sum(0) < HOLDERS
    by_tracks = np.where(unseen | unseen[0] | unlinked(b, sight), done.spread.q, 0.0)
    sure = replace(sure, q=np.maximum(np.interp(every, frames, sure.q), by_tracks))
    return replace(done, bundle=replace(out, X=out.X[kept]), sight=sight.of(kept), members=done.members[kept],
                   spread=sure, once=None)  # fmt: skip


def _onto_faces(b: Bundle, sight: Sightings, frame: int, s: Surface, grid: np.ndarray, face: np.ndarray
                ) -> tuple[Bundle, np.ndarray]:  # fmt: skip
    """The points that are seen on faces at a frame put onto their planes; and (N,) bool, these and what is as far away.

    A short path holds a point's depth badly, and what follows it wrongly is placed far before or behind the faces.
    """
    at = positions(b, sight)[1][:, frame]
    ray = at / np.maximum(at[:, 2:], 1e-3)
    xy = sight.focal * np.exp(b.log_focal) * ray[:, :2]
    j, i = np.round(xy - grid[0, 0]).astype(int).T
    on = np.flatnonzero((i >= 0) & (j >= 0) & (i < face.shape[0]) & (j < face.shape[1]) & (at[:, 2] > 0))
    on = on[face[i[on], j[on]] >= 0]
    if len(on) < LEAST_ON_FACE:
        return b, np.ones(len(at), bool)
    inverse = s.inverse_depths(xy[on], face[i[on], j[on]], sight.focal)
    R, p = (x[0] for x in b.twist.pose(b.q[[frame]]))
    g, X = b.twist.anchor, b.X.copy()
    X[on] = (ray[on] / inverse[:, None] - g - p) @ R + g
    low, high = 1 / inverse.max(), 1 / inverse.min()
    beside = BESIDE * float(np.linalg.norm(np.ptp(ray[on, :2], axis=0))) * high
    kept = (at[:, 2] > low - beside) & (at[:, 2] < high + beside)
    kept[on] = True
    return replace(b, X=X), kept


def template_frame(b: Bundle, s: Sightings) -> int:
    """A frame in the middle half of the motion that sees as many of the link's tracks as any of these."""
    low, high = b.q.min(), b.q.max()
    off = np.abs(b.q - (low + high) / 2) / max(high - low, 1e-12)
    some = off <= max(0.25, off.min())
    return int(np.argmax(np.where(some, s.seen.sum(0) - 1e-3 * off, -1)))


def planes_of(b: Bundle, s: Sightings, frame: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Planes through the link's points (RANSAC, one after the other), each point by what its track holds of its depth.

    Returns:
        (F, 3) inverse depths in a frame, as in :class:`Surface`, the plane with most points first; and (N, 2) where the
        points are there, px from the centre.
    """
    f = s.focal * np.exp(b.log_focal)
    sigma = max(b.sigma, 0.05)
    at = positions(b, s)[1][:, frame]
    xy, inverse = at[:, :2] / np.maximum(at[:, 2:], 1e-3), 1 / np.maximum(at[:, 2], 1e-3)
    # The same joint written from that frame on: a point's depth moves it along the ray there.
    here, h = replace(b, q=b.q - b.q[frame], X=at), 1e-4
    r = residuals(here, s)
    slope = (residuals(replace(here, X=at / (1 + h)), s) - r) / (h * inverse)[:, None, None]
    sharp = np.sqrt(np.sum(slope**2, axis=(1, 2))) / sigma
    off = np.sqrt(np.sum(r**2, axis=(1, 2)) / np.maximum(2 * s.seen.sum(1), 1))
    left = compact(b.X) & (at[:, 2] > 0) & (sharp > 0) & (off < 3 * sigma)
    where = f * xy[left]
    size = max(float(np.linalg.norm(np.ptp(xy[left], axis=0))), 1e-6) if left.any() else 1.0
    A = np.concatenate([np.ones((len(xy), 1)), xy], axis=1)
    rng, planes = np.random.default_rng(seed), []
    for _ in range(FACES):
        ids = np.flatnonzero(left)
        plane = _plane(A[ids], inverse[ids], sharp[ids], size, rng) if len(ids) >= LEAST_ON_FACE else None
        if plane is None:
            break
        on = np.abs(A[ids] @ plane - inverse[ids]) * sharp[ids] < 4
        if on.sum() < LEAST_ON_FACE:
            break
        planes.append(plane)
        left[ids[on]] = False
    return np.array(planes).reshape(-1, 3), where


def _plane(A: np.ndarray, inverse: np.ndarray, sharp: np.ndarray, size: float, rng: np.random.Generator
           ) -> np.ndarray | None:  # fmt: skip
    """(3,) the plane that most points keep to; None where all triples are seen on edge."""

    def off(plane: np.ndarray) -> np.ndarray:
        return np.abs(A @ plane - inverse) * sharp

    best, most = None, 0.0
    for _ in range(DRAWS):
        pick = rng.choice(len(A), 3, replace=False)
        try:
            plane = np.linalg.solve(A[pick], inverse[pick])
        except np.linalg.LinAlgError:
            continue
        if np.linalg.norm(plane[1:]) * size > STEEP * abs(plane[0]):
            continue
        value = float(np.sum(1 / (1 + (off(plane) / 3) ** 2)))
        if value > most:
            best, most = plane, value
    for _ in range(10 if best is not None else 0):
        w = sharp / (1 + (off(best) / 3) ** 2)
        best = np.linalg.lstsq(A * w[:, None], inverse * w, rcond=None)[0]
    return best


def _surroundings(xy: np.ndarray, centre: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (h', w', 2), px from the centre, of the box around what points (N, 2) enclose, and MARGIN beside it; and
    which of them are no farther from it, (h', w') bool."""
    import cv2

    region = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(region, cv2.convexHull(np.round(xy + centre).astype(np.int32)), 1)
    region = cv2.dilate(region, np.ones((2 * MARGIN + 1,) * 2, np.uint8))
    x, y, w, h = cv2.boundingRect(region)
    v, u = np.mgrid[y : y + h, x : x + w]
    return np.stack([u, v], axis=-1) - centre, region[y : y + h, x : x + w] > 0


def _windows(v: np.ndarray) -> np.ndarray:
    """(T, h, w) means over the windows around pixels."""
    import cv2

    return np.stack([cv2.boxFilter(x, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REPLICATE) for x in v])


def _fewer(s: Surface, reader: Reader) -> tuple[Surface, Reader]:
    """The same in MOST_ASKED frames at most, the template's among them."""
    if len(s.q) <= MOST_ASKED:
        return s, reader
    order = np.argsort(s.q, kind="stable")
    some = order[np.linspace(0, len(order) - 1, MOST_ASKED).round().astype(int)]
    some = np.unique(np.append(some, s.frame))
    return replace(s, q=s.q[some], frame=int(np.searchsorted(some, s.frame))), reader.of(some)


def _misses(value: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(T, h, w) mean squared differences of the windows around pixels from what the frames ``near`` show, brightness
    aside; NaN where not all of a window is seen."""
    seen = np.isfinite(value)
    v = np.where(seen, value, 0.0)
    whole = _windows(seen.astype(np.float32)) > 0.999
    v = v - _windows(v)
    own = np.nan_to_num(np.nanmedian(np.where(whole[near], v[near], np.nan), axis=0))
    drawn = _windows(whole[near].any(0)[None].astype(np.float32))[0] > 0.999
    return np.where(whole & drawn, _windows((v - own) ** 2), np.nan)


def belonging(s: Surface, reader: Reader, xy: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Face of each pixel, (h, w); -1 where what is around it does not go along with any.

    What a link covers for a while is explained by going along then, and by resting else: every part of the motion is
    asked, against the picture at the template's own state.

    Args:
        xy: (h, w, 2) px from the centre.  inside: (h, w) bool, those that are asked.
    """
    import cv2

    h, w = inside.shape
    s, reader = _fewer(s, reader)
    flat, T = xy.reshape(-1, 2).astype(float), len(s.q)
    rest = (flat + reader.centre).astype(np.float32)
    every = np.broadcast_to(rest, (T, *rest.shape))
    part = np.argsort(np.argsort(s.q)) * PARTS // T
    out, least, near, still, floor = np.full((h, w), -1), np.full((h, w), np.inf), None, None, 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that are never seen
        for k in range(len(s.planes)):
            inverse = s.inverse_depths(flat, np.full(len(flat), k), reader.focal)
            ok = (inverse > LEAST_INVERSE) & inside.ravel()
            if not ok.any():
                continue
            at = reader.places(s, flat, np.where(ok, inverse, 1.0)).astype(np.float32)
            went = np.linalg.norm(at - rest, axis=-1)
            if near is None:
                near = np.flatnonzero(np.median(went[:, ok], axis=1) < NEAR_PX)
                still = _misses(reader.read(every, False)[0].reshape(T, h, w), near)
            goes = _misses(reader.read(at, False)[0].reshape(T, h, w), near)
            known = np.isfinite(goes) & np.isfinite(still) & ok.reshape(h, w)
            enough = known.mean(0) > SEEN
            if not enough.any():
                continue
            value = np.nanmean(np.where(known, goes, np.nan), axis=0)
            if not floor:
                both = np.fmin(value, np.nanmean(np.where(known, still, np.nan), axis=0))
                floor = float(np.nanquantile(both[enough], 0.2))
            limit = COVERED * floor
            gain = np.minimum(still, limit) - np.minimum(goes, limit)
            gain[~(known & (went.reshape(T, h, w) > WENT_PX))] = np.nan
            better = np.nanmin([np.nanmean(gain[part == j], axis=0) for j in range(PARTS)], axis=0) > BETTER * floor
            first = enough & better & (value < SAME * floor) & (value < least - (CLEARLY * floor if k else 0.0))
            out[first], least[first] = k, value[first]
    # Strips beside an edge are of what it covers and uncovers.
    broad = cv2.morphologyEx((out >= 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((STRIP, STRIP), np.uint8))
    return np.where(broad > 0, out, -1)
