"""The 21 landmarks of a demonstrated hand: their names, the palm's frame, and which hand it is."""

from __future__ import annotations

import numpy as np

FINGERS = {"thumb": (1, 2, 3, 4), "index": (5, 6, 7, 8), "middle": (9, 10, 11, 12), "ring": (13, 14, 15, 16),
           "little": (17, 18, 19, 20)}
TIPS = {name: joints[-1] for name, joints in FINGERS.items()}
SIDES = ("right", "left")


def palm_frame(joints: np.ndarray, side: str) -> np.ndarray:
    """(4, 4) frame of the palm of landmarks (21, 3) m.

    Origin at the middle finger's knuckle, x to the thumb's side, y along the middle metacarpal, z out of the palm of a
    right hand. Of a left hand x points away from the thumb, so that z is out of its palm as well.
    """
    y = joints[9] - joints[0]
    y = y / max(float(np.linalg.norm(y)), 1e-9)
    x = joints[5] - joints[17] if side == "right" else joints[17] - joints[5]
    x = x - (x @ y) * y
    x = x / max(float(np.linalg.norm(x)), 1e-9)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    frame[:3, 3] = joints[9]
    return frame


def side_of(joints: np.ndarray) -> str:
    """"right" or "left" of landmarks (T, 21, 3), by where the fingers curl; a flat hand passes for a right one."""
    x, y = joints[:, 5] - joints[:, 17], joints[:, 9] - joints[:, 0]
    out = np.cross(x, y)
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    curl = joints[:, [4, 8, 12, 16, 20]].mean(1) - joints[:, [2, 5, 9, 13, 17]].mean(1)
    return "right" if float(np.median((curl * out).sum(1))) >= 0 else "left"
