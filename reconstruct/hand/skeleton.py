"""The 21 landmarks as a skeleton: bones, one anatomy for a clip, fingers that reach for a point."""

from __future__ import annotations

import numpy as np

FINGERS = ((1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12), (13, 14, 15, 16), (17, 18, 19, 20))
PARENT = np.array([0, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19])
TIPS = np.array([4, 8, 12, 16, 20])
CONTACT = np.array([3, 4, 7, 8, 11, 12, 15, 16, 19, 20])
"""Finger tips and the joints before them: what usually touches."""
HAND_SIZE_STD = 0.12
"""Relative spread of adult hand sizes about the network's prior; the floor of every length that rests on a hand."""


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


def one_anatomy(metric: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Metric landmarks (T, 21, 3) with the clip's median bone lengths; NaN frames stay NaN.

    Only the better half of the frames by score votes: an occluded hand gets shorter fingers from the network.
    """
    seen = np.isfinite(metric[:, 0, 0])
    if not seen.any():
        return metric.copy()
    good = seen & (score >= np.median(score[seen]))
    return with_bone_lengths(metric, np.median(bone_lengths(metric[good]), axis=0))


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
