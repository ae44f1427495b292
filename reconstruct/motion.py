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
    """Homographies to the first frame from corners that agree with the dominant motion.

    Raises:
        TaaError: the view changes so much that the first frame's background is lost (a cut, a pan).
    """
    import cv2

    cv2.setRNGSeed(seed)
    frames = video.frames
    T, h, w = frames.shape[:3]
    grey0 = cv2.cvtColor(frames[0], cv2.COLOR_BGR2GRAY)
    points = _grid_corners(grey0, per_cell=6)
    H = np.tile(np.eye(3), (T, 1, 1))
    drift, support = np.zeros(T), np.ones(T)
    residuals = []
    if len(points) < 12:
        # Too little texture to say anything: the common case, a static camera, is assumed.
        return CameraMotion(True, H, drift, float("nan"), np.zeros(T))
    lk = dict(winSize=(21, 21), maxLevel=3)
    guess = points.copy()
    alive = np.ones(len(points), bool)
    for t in range(1, T):
        grey = cv2.cvtColor(frames[t], cv2.COLOR_BGR2GRAY)
        nxt, ok, _ = cv2.calcOpticalFlowPyrLK(
            grey0, grey, points, guess.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **lk
        )
        back, ok2, _ = cv2.calcOpticalFlowPyrLK(
            grey, grey0, nxt, points.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **lk
        )
        alive = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(back - points, axis=-1).ravel() < 1.0)
        if alive.sum() < 12:
            raise TaaError(
                f"the background of the first frame is lost at {video.time[t]:.2f} s (camera cut or pan); "
                "cut the video so that the object stays in view"
            )
        found, inlier = cv2.findHomography(nxt[alive], points[alive], cv2.RANSAC, 1.5)
        share = 0.0 if inlier is None else float(inlier.mean())
        if found is None or share < 0.25:
            raise TaaError(
                f"no common background motion at {video.time[t]:.2f} s (camera cut or very fast motion); "
                "cut the video so that the object stays in view"
            )
        H[t], support[t] = found, share
        keep = np.flatnonzero(alive)[inlier.ravel() > 0]
        drift[t] = np.median(np.linalg.norm(nxt[keep] - points[keep], axis=-1))
        warped = cv2.perspectiveTransform(nxt[keep], found)
        residuals.append(np.median(np.linalg.norm(warped - points[keep], axis=-1)))
        # Predict the next frame from this homography, so that slow drift never outruns the search window.
        guess = cv2.perspectiveTransform(points, np.linalg.inv(found)).astype(np.float32)
    static = bool(np.quantile(drift, 0.9) < STATIC_PX)
    return CameraMotion(static, H, drift, float(np.median(residuals)), support)


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
    # The dominant plane may be far behind the object. A second, affine correction follows the static points
    # around the place where things happen, which is where the joint is.
    local = _local_correction(out, video.diagonal * video.scale)
    H = local @ motion.H
    for t in range(T):
        out[t] = _warp(video.frames[t], H[t])
    motion = replace(motion, H=H)
    out.flush()
    note = f"camera drifts by up to {motion.drift_px.max() / video.scale:.1f} px; compensated by homographies"
    return video.with_frames(out, note), motion


def _warp(image: np.ndarray, H: np.ndarray) -> np.ndarray:
    import cv2

    size = (image.shape[1], image.shape[0])
    return cv2.warpPerspective(image, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _local_correction(frames: np.ndarray, diagonal: float) -> np.ndarray:
    """(T, 3, 3) affine corrections from nearly static points, weighted by closeness to the picture's activity."""
    import cv2

    T = len(frames)
    small = [cv2.resize(f, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.int16) for f in frames]
    energy = sum(np.clip(np.abs(b - a).max(axis=-1) - 24, 0, 60) for a, b in zip(small[:-1], small[1:], strict=True))
    energy = cv2.GaussianBlur(energy.astype(np.float32), (0, 0), 3)
    yx = np.stack(np.nonzero(energy >= 0), axis=-1)
    mass = energy.ravel() ** 2
    centre = 4 * (yx * mass[:, None]).sum(0)[::-1] / (mass.sum() + 1e-9)

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
    near = np.exp(-0.5 * (np.linalg.norm(target - centre, axis=-1) / (0.2 * diagonal)) ** 2) + 1e-3
    for t in range(1, T):
        seen = np.isfinite(x[t, :, 0])
        a, b, w = np.c_[x[t, seen], np.ones(seen.sum())], target[seen], near[seen].copy()
        M = None
        for _ in range(6):
            sw = np.sqrt(w)[:, None]
            # A weak pull to the identity keeps the far corners of the image where they are.
            ridge = np.diag([0.03 * diagonal] * 2 + [0.3])
            M = np.linalg.lstsq(np.r_[a * sw, ridge], np.r_[b * sw, ridge @ np.eye(3)[:, :2]], rcond=None)[0]
            r = np.linalg.norm(a @ M - b, axis=-1)
            w = near[seen] / (1 + (r / 0.7) ** 2) ** 2
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
