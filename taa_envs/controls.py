"""The hand motions of a replay's negative controls: replays that must not succeed.

- *no_hand*: the same time without a hand. Finds objects that move by themselves.
- *mirrored_hand*: the driven stroke reflected in the fixed plane in which the link lies when the demonstration starts:
  through the axis and the link's centre of mass (revolute; through the hand instead of the centre of mass where that
  lies on the axis), or square to the axis through the centre of mass (prismatic). Reflection turns the demonstrated
  motion about: the hand pushes as hard, on the link's other side and the wrong way. Finds joints that answer to a
  hand's presence rather than to its push.
- *late_hand*: the hand motion delayed by the replay's own length, so that the hand waits where the video began while
  the demonstrated motion would take place. Finds joints that move by the clock, and first poses whose overlap of hand
  and link alone pushes. (A delay that ended with the hand at the link would measure how hard a waiting hand leans on
  it, which on a stroke of millimetres is no small part.)

Only the stroke is reflected. The way to the grip and back is free of contact as it was demonstrated, against the link
as it then lay, and its reflection is not: a hand that comes down onto a closed lid comes up through it in the mirror
and lifts it honestly, by a contact that decides between nothing and a large part of the stroke with a millimetre. The
mirrored hand comes along the joint's own motion instead, backwards: turning about the axis (or sliding along it)
against the demonstrated direction from where it is clear of the link, straight on into the mirrored stroke. A hand
that moves so at every instant can only push the joint back, whatever the link's shape is and wherever it meets it.
"""

from __future__ import annotations

import numpy as np

from taa_envs.asset import Asset
from taa_envs.scene import Scene
from taa_envs.simulation import HandPath, Simulation

CONTROLS = ("no_hand", "mirrored_hand", "late_hand")
HOLD = 0.2  # s for which the hand stays at its last pose: time for what it pushes to catch up
APPROACH = 0.6  # s in which a mirrored hand comes to the link
ANGLES = np.deg2rad(np.arange(15.0, 181.0, 15.0))  # rad from which it comes to a hinge, the first that is clear
SLIDES = np.arange(0.2, 1.7, 0.2)  # of the object's size from which it comes to a slide


def mirror_plane(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Point (3,) m and unit normal (3,) of the plane in which the mirrored control reflects the hand."""
    import mujoco

    asset = scene.asset
    data = mujoco.MjData(scene.model)
    scene.put(data.qpos, asset.demo["q_start"])
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_comPos(scene.model, data)
    centre = data.xipos[scene.model.body("moving").id].copy()
    axis = np.array(asset.joint["axis"], float)
    axis /= np.linalg.norm(axis)
    if asset.joint_type == "prismatic":
        return centre, axis
    point = np.array(asset.joint["point"], float)

    def from_axis(x: np.ndarray) -> np.ndarray:
        return (x - point) - ((x - point) @ axis) * axis

    arm = from_axis(centre)
    if np.linalg.norm(arm) < 0.05 * scene.size:  # a knob: its centre of mass names no side
        reference = asset.reference
        first = int(np.argmax(reference.contact)) if reference.contact.any() else 0
        arm = from_axis(reference.hand_joints[first].mean(0))
    normal = np.cross(axis, arm)
    length = np.linalg.norm(normal)
    if length < 1e-9:
        normal, length = np.linalg.svd(axis[None])[2][1], 1.0
    return point, normal / length


def carried(asset: Asset, x: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Points x (T, N, 3) or (N, 3) m as they ride on the joint when it moves by (T,) rad or m: (T, N, 3)."""
    from scipy.spatial.transform import Rotation

    axis, by = np.array(asset.joint["axis"], float), np.asarray(by, float)
    axis /= np.linalg.norm(axis)
    x = np.broadcast_to(x, (len(by), *x.shape[-2:]))
    if asset.joint_type == "prismatic":
        return x + by[:, None, None] * axis
    point = np.array(asset.joint["point"], float)
    turned = np.einsum("tij,tnj->tni", Rotation.from_rotvec(by[:, None] * axis).as_matrix(), x - point) + point
    return turned + asset.pitch * by[:, None, None] * axis


def _start(scene: Scene, grip: np.ndarray) -> float:
    """rad or m, in the demonstrated direction, by which a hand in this grip (21, 3) must be moved on to be clear of the
    link at rest: the least that is looked at, and one more for clearance. The largest where none is clear (a knob)."""
    asset = scene.asset
    away = SLIDES * scene.size if asset.joint_type == "prismatic" else ANGLES
    sign = 1.0 if asset.demo["q_demo_end"] > asset.demo["q_start"] else -1.0
    sim = Simulation(scene)
    blocked = True
    for by in sign * away:
        sim.reset(asset.demo["q_start"], carried(asset, grip, np.array([by]))[0])
        before, blocked = blocked, bool(sim.data.ncon)
        if not before and not blocked:
            break
    return float(by)


def mirrored_path(scene: Scene) -> HandPath:
    """The hand of the mirrored control, see the module's text.

    The stroke is from the first frame to the last in which the reference says that the hand drives the link; between
    two driven stretches the hand goes straight from one grip to the other, in the frame of a link that moves the other
    way. Where the hand drives the link from the video's very beginning the stroke begins :data:`APPROACH` later.
    A reference without a driven frame has no stroke: its hand is reflected as it is.
    """
    asset, reference = scene.asset, scene.asset.reference
    point, normal = mirror_plane(scene)
    away = (reference.hand_joints - point) @ normal
    mirrored = reference.hand_joints - 2 * away[..., None] * normal
    end = asset.demo["demo_end_frame"]
    driven = np.flatnonzero(reference.contact[:end + 1])
    if not len(driven) or scene.hand is None:
        return HandPath(reference.time, mirrored)
    travelled = reference.q - asset.demo["q_start"]
    at_rest = carried(asset, mirrored, travelled)  # on the link that moves the other way, brought back to its start
    frames = np.arange(len(at_rest))
    grips = np.stack([np.interp(frames, driven, column) for column in at_rest[driven].reshape(len(driven), -1).T], 1)
    first = int(driven[0])
    # Before the stroke the joint is where it starts; what its state says there beyond that is noise.
    travelled = np.where(frames < first, travelled[first], travelled)
    stroke = carried(asset, grips.reshape(at_rest.shape), -travelled)
    far, clock = _start(scene, stroke[first]), float(reference.time[first])
    delay = max(0.0, APPROACH - (clock - float(reference.time[0])))
    s = np.linspace(0.0, 1.0, 61)[:-1]
    approach = carried(asset, stroke[first], far * (1 - s) ** 2 * (1 + 2 * s))
    return HandPath(np.concatenate([clock - APPROACH * (1 - s), reference.time[first:]]) + delay,
                    np.concatenate([approach, stroke[first:]]))


def control_path(scene: Scene, name: str) -> HandPath | None:
    """The hand of a control ("no_hand", "mirrored_hand", "late_hand"), see the module's text; None for no hand."""
    asset, reference = scene.asset, scene.asset.reference
    if name == "no_hand":
        return None
    if name == "mirrored_hand":
        return mirrored_path(scene)
    if name == "late_hand":
        return HandPath(reference.time + asset.end_time + HOLD - reference.time[0], reference.hand_joints)
    raise ValueError(f"no control is named {name!r}; known: {', '.join(CONTROLS)}")


__all__ = ["CONTROLS", "HOLD", "carried", "control_path", "mirror_plane", "mirrored_path"]
