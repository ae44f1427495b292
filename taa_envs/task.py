"""The task itself, for any number of simulations at once: actions, observations, success, rewards.

:class:`taa_envs.vector.BatchedArticulationEnv` runs it on many simulations, :class:`taa_envs.env.ArticulationEnv` its
faster twin for one (:mod:`taa_envs.single`). Every array has a leading axis of simulations, n.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from taa_envs import randomize
from taa_envs.motion import (
    CORRECTIONS,
    PACE,
    RESIDUALS,
    SLEW,
    TIPS,
    Layout,
    Motion,
    apply_residual,
    residual_translation,
)
from taa_envs.registry import CONTROL_PERIOD
from taa_envs.reward import DRIVEN_SHARE, GOAL, SUCCESS_PROGRESS, RewardInputs, goal_reward, reward_scales, reward_terms
from taa_envs.rows import BAD, MODEL_FIELDS, Rows, hand_rows
from taa_envs.scene import SUBSTEPS, TIMESTEP, Scene, touch_columns

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
        self._motion = Motion(scene, self._hand.weights, self._layout)
        self._scale, self._raw = self._layout.scale(scene), np.zeros((rows.n, self._layout.size))
        self._lead, self._depth = scene.hand.lead, touch_columns(scene)[1]
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
        self._ids = (joints, model.body("moving").id, scene.dof)
        self.range = tuple(model.jnt_range[joint.id])
        self._before = {name: getattr(model, name).copy() for name in MODEL_FIELDS}
        self._nominal = randomize.nominal(self.asset, model.jnt_axis[joint.id], model.jnt_pos[joint.id])
        self._hinge, self._pitch = self.asset.joint_type != "prismatic", self.asset.pitch
        self._draws = [self._nominal] * self.n
        surface = scene.surface[np.linspace(0, len(scene.surface) - 1, SURFACE).astype(int)]
        # |a - b|^2 = |a|^2 + (a, 1) (-2 b, |b|^2): one product for all pairs
        self._surface = np.concatenate([-2 * surface, (surface * surface).sum(1, keepdims=True)], 1).T
        n, frames = self.n, len(self._times)
        self._axis = np.tile(self._nominal.axis, (n, 1))
        self._point = np.tile(self._nominal.point, (n, 1))
        self._offset, self._time, self._clock = np.zeros((n, 3)), np.zeros(n), np.zeros(n)
        self._first, self._driven = np.zeros(n), np.zeros(n)
        self._succeeded, self._diverged = np.zeros(n, bool), np.zeros(n, bool)
        self._warned, self._raised = np.zeros(n, int), 0  # MuJoCo's warnings: in the last step, and since the start
        self._action = np.zeros((n, self.action_size), np.float32)
        self._correction = np.zeros((n, CORRECTIONS))
        self._aim = np.zeros((n, self._motion.count, 3))
        self._seen, self._hit = np.zeros((n, frames), bool), np.zeros((n, frames), bool)
        self._push = np.zeros((n, 5))  # of the hand on the link: whether, force (N), moment about the joint

    # The arrays above that an episode changes; with the rows' states they are all there is to a snapshot.
    EPISODE = ("_axis", "_point", "_offset", "_time", "_clock", "_first", "_driven", "_succeeded", "_diverged",
               "_action", "_correction", "_aim", "_seen", "_hit", "_push")
    # Of those, what a step changes.
    _STEP = EPISODE[3:5] + EPISODE[6:]

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
        self._time[row], self._clock[row], self._warned[row], self._raised = time, 0.0, 0, 0
        self._first[row] = np.clip(float(self.asset.stroke_fraction(q0)), 0.0, 1.0)
        for values in (self._driven, self._succeeded, self._diverged, self._seen, self._hit, self._push,
                       self._action, self._correction):
            values[row] = 0
        joints = self.path(np.array(time)) + self._offset[row]
        self._aim[row] = self._hand.targets(joints)
        self.rows.clear(ids)
        self.scene.put(self.rows.qpos[row], q0)
        self.scene.put_further(self.rows.qpos[row], time)
        self._hand.place(ids, joints[None])
        self.rows.forward(ids)

    def step(self, action: np.ndarray, ids: np.ndarray | None = None) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """One environment step of all simulations, or of those of ``ids`` (the others' rows of results mean nothing).

        Args:
            action: (n, A), clipped to [-1, 1].

        Returns:
            rewards (n,), and the scaled reward terms (n,) each.
        """
        action = np.minimum(np.maximum(np.asarray(action, np.float32), -1.0), 1.0)
        n, rows, column = self.n, self.rows, self.scene.qpos
        if ids is not None:  # results of others are not to change their episodes
            kept = {name: getattr(self, name).copy() for name in self._STEP}
        before, q, warned = self._time, rows.qpos[:, column].copy(), rows.warnings
        aim = self._targets(action.astype(float))
        self._hand.advance(self._aim, aim, ids)
        self._aim = aim
        warned = np.maximum(rows.warnings - warned, 0)
        self._warned = warned.sum(1)
        moved = (rows.qpos[:, column] - q) / self._stroke
        self._push = self._touch()
        contact, load = self._push[:, 0] > 0, self._push[:, 4]
        driven = np.where((moved > 0) & (load * self._stroke > 0), moved, 0.0)
        self._mark(before, contact)
        clock = rows.time
        # MuJoCo begins anew, its clock at zero, where a state is no longer finite, and warns.
        self._diverged = (self._diverged | warned[:, BAD].any(1)
                          | (clock < self._clock + (SUBSTEPS - 0.5) * TIMESTEP))
        self._clock = clock
        self._driven = self._driven + driven
        success = self.success()
        self._succeeded = self._succeeded | success
        distance = np.zeros(n)
        free = ~contact
        if "reach" in self.scales and free.any():
            distance[free] = self._surface_distance(self._tips()[free])
        depth = np.maximum(-rows.sensordata[:, self._depth], 0.0)
        terms = reward_terms(RewardInputs(
            driven=driven, moved=moved, contact=contact, distance=distance, penetration=depth, action=action,
            previous_action=self._action, success=success), self.scales)
        self._action = action.copy()
        if ids is not None:
            others = np.ones(n, bool)
            others[ids] = False
            for name, value in kept.items():
                getattr(self, name)[others] = value[others]
        if self.goal:
            return goal_reward(self.achieved(), np.broadcast_to(GOAL, (n, 2))), terms
        return (sum(terms.values()) if terms else np.zeros(n)), terms

    def _targets(self, action: np.ndarray) -> np.ndarray:
        """(n, S, 3) m where the hand's targets are to be after a step of actions (n, A); sets clock and correction."""
        if self.residual:
            way = action[:, :CORRECTIONS] - self._correction
            self._correction = self._correction + np.minimum(np.maximum(way, -SLEW), SLEW)
            self._time = np.maximum(self._time + CONTROL_PERIOD * (1 + PACE * action[:, CORRECTIONS]), self._times[0])
            return self._motion.many(self._time + self._lead, self._correction, self.translation, self._offset)
        self._time = self._time + CONTROL_PERIOD
        goal = self._joints[0] + self.reach * action.reshape(self.n, 21, 3) + self._offset[:, None]
        way = goal - self._aim[:, :21]
        length = np.sqrt((way * way).sum(-1, keepdims=True))
        way *= self._stride / np.maximum(length, self._stride)
        return self._hand.targets(self._aim[:, :21] + way)

    def _touch(self) -> np.ndarray:
        """(n, 5): whether the hand pushed on the link in the substeps just made, its mean force and that one's moment
        about the joint (along it, for a slide)."""
        touches = self.rows.touches
        total = touches.sum(1)
        # MuJoCo gives the wrench from the link on the hand, about the contact's place.
        force, torque = -total[:, 1:4] / SUBSTEPS, -total[:, 4:7] / SUBSTEPS
        if self._hinge:
            g = -(touches[:, :, 1:4].transpose(0, 2, 1) @ touches[:, :, 7:10]) / SUBSTEPS  # force x place, summed
            p = self._point
            torque += np.stack([g[:, 2, 1] - g[:, 1, 2] - p[:, 1] * force[:, 2] + p[:, 2] * force[:, 1],
                                g[:, 0, 2] - g[:, 2, 0] - p[:, 2] * force[:, 0] + p[:, 0] * force[:, 2],
                                g[:, 1, 0] - g[:, 0, 1] - p[:, 0] * force[:, 1] + p[:, 1] * force[:, 0]], -1)
        load = ((torque if self._hinge else force) * self._axis).sum(-1)
        if self._pitch:  # a screw's link does work along its advance too
            load += self._pitch * (force * self._axis).sum(-1)
        return np.concatenate([(force * force).sum(-1, keepdims=True) > 0, force, load[:, None]], 1)

    def _mark(self, before: np.ndarray, contact: np.ndarray) -> None:
        """Note which of the reference's frames were played since its clock said so (n,), and in which the hand pushed
        (n,)."""
        begin, end = np.minimum(before, self._time), np.maximum(before, self._time)
        first = self._times.searchsorted(begin + 1e-9, side="right") - 1
        last = self._times.searchsorted(end - 1e-9, side="right") - 1
        frames = np.arange(len(self._times))
        played = (frames >= first[:, None]) & (frames <= np.maximum(last, first)[:, None])
        self._seen = self._seen | played
        self._hit = self._hit | (played & contact[:, None])

    def _tips(self) -> np.ndarray:
        """(n, 5, 3) m, the finger tips in the moving link's frame (of the last substep's beginning)."""
        here = self._hand.landmarks()[:, TIPS]
        return (here - self.rows.link_pos[:, None]) @ self.rows.link_mat

    def _surface_distance(self, tips: np.ndarray) -> np.ndarray:
        """(m,) m, least distance of finger tips (m, 5, 3) to points of the moving link's surface, in its frame."""
        square = (tips * tips).sum(-1)[..., None] + tips @ self._surface[:3] + self._surface[3]
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
                "is_success": self._succeeded.copy(), "success_now": self.success(), "contact": self._push[:, 0] > 0,
                "contact_fraction": (wanted & self._hit).sum(1) / np.maximum(count, 1), "diverged": self.diverged,
                "warnings": self._warned.copy()}

    def observation(self) -> np.ndarray:
        """(n, size) float32, flat, clipped to [-10, 10]; a new array. See :class:`taa_envs.motion.Layout`."""
        raw, layout, here = self._raw, self._layout, self._hand.landmarks()
        hand, contact = layout.at["hand"].start, layout.at["contact"].start
        raw[:, 0] = raw[:, 2] = self.fraction()
        raw[:, 1] = self.rows.qvel[:, self.scene.dof]
        raw[:, hand:hand + 63] = here.reshape(self.n, 63)
        raw[:, hand + 63:hand + 66] = self._hand.velocity()
        raw[:, contact:contact + 5] = self._push
        raw[:, layout.error] = (here - self._offset[:, None]).reshape(self.n, 63)
        raw[:, layout.at["grip"]] = self._tips().reshape(self.n, 15)
        start = layout.at["action"].start
        raw[:, start:] = self._action
        if self.residual:
            raw[:, start:start + CORRECTIONS] = self._correction
        out = raw * self._scale + self._motion.shown.many(self._time)
        return np.minimum(np.maximum(out, -10.0), 10.0).astype(np.float32)

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


__all__ = ["Task", "apply_residual"]
