"""The 21 landmarks as a skeleton: bones, one anatomy for a clip, fingers that reach for a point."""

from __future__ import annotations

import numpy as np

FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
PARENT = np.array([0, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19])
TIPS = np.array([4, 8, 12, 16, 20])
CONTACT = np.array([3, 4, 7, 8, 11, 12, 15, 16, 19, 20])
"""Finger tips and the joints before them: what usually touches."""
ADULT_SIZE_STD = 0.07
"""Relative spread of adult hand sizes."""
HAND_SIZE_STD = 0.09
"""Relative error of every length that rests on a hand: adult hand sizes spread by 7 %, landmarks on the palm add 5 %
(rendered clips, true palm: depth off by -2 to +10 %)."""
PALM = (0, 5, 9, 13, 17)
PALM_SHAPE = np.array([[0.0, 0.0, 0.0], [0.023, 0.085, 0.0], [0.0, 0.087, 0.0], [-0.020, 0.080, 0.0],
                       [-0.038, 0.068, 0.0]])  # fmt: skip
"""(5, 3) m, wrist and knuckles of a mean adult's right hand: x to the thumb's side, y along the middle metacarpal."""
ADULT = np.array([0.0, 0.033, 0.041, 0.032, 0.026, 0.088, 0.040, 0.024, 0.021, 0.087, 0.045, 0.028, 0.022, 0.082,
                  0.041, 0.026, 0.022, 0.078, 0.032, 0.020, 0.019])  # fmt: skip
"""(21,) m from each landmark to its parent in a mean adult hand (wrist to middle finger tip 0.18 m).

Used instead of the network's own lengths, which depend on pose and view: over the shared clips its hand length runs
from 0.11 to 0.25 m, its palm width from 0.03 to 0.09 m.
"""


def palm_pixels(uv: np.ndarray) -> np.ndarray:
    """(..., 21, 2) -> (...,) size of the palm in px, the larger of its length and width."""
    length = np.linalg.norm(uv[..., 9, :] - uv[..., 0, :], axis=-1)
    return np.maximum(length, np.linalg.norm(uv[..., 5, :] - uv[..., 17, :], axis=-1))


def bone_lengths(joints: np.ndarray) -> np.ndarray:
    """(..., 21, 3) -> (..., 21), each landmark's distance to its parent (0 for the wrist)."""
    return np.linalg.norm(joints - joints[..., PARENT, :], axis=-1)


def with_bone_lengths(joints: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Same bone directions, given lengths (21,), centroid kept."""
    out = np.array(joints, float)
    for i in range(1, 21):  # parents come before their children
        bone = joints[..., i, :] - joints[..., PARENT[i], :]
        norm = np.linalg.norm(bone, axis=-1, keepdims=True)
        out[..., i, :] = out[..., PARENT[i], :] + bone / np.maximum(norm, 1e-9) * lengths[i]
    return out + (joints - out).mean(axis=-2, keepdims=True)


def one_anatomy(metric: np.ndarray) -> np.ndarray:
    """Metric landmarks (T, 21, 3) with a mean adult's bone lengths; NaN frames stay NaN."""
    return with_bone_lengths(metric, ADULT)


def reach(chain: np.ndarray, target: np.ndarray, rounds: int = 12) -> np.ndarray:
    """Bend a chain (n, 3) so that its last joint comes to target; first joint and bone lengths are kept (FABRIK)."""
    lengths = np.linalg.norm(np.diff(chain, axis=0), axis=1)
    base, out = chain[0].copy(), chain.astype(float).copy()
    span = target - base
    if np.linalg.norm(span) > lengths.sum():  # out of reach: as near as a straight finger comes
        target = base + span / np.linalg.norm(span) * lengths.sum() * 0.999
    for _ in range(rounds):
        out[-1] = target
        for i in range(len(out) - 2, -1, -1):
            step = out[i] - out[i + 1]
            out[i] = out[i + 1] + step / max(np.linalg.norm(step), 1e-9) * lengths[i]
        out[0] = base
        for i in range(1, len(out)):
            step = out[i] - out[i - 1]
            out[i] = out[i - 1] + step / max(np.linalg.norm(step), 1e-9) * lengths[i - 1]
    return out
