"""Clips of objects on a desk: who touches what where, and from where it is seen."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.synth import desk
from reconstruct.synth.hand_model import HandPose
from reconstruct.synth.staging import Clip, place_hand, pose_matrix

ANY_JOINT = tuple(range(21))
UP = np.array([0.0, 0, 1])


def laptop(seed: int) -> Clip:
    model = desk.laptop(seed)
    pose = HandPose(
        flex=((12, 14, 8), (12, 14, 8), (12, 14, 8), (14, 16, 8)),
        spread=(11, 1, -8, -19),
        thumb=(52, 8, 10, 8),
        wrist=(0, 0),
        arm=0.95,
    )
    up = np.array([0.0, 0, 1])
    T = place_hand(
        pose,
        "right",
        -up,
        np.array([0.12, -0.97, -0.10]),
        np.array([0.02, 0.115, 0.03]),
        (12,),
        (np.array([0, 0, 0.030]), up),
        tuple(range(21)),
    )
    opened = model.link_pose(np.radians(-100.0))
    return Clip(
        "laptop",
        "a laptop's lid is pushed shut from behind",
        model,
        pose,
        "right",
        opened @ T,
        np.array([0.10, -0.16, 0.14]),
        np.array([0.0, -0.08, 0.02]),
        np.array([-0.28, -0.60, 0.42]),
        np.array([0.01, 0.04, 0.13]),
    )


def _lifted(s: float) -> np.ndarray:
    R = Rotation.from_rotvec(np.radians([28 * s, -22 * s * s, 55 * s * (1 - 0.4 * s)])).as_matrix()
    return pose_matrix(R, np.array([0.11 * s * s, -0.07 * np.sin(np.pi * s), 0.17 * s * (1.5 - 0.5 * s)]))


def lift(seed: int) -> Clip:
    model = desk.parcel(seed)
    pose = HandPose(
        flex=((46, 30, 14), (48, 30, 14), (48, 30, 14), (46, 30, 14)),
        spread=(14, 2, -9, -22),
        thumb=(62, 40, 0, 8),
        wrist=(6, 0),
    )
    y = np.array([0.0, 1, 0])
    T = place_hand(
        pose,
        "right",
        np.array([0, -0.12, -1.0]),
        np.array([0, 1, -0.12]),
        np.array([0.0, 0.05, 0.134]),
        (8, 12, 16, 20),
        (np.array([0, 0.05, 0.0]), y),
        (7, 8, 11, 12, 15, 16, 19, 20),
    )
    return Clip(
        "lift",
        "a parcel is lifted freely away: no joint",
        model,
        pose,
        "right",
        T,
        np.array([0.05, -0.14, 0.16]),
        np.array([0.0, 0.0, 0.09]),
        np.array([-0.26, -0.50, 0.72]),
        np.array([0.03, 0.0, 0.14]),
        free_path=_lifted,
    )




def monitor(seed: int) -> Clip:
    model = desk.monitor(seed)
    # The wrist is bent back and to the side, so that the arm does not hide the screen.
    pose = HandPose(
        flex=((14, 16, 10), (14, 16, 10), (14, 16, 10), (16, 18, 10)),
        spread=(12, 1, -9, -21),
        thumb=(50, 14, 12, 10),
        wrist=(42, 22),
    )
    leaned = model.link_pose(np.radians(4.0))  # place the hand while the screen is upright
    out = np.array([0.0, -1, 0])
    T = place_hand(
        pose,
        "right",
        -out,
        np.array([-0.42, 0.10, 0.90]),
        np.array([0.150, 0, 0.405]),
        (12,),
        (np.array([0, -0.0135, 0.0]), out),
        ANY_JOINT,
    )
    return Clip(
        "monitor",
        "a monitor is tilted back at its upper edge",
        model,
        pose,
        "right",
        np.linalg.inv(leaned) @ T,
        np.array([0.14, -0.20, -0.10]),
        np.array([0.0, -0.10, 0.0]),
        np.array([-0.44, -0.62, 0.50]),
        np.array([0.0, 0.0, 0.25]),
    )


def stapler(seed: int) -> Clip:
    model = desk.stapler(seed)
    pose = HandPose(
        flex=((10, 14, 8), (10, 14, 8), (10, 14, 8), (12, 16, 8)),
        spread=(10, 1, -8, -18),
        thumb=(58, 6, 10, 8),
        wrist=(18, 0),
    )
    closed = model.link_pose(np.radians(52.0))
    T = place_hand(
        pose,
        "right",
        -UP,
        np.array([-0.95, 0.30, -0.05]),
        np.array([0.058, 0.004, 0.09]),
        (8, 12),
        (np.array([0, 0, 0.062]), UP),
        ANY_JOINT,
    )
    return Clip(
        "stapler",
        "a stapler's arm is pressed down",
        model,
        pose,
        "right",
        np.linalg.inv(closed) @ T,
        np.array([0.10, -0.06, 0.14]),
        np.array([0.0, 0.0, 0.08]),
        np.array([-0.12, -0.50, 0.30]),
        np.array([0.025, 0.0, 0.115]),
    )


def puncher(seed: int) -> Clip:
    model = desk.puncher(seed)
    pose = HandPose(
        flex=((10, 14, 8), (10, 14, 8), (10, 14, 8), (12, 16, 8)),
        spread=(10, 1, -8, -18),
        thumb=(56, 6, 10, 8),
        wrist=(20, -10),
    )
    closed = model.link_pose(np.radians(30.0))
    T = place_hand(
        pose,
        "right",
        -UP,
        np.array([-0.45, 0.89, -0.05]),
        np.array([0.030, -0.012, 0.09]),
        (8, 12),
        (np.array([0, 0, 0.068]), UP),
        ANY_JOINT,
    )
    return Clip(
        "puncher",
        "a paper punch's lever is pressed down",
        model,
        pose,
        "right",
        np.linalg.inv(closed) @ T,
        np.array([0.10, -0.10, 0.14]),
        np.array([0.0, 0.0, 0.08]),
        np.array([-0.30, -0.22, 0.40]),
        np.array([0.03, 0.015, 0.080]),
    )
