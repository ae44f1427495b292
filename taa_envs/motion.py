"""The demonstrated hand as an action changes it, and what of it is observed: the tables that a step looks things up in.

:mod:`taa_envs.kernels` does the looking up.
"""

from __future__ import annotations

import numpy as np

from taa_envs import randomize
from taa_envs.asset import Asset
from taa_envs.kernels import CORRECTIONS, TIPS, turn_and_shift
from taa_envs.scene import Scene

ROTATION, CLOSURE = 0.3, 0.5  # rad, share of the way: corrections of an action of 1
TRANSLATION = (0.03, 0.15)  # m, least and most that an action of 1 shifts the hand by
PACE = 1.5  # the reference's clock runs at 1 + PACE * action seconds a second: from -0.5 to 2.5
SLEW = 0.2  # of an action of 1: the fastest that a correction changes in one step
RESIDUALS = CORRECTIONS + 1  # and the pace
PALM = (0, 5, 9, 13, 17)
# How far along its finger each landmark is: closing moves tips all the way, knuckles not at all.
CURL = np.array([0, 0, 1, 2, 3] + [0, 1, 2, 3] * 4) / 3.0
PREVIEW = (0.1, 0.3)  # s ahead
ERROR_SCALE, FORCE_SCALE = 0.02, 10.0  # m, N: units of observations
LAG = 5.0  # observed: how far the joint is ahead of the demonstration, in fifths of the stroke

_MEANS = np.zeros((2, 21))  # of finger tips, of the palm
_MEANS[0, list(TIPS)], _MEANS[1, list(PALM)] = 1 / len(TIPS), 1 / len(PALM)


def residual_translation(asset: Asset, size: float) -> float:
    """m that an action of 1 shifts the hand by: three standard deviations of where hand and part meet.

    Those are the asset's own, of the hand's place, of the pivot, and of the axis over its lever (the stroke of a slide,
    the object's size about a hinge); within :data:`TRANSLATION`.
    """
    std = randomize.uncertainties(asset)
    lever = size if asset.joint_type != "prismatic" else abs(asset.demo["q_demo_end"] - asset.demo["q_start"])
    spread = np.sqrt(std.get("hand", 0.0)**2 + std.get("point", 0.0)**2 + (std.get("axis", 0.0) * lever)**2)
    return float(np.clip(3 * spread, *TRANSLATION))


def apply_residual(joints: np.ndarray, action: np.ndarray, translation: float = TRANSLATION[0]) -> np.ndarray:
    """Landmarks (..., 21, 3) m, closed, turned about the palm and shifted by actions (..., 7 or more); leading axes
    broadcast. translation: m that an action of 1 shifts by."""
    action = np.asarray(action, float)
    means = _MEANS @ joints
    moved = joints + (CLOSURE * action[..., 6, None] * CURL)[..., None] * (means[..., :1, :] - joints)
    x, y, z = np.moveaxis(ROTATION * action[..., 3:6], -1, 0)
    palm, shift = np.moveaxis(means[..., 1, :], -1, 0), np.moveaxis(translation * action[..., :3], -1, 0)
    numbers = np.broadcast_arrays(*turn_and_shift(x, y, z, palm, shift))
    matrix = np.stack(numbers, -1).reshape(*numbers[0].shape, 4, 3)
    return moved @ matrix[..., :3, :] + matrix[..., 3:, :]


def aim_table(scene: Scene, weights: np.ndarray) -> np.ndarray:
    """(T, 8 S + 3), at the reference's frames, for a hand whose S targets are ``weights @ landmarks``: targets as
    (S, 4), their change by closing as (S, 4) (their last numbers are not used), and the palm's centre (3,), m."""
    joints = scene.asset.reference.hand_joints
    means = _MEANS @ joints
    base, curl = (np.zeros((len(joints), len(weights), 4)) for _ in range(2))
    base[..., :3] = weights @ joints
    curl[..., :3] = weights @ (CLOSURE * CURL[:, None] * (means[:, :1] - joints))
    return np.concatenate([base.reshape(len(joints), -1), curl.reshape(len(joints), -1), means[:, 1]], 1)


class Layout:
    """The flat observation: ``clip(raw * scale + shift, -10, 10)``.

    Attributes:
        parts: name -> numbers in it, in order.  at: name -> slice.  size: in all.
    """

    def __init__(self, action_size: int) -> None:
        self.parts = {"joint": 3, "hand": 66, "contact": 5, "reference": 2 + 4 * len(PREVIEW) + 63, "grip": 15,
                      "action": action_size}
        ends = np.cumsum(list(self.parts.values()))
        self.at = {name: slice(int(end) - size, int(end))
                   for (name, size), end in zip(self.parts.items(), ends, strict=True)}
        self.size = int(ends[-1])
        error = self.at["reference"].stop - 63
        self.error = slice(error, error + 63)

    def scale(self, scene: Scene) -> np.ndarray:
        """(size,) factors on raw numbers: strokes, rad or m a second, m, m/s, N."""
        asset = scene.asset
        stroke = asset.demo["q_demo_end"] - asset.demo["q_start"]
        lever = scene.size if asset.joint_type != "prismatic" else 1.0
        out = np.zeros(self.size)
        out[self.at["joint"]] = 1.0, asset.demo["duration"] / stroke, LAG
        out[self.at["hand"]] = [1 / scene.size] * 63 + [1.0] * 3
        out[self.at["contact"]] = 1.0, *[1 / FORCE_SCALE] * 3, 1 / FORCE_SCALE / lever
        out[self.error], out[self.at["grip"]], out[self.at["action"]] = -1 / ERROR_SCALE, 1 / ERROR_SCALE, 1.0
        return out

    def shift(self, scene: Scene) -> np.ndarray:
        """(T, size) what is added, at the reference's frames."""
        asset, reference = scene.asset, scene.asset.reference
        times, joints = reference.time, reference.hand_joints
        out = np.zeros((len(times), self.size))
        stroke = asset.stroke_fraction(reference.q)
        out[:, self.at["joint"].start + 2] = -LAG * stroke
        out[:, self.at["hand"]][:, :63] = np.tile(-scene.centre / scene.size, 21)
        centres = joints.mean(1)
        columns = [np.minimum((times - times[0]) / asset.demo["duration"], 1.0), stroke]
        columns += [np.interp(times + ahead, times, stroke) for ahead in PREVIEW]
        for ahead in PREVIEW:
            columns += [(np.interp(times + ahead, times, centres[:, k]) - centres[:, k]) / scene.size for k in range(3)]
        out[:, self.at["reference"].start:self.error.start] = np.stack(columns, 1)
        out[:, self.error] = joints.reshape(len(times), 63) / ERROR_SCALE
        out[:, self.at["grip"]] = -_in_the_link(scene).reshape(len(times), 15) / ERROR_SCALE
        return out


def _in_the_link(scene: Scene) -> np.ndarray:
    """(T, 5, 3) m, the demonstrated finger tips in the moving link's own frame."""
    import mujoco

    data, body = mujoco.MjData(scene.model), scene.model.body("moving").id
    reference = scene.asset.reference
    out = np.empty((len(reference.time), len(TIPS), 3))
    for i, (q, joints) in enumerate(zip(reference.q, reference.hand_joints, strict=True)):
        scene.put(data.qpos, q)
        mujoco.mj_kinematics(scene.model, data)
        out[i] = (joints[list(TIPS)] - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
    return out
