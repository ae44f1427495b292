"""Where an axis is likely to point before a camera that is held level: a prior, made from how mechanisms are mounted
and how people film them.

A small motion is seen nearly as from afar, and from there a joint and its mirror image in depth look the same. Of a
vertical axis that is looked down on, the mirror image is one that is looked up to. Hinges are vertical or horizontal,
most of them; people hold cameras level, and look down on what they film.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from reconstruct.joint.world import TYPICAL_PITCH

PITCH_STD, ROLL_STD = np.radians(20.0), np.radians(8.0)
"""Standard deviations of how far down a camera looks about the typical pitch, and of how it is tilted to a side."""
MOUNTED = np.radians(3.0)
"""How far from vertical or horizontal such axes are, standard deviation."""
ANY = 0.2
"""Share of axes that go anywhere: the camera lies on its side, or the object."""
VERTICAL = 0.5
"""Share of the others that are vertical."""


@cache
def _ups() -> tuple[np.ndarray, np.ndarray]:
    """(K, 3) unit, directions that may be up in the camera frame, and (K,) their probabilities."""
    stds = np.linspace(-2.5, 2.5, 31)
    pitch, roll = TYPICAL_PITCH + PITCH_STD * stds[:, None], ROLL_STD * stds[None, ::2]
    weight = np.exp(-(stds[:, None] ** 2 + stds[None, ::2] ** 2) / 2).ravel()
    up = np.stack(np.broadcast_arrays(np.sin(roll), -np.cos(roll) * np.cos(pitch), -np.cos(roll) * np.sin(pitch)), -1)
    return up.reshape(-1, 3), weight / weight.sum()


def log_prior(axis: np.ndarray) -> float:
    """Logarithm of how many times more likely an axis is than if all directions were alike.

    Args:
        axis: (3,) unit, camera frame (right, down, forward); its sign does not matter.
    """
    up, weight = _ups()
    along = np.abs(up @ axis)
    sharp = MOUNTED**-2
    vertical = float(weight @ np.exp(sharp * (along - 1))) * sharp
    horizontal = float(weight @ np.exp(-sharp * along**2 / 2)) * np.sqrt(2 * sharp / np.pi)
    return float(np.log(ANY + (1 - ANY) * (VERTICAL * vertical + (1 - VERTICAL) * horizontal)))
