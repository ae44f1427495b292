"""Camera compensation: is the camera static, and if not, warp every frame to the first view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError
from reconstruct.video import Video

STATIC_PX = 0.5
"""A camera is static if the background's median displacement stays under this, working px."""


@dataclass(frozen=True)
class CameraMotion:
    """How the camera moved.

    Attributes:
        static: True if the frames were left as they are.
        H: (T, 3, 3) homography from frame t to frame 0, working px.
        drift_px: (T,) median displacement of background points against frame 0, working px.
        residual_px: median distance of background points after compensation, working px.
        support: (T,) share of background corners that agree with H.
    """

    static: bool
    H: np.ndarray
    drift_px: np.ndarray
    residual_px: float
    support: np.ndarray


def estimate_camera_motion(video: Video, seed: int = 0) -> CameraMotion:
    """Homographies to the first view from corners that agree with the dominant motion.

    Every frame is registered against one reference frame. The first is tried first; where it is too unlike the others
    (an exposure that settles, an object held before the lens) a later one serves. Frames that fail one by one, and
    those that jump against their neighbours, are filled in from these.

    Raises:
        TaaError: the view changes so much that no frame's background is found in the others (a cut, a pan).
    """
    import cv2

    cv2.setRNGSeed(seed)
    T = len(video)
    grey = [_levelled(f) for f in video.frames]
    best: _Registration | None = None
    for reference in dict.fromkeys((0, T // 2, T - 1)):
        tried = _register(grey, reference)
        if tried is None:
            # Too little texture to say anything: the common case, a static camera, is assumed.
            return CameraMotion(True, np.tile(np.eye(3), (T, 1, 1)), np.zeros(T), float("nan"), np.zeros(T))
        if best is None or tried.good.mean() > best.good.mean() + 0.05:
            best = tried
        if best.good.mean() > 0.95:
            break
    assert best is not None
    if best.good.mean() < 0.8:
        when = video.time[int(np.argmin(best.good))]
        raise TaaError(
            f"the background is lost at {when:.2f} s (camera cut, pan or very fast motion); "
            "cut the video so that the object stays in view"
        )
    H = _without_jumps(best.H, best.good, video.frames.shape[1:3])
    H = np.linalg.inv(H[0]) @ H
    h, w = video.frames.shape[1:3]
    probe = np.array([[[x, y] for x in (0.2 * w, 0.5 * w, 0.8 * w) for y in (0.2 * h, 0.5 * h, 0.8 * h)]])
    drift = np.array([np.median(np.linalg.norm(cv2.perspectiveTransform(probe, M) - probe, axis=-1)) for M in H])
    static = bool(np.quantile(drift, 0.9) < STATIC_PX)
    return CameraMotion(static, H, drift, float(np.median(best.residual[best.good])), best.support)


@dataclass(frozen=True)
class _Registration:
    """H: (T, 3, 3) to the reference.  good: (T,) bool.  support: (T,) share.  residual: (T,) px."""

    H: np.ndarray
    good: np.ndarray
    support: np.ndarray
    residual: np.ndarray


def _levelled(image: np.ndarray) -> np.ndarray:
    """(h, w) uint8 with local brightness and contrast evened out: exposure changes are not motion."""
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    mean = cv2.GaussianBlur(grey, (0, 0), 12)
    spread = np.sqrt(cv2.GaussianBlur((grey - mean) ** 2, (0, 0), 12)) + 6.0
    return np.clip(128 + 48 * (grey - mean) / spread, 0, 255).astype(np.uint8)


def _register(grey: list[np.ndarray], reference: int) -> _Registration | None:
    """Homographies of all frames to one; None where the reference has too little texture."""
    import cv2

    T = len(grey)
    points = _grid_corners(grey[reference], per_cell=6)
    if len(points) < 12:
        return None
    H, good = np.tile(np.eye(3), (T, 1, 1)), np.zeros(T, bool)
    support, residual = np.zeros(T), np.zeros(T)
    good[reference], support[reference] = True, 1.0
    lk = dict(winSize=(21, 21), maxLevel=3, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    for order in (range(reference + 1, T), range(reference - 1, -1, -1)):
        guess = points.copy()
        for t in order:
            nxt, ok, _ = cv2.calcOpticalFlowPyrLK(grey[reference], grey[t], points, guess.copy(), **lk)
            back, ok2, _ = cv2.calcOpticalFlowPyrLK(grey[t], grey[reference], nxt, points.copy(), **lk)
            alive = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(back - points, axis=-1).ravel() < 1.0)
            if alive.sum() < 12:
                continue
            found, inlier = cv2.findHomography(nxt[alive], points[alive], cv2.RANSAC, 1.5)
            if found is None or inlier.mean() < 0.25:
                continue
            H[t], support[t], good[t] = found, float(inlier.mean()), True
            keep = np.flatnonzero(alive)[inlier.ravel() > 0]
            warped = cv2.perspectiveTransform(nxt[keep], found)
            residual[t] = np.median(np.linalg.norm(warped - points[keep], axis=-1))
            # Predict the next frame from this one, so that slow drift never outruns the search window.
            guess = cv2.perspectiveTransform(points, np.linalg.inv(found)).astype(np.float32)
    return _Registration(H, good, support, residual)


def _without_jumps(H: np.ndarray, good: np.ndarray, size: tuple[int, int], reach: int = 4) -> np.ndarray:
    """Homographies with missing frames and single-frame jumps replaced: cameras in hands do not jump and come back.

    Works on where four inner picture points go, (T, 4, 2): a frame that is farther than 3 px, and farther than three
    times what its neighbours leave, from the parabola through them counts as missing, and missing frames are
    interpolated in time.
    """
    import cv2

    h, w = size
    corners = np.float32([[[0.2 * w, 0.2 * h], [0.8 * w, 0.2 * h], [0.8 * w, 0.8 * h], [0.2 * w, 0.8 * h]]])
    path = np.stack([cv2.perspectiveTransform(corners, M)[0] for M in H]).astype(float)
    T = len(H)
    flat, jump = path.reshape(T, -1), np.zeros(T, bool)
    for t in range(T):
        near = np.array([k for k in range(max(0, t - reach), min(T, t + reach + 1)) if k != t and good[k]], int)
        if len(near) < 4:
            continue
        powers = np.vander(np.append(near, t) - t, 3).astype(float)
        fitted = powers @ np.linalg.lstsq(powers[:-1], flat[near], rcond=None)[0]
        left = np.linalg.norm((flat[near] - fitted[:-1]).reshape(len(near), 4, 2), axis=-1).max(1)
        off = np.linalg.norm((flat[t] - fitted[-1]).reshape(4, 2), axis=-1).max()
        jump[t] = off > max(3.0, 3.0 * np.median(left))
    good = good & ~jump
    filled = path.copy()
    known = np.flatnonzero(good)
    for i in range(4):
        for j in range(2):
            filled[:, i, j] = np.interp(np.arange(T), known, path[known, i, j])
    out = H.copy()
    for t in np.flatnonzero(~good):
        out[t] = cv2.getPerspectiveTransform(corners[0], filled[t].astype(np.float32))
    return out


def stabilise(video: Video, scratch: Path | None = None, seed: int = 0) -> tuple[Video, CameraMotion]:
    """The video as a static camera at the first frame's pose would have seen it.

    A static camera's frames are returned untouched. Pixels that the moving camera did not see are
    filled with the nearest ones.
    """

    motion = estimate_camera_motion(video, seed)
    if motion.static:
        return video, motion
    T, h, w = video.frames.shape[:3]
    where = scratch or Path(video.frames.filename).parent  # type: ignore[attr-defined]  # frames are a memmap
    where.mkdir(parents=True, exist_ok=True)
    out = np.lib.format.open_memmap(where / "frames_stable.npy", mode="w+", dtype=np.uint8, shape=video.frames.shape)
    for t in range(T):
        out[t] = _warp(video.frames[t], motion.H[t])
    # The dominant plane may be far behind the object. A second, affine correction follows the static points that the
    # object stands among.
    local = _local_correction(out, video.diagonal * video.scale)
    H = _without_jumps(local @ motion.H, np.ones(T, bool), (h, w))
    for t in range(T):
        out[t] = _warp(video.frames[t], H[t])
    motion = replace(motion, H=H)
    out.flush()
    note = f"camera drifts by up to {motion.drift_px.max() / video.scale:.1f} px; compensated by homographies"
    return replace(video.with_frames(out, note), warp=H), motion


def _warp(image: np.ndarray, H: np.ndarray) -> np.ndarray:
    import cv2

    size = (image.shape[1], image.shape[0])
    return cv2.warpPerspective(image, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


FOOT = 0.95
"""Share of the picture's activity above the place that the local correction is made for. What moves reaches up before
the room behind it; the static link and what it stands on, at about the object's depth, lie at its lower end."""
REACH, REACH_UP = 0.15, 0.05
"""Standard deviations of that place to the sides and down, and up, where the room behind may show; shares of the
diagonal."""
NARROWING = (8.0, 4.0, 2.0, 1.0, 0.7, 0.7)
"""Scales of the robust weights in turn, px. Points near the object may go 10 px against the dominant plane; begun with
the last scale they count as outliers, and the correction follows the wall."""


def _foot_of_activity(frames: np.ndarray) -> np.ndarray:
    """(2,) px: the lower end of where the picture changes."""
    import cv2

    small = [cv2.resize(f, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.int16) for f in frames]
    energy = sum(np.clip(np.abs(b - a).max(axis=-1) - 24, 0, 60) for a, b in zip(small[:-1], small[1:], strict=True))
    mass = cv2.GaussianBlur(energy.astype(np.float32), (0, 0), 3).astype(float) ** 2 + 1e-9
    rows = np.cumsum(mass.sum(1))
    y = int(np.searchsorted(rows, FOOT * rows[-1]))
    half = max(1, len(mass) // 14)
    band = mass[max(0, y - half) : y + half].sum(0)
    return 4.0 * np.array([band @ np.arange(len(band)) / band.sum(), y])


def _local_correction(frames: np.ndarray, diagonal: float) -> np.ndarray:
    """(T, 3, 3) affine corrections from nearly static points, weighted by closeness to the activity's foot."""
    import cv2

    T = len(frames)
    centre = _foot_of_activity(frames)
    grey0 = cv2.cvtColor(frames[0], cv2.COLOR_BGR2GRAY)
    points = _grid_corners(grey0, per_cell=8)
    where = np.full((T, len(points), 2), np.nan, np.float32)
    where[0] = points[:, 0]
    guess = points.copy()
    lk = dict(winSize=(15, 15), maxLevel=2, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    for t in range(1, T):
        grey = cv2.cvtColor(frames[t], cv2.COLOR_BGR2GRAY)
        n, ok, _ = cv2.calcOpticalFlowPyrLK(grey0, grey, points, guess.copy(), **lk)
        b, ok2, _ = cv2.calcOpticalFlowPyrLK(grey, grey0, n, points.copy(), **lk)
        good = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(b - points, axis=-1).ravel() < 0.7)
        good &= np.linalg.norm(n - points, axis=-1).ravel() < 0.02 * diagonal
        where[t, good] = n[good, 0]
        guess = np.where(good[:, None, None], n, points).astype(np.float32)
    steady = np.isfinite(where[..., 0]).mean(0) > 0.7
    out = np.tile(np.eye(3), (T, 1, 1))
    if steady.sum() < 12:
        return out
    x, target = where[:, steady].astype(float), points[steady, 0].astype(float)
    off = (target - centre) / (diagonal * REACH)
    off[:, 1] *= np.where(off[:, 1] < 0, REACH / REACH_UP, 1.0)
    near = np.exp(-0.5 * np.sum(off**2, axis=1)) + 1e-3
    # A weak pull to the identity keeps the far corners of the image where they are.
    ridge = np.diag([0.03 * diagonal] * 2 + [0.3])
    M = np.eye(3)[:, :2]
    for t in range(1, T):
        seen = np.isfinite(x[t, :, 0])
        a, b = np.c_[x[t, seen], np.ones(seen.sum())], target[seen]
        for scale in NARROWING:  # from where the frame before it went
            r = np.linalg.norm(a @ M - b, axis=-1)
            sw = np.sqrt(near[seen] / (1 + (r / scale) ** 2) ** 2)[:, None]
            M = np.linalg.lstsq(np.r_[a * sw, ridge], np.r_[b * sw, ridge @ np.eye(3)[:, :2]], rcond=None)[0]
        out[t, :2] = M.T
    return out


def _grid_corners(grey: np.ndarray, per_cell: int, cells: int = 10) -> np.ndarray:
    """(N, 1, 2) float32 corners, the same number wanted from every cell so that no textured spot dominates."""
    import cv2

    h, w = grey.shape
    found = []
    for y in range(cells):
        for x in range(cells):
            y0, y1, x0, x1 = y * h // cells, (y + 1) * h // cells, x * w // cells, (x + 1) * w // cells
            c = cv2.goodFeaturesToTrack(grey[y0:y1, x0:x1], per_cell, 0.05, 5)
            if c is not None:
                found.append(c + np.float32([x0, y0]))
    corners = np.concatenate(found) if found else np.zeros((0, 1, 2), np.float32)
    strength = cv2.cornerMinEigenVal(grey, 5)
    ij = corners.reshape(-1, 2).astype(int)
    return corners[strength[ij[:, 1], ij[:, 0]] > 1e-4].astype(np.float32)
