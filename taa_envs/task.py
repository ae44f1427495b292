"""The task itself, for any number of simulations at once: actions, observations, success, rewards.

:class:`taa_envs.vector.BatchedArticulationEnv` runs it on many simulations, :class:`taa_envs.env.ArticulationEnv` its
twin for one with less Python around it (:mod:`taa_envs.single`). Every array has a leading axis of simulations, n; what
is done to each row is compiled (:mod:`taa_envs.kernels`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from taa_envs import kernels, motion, randomize
from taa_envs.motion import RESIDUALS, Layout, aim_table, apply_residual, residual_translation
from taa_envs.registry import CONTROL_PERIOD
from taa_envs.reward import (
    DRIVEN_SHARE,
    FREE_PENETRATION,
    GOAL,
    REACH_SCALE,
    SUCCESS_PROGRESS,
    TERMS,
    goal_reward,
    reward_scales,
)
from taa_envs.rows import Rows, hand_rows
from taa_envs.scene import Scene, touch_columns

ABSOLUTES = 63
HAND_SPEED = 2.0  # m/s, of an absolute target, or 1.5 times the demonstration's fastest where that is faster
ACTIONS = ("residual", "absolute")
OBSERVATIONS = ("flat", "dict")
RESET_OPTIONS = ("q0", "phase", "randomize")
SURFACE = 128  # points of the link's surface that the finger tips' distance is taken to


class Task:
    """Episodes of n simulations.

    Attributes:
        scene: what is simulated.  rows: its states.  n: how many.
        action_size, observation_parts (name -> size), scales (of reward terms).
        translation: m that a residual action of 1 shifts the hand by.  reach: m of an absolute action of 1.
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
        self._hand = hand_rows(scene, rows)
        self._layout = Layout(self.action_size)
        self.observation_parts = self._layout.parts
        self._scale, self._raw = self._layout.scale(scene), np.zeros((rows.n, self._layout.size))
        self._lead = scene.hand.lead
        reference, demo, model = self.asset.reference, self.asset.demo, scene.model
        self._times, self._joints = reference.time, reference.hand_joints
        self._stroke = demo["q_demo_end"] - demo["q_start"]
        self.translation = residual_translation(self.asset, scene.size)
        away = np.abs(self._joints - self._joints[0]).max()
        self.reach = float(max(1.25 * away, 0.1))
        rate = np.linalg.norm(np.diff(self._joints, axis=0), axis=-1) / np.diff(self._times)[:, None]
        self._stride = float(max(HAND_SPEED, 1.5 * rate.max())) * CONTROL_PERIOD  # m an environment step
        joint = model.joint("joint")
        joints = [joint.id] if scene.advance is None else [joint.id, model.joint("advance").id]
        self._ids = (joints, model.body("moving").id, scene.dof, scene.qpos)
        self.range = tuple(model.jnt_range[joint.id])
        self._fields = randomize.FIELDS
        self._before = {name: getattr(model, name).copy() for name in self._fields + randomize.SPRING_FIELDS}
        self._covariance = randomize.covariance(self.asset)
        self._nominal = randomize.nominal(self.asset, model.jnt_axis[joint.id], model.jnt_pos[joint.id])
        self._draws = [self._nominal] * self.n
        n, frames = self.n, len(self._times)
        self._numbers = numbers = np.zeros((n, kernels.NUMBERS))

        def column(first: int, size: int = 0) -> np.ndarray:
            """View (n,) or (n, size) of what an episode changes."""
            return numbers[:, first:first + size] if size else numbers[:, first]

        self._axis, self._point = column(kernels.AXIS, 3), column(kernels.POINT, 3)
        self._axis[:], self._point[:] = self._nominal.axis, self._nominal.point
        self._time, self._offset = column(kernels.TIME), column(kernels.OFFSET, 3)
        self._action = np.zeros((n, self.action_size), np.float32)
        self._aim = np.zeros((n, len(self._hand.weights), 3))
        self._seen, self._hit = np.zeros((n, frames), bool), np.zeros((n, frames), bool)
        # What no episode changes, and room to work in.
        self._everyone, self._given = np.arange(n), np.zeros_like(self._action)
        self._raised, self._results = np.zeros_like(rows.warnings), np.zeros((n, kernels.RESULTS))
        self._constants = self._described()
        times, driving = np.array(self._times), np.array(reference.contact, bool)
        surface = scene.surface[np.linspace(0, len(scene.surface) - 1, SURFACE).astype(int)]
        # |a - b|^2 = |a|^2 + (a, 1) (-2 b, |b|^2)
        surface = np.concatenate([-2 * surface, (surface * surface).sum(1, keepdims=True)], 1).T.copy()
        link = rows.link_pos, rows.link_mat
        self._aims = (self._given, numbers, rows.qpos, times, aim_table(scene, self._hand.weights), self._constants,
                      self._aim)
        self._reads = (link[0], link[1], rows.warnings, self._raised, times, driving, self._seen, self._hit, surface,
                       self._constants, self._results)
        self._observes = (*link, times, self._layout.shift(scene), self._scale, self._constants, self._raw)

    # The arrays above that an episode changes; with the rows' states they are all there is to a snapshot.
    EPISODE = ("_numbers", "_action", "_aim", "_seen", "_hit")

    def _described(self) -> np.ndarray:
        """(CONSTANTS,) numbers that :mod:`taa_envs.kernels` needs."""
        demo, at, scene = self.asset.demo, self._layout.at, self.scene
        values = {
            kernels.Q_START: demo["q_start"], kernels.Q_END: demo["q_demo_end"],
            kernels.Q_RANGE: demo["q_max"] - demo["q_min"], kernels.TRANSLATION: self.translation,
            kernels.LEAD: self._lead, kernels.Q_COLUMN: scene.qpos, kernels.V_COLUMN: scene.dof,
            kernels.DEPTH_COLUMN: touch_columns(scene)[1], kernels.TURNS: self.asset.joint_type != "prismatic",
            kernels.PITCH: self.asset.pitch,
            kernels.REACH: "reach" in self.scales, kernels.RESIDUAL: self.residual, kernels.O_HAND: at["hand"].start,
            kernels.O_CONTACT: at["contact"].start, kernels.O_ERROR: self._layout.error.start,
            kernels.O_GRIP: at["grip"].start, kernels.O_ACTION: at["action"].start, kernels.PERIOD: CONTROL_PERIOD,
            kernels.ROTATION: motion.ROTATION, kernels.PACE: motion.PACE, kernels.SLEW: motion.SLEW,
            kernels.ENOUGH: SUCCESS_PROGRESS, kernels.DRIVEN_ENOUGH: DRIVEN_SHARE, kernels.REACH_LENGTH: REACH_SCALE,
            kernels.FREE_DEPTH: FREE_PENETRATION}  # fmt: skip
        return np.array([float(values[k]) for k in range(kernels.CONSTANTS)])

    @property
    def q(self) -> np.ndarray:
        return self.rows.qpos[:, self.scene.qpos].copy()

    @property
    def time(self) -> np.ndarray:
        """(n,) s, the reference's clock."""
        return self._time.copy()

    def landmarks(self) -> np.ndarray:
        """(n, 21, 3) m, where the hand's landmarks are; a copy."""
        return self._hand.landmarks().copy()

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
        q0 = float(np.clip(np.interp(time, self._times, self.asset.reference.q), low, high))
        if options.get("q0") is not None:
            q0 = float(options["q0"])
        if not low <= q0 <= high:
            raise ValueError(f"q0 must lie in the joint's range [{low:.4g}, {high:.4g}] {self.asset.unit}, is {q0:.4g}")
        amounts = randomize.chosen(self.asset, options.get("randomize", randomized))
        made = self._nominal
        if amounts:
            made = randomize.draw(rng, amounts, made.axis, made.point, self._covariance)
        self._place(row, made, time, q0)
        return made.as_dict() if amounts else {}

    def _apply(self, row: int, made: randomize.Draw) -> None:
        if made is self._draws[row]:
            return
        if made.springs:  # from then on: what one episode drew the next one takes back
            self._fields = randomize.FIELDS + randomize.SPRING_FIELDS
        randomize.write(self.rows.fields(row, self._fields), self._before, made, *self._ids)
        self.rows.constants(row)
        self._draws[row] = made
        self._axis[row], self._point[row] = made.axis, made.point

    def _place(self, row: int, made: randomize.Draw, time: float, q0: float) -> None:
        self._apply(row, made)
        ids = np.array([row])
        numbers = self._numbers[row]
        numbers[:kernels.AXIS] = numbers[kernels.PUSH:] = 0.0
        self._offset[row] = 0.0 if made.hand is None else made.hand
        numbers[kernels.TIME] = time
        numbers[kernels.FIRST] = np.clip(float(self.asset.stroke_fraction(q0)), 0.0, 1.0)
        for values in (self._seen, self._hit, self._action):
            values[row] = 0
        joints = self.path(np.array(time)) + self._offset[row]
        self._aim[row] = self._hand.targets(joints)
        self.rows.clear(ids)
        self.scene.put(self.rows.qpos[row], q0)
        self.scene.put_further(self.rows.qpos[row], time)
        self._hand.place(ids, joints[None])
        self.rows.forward(ids)
        self._look(ids)

    def _look(self, ids: np.ndarray) -> None:
        """Results of episodes that have just begun, or were put in place."""
        self._raised[ids] = self.rows.warnings[ids]
        kernels.status(ids, self.rows.qpos, self._numbers, self._constants, self._results)

    def step(self, action: np.ndarray, ids: np.ndarray | None = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """One environment step of all simulations, or of those of ``ids`` (the others' rows of results mean nothing).

        Args:
            action: (n, A), clipped to [-1, 1].

        Returns:
            rewards (n,), and the scaled reward terms (n,) each.
        """
        self._given[:] = action
        self._advance(ids)
        terms = {name: scale * self._results[:, kernels.TERMS + TERMS.index(name)]
                 for name, scale in self.scales.items()}
        if self.goal:
            return goal_reward(self.achieved(), np.broadcast_to(GOAL, (self.n, 2))), terms
        return (sum(terms.values()) if terms else np.zeros(self.n)), terms

    def _advance(self, ids: np.ndarray | None) -> None:
        """One environment step of the actions in ``_given``."""
        rows, hand, some = self.rows, self._hand, self._everyone if ids is None else ids
        kernels.aims(some, *self._aims)
        if not self.residual:
            aim = self._absolute(self._given.astype(float))
            self._aim[some] = aim[some]
        hand.advance(self._aim, ids)
        kernels.read(some, self._given, self._action, self._numbers, rows.qpos, rows.time, rows.touches,
                     rows.sensordata, hand.landmarks(), *self._reads)

    def _absolute(self, action: np.ndarray) -> np.ndarray:
        """(n, S, 3) m where the hand's targets are to be after a step of absolute actions (n, A)."""
        goal = self._joints[0] + self.reach * action.reshape(self.n, 21, 3) + self._offset[:, None]
        way = goal - self._aim[:, :21]
        length = np.sqrt((way * way).sum(-1, keepdims=True))
        way *= self._stride / np.maximum(length, self._stride)
        return self._hand.targets(self._aim[:, :21] + way)

    def success(self) -> np.ndarray:
        """(n,) bool: the state is a success now."""
        return self._results[:, kernels.SUCCESS_NOW] > 0

    def achieved(self) -> np.ndarray:
        """(n, 2) float32 goal reached so far, see :func:`taa_envs.reward.goal_reward`."""
        fraction, share = self._results[:, kernels.FRACTION], self._results[:, kernels.SHARE]
        return np.stack([np.clip(fraction, -10, 10), share], -1).astype(np.float32)

    @property
    def diverged(self) -> np.ndarray:
        return self._results[:, kernels.HAS_DIVERGED] > 0

    def info(self) -> dict[str, np.ndarray]:
        """(n,) each, the contract's names; copies."""
        out = self._results
        return {"joint_progress": out[:, kernels.PROGRESS].copy(), "final_q_error": out[:, kernels.ERROR].copy(),
                "is_success": out[:, kernels.IS_SUCCESS] > 0, "success_now": self.success(),
                "contact": out[:, kernels.CONTACT] > 0, "contact_fraction": out[:, kernels.CONTACT_FRACTION].copy(),
                "diverged": self.diverged, "warnings": out[:, kernels.WARNED].astype(int)}

    def observation(self) -> np.ndarray:
        """(n, size) float32, flat, clipped to [-10, 10]; a new array. See :class:`taa_envs.motion.Layout`."""
        rows, hand = self.rows, self._hand
        out = np.empty((self.n, self._layout.size), np.float32)
        kernels.observe(self._numbers, self._action, rows.qpos, rows.qvel, hand.landmarks(), hand.velocity(),
                        *self._observes, out)
        return out

    def parts_of(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        """Name -> (n, size) copies of a flat observation's parts."""
        return {name: flat[:, columns].copy() for name, columns in self._layout.at.items()}

    def reference_action(self) -> np.ndarray:
        """(n, A): the action that follows the demonstrated hand in the next step; zeros for residual actions."""
        if self.residual:
            return np.zeros((self.n, RESIDUALS), np.float32)
        t = self._time + CONTROL_PERIOD + self._lead
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
        self._hand.aimed[row] = self._aim[row]
        self._look(np.array([row]))


__all__ = ["Task", "apply_residual"]
