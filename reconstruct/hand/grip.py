"""How the hand holds the link: small corrections of its pose that let finger tips push.

All in the link's frame, where a hand that drives the link is still. A grip puts finger tips (or the thumb) on faces of
the link that look against the motion, pressed in by a few millimetres because position actuators push only with the
distance that they are behind; the thumb takes the other side where it reaches. Among all grips the one nearest to what
was seen comes first: cheap along the viewing ray, where a single view is blind, dear across it, and with the palm in
the camera's sight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.hand.shape import LinkShape, drive_direction, lever
from reconstruct.hand.skeleton import FINGERS, reach
from reconstruct.joint.models import JointFit

PRESS = 0.004  # m by which pushing tips are aimed below the surface
RAY_STD, ACROSS_STD = 0.05, 0.025  # m, what the image says about the hand along and across the viewing ray
TURN_STD = np.deg2rad(25.0)
TIPS = (4, 8, 12, 16, 20)
TOUCH = 0.001  # m of overlap from which on a sphere pushes
HALF_HAND = 0.1  # m: a turn by an angle moves a hand's ends by so much a radian
AGAINST = -0.55  # cosine between a pushed face's normal and the motion
FINGER_REACH = 0.035  # m by which a finger may be bent onto the surface
OCCLUDED = 9.0  # cost of each palm landmark that the link would hide from the camera
PALM = (0, 2, 5, 9, 13, 17)
COVER = 0.004  # m of a part between a landmark and the camera that hide it
SURE = 0.008  # m
IDLE = 2.0  # cost of each tip of the group that does not push
SLIP = 2.0  # cost of each direction in which all of the push would be lost
GROUPS = ((8, 12, 16), (8, 12), (8, 12, 16, 20), (4,), (4, 8, 12))
"""Finger tips that push together."""


@dataclass(frozen=True)
class Sighting:
    """How well it is known where the hand was: standard deviations along and across the viewing ray, m, and of its
    turn, rad. The defaults are one picture's."""

    ray: float = RAY_STD
    across: float = ACROSS_STD
    turn: float = float(TURN_STD)

    @classmethod
    def measured(cls, std: float) -> Sighting:
        """Of a hand measured in space to std, m, a coordinate."""
        return cls(std, std, std / HALF_HAND)

    def off(self, grip: Grip, ray: np.ndarray) -> float:
        """By how many standard deviations a grip is off where the hand was seen; ray (3,) unit."""
        along = float(grip.shift @ ray)
        aside = float(np.linalg.norm(grip.shift - along * ray))
        return float(np.sqrt((along / self.ray) ** 2 + (aside / self.across) ** 2 + (grip.turn / self.turn) ** 2
                             + (grip.bend / self.across) ** 2))  # fmt: skip


@dataclass(frozen=True)
class Grip:
    """A pose of the hand (21, 3) m in the link's frame that can drive the link.

    Attributes:
        kind: "push" or "pinch" (thumb on the other side).
        shift: (3,) m and turn: rad, how the hand was moved from where it was seen.
        pushing: number of contact spheres on faces that look against the motion.
        hidden: number of palm landmarks that the link would hide from the camera.
        cost: smaller is nearer to the evidence.
        bend: m, the farthest that bending a finger moved its tip.
    """

    pose: np.ndarray
    kind: str
    shift: np.ndarray
    turn: float
    pushing: int
    hidden: int
    cost: float
    bend: float = 0.0


def _spheres() -> tuple[np.ndarray, np.ndarray]:
    from taa_envs.hands.points import TIPS, PointsHand, sphere_weights

    weights, hand = sphere_weights(), PointsHand()
    radius = np.full(len(weights), hand.radius)
    radius[list(TIPS)] = hand.tip_radius
    return weights, radius


SPHERES, RADII = _spheres()


def penetration(shape: LinkShape, pose: np.ndarray) -> np.ndarray:
    """(..., S) m by which the hand's spheres overlap the link, 0 where they do not."""
    return np.maximum(RADII - shape.distance(SPHERES @ pose)[0], 0.0)


