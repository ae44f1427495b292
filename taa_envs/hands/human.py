"""A human hand of average anatomy: 26 degrees of freedom, capsules for flesh.

Six of the base, four of each finger (spread and flexion at the knuckle, flexion at the two joints after it; the thumb's
saddle joint has two axes, its other joints one each). Lengths are those of a mean adult hand, wrist to middle finger
tip 0.18 m; ranges of motion are the textbook ones of an adult (American Academy of Orthopaedic Surgeons, Joint Motion:
Method of Measuring and Recording, 1965).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from taa_envs.hands.rig import JointedHand, Skeleton

if TYPE_CHECKING:
    import mujoco

# A right hand's frame: the wrist at 0, y along the middle metacarpal, x to the thumb's side, z out of the palm; m.
KNUCKLES = {"index": (0.023, 0.085, 0.0), "middle": (0.0, 0.087, 0.0), "ring": (-0.020, 0.080, 0.0),
            "little": (-0.038, 0.068, 0.0)}
PHALANGES = {"index": (0.040, 0.024, 0.021), "middle": (0.045, 0.028, 0.022), "ring": (0.041, 0.026, 0.022),
             "little": (0.032, 0.020, 0.019)}
THUMB_BASE, THUMB = (0.020, 0.024, 0.010), (0.041, 0.032, 0.026)
RADII = {"thumb": (0.011, 0.010, 0.009), "index": (0.009, 0.008, 0.0075), "middle": (0.009, 0.008, 0.0075),
         "ring": (0.009, 0.008, 0.007), "little": (0.008, 0.007, 0.0065)}
PALM_RADIUS = 0.010
SPREAD, KNUCKLE, MIDDLE, LAST = (-0.35, 0.35), (-0.5, 1.57), (0.0, 1.75), (-0.1, 1.4)
THUMB_OUT, THUMB_FLEX, THUMB_KNUCKLE, THUMB_LAST = (-0.4, 1.1), (-0.5, 0.9), (-0.2, 0.95), (-0.25, 1.4)
MASS = 0.45  # kg, the hand
STIFFNESS = {"knuckle": 4.0, "middle": 2.5, "last": 1.5}  # N m/rad
TORQUE = {"knuckle": 1.6, "middle": 1.0, "last": 0.6}  # N m: 12 N at a straight finger's tip
SKIN = [0.88, 0.68, 0.56, 1.0]


def _capsule(body: mujoco.MjsBody, a: tuple, b: tuple, radius: float, mass: float) -> None:
    import mujoco

    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*a, *b], size=[radius, 0, 0], mass=mass, condim=4,
                  friction=[1.0, 0.005, 0.0001], priority=1, solref=[0.02, 1.0],
                  solimp=[0.9, 0.95, 0.002, 0.5, 2.0], rgba=SKIN)


def _joint(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, axis: np.ndarray, bounds: tuple, kind: str) -> None:
    import mujoco

    stiffness = STIFFNESS[kind]
    inertia = 2e-4  # reflected: keeps light phalanges from ringing
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, range=list(bounds), limited=1,
                   armature=inertia, damping=[0.02, 0, 0])
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=stiffness, kv=2 * float(np.sqrt(stiffness * inertia)))
    actuator.forcerange, actuator.forcelimited = [-TORQUE[kind], TORQUE[kind]], 1
    actuator.ctrlrange, actuator.ctrllimited = list(bounds), 1


def build_spec(side: str) -> mujoco.MjSpec:
    """The hand alone as an uncompiled ``mujoco.MjSpec``; a left hand is the right one mirrored in x."""
    import mujoco

    mirror = 1.0 if side == "right" else -1.0

    def at(p: tuple) -> tuple:
        return (mirror * p[0], p[1], p[2])

    spec = mujoco.MjSpec()
    spec.modelname = f"human_{side}"
    spec.compiler.degree = False
    palm = spec.worldbody.add_body(name="palm")
    ends = [at(p) for p in (*KNUCKLES.values(), THUMB_BASE)]
    for end in ends:
        _capsule(palm, (0, 0, 0), end, PALM_RADIUS, 0.5 * MASS / len(ends))
    for a, b in zip(ends[:3], ends[1:4], strict=True):
        _capsule(palm, a, b, PALM_RADIUS, 0.0)
    flex = np.array([1.0, 0, 0])  # a positive turn about x brings y towards z, out of the palm
    part = 0.5 * MASS / 15
    for finger, start in KNUCKLES.items():
        lengths, radii = PHALANGES[finger], RADII[finger]
        body = palm.add_body(name=f"{finger}_1", pos=at(start))
        _joint(spec, body, f"{finger}_spread", np.array([0, 0, mirror]), SPREAD, "knuckle")
        _joint(spec, body, f"{finger}_flex", flex, KNUCKLE, "knuckle")
        for k, length in enumerate(lengths):
            _capsule(body, (0, 0, 0), (0, length, 0), radii[k], part)
            if k < 2:
                body = body.add_body(name=f"{finger}_{k + 2}", pos=[0, length, 0])
                _joint(spec, body, f"{finger}_{('middle', 'last')[k]}", flex, (MIDDLE, LAST)[k], ("middle", "last")[k])
    # The thumb points to its side and forwards; it flexes across the palm.
    way = np.array([mirror * 0.62, 0.70, 0.35])
    way /= np.linalg.norm(way)
    across = np.cross(way, [0.0, 0.0, 1.0]) * mirror
    across /= np.linalg.norm(across)
    turn = np.stack([across * mirror, way, np.cross(across * mirror, way)], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, turn.ravel())
    body = palm.add_body(name="thumb_1", pos=at(THUMB_BASE), quat=quat)
    _joint(spec, body, "thumb_out", np.array([1.0, 0, 0]), THUMB_OUT, "knuckle")
    _joint(spec, body, "thumb_flex", np.array([0, 0, mirror]), THUMB_FLEX, "knuckle")
    for k, length in enumerate(THUMB):
        _capsule(body, (0, 0, 0), (0, length, 0), RADII["thumb"][k], part)
        if k < 2:
            body = body.add_body(name=f"thumb_{k + 2}", pos=[0, length, 0])
            bounds, kind = ((THUMB_KNUCKLE, "middle"), (THUMB_LAST, "last"))[k]
            _joint(spec, body, f"thumb_{kind}", np.array([0, 0, mirror]), bounds, kind)
    return spec


def human(side: str = "right") -> JointedHand:
    """The hand ``human``."""
    lengths = {**{f: p[2] for f, p in PHALANGES.items()}, "thumb": THUMB[2]}
    fingers = ("thumb", *KNUCKLES)
    skeleton = Skeleton(root="palm", side=side, palm="palm", knuckles={f: f"{f}_1" for f in fingers},
                        chain={f: (f"{f}_2", f"{f}_3") for f in fingers},
                        tips={f: (f"{f}_3", (0.0, lengths[f], 0.0)) for f in fingers})
    return JointedHand("human", lambda: build_spec(side), skeleton)
