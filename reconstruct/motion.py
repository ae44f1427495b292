"""Camera compensation: is the camera static, and if not, warp every frame to the first view."""

from __future__ import annotations

from dataclasses import dataclass
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
        nxt, ok, _ = cv2.calcOpticalFlowPyrLK(grey0, grey, points, guess.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **lk)
        back, ok2, _ = cv2.calcOpticalFlowPyrLK(grey, grey0, nxt, points.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **lk)
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
    import cv2

    motion = estimate_camera_motion(video, seed)
    if motion.static:
        return video, motion
    T, h, w = video.frames.shape[:3]
    where = scratch or Path(video.frames.filename).parent
    where.mkdir(parents=True, exist_ok=True)
    out = np.lib.format.open_memmap(where / "frames_stable.npy", mode="w+", dtype=np.uint8, shape=video.frames.shape)
    for t in range(T):
        out[t] = cv2.warpPerspective(
            video.frames[t], motion.H[t], (w, h), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    out.flush()
    note = f"camera drifts by up to {motion.drift_px.max() / video.scale:.1f} px; compensated by homographies"
    return video.with_frames(out, note), motion


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