def _turns(std: float) -> list[Rotation]:
    out = [Rotation.identity()]
    for angle in (std, 2 * std):
        for axis in np.vstack([np.eye(3), -np.eye(3)]):
            out.append(Rotation.from_rotvec(angle * axis))
    return out


def pushing_spheres(shape: LinkShape, fit: JointFit, sign: float, pose: np.ndarray) -> np.ndarray:
    """(S,) bool, spheres that overlap a face that looks against the motion."""
    x = SPHERES @ pose
    distance, normal = shape.distance(x)
    against = np.einsum("...i,...i->...", normal, drive_direction(fit, x, sign)) < AGAINST
    return against & (distance < RADII - TOUCH)


def _slips(shape: LinkShape, fit: JointFit, sign: float, pose: np.ndarray, pushing: int) -> float:
    """Share of the push that is lost by a shift of :data:`SURE`, summed over four directions across the motion: at an
    edge a hand whose place is known to a centimetre is as likely beside the link as on it, and would not stay on it."""
    forward = drive_direction(fit, pose[list(TIPS)].mean(0), sign)
    across = np.linalg.svd(forward[None])[2][1:]
    left = [pushing_spheres(shape, fit, sign, pose + s * SURE * u).sum() for u in across for s in (-1, 1)]
    return sum(1.0 - min(1.0, float(n) / max(pushing, 1)) for n in left)


def _overlap_cost(deep: np.ndarray, tips: tuple[int, ...]) -> np.ndarray:
    """Penetration beyond the press, over the spheres; (..., S) -> (...)."""
    allowed = np.full(deep.shape[-1], 0.002)
    allowed[list(tips)] = PRESS + 0.004
    return (np.minimum(np.maximum(deep - allowed, 0.0) / 0.004, 5.0) ** 2).sum(-1)


