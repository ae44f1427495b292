"""A clip before it is rendered: an object, a hand that touches it somewhere, and a camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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
