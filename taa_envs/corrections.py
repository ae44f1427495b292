"""What may be wrong with a demonstrated hand, as a few smooth parameters in units of their stated uncertainty.

A hand from one camera has an uncertain depth, size and timing, and its finger tips are off by millimetres. Each
parameter moves the whole demonstration along one such direction: 0 is the demonstration, 1 one standard deviation.
The deviations are those that the asset states (``hand.*`` in its provenance); nothing here looks at the simulation.

=============  =================================================================  ==========================
name           what it does                                                       unit of the deviation
=============  =================================================================  ==========================
depth          shift along the camera's ray to the hand, riding on the link       ``hand.depth``, m
across, up     shift across that ray, riding on the link                          ``hand.across``, m
size           the hand about its finger tips                                     ``hand.size``, relative
time           the hand later                                                     ``hand.time``, s
stroke         the hand further along the joint's motion, growing with the stroke  ``hand.across``, m
close          finger tips towards their mean                                     ``hand.tips``, m
thumb ...      one finger tip along the link's motion                             ``hand.tips``, m
=============  =================================================================  ==========================

A shift that rides on the link is constant in the link's frame as the demonstration has it: a hand that was still there
stays still there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from taa_envs.asset import Asset
from taa_envs.simulation import HandPath

FINGERS = {"thumb": (2, 3, 4), "index": (6, 7, 8), "middle": (10, 11, 12), "ring": (14, 15, 16), "little": (18, 19, 20)}
NAMES = ("depth", "across", "up", "size", "time", "stroke", "close", *FINGERS)
FOLLOW = (0.3, 0.6, 1.0)  # how much of its tip's way the last three joints of a finger go
FADE = 0.3  # s over which what concerns the finger tips sets in before contact, and ends after it
DEFAULTS = {"hand.depth": 0.02, "hand.across": 0.01, "hand.size": 0.07, "hand.time": 0.02, "hand.tips": 0.005}
"""Where an asset states nothing: a hand held against the part by contact, one frame, the spread of adult hands."""
_ENTRY = {"depth": "hand.depth", "across": "hand.across", "up": "hand.across", "size": "hand.size", "time": "hand.time",
          "stroke": "hand.across", **dict.fromkeys(("close", *FINGERS), "hand.tips")}


def deviations(asset: Asset) -> tuple[dict[str, float], bool]:
    """Standard deviation of each parameter, and whether the asset states them all (:data:`DEFAULTS` otherwise)."""
    out, stated = {}, True
    for name, key in _ENTRY.items():
        std = (asset.provenance.get(key) or {}).get("std")
        known = isinstance(std, (int, float)) and np.isfinite(std) and std >= 0
        stated &= bool(known)
        out[name] = float(std) if known else DEFAULTS[key]
    return out, stated


def rotations(asset: Asset, q: np.ndarray) -> np.ndarray:
    """(T, 3, 3) rotation of the moving link at q (T,)."""
    from scipy.spatial.transform import Rotation

    if asset.joint_type == "prismatic":
        return np.broadcast_to(np.eye(3), (len(q), 3, 3))
    return Rotation.from_rotvec(np.asarray(q)[:, None] * np.array(asset.joint["axis"], float)).as_matrix()


def along(asset: Asset, x: np.ndarray) -> np.ndarray:
    """Unit direction (..., 3) in which points x (..., 3) m of the link move during the demonstration."""
    sign = np.sign(asset.demo["q_demo_end"] - asset.demo["q_start"])
    axis = sign * np.array(asset.joint["axis"], float)
    if asset.joint_type == "prismatic":
        return np.broadcast_to(axis, x.shape)
    v = np.cross(np.broadcast_to(axis, x.shape), x - np.array(asset.joint["point"], float)) + asset.pitch * axis
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


@dataclass(frozen=True)
class Corrections:
    """An asset's demonstration and the directions in which it may be wrong.

    Attributes:
        std: standard deviation of each name in :data:`NAMES`.
        stated: whether the asset states them.
    """

    asset: Asset
    std: dict[str, float]
    stated: bool

    @classmethod
    def of(cls, asset: Asset) -> Corrections:
        return cls(asset, *deviations(asset))

    def _view(self) -> tuple[int, np.ndarray]:
        """Frame in the middle of the driven stroke, and rows (3, 3): the camera's ray to the hand, and across it."""
        reference = self.asset.reference
        end = self.asset.demo["demo_end_frame"]
        driven = np.flatnonzero(reference.contact[:end + 1])
        key = int(driven[len(driven) // 2]) if len(driven) else end // 2
        if self.asset.camera is None:
            return key, np.eye(3)
        T = np.array(self.asset.camera["T_camera_world"], float)
        ray = reference.hand_joints[key].mean(0) + T[:3, :3].T @ T[:3, 3]
        ray = ray / max(float(np.linalg.norm(ray)), 1e-9)
        right = np.cross(ray, np.cross(T[0, :3], ray))
        right /= max(float(np.linalg.norm(right)), 1e-9)
        return key, np.stack([ray, right, np.cross(ray, right)])

    def _held(self) -> np.ndarray:
        """(T,) 1 from the first to the last driven frame, fading to 0 outside."""
        reference = self.asset.reference
        driven = np.flatnonzero(reference.contact)
        if not len(driven):
            return np.ones(len(reference.time))
        t = reference.time
        away = np.maximum(np.maximum(t[driven[0]] - t, t - t[driven[-1]]), 0.0)
        s = np.clip(1 - away / FADE, 0.0, 1.0)
        return s * s * (3 - 2 * s)

    def path(self, z: np.ndarray) -> HandPath:
        """The demonstration with parameters z (len(NAMES),), in standard deviations."""
        asset, reference = self.asset, self.asset.reference
        x = {name: float(v) * self.std[name] for name, v in zip(NAMES, z, strict=True)}
        joints = reference.hand_joints.copy()
        held = self._held()[:, None]
        tips = [finger[-1] for finger in FINGERS.values()]
        middle = joints[:, tips].mean(1, keepdims=True)
        joints = middle + np.exp(x["size"]) * (joints - middle)
        direction = along(asset, joints)
        for finger in FINGERS.values():
            inward = middle[:, 0] - joints[:, finger[-1]]
            inward /= np.maximum(np.linalg.norm(inward, axis=-1, keepdims=True), 1e-9)
            name = next(n for n, f in FINGERS.items() if f is finger)
            way = held * (x["close"] * inward + x[name] * direction[:, finger[-1]])
            for joint, share in zip(finger, FOLLOW, strict=True):
                joints[:, joint] += share * way
        key, view = self._view()
        turn = rotations(asset, reference.q)
        shift = turn[key].T @ (np.array([x["depth"], x["across"], x["up"]]) @ view)
        joints += (turn @ shift)[:, None]
        if x["stroke"]:
            ahead = x["stroke"] * np.clip(asset.stroke_fraction(reference.q), 0, 1)
            joints = joints + (ahead[:, None] * along(asset, joints.mean(1)))[:, None]
        return HandPath(reference.time + x["time"], joints)