def hidden(shape: LinkShape, poses: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """(...,) how many palm landmarks lie behind the link: hands were seen, so hardly any can."""
    return (shape.thickness(poses[..., list(PALM), :], -ray) > COVER).sum(-1)


def _bend(shape: LinkShape, pose: np.ndarray, tips: tuple[int, ...], points: np.ndarray, normals: np.ndarray
          ) -> np.ndarray:
    """Bend the fingers of these tips so that the tips press on the given points (n, 3) of the surface."""
    out = pose.copy()
    aims = points + normals * (RADII[tips[0]] - PRESS)
    for tip in tips:
        gap = np.linalg.norm(aims - out[tip], axis=1)
        k = int(gap.argmin())
        if gap[k] > FINGER_REACH:
            continue
        # Onto the face straight below the tip, not onto the nearest sample.
        height = (out[tip] - points[k]) @ normals[k]
        target = out[tip] - normals[k] * (height - RADII[tip] + PRESS)
        if shape.distance(target)[0] > RADII[tip] or np.linalg.norm(target - aims[k]) > 0.02:
            target = aims[k]
        finger = list(next(f for f in FINGERS if tip in f))
        out[finger] = reach(out[finger], target)
    return out


def _around(shape: LinkShape, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Surface points (n, 3) m and normals next to the seen finger tips, denser than the shape's own samples: a handle
    is a few of those."""
    steps = np.arange(-0.02, 0.021, 0.005)
    grid = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    x = (seen[list(TIPS), None] + grid).reshape(-1, 3)
    height, normal = shape.distance(x)
    x = x - height[:, None] * normal
    on = np.abs(shape.distance(x)[0]) < 1e-5
    free = shape.distance(x + 1e-3 * normal)[0] > 5e-4
    cells = np.unique(np.round(x / 0.004).astype(int), axis=0, return_index=True)[1]
    keep = np.zeros(len(x), bool)
    keep[cells] = True
    keep &= on & free
    return x[keep], normal[keep]


def find_grips(shape: LinkShape, fit: JointFit, sign: float, seen: np.ndarray, ray: np.ndarray, limit: int = 4,
               sighting: Sighting | None = None) -> list[Grip]:  # fmt: skip
    """Grips that can drive the link, nearest to the evidence first.

    Args:
        shape: the link.
        fit: the joint, metric.
        sign: +1 where the link is driven towards larger q, -1 otherwise.
        seen: (21, 3) m, where the hand was seen, link frame.
        ray: (3,) unit viewing direction there, link frame.
        limit: at most this many, clearly different ones.
        sighting: how well ``seen`` is known; default one picture's.
    """
    std = sighting or Sighting()
    near_points, near_normals = _around(shape, seen)
    surface, normals = np.concatenate([shape.points, near_points]), np.concatenate([shape.normals, near_normals])
    facing = np.einsum("ij,ij->i", normals, drive_direction(fit, surface, sign))
    arm = lever(fit, surface)
    useful = arm > 0.3 * arm.max()
    push, other = np.flatnonzero((facing < AGAINST) & useful), np.flatnonzero((facing > -AGAINST) & useful)
    if not len(push):
        return []
    turns = _turns(std.turn)
    found: list[tuple[float, Grip]] = []
    for g, tips in enumerate(GROUPS):
        anchor = seen[list(tips)].mean(0)
        # Brought to a face, or left where it was seen with only the fingers bent onto one.
        aims = np.vstack([surface[push] + normals[push] * (RADII[tips[0]] - PRESS), anchor])
        d = aims - anchor
        along = d @ ray
        across = np.linalg.norm(d - along[:, None] * ray, axis=1)
        prior = (along / std.ray) ** 2 + (across / std.across) ** 2
        # All places with the hand as it was seen, then the promising ones turned as well.
        poses = (seen - anchor)[None] + aims[:, None]
        rough = prior + _overlap_cost(penetration(shape, poses), tips) + OCCLUDED * hidden(shape, poses, ray)
        near = np.unique(np.concatenate([np.argsort(rough)[:60], np.argsort(prior)[:40], [len(aims) - 1]]))
        best: list[tuple[float, int, int]] = []
        for k, turn in enumerate(turns):
            turned = turn.apply(seen - anchor)
            poses = turned[None] + aims[near][:, None]
            deep = penetration(shape, poses)
            x = poses[:, list(tips)]
            # Tips that float far off the surface cannot all be bent onto it.
            off = np.maximum(shape.distance(x)[0] - 0.02, 0).sum(1) / 0.02
            cost = prior[near] + (turn.magnitude() / std.turn) ** 2 + _overlap_cost(deep, tips) + off
            cost = cost + OCCLUDED * hidden(shape, poses, ray)
            best += [(float(cost[j]), int(near[j]), k) for j in np.argsort(cost)[:4]]
        for _, j, k in sorted(best)[:10]:
            turn = turns[k]
            pose = turn.apply(seen - anchor) + aims[j]
            bent = _bend(shape, pose, tips, surface[push], normals[push])
            kind = "push"
            if 4 not in tips and len(other):
                pinched = _bend(shape, bent, (4,), surface[other], normals[other])
                extra = _overlap_cost(penetration(shape, pinched), (*tips, 4)) - _overlap_cost(
                    penetration(shape, bent), (*tips, 4))
                if not np.allclose(pinched[4], bent[4]) and extra < 1.0:
                    bent, kind = pinched, "pinch"
            pushes = pushing_spheres(shape, fit, sign, bent)
            pushing = int(pushes.sum())
            wrong = _overlap_cost(penetration(shape, bent), (*tips, 4) if kind == "pinch" else tips)
            cost = prior[j] + (turn.magnitude() / std.turn) ** 2 + wrong + 4.0 * max(0, 3 - pushing) + 0.3 * g
            cost += SLIP * _slips(shape, fit, sign, bent, pushing) + IDLE * int((~pushes[list(tips)]).sum())
            bend = float(np.linalg.norm(bent[list(tips)] - pose[list(tips)], axis=1).max())
            cost += (bend / std.across) ** 2
            behind = int(hidden(shape, bent, ray))
            cost += OCCLUDED * behind
            if pushing:
                shift, angle = aims[j] - anchor, float(turn.magnitude())
                found.append((float(cost), Grip(bent, kind, shift, angle, pushing, behind, float(cost), bend)))
    found.sort(key=lambda item: item[0])
    out: list[Grip] = []
    for _, grip in found:
        if all(np.abs(grip.pose - kept.pose).max() > 0.02 for kept in out):
            out.append(grip)
        if len(out) == limit:
            break
    return out
