"""What the clips show: an object, a hand that touches it somewhere, and a camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.synth import objects
from reconstruct.synth.hand_model import RADII, THUMB_RADII, HandPose, landmarks
from reconstruct.synth.objects import Model


@dataclass(frozen=True)
class Clip:
    """One clip before it is rendered.

    Attributes:
        model: the object and its room.
        pose, side: the hand's finger angles; "right" or "left".
        T_world_hand: (4, 4) of the hand when contact begins (q = 0).
        far, near: (3,) m, where the hand comes from, relative to the contact: it starts at ``far`` and arrives
            along ``near``; when it leaves, both are turned with the moving link.
        camera, target: (3,) camera position and what it looks at, world.
        focal: focal length in units of the image's width.
        drift: standard deviation of hand-held camera motion, (m, rad); zeros for a tripod.
        frames: number of frames.  touches: whether the hand ever reaches the object.
        free_path: pose (4, 4) of an unattached moving link for s in [0, 1].
    """

    name: str
    story: str
    model: Model
    pose: HandPose
    side: str
    T_world_hand: np.ndarray
    far: np.ndarray
    near: np.ndarray
    camera: np.ndarray
    target: np.ndarray
    focal: float = 0.82
    drift: tuple[float, float] = (0.0, 0.0)
    frames: int = 120
    touches: bool = True
    free_path: Callable[[float], np.ndarray] | None = None


def pose_matrix(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(4, 4) from a rotation and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def skin_radii() -> np.ndarray:
    """(21,) distance from each landmark to the skin, m."""
    return np.concatenate([[0.018], THUMB_RADII, RADII.reshape(-1)])


def place_hand(
    pose: HandPose,
    side: str,
    palm: np.ndarray,
    fingers: np.ndarray,
    anchor: np.ndarray,
    anchor_joints: tuple[int, ...],
    surface: tuple[np.ndarray, np.ndarray],
    touching: tuple[int, ...],
) -> np.ndarray:
    """(4, 4) world pose of a hand that touches a plane.

    Args:
        palm, fingers: (3,) where the palm faces and the metacarpals point, world.
        anchor: (3,) where the mean of ``anchor_joints`` goes, before the shift below.
        surface: point and unit normal (to the hand's side) of the touched plane.
        touching: joints of which the nearest one's skin meets the plane.
    """
    y = np.asarray(fingers, float)
    y = y / np.linalg.norm(y)
    z = np.asarray(palm, float) - (palm @ y) * y
    z /= np.linalg.norm(z)
    R = np.stack([np.cross(y, z), y, z], axis=1)
    joints = landmarks(pose, side) @ R.T
    t = np.asarray(anchor, float) - joints[list(anchor_joints)].mean(0)
    point, normal = surface
    gap = ((joints + t - point) @ normal - skin_radii())[list(touching)].min()
    # Skin gives way: the touching finger is pressed in by half a millimetre.
    return pose_matrix(R, t - (gap + 0.0005) * normal)


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
        tuple(range(21)),
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


def _laptop(seed: int) -> Clip:
    model = objects.laptop(seed)
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


def _lifted(s: float) -> np.ndarray:
    R = Rotation.from_rotvec(np.radians([28 * s, -22 * s * s, 55 * s * (1 - 0.4 * s)])).as_matrix()
    return pose_matrix(R, np.array([0.11 * s * s, -0.07 * np.sin(np.pi * s), 0.17 * s * (1.5 - 0.5 * s)]))


def _lift(seed: int) -> Clip:
    model = objects.parcel(seed)
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
        tuple(range(21)),
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
    "laptop": _laptop,
    "oven": _oven,
    "lift": _lift,
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
