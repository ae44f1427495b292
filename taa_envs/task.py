"""The task itself, for any number of simulations at once: actions, observations, success, rewards.

:class:`taa_envs.env.ArticulationEnv` runs it on one simulation,
:class:`taa_envs.vector.BatchedArticulationEnv` on many.
Every array has a leading axis of simulations, n.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from taa_envs import randomize
from taa_envs.registry import CONTROL_PERIOD
from taa_envs.reward import DRIVEN_SHARE, GOAL, SUCCESS_PROGRESS, RewardInputs, goal_reward, reward_scales, reward_terms
from taa_envs.rows import MODEL_FIELDS, Rows, hand_rows
from taa_envs.scene import SUBSTEPS, TIMESTEP, Scene, decode_touch, touch_columns

TRANSLATION, ROTATION, CLOSURE = 0.03, 0.3, 0.5  # m, rad, share of the way: residuals of an action of 1
RESIDUALS, ABSOLUTES = 7, 63
HAND_SPEED = 2.0  # m/s, of an absolute target, or 1.5 times the demonstration's fastest where that is faster
PALM = (0, 5, 9, 13, 17)
TIPS = (4, 8, 12, 16, 20)
# How far along its finger each landmark is: closing moves tips all the way, knuckles not at all.
CURL = np.array([0, 0, 1, 2, 3] + [0, 1, 2, 3] * 4) / 3.0
PREVIEW = (0.1, 0.3)  # s ahead
ERROR_SCALE, FORCE_SCALE = 0.02, 10.0  # m, N: units of observations
ACTIONS = ("residual", "absolute")
OBSERVATIONS = ("flat", "dict")
RESET_OPTIONS = ("q0", "phase", "randomize")
# Name -> numbers of the observation's parts, in the flat box's order; the action's own follow.
PARTS = {"joint": 2, "hand": 66, "contact": 5, "reference": 2 + 63 + 4 * len(PREVIEW)}


_MEANS = np.zeros((2, 21))  # of finger tips, of the palm
_MEANS[0, list(TIPS)], _MEANS[1, list(PALM)] = 1 / len(TIPS), 1 / len(PALM)
_STEPS, _AHEAD = np.arange(SUBSTEPS), np.array((0.0, *PREVIEW))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 3); np.cross costs more than a simulation step."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def apply_residual(joints: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Landmarks (..., 21, 3) m, moved, turned about the palm and closed by actions (..., 7); leading axes broadcast."""
    action = np.asarray(action, float)
    means = _MEANS @ joints
    moved = joints + (CLOSURE * action[..., 6, None] * CURL)[..., None] * (means[..., :1, :] - joints)
    rotvec = ROTATION * action[..., 3:6]
    if rotvec.any():
        square = (rotvec * rotvec).sum(-1)[..., None, None]
        angle = np.sqrt(square)
        K = np.zeros((*rotvec.shape, 3))
        x, y, z = rotvec[..., 0], rotvec[..., 1], rotvec[..., 2]
        K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -z, y, -x
        K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = z, -y, x
        # Rodrigues with sin(a)/a and (1 - cos(a))/a^2, so that nothing is divided by zero.
        rotation = np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K)
        # As what is added to the landmarks, so that no turn adds nothing at all.
        moved = moved + (moved - means[..., 1:, :]) @ np.swapaxes(rotation, -1, -2)
    return moved + TRANSLATION * action[..., None, :3]


