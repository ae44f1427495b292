"""Small textured pictures for tests of pixels."""

import cv2
import numpy as np


def turning_plate(count: int, size=(360, 480)):
    """A textured plate that turns and shrinks as a door does, over a static background.

    Returns:
        (count, h, w, 3) uint8 frames, and (count, 3, 3) homographies of the plate from its first position.
    """
    rng = np.random.default_rng(0)
    back = cv2.resize(rng.integers(60, 200, (18, 24, 3), dtype=np.uint8), size[::-1], interpolation=cv2.INTER_CUBIC)
    plate = cv2.resize(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8), size[::-1], interpolation=cv2.INTER_CUBIC)
    corners = np.float32([[180, 120], [330, 120], [330, 260], [180, 260]])
    frames, homographies = [], []
    for t in range(count):
        s = t / (count - 1)
        now = np.float32([[180, 120], [330 - 70 * s, 120 + 30 * s], [330 - 70 * s, 260 + 45 * s], [180, 260]])
        H = cv2.getPerspectiveTransform(corners, now).astype(float)
        mask = cv2.fillConvexPoly(np.zeros(size, np.uint8), now.astype(int), 1) > 0
        image = back.copy()
        warped = cv2.warpPerspective(plate, H, size[::-1])
        image[mask] = warped[mask]
        frames.append(cv2.GaussianBlur(image, (0, 0), 0.7))
        homographies.append(H)
    return np.stack(frames), np.stack(homographies)
