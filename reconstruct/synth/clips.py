"""What the clips show; those on a desk are in :mod:`reconstruct.synth.desk_clips`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.synth import desk_clips, objects
from reconstruct.synth.desk_clips import ANY_JOINT
from reconstruct.synth.hand_model import HandPose
from reconstruct.synth.staging import Clip, place_hand


def _demo(seed: int) -> Clip:
    model = objects.cupboard(seed)
    # Flat fingers whose pads and not the palm meet the door; the wrist is bent back.
    pose = HandPose(
        flex=((14, 16, 10), (14, 16, 10), (14, 16, 10), (16, 18, 10)),
        spread=(12, 1, -9, -21),
        thumb=(50, 14, 12, 10),
        wrist=(48, 0),
    )
    out = np.array([0.0, -1, 0])
    T = place_hand(
        pose,
        "right",
        -out,
        np.array([-0.28, 0.14, 0.95]),
        np.array([0.085, 0, 0.585]),
        (12,),
        (np.array([0, -0.020, 0.0]), out),
        ANY_JOINT,
    )
    opened = model.link_pose(np.radians(-75.0))
    turn = opened[:3, :3]
    return Clip(
        "demo",
        "a wall cupboard's door is pushed shut",
        model,
        pose,
        "right",
        opened @ T,
        turn @ np.array([0.06, -0.20, -0.16]),
        turn @ np.array([0.0, -0.10, 0.0]),
        np.array([-0.56, -0.86, 0.62]),
        np.array([-0.02, -0.06, 0.50]),
    )


def _demo_handheld(seed: int) -> Clip:
    return replace(_demo(seed), name="demo_handheld", story="the demo, filmed from a hand", drift=(0.006, 0.006))


def _hook(first: float, second: float, third: float, wrist: tuple[float, float]) -> HandPose:
    flex = (
        (first - 2, second, third),
        (first, second, third),
        (first + 1, second, third),
        (first + 3, second - 2, third),
    )
    return HandPose(flex=flex, spread=(7, 1, -5, -12), thumb=(44, 4, 8, 12), wrist=wrist)


def _pull(pose: HandPose, rise: float, plate: np.ndarray) -> np.ndarray:
    """A right hand hooked from above behind a plate handle whose inner face (normal +y) is centred at ``plate``."""
    a = np.radians(rise)
    fingers, palm = np.array([0, np.cos(a), np.sin(a)]), np.array([0, np.sin(a), -np.cos(a)])
    joints = (6, 7, 10, 11, 14, 15, 18, 19)
    return place_hand(
        pose,
        "right",
        palm,
        fingers,
        plate + [0.015, 0.009, 0.004],
        joints,
        (plate, np.array([0.0, 1, 0])),
        (6, 7, 8, 10, 11, 12, 14, 15, 16, 18, 19, 20),
    )


def _drawer(seed: int) -> Clip:
    model = objects.drawers(seed)
    pose = _hook(45, 53, 4, (4, 20))
    T = _pull(pose, 10, np.array([0.0, -0.064, 0.2635]))
    return Clip(
        "drawer",
        "a drawer is pulled out by its handle",
        model,
        pose,
        "right",
        T,
        np.array([0.05, -0.22, 0.10]),
        np.array([0.0, 0.0, 0.10]),
        np.array([-0.26, -0.72, 0.66]),
        np.array([0.01, -0.10, 0.19]),
    )


def _oven(seed: int) -> Clip:
    model = objects.oven(seed)
    pose = _hook(34, 45, 3, (8, 20))
    T = _pull(pose, -8, np.array([0.0, -0.066, 0.262]))
    return Clip(
        "oven",
        "an oven's door is pulled open downwards",
        model,
        pose,
        "right",
        T,
        np.array([0.08, -0.18, 0.14]),
        np.array([0.0, 0.0, 0.10]),
        np.array([-0.30, -0.74, 0.72]),
        np.array([0.01, -0.12, 0.17]),
    )


def _cabinet(seed: int) -> Clip:
    model = objects.cabinet(seed)
    # From below, palm up: the forearm leaves the picture without passing in front of the door.
    pose = replace(_hook(44, 27, 3, (34, 0)), thumb=(66, -4, 8, 12))
    # Turned a little to the hinge's far side, so that the short little finger does not pull alone.
    rise, turn = np.radians([16.0, 14.0])
    ahead = np.array([np.sin(turn), np.cos(turn), 0.0])
    fingers = np.cos(rise) * ahead + np.array([0, 0, np.sin(rise)])
    palm = -np.sin(rise) * ahead + np.array([0, 0, np.cos(rise)])
    plate = np.array([0.115, -0.064, 0.382])
    T = place_hand(
        pose,
        "right",
        palm,
        fingers,
        plate + [-0.002, 0.009, 0.004],
        (6, 7, 10, 11, 14, 15, 18, 19),
        (plate, np.array([0.0, 1, 0])),
        (6, 7, 8, 10, 11, 12, 14, 15, 16, 18, 19, 20),
    )
    return Clip(
        "cabinet",
        "a wall cabinet's door is pulled open by its handle",
        model,
        pose,
        "right",
        T,
        np.array([0.06, -0.20, -0.16]),
        np.array([0.0, 0.0, -0.10]),
        np.array([-0.42, -0.96, 0.72]),
        np.array([-0.02, -0.06, 0.51]),
    )


def _box(seed: int) -> Clip:
    model = objects.chest(seed)
    pose = HandPose(
        flex=((10, 12, 8), (10, 12, 8), (10, 12, 8), (12, 14, 8)),
        spread=(9, 1, -7, -16),
        thumb=(58, 10, 8, 8),
        wrist=(0, 0),
    )
    up = np.array([0.0, 0, 1])
    T = place_hand(
        pose,
        "right",
        up,
        np.array([-0.10, 0.98, 0.10]),
        np.array([0.025, -0.019, 0.12]),
        (12,),
        (np.array([0, 0, 0.132]), -up),
        ANY_JOINT,
    )
    return Clip(
        "box",
        "a box's lid is lifted at its lip",
        model,
        pose,
        "right",
        T,
        np.array([0.05, -0.16, -0.02]),
        np.array([0.0, -0.02, -0.05]),
        np.array([-0.60, 0.01, 0.68]),
        np.array([0.02, 0.01, 0.19]),
    )


def _locker(seed: int) -> Clip:
    model = objects.locker(seed)
    pose = HandPose(
        flex=((14, 16, 10), (14, 16, 10), (14, 16, 10), (16, 18, 10)),
        spread=(12, 1, -9, -21),
        thumb=(50, 14, 12, 10),
        wrist=(46, 0),
    )
    out = np.array([0.0, -1, 0])
    T = place_hand(
        pose,
        "left",
        -out,
        np.array([0.28, 0.14, 0.95]),
        np.array([-0.075, 0, 0.60]),
        (12,),
        (np.array([0, -0.020, 0.0]), out),
        ANY_JOINT,
    )
    opened = model.link_pose(np.radians(-80.0))
    turn = opened[:3, :3]
    return Clip(
        "locker",
        "a tall cabinet's door is pushed shut with the left hand",
        model,
        pose,
        "left",
        opened @ T,
        turn @ np.array([-0.06, -0.20, -0.16]),
        turn @ np.array([0.0, -0.10, 0.0]),
        np.array([0.56, -0.90, 0.70]),
        np.array([0.02, -0.06, 0.53]),
    )


def _crate(seed: int) -> Clip:
    model = objects.crate(seed)
    pose = HandPose(
        flex=((14, 18, 10), (14, 18, 10), (14, 18, 10), (14, 18, 10)),
        spread=(8, 1, -6, -14),
        thumb=(60, 4, 8, 8),
        wrist=(14, 0),
    )
    T = place_hand(
        pose,
        "right",
        np.array([0, -0.20, -0.98]),
        np.array([-0.12, 0.97, -0.20]),
        np.array([0.010, 0.05, 0.176]),
        (8, 12, 16),
        (np.array([0, 0.060, 0.0]), np.array([0.0, -1, 0])),
        (8, 12, 16, 20),
    )
    return Clip(
        "crate",
        "a crate's lid is slid open",
        model,
        pose,
        "right",
        T,
        np.array([0.06, -0.18, 0.10]),
        np.array([0.0, -0.05, 0.06]),
        np.array([-0.48, -0.34, 0.66]),
        np.array([0.01, 0.12, 0.15]),
    )


def _still(seed: int) -> Clip:
    clip = _drawer(seed)
    pose = HandPose(wrist=(55, 0))
    out = np.array([0.0, -1, 0])
    T = place_hand(
        pose,
        "right",
        -out,
        np.array([-0.5, 0.0, 0.85]),
        np.array([0.05, 0, 0.30]),
        (9,),
        (np.array([0, -0.14, 0.0]), out),
        ANY_JOINT,
    )
    return replace(
        clip,
        name="still",
        story="a hand waves in front of a chest; nothing else moves",
        pose=pose,
        T_world_hand=T,
        far=np.array([0.14, -0.16, -0.02]),
        near=np.array([0.06, -0.04, 0.0]),
        touches=False,
    )


_BUILDERS: dict[str, Callable[[int], Clip]] = {
    "demo": _demo,
    "drawer": _drawer,
    "laptop": desk_clips.laptop,
    "oven": _oven,
    "monitor": desk_clips.monitor,
    "stapler": desk_clips.stapler,
    "puncher": desk_clips.puncher,
    "cabinet": _cabinet,
    "box": _box,
    "locker": _locker,
    "crate": _crate,
    "lift": desk_clips.lift,
    "still": _still,
    "demo_handheld": _demo_handheld,
}


def list_clips() -> list[str]:
    """Names of the clips that can be rendered."""
    return list(_BUILDERS)


def build_clip(name: str, seed: int = 0) -> Clip:
    """The named clip's description.

    Raises:
        ValueError: no such clip; the message lists those there are.
    """
    if name not in _BUILDERS:
        raise ValueError(f"unknown clip {name!r}; known: {', '.join(_BUILDERS)}")
    return _BUILDERS[name](seed)