class Task:
    """Episodes of n simulations.

    Attributes:
        scene: what is simulated.  rows: its states.  n: how many.
        action_size, observation_parts (name -> size), scales (of reward terms).
        q: (n,) the joint, rad or m.
    """

    def __init__(self, scene: Scene, rows: Rows, *, action: str = "residual",
                 reward: str | Mapping[str, float] = "dense") -> None:
        if action not in ACTIONS:
            raise ValueError(f"no action is named {action!r}; known: {', '.join(ACTIONS)}")
        self.scales = reward_scales(reward)
        self.scene, self.rows, self.n, self.asset = scene, rows, rows.n, scene.asset
        self.goal = reward == "sparse_goal"
        self.residual = action == "residual"
        self.action_size = RESIDUALS if self.residual else ABSOLUTES
        self.observation_parts = {**PARTS, "action": self.action_size}
        self._hand = hand_rows(scene, rows)
        self._lead, self._touch = scene.hand.lead, touch_columns(scene)
        reference, demo, model = self.asset.reference, self.asset.demo, scene.model
        self._times, self._reference_q = reference.time, reference.q
        self._joints = reference.hand_joints
        self._stroke = demo["q_demo_end"] - demo["q_start"]
        self._direction = float(np.sign(self._stroke))
        away = np.abs(self._joints - self._joints[0]).max()
        self.reach = float(max(1.25 * away, 0.1))  # m, of an absolute action of 1
        rate = np.linalg.norm(np.diff(self._joints, axis=0), axis=-1) / np.diff(self._times)[:, None]
        self._stride = float(max(HAND_SPEED, 1.5 * rate.max())) * CONTROL_PERIOD  # m an environment step
        joint = model.joint("joint")
        self._ids = (joint.id, model.body("moving").id, scene.dof)
        self.range = tuple(model.jnt_range[joint.id])
        self._before = {name: getattr(model, name).copy() for name in MODEL_FIELDS}
        self._nominal = randomize.nominal(self.asset, model.jnt_axis[joint.id], model.jnt_pos[joint.id])
        self._hinge = self.asset.joint_type == "revolute"
        self._draws = [self._nominal] * self.n
        n, frames = self.n, len(self._times)
        self._axis = np.tile(self._nominal.axis, (n, 1))
        self._point = np.tile(self._nominal.point, (n, 1))
        self._offset, self._start, self._count = np.zeros((n, 3)), np.zeros(n), np.zeros(n, int)
        self._clock, self._first, self._driven = np.zeros(n), np.zeros(n), np.zeros(n)
        self._succeeded, self._diverged = np.zeros(n, bool), np.zeros(n, bool)
        self._action = np.zeros((n, self.action_size), np.float32)
        self._aim = np.zeros((n, 21, 3))
        self._seen, self._hit = np.zeros((n, frames), bool), np.zeros((n, frames), bool)
        self._contact, self._force, self._torque = np.zeros(n, bool), np.zeros((n, 3)), np.zeros(n)

    # The arrays above that an episode changes; with the rows' states they are all there is to a snapshot.
    EPISODE = ("_axis", "_point", "_offset", "_start", "_count", "_clock", "_first", "_driven", "_succeeded",
               "_diverged", "_action", "_aim", "_seen", "_hit", "_contact", "_force", "_torque")

    @property
    def q(self) -> np.ndarray:
        return self.rows.qpos[:, self.scene.qpos].copy()

    def path(self, t: np.ndarray) -> np.ndarray:
        """(..., 21, 3) m: the demonstrated landmarks at times t (...), s of the reference."""
        time = self._times
        i = np.minimum(np.maximum(time.searchsorted(t) - 1, 0), len(time) - 2)
        w = np.minimum(np.maximum((t - time[i]) / (time[i + 1] - time[i]), 0.0), 1.0)[..., None, None]
        return (1 - w) * self._joints[i] + w * self._joints[i + 1]

    def begin(self, row: int, rng: np.random.Generator, options: Mapping[str, Any] | None = None,
              randomized: Any = False) -> dict[str, Any]:
        """Start an episode of one simulation. options: see the environment; randomized: where they do not say.

        Returns:
            what was drawn, see :meth:`taa_envs.randomize.Draw.as_dict`; empty without randomisation.

        Raises:
            ValueError: an option is unknown or out of range; nothing has changed then.
        """
        options = dict(options or {})
        unknown = set(options) - set(RESET_OPTIONS)
        if unknown:
            raise ValueError(f"no reset option is named {', '.join(sorted(unknown))}; known: "
                             + ", ".join(RESET_OPTIONS))
        phase = float(options.get("phase", 0.0))
        if not 0.0 <= phase <= 1.0:
            raise ValueError(f"phase must lie in [0, 1], is {phase}")
        low, high = self.range
        time = float(self._times[0]) + phase * self.asset.demo["duration"]
        q0 = float(np.clip(np.interp(time, self._times, self._reference_q), low, high))
        if options.get("q0") is not None:
            q0 = float(options["q0"])
        if not low <= q0 <= high:
            raise ValueError(f"q0 must lie in the joint's range [{low:.4g}, {high:.4g}] {self.asset.unit}, is {q0:.4g}")
        amounts = randomize.chosen(self.asset, options.get("randomize", randomized))
        made = randomize.draw(rng, amounts, self._nominal.axis, self._nominal.point) if amounts else self._nominal
        self._place(row, made, time, q0)
        return made.as_dict() if amounts else {}

    def _apply(self, row: int, made: randomize.Draw) -> None:
        if made is self._draws[row]:
            return
        randomize.write(self.rows.fields(row), self._before, made, *self._ids)
        self.rows.constants(row)
        self._draws[row] = made
        self._axis[row], self._point[row] = made.axis, made.point

    def _place(self, row: int, made: randomize.Draw, time: float, q0: float) -> None:
        self._apply(row, made)
        ids = np.array([row])
        self._offset[row] = 0.0 if made.hand is None else made.hand
        self._start[row], self._count[row], self._clock[row] = time, 0, 0.0
        self._first[row] = np.clip(float(self.asset.stroke_fraction(q0)), 0.0, 1.0)
        self._driven[row] = 0.0
        for flags in (self._succeeded, self._diverged, self._seen, self._hit, self._contact):
            flags[row] = False
        self._action[row], self._force[row], self._torque[row] = 0.0, 0.0, 0.0
        self._aim[row] = self.path(np.array(time)) + self._offset[row]
        self.rows.clear(ids)
        self.rows.qpos[row, self.scene.qpos] = q0
        self._hand.place(ids, self._aim[ids])
        self.rows.forward(ids)

    def targets(self, action: np.ndarray) -> np.ndarray:
        """(n, SUBSTEPS, 21, 3) m: where the landmarks are to be in the next step's substeps, for actions (n, A)."""
        steps, offset = _STEPS, self._offset[:, None, None, :]
        if self.residual:
            t = self._start[:, None] + (self._count[:, None] + steps) * TIMESTEP + self._lead
            return apply_residual(self.path(t), action[:, None]) + offset
        goal = self._joints[0] + self.reach * action.reshape(self.n, 21, 3) + self._offset[:, None]
        way = goal - self._aim
        length = np.sqrt((way * way).sum(-1, keepdims=True))
        way *= self._stride / np.maximum(length, self._stride)
        return self._aim[:, None] + ((steps + 1) / SUBSTEPS)[:, None, None] * way[:, None]

    def step(self, action: np.ndarray, ids: np.ndarray | None = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """One environment step of all simulations, or of those of ``ids`` (the others' rows of results mean nothing).

        Args:
            action: (n, A), clipped to [-1, 1].

        Returns:
            rewards (n,), and the scaled reward terms (n,) each.
        """
        action = np.minimum(np.maximum(np.asarray(action, np.float32), -1.0), 1.0)
        n, rows, hand, column = self.n, self.rows, self._hand, self.scene.qpos
        targets = self.targets(action.astype(float))
        aims = hand.targets(targets)
        q = np.empty((n, SUBSTEPS + 1))
        touch = np.empty((n, SUBSTEPS, rows.sensordata.shape[1]))
        q[:, 0] = rows.qpos[:, column]
        for k in range(SUBSTEPS):
            hand.control(aims[:, k])
            rows.step(ids)
            q[:, k + 1] = rows.qpos[:, column]
            touch[:, k] = rows.sensordata
        if ids is not None:  # results of others are not to change their episodes
            kept = {name: getattr(self, name).copy() for name in ("_hit", "_seen", *self._STEP)}
        force, torque, position, depth = decode_touch(self._touch, touch)
        contact = (force * force).sum(-1) > 0  # (n, SUBSTEPS)
        load = (force * self._axis[:, None]).sum(-1)
        if self._hinge:
            moment = torque + _cross(position - self._point[:, None], force)
            load = (moment * self._axis[:, None]).sum(-1)
        moved = q[:, 1:] - q[:, :-1]
        driven = np.where((moved * self._direction > 0) & (load * moved > 0), np.abs(moved), 0.0).sum(1)
        driven = driven / abs(self._stroke)
        self._mark(contact)
        self._count = self._count + SUBSTEPS
        clock = rows.time
        # MuJoCo begins anew, its clock at zero, where a state is no longer finite.
        self._diverged = self._diverged | (clock < self._clock + (SUBSTEPS - 0.5) * TIMESTEP)
        self._clock = clock
        self._driven = self._driven + driven
        self._contact, self._force, self._torque = contact.any(1), force.mean(1), load.mean(1)
        self._aim = targets[:, -1].copy()
        success = self.success()
        self._succeeded = self._succeeded | success
        distance = np.zeros(n)
        free = ~self._contact
        if "reach" in self.scales and free.any():
            distance[free] = self._surface_distance(free, q[free, -1])
        terms = reward_terms(RewardInputs(
            driven=driven, moved=(q[:, -1] - q[:, 0]) / self._stroke, contact=self._contact, distance=distance,
            penetration=depth.max(1), action=action, previous_action=self._action, success=success), self.scales)
        self._action = action.copy()
        if ids is not None:
            others = np.ones(n, bool)
            others[ids] = False
            for name, value in kept.items():
                getattr(self, name)[others] = value[others]
        if self.goal:
            return goal_reward(self.achieved(), np.broadcast_to(GOAL, (n, 2))), terms
        return (sum(terms.values()) if terms else np.zeros(n)), terms

    _STEP = ("_count", "_clock", "_driven", "_diverged", "_contact", "_force", "_torque", "_aim", "_succeeded",
             "_action")

    def _mark(self, contact: np.ndarray) -> None:
        """Note which of the reference's frames were played, and in which the hand pushed (n, SUBSTEPS)."""
        t = self._start[:, None] + (self._count[:, None] + _STEPS) * TIMESTEP
        frame = self._times.searchsorted(t + 1e-9, side="right") - 1
        index = frame + np.arange(self.n)[:, None] * len(self._times)
        self._seen.ravel()[index] = True
        self._hit.ravel()[index[contact]] = True

    def _surface_distance(self, rows: np.ndarray, q: np.ndarray) -> np.ndarray:
        """(m,) m, least distance of the finger tips to the corners of the moving link's collision surface."""
        tips = self._hand.landmarks()[rows][:, TIPS]
        axis, point = self._axis[rows][:, None], self._point[rows][:, None]
        if self._hinge:  # into the link's own frame: back by q
            arm, c, s = tips - point, np.cos(q)[:, None, None], np.sin(-q)[:, None, None]
            local = point + arm * c + _cross(axis, arm) * s + axis * ((arm * axis).sum(-1, keepdims=True) * (1 - c))
        else:
            local = tips - axis * q[:, None, None]
        surface = self.scene.surface
        square = ((local * local).sum(-1)[..., None] - 2 * local @ surface.T + (surface * surface).sum(-1))
        return np.sqrt(np.maximum(square.min((1, 2)), 0.0))

    def success(self) -> np.ndarray:
        """(n,) bool: the state is a success now."""
        return ((self.fraction() >= SUCCESS_PROGRESS) & (self._share() >= DRIVEN_SHARE) & ~self._diverged)

    def fraction(self) -> np.ndarray:
        """(n,) fraction of the stroke, not clipped."""
        return np.asarray(self.asset.stroke_fraction(self.rows.qpos[:, self.scene.qpos]))

    def _share(self) -> np.ndarray:
        """(n,) of the progress made in the episode, the share that contact drove; 0 where none was made."""
        made = np.minimum(np.maximum(self.fraction(), 0.0), 1.0) - self._first
        return np.where(made > 1e-9, np.minimum(self._driven / np.maximum(made, 1e-9), 1.0), 0.0)

    def achieved(self) -> np.ndarray:
        """(n, 2) float32 goal reached so far, see :func:`taa_envs.reward.goal_reward`."""
        return np.stack([np.clip(self.fraction(), -10, 10), self._share()], -1).astype(np.float32)

    @property
    def diverged(self) -> np.ndarray:
        return self._diverged.copy()

    def info(self) -> dict[str, np.ndarray]:
        """(n,) each, the contract's names; copies."""
        q, demo = self.q, self.asset.demo
        wanted = self.asset.reference.contact & self._seen
        count = wanted.sum(1)
        return {"joint_progress": self.asset.progress(q),
                "final_q_error": np.abs(q - demo["q_demo_end"]) / (demo["q_max"] - demo["q_min"]),
                "is_success": self._succeeded.copy(), "success_now": self.success(), "contact": self._contact.copy(),
                "contact_fraction": (wanted & self._hit).sum(1) / np.maximum(count, 1), "diverged": self.diverged}

    def observation(self) -> dict[str, np.ndarray]:
        """Name -> (n, size) float32 parts, clipped to [-10, 10]; new arrays."""
        asset, duration = self.asset, self.asset.demo["duration"]
        t = self._start + self._count * TIMESTEP
        here = self._hand.landmarks()
        times = t[:, None] + _AHEAD
        ahead = self.path(times)  # (n, 1 + previews, 21, 3)
        moments = np.interp(times, self._times, self._reference_q)
        stroke = asset.stroke_fraction(moments)
        centres = ahead.mean(2)
        n, size = self.n, self.scene.size
        lever = size if self._hinge else 1.0
        parts = {
            "joint": [self.fraction()[:, None], (self.rows.qvel[:, self.scene.dof] * duration / self._stroke)[:, None]],
            "hand": [((here - self.scene.centre) / size).reshape(n, 63), self._hand.velocity()],
            "contact": [self._contact[:, None], self._force / FORCE_SCALE, self._torque[:, None] / FORCE_SCALE / lever],
            "reference": [np.minimum((t - self._times[0]) / duration, 1.0)[:, None], stroke[:, :1],
                          ((ahead[:, 0] + self._offset[:, None] - here) / ERROR_SCALE).reshape(n, 63), stroke[:, 1:],
                          ((centres[:, 1:] - centres[:, :1]) / size).reshape(n, 3 * len(PREVIEW))],
            "action": [self._action],
        }
        return {name: np.minimum(np.maximum(np.concatenate(values, 1), -10.0), 10.0).astype(np.float32)
                for name, values in parts.items()}

    def reference_action(self) -> np.ndarray:
        """(n, A): the action that follows the demonstrated hand in the next step; zeros for residual actions."""
        if self.residual:
            return np.zeros((self.n, RESIDUALS), np.float32)
        t = self._start + (self._count + SUBSTEPS) * TIMESTEP + self._lead
        return ((self.path(t) - self._joints[0]) / self.reach).reshape(self.n, ABSOLUTES).astype(np.float32)

    def snapshot(self, row: int) -> dict[str, Any]:
        """Full state of one simulation's episode, arrays and numbers; copies."""
        return {"simulation": self.rows.snapshot(row), "draw": self._draws[row].as_dict(),
                "episode": {name: np.array(getattr(self, name)[row]) for name in self.EPISODE}}

    def restore(self, row: int, state: Mapping[str, Any]) -> None:
        """Take a state of :meth:`snapshot`, of this task or of another of the same asset and arguments."""
        drawn = {name: np.array(v) if np.ndim(v) else float(v) for name, v in state["draw"].items()}
        self._apply(row, randomize.Draw(**drawn))
        for name in self.EPISODE:
            getattr(self, name)[row] = state["episode"][name]
        self.rows.restore(row, np.asarray(state["simulation"]))


__all__ = ["Task", "apply_residual"]
