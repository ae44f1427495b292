"""The object that the other examples use: a cupboard door of boxes, with the demonstration of a hand that opens it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import taa_envs.asset


def link(*boxes: tuple[tuple, tuple], colour: tuple[int, int, int]) -> SimpleNamespace:
    """A link of boxes given by two corners each (m); every box is a convex part for collision."""
    meshes = [trimesh.creation.box(bounds=b) for b in boxes]
    whole = trimesh.util.concatenate(meshes)
    colours = np.tile(np.uint8([*colour, 255]), (len(whole.vertices), 1))
    parts = tuple((np.array(m.vertices), np.array(m.faces)) for m in meshes)
    return SimpleNamespace(vertices=np.array(whole.vertices), faces=np.array(whole.faces), colors=colours, parts=parts)


def demonstration() -> dict[str, np.ndarray]:
    """Two seconds in which four fingers behind the door's free edge pull it open by a radian."""
    time = np.arange(0.0, 2.8, 1 / 30)
    s = np.clip((time - 0.4) / 2.0, 0, 1)
    q = s**3 * (10 - 15 * s + 6 * s**2)
    hand = np.zeros((21, 3))
    hand[0] = 0.12, -0.02, 0.0
    hand[1:5] = [(0.08, 0.03, 0.04), (0.05, 0.045, 0.04), (0.03, 0.045, 0.03), (0.01, 0.045, 0.02)]
    for k, z in enumerate((0.03, 0.01, -0.01, -0.03)):
        hand[5 + 4 * k : 9 + 4 * k] = [(x, -0.026, z) for x in (0.06, 0.03, 0.0, -0.025)]
    hand += [0.375, 0.0, 0.3]
    joints = np.stack([Rotation.from_rotvec([0, 0, angle]).apply(hand) for angle in q])
    away = np.clip(1 - time / 0.35, 0, 1)[:, None, None] * np.array([0.12, -0.03, 0.0])
    moving = (q > 0.01) & (q < 0.99)
    return {
        "time": time,
        "q": q,
        "hand_joints": joints + away,
        "hand_valid": np.ones(len(time), bool),
        "contact": moving,
    }


def save_door(root: Path, name: str = "door") -> taa_envs.asset.Asset:
    """Write the asset ``root/name``."""
    return taa_envs.asset.save_asset(
        root,
        name,
        overwrite=True,
        reference=demonstration(),
        joint_origin="given",
        joint={"verdict": "ok", "reason": "made by hand", "type": "revolute", "axis": [0, 0, 1], "point": [0, 0, 0]},
        moving=link(((0.005, -0.018, 0.0), (0.4, 0.0, 0.6)), colour=(176, 124, 78)),
        static=link(
            ((-0.03, -0.3, 0.0), (-0.01, -0.02, 0.6)), ((-0.01, -0.3, 0.0), (0.4, -0.28, 0.6)), colour=(200, 196, 188)
        ),
    )
