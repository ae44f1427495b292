"""A small video of a chest whose two drawers are pulled out one after the other, with its truth; no hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

SIZE, FOCAL, T = (640, 360), 560.0, 60
K = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
OUT = np.array([0.45, 0.25, -1.0]) / np.linalg.norm([0.45, 0.25, -1.0])  # camera frame: right, down, forward
FRONT = 1.3  # m
ramp = lambda a, b: np.clip((np.arange(T) - a) / (b - a), 0, 1)  # noqa: E731
STATES = (0.24 * ramp(4, 24), 0.2 * ramp(34, 54))
LOW_HIGH = (((-0.32, -0.18), (0.16, -0.02)), ((-0.32, 0.02), (0.16, 0.18)))  # m, fronts at rest: (x, y) corners


def _texture(rng: np.random.Generator, h: int, w: int, colour: tuple) -> np.ndarray:
    import cv2

    noise = cv2.resize(rng.uniform(-70, 70, (h // 8, w // 8)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    fine = cv2.resize(rng.uniform(-40, 40, (h // 3, w // 3)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.array(colour, np.float32) + (noise + fine)[..., None], 0, 255).astype(np.uint8)


def corners(k: int, q: float) -> np.ndarray:
    """(4, 3) m, a front's corners in the camera frame."""
    (x0, y0), (x1, y1) = LOW_HIGH[k]
    return np.array([[x0, y0, FRONT], [x1, y0, FRONT], [x1, y1, FRONT], [x0, y1, FRONT]]) + q * OUT


def frames(seed: int = 0) -> np.ndarray:
    """(T, H, W, 3) uint8 BGR."""
    import cv2

    rng = np.random.default_rng(seed)
    W, H = SIZE
    back = _texture(rng, H, W, (120, 130, 110))
    fronts = [_texture(rng, 240, 480, colour) for colour in ((90, 140, 180), (170, 120, 90))]
    source = np.float32([[0, 0], [480, 0], [480, 240], [0, 240]])
    out = np.empty((T, H, W, 3), np.uint8)
    for t in range(T):
        out[t] = back
        for k in np.argsort([-STATES[0][t], -STATES[1][t]])[::-1]:
            x = corners(k, STATES[k][t]) @ K.T
            M = cv2.getPerspectiveTransform(source, np.float32(x[:, :2] / x[:, 2:]))
            warped = cv2.warpPerspective(fronts[k], M, SIZE, flags=cv2.INTER_LINEAR)
            inside = cv2.warpPerspective(np.full((240, 480), 255, np.uint8), M, SIZE) > 127
            out[t][inside] = warped[inside]
    return out


def write_video(path: Path, seed: int = 0) -> Path:
    """The clip as a file, 20 frames a second."""
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, SIZE)
    for image in frames(seed):
        writer.write(image)
    writer.release()
    return path


def tracks(seed: int = 0, px: float = 0.4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uv (N, T, 2), visible (N, T), xyz (N, T, 3) in the camera frame: 60 on each front, 150 on the wall behind."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, q in enumerate(STATES):
        (x0, y0), (x1, y1) = LOW_HIGH[k]
        X = np.column_stack([rng.uniform(x0 + 0.01, x1 - 0.01, 60), rng.uniform(y0 + 0.01, y1 - 0.01, 60),
                             np.full(60, FRONT)])  # fmt: skip
        parts.append(X[:, None] + q[:, None] * OUT)
    wall = np.column_stack([rng.uniform(-0.7, 0.7, 150), rng.uniform(-0.4, 0.4, 150), np.full(150, FRONT + 0.02)])
    parts.append(np.repeat(wall[:, None], T, axis=1))
    X = np.concatenate(parts)
    uv = X[..., :2] / X[..., 2:] * FOCAL + K[:2, 2] + rng.normal(scale=px, size=(*X.shape[:2], 2))
    return uv, np.ones(X.shape[:2], bool), X
