"""The benchmark's objects: joints of MuJoCo models, with surfaces that rays can be cast at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np

from reconstruct.joint.models import joint_transform

FURNITURE = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "objects" / "furniture_sim"
VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
"""Groups 0 to 2 are what a viewer shows; the furniture's collision shapes are in group 4."""

OPENED = {"dishwasher/top_rack": {"door": -1.5}}
"""What has to be out of the way: states of other joints, where they are not those of the model."""


@dataclass(frozen=True)
class Model:
    """One joint of one MuJoCo model; all other joints rest at their initial state.

    Attributes:
        name: "laptop", "oven/knob1_joint".  source: "procedural" or "furniture_sim".
        spec: MJCF text or the path of an MJCF file.  joint: name of the joint.
    """

    name: str
    source: str
    spec: str
    joint: str

    @cached_property
    def mj(self) -> mujoco.MjModel:
        if self.source == "procedural":
            return mujoco.MjModel.from_xml_string(self.spec)
        return mujoco.MjModel.from_xml_path(self.spec)

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self.mj)

    @cached_property
    def _id(self) -> int:
        return mujoco.mj_name2id(self.mj, mujoco.mjtObj.mjOBJ_JOINT, self.joint)

    @property
    def kind(self) -> str:
        return "revolute" if int(self.mj.jnt_type[self._id]) == int(mujoco.mjtJoint.mjJNT_HINGE) else "prismatic"

    @property
    def limits(self) -> tuple[float, float]:
        """Range of the joint, rad or m."""
        low, high = self.mj.jnt_range[self._id]
        return float(low), float(high)

    @cached_property
    def axis_and_point(self) -> tuple[np.ndarray, np.ndarray]:
        """(3,) unit axis and (3,) a point on it, world; the axis is that of the model's initial state."""
        self.pose(0.0)
        return self._data.xaxis[self._id].copy(), self._data.xanchor[self._id].copy()

    @cached_property
    def moving_geoms(self) -> np.ndarray:
        """(ngeom,) bool, what the joint moves."""
        bodies = np.zeros(self.mj.nbody, bool)
        bodies[self.mj.jnt_bodyid[self._id]] = True
        for b in range(1, self.mj.nbody):
            bodies[b] |= bodies[self.mj.body_parentid[b]]
        return bodies[self.mj.geom_bodyid]

    def pose(self, q: float) -> None:
        """Put the joint to q and all others to their initial state."""
        self._data.qpos[:] = self.mj.qpos0
        for joint, state in OPENED.get(self.name, {}).items():
            self._data.qpos[self.mj.joint(joint).qposadr[0]] = state
        self._data.qpos[self.mj.jnt_qposadr[self._id]] = q
        mujoco.mj_kinematics(self.mj, self._data)

    def link_pose(self, q: np.ndarray | float, origin: float = 0.0) -> np.ndarray:
        """(..., 4, 4) the moving link at q relative to where it is at ``origin``, world."""
        axis, point = self.axis_and_point
        return joint_transform(self.kind, axis, point, np.asarray(q) - origin)

    def cast(self, q: float, start: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays against the model at state q.

        Args:
            start: (3,).  directions: (n, 3) unit.

        Returns:
            (n,) distance, inf where nothing is met, and (n,) geom, -1 there.
        """
        self.pose(q)
        n = len(directions)
        geom, distance = np.full(n, -1, np.int32), np.zeros(n)
        mujoco.mj_multiRay(self.mj, self._data, np.asarray(start, float), np.ascontiguousarray(directions).ravel(),
                           VISIBLE_GROUPS, True, -1, geom, distance, None, n, mujoco.mjMAXVAL)  # fmt: skip
        return np.where(geom >= 0, distance, np.inf), geom

    def corners(self, q: float, moving: bool) -> np.ndarray:
        """(m, 3) corners of the boxes around the visible geoms of one link, world."""
        self.pose(q)
        shown = (self.mj.geom_group <= 2) & (self.moving_geoms == moving)
        shown &= self.mj.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)
        signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
        out = []
        for g in np.flatnonzero(shown):
            centre, half = self.mj.geom_aabb[g, :3], self.mj.geom_aabb[g, 3:]
            R = self._data.geom_xmat[g].reshape(3, 3)
            out.append(self._data.geom_xpos[g] + (centre + signs * half) @ R.T)
        return np.concatenate(out) if out else np.zeros((0, 3))


@dataclass(frozen=True)
class Box:
    """centre and size, m."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]

    def mjcf(self) -> str:
        half = " ".join(f"{s / 2:.6g}" for s in self.size)
        return f'<geom type="box" pos="{" ".join(f"{c:.6g}" for c in self.centre)}" size="{half}"/>'


def _mjcf(kind: str, axis: str, point: str, limits: str, static: list[Box], moving: list[Box]) -> str:
    what = "hinge" if kind == "revolute" else "slide"
    return f"""<mujoco><compiler angle="radian"/><worldbody>
    <body name="static">{"".join(b.mjcf() for b in static)}
      <body name="moving">
        <joint name="joint" type="{what}" axis="{axis}" pos="{point}" limited="true" range="{limits}"/>
        {"".join(b.mjcf() for b in moving)}
      </body></body></worldbody></mujoco>"""


def _shell(width: float, depth: float, height: float, wall: float) -> list[Box]:
    """A cabinet, open at low y, its lower front left corner at the origin."""
    w, d, h, t = width, depth, height, wall
    return [
        Box((t / 2, d / 2, h / 2), (t, d, h)), Box((w - t / 2, d / 2, h / 2), (t, d, h)),
        Box((w / 2, d / 2, t / 2), (w, d, t)), Box((w / 2, d / 2, h - t / 2), (w, d, t)),
        Box((w / 2, d - t / 2, h / 2), (w, t, h)), Box((w / 2, d / 2, h / 2), (w - 2 * t, d * 0.8, t)),
    ]  # fmt: skip


def procedural() -> list[Model]:
    """Ten objects after the list of the paper's dataset, written down here as boxes at the sizes of such things."""
    made = {
        # The seat folds up against the back.
        "foldchair": ("revolute", "1 0 0", "0 0 0.42", "0 1.4", [
            Box((0.2, 0.02, 0.4), (0.03, 0.03, 0.8)), Box((-0.2, 0.02, 0.4), (0.03, 0.03, 0.8)),
            Box((0, 0.02, 0.7), (0.4, 0.02, 0.16)), Box((0, 0.02, 0.12), (0.4, 0.02, 0.03))], [
            Box((0, -0.19, 0.42), (0.36, 0.36, 0.025)), Box((0, -0.36, 0.40), (0.36, 0.02, 0.03))]),
        "fridge": ("revolute", "0 0 1", "0 0 0.4", "-1.9 0", _shell(0.45, 0.44, 0.80, 0.025), [
            Box((0.225, -0.025, 0.4), (0.45, 0.045, 0.79)), Box((0.42, -0.06, 0.45), (0.015, 0.025, 0.2)),
            Box((0.225, 0.02, 0.3), (0.36, 0.05, 0.03))]),
        "laptop": ("revolute", "1 0 0", "0 0.12 0.012", "0 2.2", [
            Box((0, 0, 0.006), (0.33, 0.24, 0.012)), Box((0, -0.07, 0.013), (0.1, 0.07, 0.002)),
            Box((0, 0.03, 0.014), (0.28, 0.1, 0.004))], [
            Box((0, 0, 0.018), (0.33, 0.235, 0.008)), Box((0, -0.118, 0.023), (0.04, 0.004, 0.004))]),
        "oven": ("revolute", "1 0 0", "0.28 0 0.08", "0 1.5", [
            *_shell(0.56, 0.5, 0.5, 0.03), Box((0.28, -0.015, 0.46), (0.56, 0.03, 0.08)),
            Box((0.1, -0.035, 0.46), (0.03, 0.02, 0.03)), Box((0.46, -0.035, 0.46), (0.03, 0.02, 0.03))], [
            Box((0.28, -0.02, 0.245), (0.54, 0.035, 0.33)), Box((0.28, -0.055, 0.38), (0.44, 0.02, 0.02))]),
        "scissors": ("revolute", "0 0 1", "0 0 0", "-0.9 0", [
            Box((0.045, 0.006, 0), (0.1, 0.012, 0.003)), Box((-0.05, -0.012, 0), (0.09, 0.01, 0.004)),
            Box((-0.09, -0.022, 0), (0.03, 0.02, 0.006))], [
            Box((0.045, -0.006, 0.004), (0.1, 0.012, 0.003)), Box((-0.05, 0.012, 0.004), (0.09, 0.01, 0.004)),
            Box((-0.09, 0.022, 0.004), (0.03, 0.02, 0.006))]),
        "stapler": ("revolute", "0 -1 0", "-0.065 0 0.03", "0 1.6", [
            Box((0, 0, 0.005), (0.15, 0.04, 0.01)), Box((-0.06, 0, 0.02), (0.025, 0.036, 0.03))], [
            Box((0.005, 0, 0.04), (0.145, 0.03, 0.02)), Box((0.01, 0, 0.026), (0.12, 0.014, 0.008))]),
        # A swivel cap about the stick.
        "usb": ("revolute", "0 0 1", "-0.02 0 0", "0 3.1", [
            Box((0, 0, 0), (0.04, 0.016, 0.007)), Box((0.027, 0, 0), (0.014, 0.012, 0.004))], [
            Box((0.005, 0, 0.005), (0.058, 0.019, 0.0015)), Box((0.005, 0, -0.005), (0.058, 0.019, 0.0015)),
            Box((-0.026, 0, 0), (0.003, 0.019, 0.010))]),
        "washer": ("revolute", "0 0 1", "0.13 -0.01 0.42", "-2.0 0", [
            Box((0.3, 0.28, 0.42), (0.6, 0.54, 0.84)), Box((0.3, 0.005, 0.76), (0.58, 0.02, 0.12)),
            Box((0.1, -0.015, 0.77), (0.06, 0.02, 0.05)), Box((0.3, 0.01, 0.12), (0.58, 0.01, 0.16))], [
            Box((0.3, -0.02, 0.42), (0.34, 0.03, 0.24)), Box((0.3, -0.02, 0.42), (0.24, 0.032, 0.34)),
            Box((0.3, 0.0, 0.42), (0.2, 0.02, 0.2)), Box((0.445, -0.045, 0.42), (0.02, 0.02, 0.08))]),
        "blade": ("prismatic", "1 0 0", "0 0 0", "0 0.07", [
            Box((-0.02, 0, 0.006), (0.13, 0.024, 0.006)), Box((-0.02, 0.010, 0.001), (0.13, 0.004, 0.006)),
            Box((-0.02, -0.010, 0.001), (0.13, 0.004, 0.006))], [
            Box((-0.005, 0, 0), (0.11, 0.014, 0.001)), Box((-0.02, 0, 0.012), (0.02, 0.008, 0.006))]),
        "storage": ("prismatic", "0 -1 0", "0 0 0", "0 0.26", [
            *_shell(0.4, 0.36, 0.42, 0.016), Box((0.2, 0.0, 0.315), (0.38, 0.014, 0.19))], [
            Box((0.2, -0.004, 0.11), (0.37, 0.016, 0.18)), Box((0.2, -0.025, 0.12), (0.12, 0.02, 0.015)),
            Box((0.2, 0.15, 0.03), (0.35, 0.30, 0.008)), Box((0.03, 0.15, 0.09), (0.008, 0.30, 0.12)),
            Box((0.37, 0.15, 0.09), (0.008, 0.30, 0.12))]),
    }  # fmt: skip
    return [Model(name, "procedural", _mjcf(*parts), "joint") for name, parts in made.items()]


def furniture() -> list[Model]:
    """Every hinge and slide of furniture_sim; empty where the data are not there."""
    out = []
    for file in sorted(FURNITURE.glob("*.xml")):
        mj = mujoco.MjModel.from_xml_path(str(file))
        for j in range(mj.njnt):
            if int(mj.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
                joint = mujoco.mj_id2name(mj, mujoco.mjtObj.mjOBJ_JOINT, j)
                out.append(Model(f"{file.stem}/{joint.replace(' ', '_')}", "furniture_sim", str(file), joint))
    return out


def all_models() -> list[Model]:
    return procedural() + furniture()
