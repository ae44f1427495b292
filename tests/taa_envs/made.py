"""Procedural assets: a door pulled by its handle, the same door pushed from behind, a drawer, two of them, a screw."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

WOOD, STEEL, WALL = (176, 124, 78), (90, 96, 105), (214, 210, 200)


def box(lo: tuple, hi: tuple, colour: tuple) -> tuple[trimesh.Trimesh, np.ndarray]:
    mesh = trimesh.creation.box(bounds=[lo, hi])
    return mesh, np.tile([*colour, 255], (len(mesh.vertices), 1)).astype(np.uint8)


def link(*boxes: tuple[trimesh.Trimesh, np.ndarray]) -> SimpleNamespace:
    """What the geometry stage hands over, from boxes that are each a convex part."""
    mesh = trimesh.util.concatenate([b[0] for b in boxes])
    return SimpleNamespace(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces),
                           colors=np.concatenate([b[1] for b in boxes]),
                           parts=tuple((np.array(b[0].vertices), np.array(b[0].faces)) for b in boxes))


def hooked_hand() -> np.ndarray:
    """(21, 3) m: four fingers along -x in the plane y = 0, the thumb in front of them (y > 0), wrist at x = 0.16."""
    hand = np.zeros((21, 3))
    hand[0] = 0.16, 0.0, 0.0
    hand[1:5] = [(0.12, 0.03, 0.04), (0.08, 0.05, 0.04), (0.05, 0.055, 0.03), (0.02, 0.055, 0.02)]
    for i, z in enumerate((0.03, 0.01, -0.01, -0.03)):
        hand[5 + 4 * i:9 + 4 * i] = [(x, 0.0, z) for x in (0.08, 0.04, 0.015, -0.01)]
    return hand


def min_jerk(s: np.ndarray) -> np.ndarray:
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def demonstration_arrays(joint: dict, grip: np.ndarray, approach: np.ndarray, q_end: float, fps: float = 30.0,
                         noise: float = 0.0, seed: int = 0) -> dict:
    """0.6 s approach from grip + approach, 2 s stroke to q_end riding on the link, 0.3 s still."""
    time = np.arange(0, 2.9, 1 / fps)
    q = q_end * min_jerk((time - 0.6) / 2.0)
    hand = np.empty((len(time), 21, 3))
    axis = np.array(joint["axis"], float)
    for i, (t, angle) in enumerate(zip(time, q, strict=True)):
        points = grip + approach * (1 - min_jerk(t / 0.55))
        if joint["type"] != "prismatic":
            hand[i] = Rotation.from_rotvec(angle * axis).apply(points - joint["point"]) + joint["point"]
            hand[i] += angle * (joint["pitch"] or 0.0) * axis
        else:
            hand[i] = points + angle * axis
    if noise:
        rng = np.random.default_rng(seed)
        hand += rng.normal(0, noise, (len(time), 1, 3)) + rng.normal(0, noise, (1, 21, 3))
    moving = (q > 0.01 * q_end) & (q < 0.99 * q_end)
    return {"time": time, "q": q, "hand_joints": hand, "hand_valid": np.ones(len(time), bool), "contact": moving}


def camera_of(eye: tuple, target: tuple, focal: float = 500.0, width: int = 640, height: int = 480) -> dict:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ np.array(eye, float)
    return {"K": [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]], "T_camera_world": T,
            "width": width, "height": height}


def door_arguments(push: bool = False, noise: float = 0.0, seed: int = 0, q_end: float = 1.05) -> dict:
    """A door with its hinge along z at the origin; it opens towards +y."""
    joint = {"verdict": "ok", "reason": "made", "type": "revolute", "axis": [0.0, 0.0, 1.0], "point": [0.0, -0.01, 0.3],
             "pitch": None, "std": {"axis_deg": 1.0, "point_m": 0.002, "q": None}, "scale_source": "given"}
    moving = link(box((0.005, -0.02, 0.0), (0.4, 0.0, 0.6), WOOD),
                  box((0.3425, 0.034, 0.2), (0.3575, 0.049, 0.4), STEEL),
                  box((0.3425, -0.001, 0.2), (0.3575, 0.035, 0.215), STEEL),
                  box((0.3425, -0.001, 0.385), (0.3575, 0.035, 0.4), STEEL))
    static = link(box((-0.06, -0.04, 0.0), (-0.013, 0.02, 0.6), WALL), box((0.405, -0.04, 0.0), (0.45, 0.0, 0.6), WALL))
    grip = hooked_hand()
    if push:
        grip = grip * [1, -1, 1] + [0.3, -0.02 - 0.007 + 0.006, 0.3]
        approach = np.array([0.0, -0.1, 0.0])
    else:
        grip = grip + [0.335, 0.032, 0.3]
        approach = np.array([0.15, -0.01, 0.0])
    return {"joint": joint, "moving": moving, "static": static, "camera": camera_of((0.9, 1.3, 0.9), (0.2, 0, 0.3)),
            "reference": demonstration_arrays(joint, grip, approach, q_end, noise=noise, seed=seed),
            "source": {"sha256": "0" * 64}, "providers": [{"name": "made", "version": "1", "licence": "Apache-2.0"}]}


def drawer_arguments(noise: float = 0.0, seed: int = 0) -> dict:
    """A drawer that comes out along -y, pulled by a vertical bar."""
    joint = {"verdict": "ok", "reason": "made", "type": "prismatic", "axis": [0.0, -1.0, 0.0], "point": None,
             "pitch": None, "std": {"axis_deg": 1.0, "point_m": None, "q": None}, "scale_source": "given"}
    moving = link(box((-0.2, 0.0, 0.1), (0.2, 0.02, 0.3), WOOD), box((-0.18, 0.02, 0.11), (0.18, 0.35, 0.12), WOOD),
                  box((-0.0075, -0.05, 0.13), (0.0075, -0.035, 0.27), STEEL),
                  box((-0.0075, -0.036, 0.13), (0.0075, 0.001, 0.145), STEEL),
                  box((-0.0075, -0.036, 0.255), (0.0075, 0.001, 0.27), STEEL))
    static = link(box((-0.22, 0.03, 0.0), (0.22, 0.4, 0.09), WALL), box((-0.22, 0.03, 0.31), (0.22, 0.4, 0.33), WALL))
    grip = hooked_hand() @ np.diag([-1.0, -1.0, 1.0]) + [0.015, -0.031, 0.2]
    return {"joint": joint, "moving": moving, "static": static,
            "reference": demonstration_arrays(joint, grip, np.array([-0.15, 0.01, 0.0]), 0.25, noise=noise, seed=seed)}


def chest_arguments() -> dict:
    """The drawer with a second one above it, which the demonstration has opened before it touches the first."""
    from taa_envs.mechanism import FurtherLink

    made = drawer_arguments()
    static = link(box((-0.22, 0.03, 0.0), (0.22, 0.4, 0.09), WALL), box((-0.22, 0.03, 0.31), (0.22, 0.4, 0.33), WALL),
                  box((-0.22, 0.03, 0.56), (0.22, 0.4, 0.58), WALL))  # fmt: skip
    moving = link(box((-0.2, 0.0, 0.35), (0.2, 0.02, 0.55), WOOD), box((-0.18, 0.02, 0.36), (0.18, 0.35, 0.37), WOOD))
    time = made["reference"]["time"]
    joint = {**made["joint"], "axis": [0.0, -1.0, 0.0]}
    return {**made, "static": static, "further": [FurtherLink(joint, moving, 0.1 * min_jerk(time / 0.5))]}


def valve_arguments(pitch: float = 0.01) -> dict:
    """A valve's cross handle on a vertical thread: two rad of turning raise it by two pitches."""
    joint = {"verdict": "ok", "reason": "made", "type": "screw", "axis": [0.0, 0.0, 1.0], "point": [0.0, 0.0, 0.3],
             "pitch": pitch, "std": {"axis_deg": 1.0, "point_m": 0.002, "pitch": 0.001, "q": None},
             "scale_source": "given"}  # fmt: skip
    moving = link(box((-0.15, -0.01, 0.3), (0.15, 0.01, 0.32), STEEL),
                  box((0.13, -0.01, 0.32), (0.15, 0.01, 0.38), WOOD))
    static = link(box((-0.05, -0.05, 0.0), (0.05, 0.05, 0.28), WALL))
    grip = hooked_hand() @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T
    grip = grip - grip[8] + [0.14, -0.017, 0.35]
    return {"joint": joint, "moving": moving, "static": static,
            "reference": demonstration_arrays(joint, grip, np.array([0.0, -0.15, 0.0]), 2.0)}


def terms(**changed: object) -> dict[str, float]:
    """Reward terms before their scales, of a step in which nothing happens but for what is changed."""
    from taa_envs.kernels import raw_terms
    from taa_envs.reward import FREE_PENETRATION, REACH_SCALE, TERMS

    step = {"driven": 0.0, "moved": 0.0, "contact": False, "distance": 0.05, "penetration": 0.0, "action": np.zeros(7),
            "previous_action": np.zeros(7), "success": False}
    out = np.empty(len(TERMS))
    raw_terms(*{**step, **changed}.values(), REACH_SCALE, FREE_PENETRATION, out)
    return dict(zip(TERMS, out.tolist(), strict=True))
