"""What a fault of the joint's place is: seen in 3D points on the part, an edit of an MjSpec."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from diagnose.geometry import Geometry
    from diagnose.plant import Plant

Reported = dict[str, dict]


@dataclass(frozen=True)
class PlaceCause:
    """One thing that can be wrong with where a joint is.

    Attributes:
        name: of the contract.  sentence: the geometry.  experiment: what to record to tell it from others.
        edit: (spec, joint, geometry, plant) puts it into the model.
        report: geometry -> parameters as the contract has them.
        hinge_only: not for slides.
    """

    name: str
    sentence: str
    experiment: str
    edit: Callable[[mujoco.MjSpec, str, Geometry, Plant], None]
    report: Callable[[Geometry], Reported]
    hinge_only: bool = False


def body_frame(spec: mujoco.MjSpec, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and place (3,) in the world of the joint's body, as the file draws it."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = int(model.jnt_bodyid[model.joint(joint).id])
    return data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy()


def number(value: float, unit: str, std: float) -> dict:
    return {"value": float(value), "unit": unit, "ci95": [float(value - 1.96 * std), float(value + 1.96 * std)]}


def vector(name: str, value: np.ndarray, unit: str, cov: np.ndarray) -> Reported:
    """Three numbers with intervals from a covariance (3, 3)."""
    return {f"{name}_{c}": number(value[i], unit, float(np.sqrt(max(cov[i, i], 0.0)))) for i, c in enumerate("xyz")}


def length(value: np.ndarray, cov: np.ndarray) -> tuple[float, float]:
    """A two-vector's length and its standard deviation."""
    size = float(np.linalg.norm(value))
    along = value / (size + 1e-300)
    return size, float(np.sqrt(max(along @ cov @ along, 0.0)))
