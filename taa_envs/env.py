"""The Gymnasium environment ``TAA/<id>``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle

from taa_envs.asset import Asset
from taa_envs.refined import with_reference
from taa_envs.registry import CONTROL_PERIOD, get_asset
from taa_envs.reward import DRIVEN_SHARE, GOAL, SUCCESS_PROGRESS, goal_reward
from taa_envs.rows import SingleRows
from taa_envs.scene import build_scene
from taa_envs.single import SingleTask
from taa_envs.task import OBSERVATIONS, Task, apply_residual


def spaces_of(task: Task, observation: str) -> tuple[spaces.Space, spaces.Box]:
    """Observation and action space of a task.

    Raises:
        ValueError: unknown kind of observation.
    """
    if observation not in OBSERVATIONS:
        raise ValueError(f"no observation is named {observation!r}; known: {', '.join(OBSERVATIONS)}")
    if task.goal and observation == "dict":
        raise ValueError("reward='sparse_goal' observes {observation, achieved_goal, desired_goal}; "
                         "leave observation='flat'")

    def box(size: int) -> spaces.Box:
        return spaces.Box(-10.0, 10.0, (size,), np.float32)

    flat: spaces.Space = box(sum(task.observation_parts.values()))
    if task.goal:
        flat = spaces.Dict({"observation": flat, "achieved_goal": box(2), "desired_goal": box(2)})
    elif observation == "dict":
        flat = spaces.Dict({name: box(size) for name, size in task.observation_parts.items()})
    return flat, spaces.Box(-1.0, 1.0, (task.action_size,), np.float32)


def observe(task: Task, observation: str, flat: np.ndarray | None = None) -> np.ndarray | dict[str, np.ndarray]:
    """(n, ...) observations in the form of :func:`spaces_of`; new arrays. flat: of :meth:`Task.observation`."""
    if flat is None:
        flat = task.observation()
    if observation == "dict":
        return task.parts_of(flat)
    if not task.goal:
        return flat
    return {"observation": flat, "achieved_goal": task.achieved(),
            "desired_goal": np.tile(np.array(GOAL, np.float32), (task.n, 1))}


def compute_reward(achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray | float:
    """Rewards (...) of goals (..., 2), see :func:`taa_envs.reward.goal_reward`; info is not looked at."""
    reward = goal_reward(achieved_goal, desired_goal)
    return reward if reward.ndim else float(reward)


class ArticulationEnv(gymnasium.Env, EzPickle):
    """Drive an articulated object's joint through contact, as the hand in a video did.

    The object's joint is passive: no actuator, no equality, and no write to its state during an episode. What moves it
    is the hand, whose position actuators the action aims.

    ## Actions
    ``action="residual"`` (default): ``Box(-1, 1, (8,), float32)``, corrections of the reference hand and the pace at
    which it is played. The zero action is the open-loop replay of the demonstration.

    | index | what | of an action of 1 |
    | --- | --- | --- |
    | 0-2 | translation along x, y, z of the asset frame | ``task.translation``, see below |
    | 3-5 | rotation about x, y, z through the palm's centre | 0.3 rad |
    | 6 | closing: finger joints move towards the finger tips' mean (negative: open) | 0.5 of the way at the tips |
    | 7 | pace: the reference's clock runs at 1 + 1.5 a (-1: backwards at half its speed) | 2.5 s a second |

    ``task.translation`` is three standard deviations of where hand and part meet, by the asset's own account, within
    0.03 and 0.15 m. Corrections follow the action by 0.2 of their range a step at most.

    ``action="absolute"``: ``Box(-1, 1, (63,), float32)``, where the 21 landmarks are to be, relative to the
    demonstration's first frame, in units of ``reach`` (1.25 times the farthest the demonstrated hand goes along an
    axis, at least 0.1 m). The zero action holds the hand where the demonstration began. Targets move at most at 2 m/s
    (or 1.5 times the demonstration's fastest). :meth:`reference_action` is the action that follows the demonstration.

    In a step of 0.02 s the actuators' targets move evenly from where they were to where the action puts them.

    ## Observations
    ``observation="flat"`` (default): ``Box(-10, 10, (170,), float32)`` (225 with absolute actions), clipped;
    ``observation="dict"``: the same parts as a Dict of boxes.

    | part | index | what |
    | --- | --- | --- |
    | joint | 0 | fraction of the demonstrated stroke, not clipped to [0, 1] |
    | | 1 | its rate in strokes per demonstration |
    | | 2 | how far it is ahead of the demonstration, in fifths of the stroke |
    | hand | 3-65 | 21 landmarks where they are, from the object's centre, in units of its size |
    | | 66-68 | their mean velocity, m/s |
    | contact | 69 | 1 if the hand pushed on the moving link in the last step |
    | | 70-72 | mean contact force of that step on the link (its impulse a second), asset frame, in units of 10 N |
    | | 73 | its moment about the joint, in 10 N at the object's size (10 N along a slide) |
    | reference | 74 | time as a fraction of the demonstration, at most 1 |
    | | 75 | the demonstration's stroke fraction now |
    | | 76-77 | the demonstration's stroke fraction in 0.1 and in 0.3 s |
    | | 78-83 | the demonstrated hand's way from now to then, in units of the object's size |
    | | 84-146 | 21 landmarks, from where they are to the reference, in units of 0.02 m |
    | grip | 147-161 | 5 finger tips in the link's frame, from where the demonstration had them, in units of 0.02 m |
    | action | 162- | the corrections as applied and the last pace; the last absolute action |

    ## Rewards
    ``reward="dense"`` (default), ``"sparse"`` (1 on success) or a dict of scales of the terms in
    :mod:`taa_envs.reward`. ``reward="sparse_goal"`` makes the task goal-conditioned: observations are a Dict of
    ``observation`` (flat), ``achieved_goal`` and ``desired_goal``, the fraction of the stroke and the share of it that
    contact drove, and the reward is ``compute_reward(achieved_goal, desired_goal, info)``, 0 at the goal, else -1.

    ## Episode
    Starts at the demonstration's first frame. Terminates on success: ``joint_progress >= 0.95``, of which at least 0.8
    was made in steps in which the hand's contact impulse did work on the joint. Truncated (by ``gym.make``'s time
    limit) after one and a half times the demonstration. Should the simulation diverge the episode terminates and
    ``info["diverged"]`` is True.

    ``reset(options=...)``:

    - ``q0``: joint state to start from, within its range, rad or m.
    - ``phase``: in [0, 1], start at this fraction of the demonstration; the joint starts where the demonstration had
      it, unless q0 says otherwise.
    - ``randomize``: True draws axis, pivot, scale, mass, damping, friction, the hand's place and, where the asset says
      how well they are known, spring and armature from the asset's own uncertainties (:mod:`taa_envs.randomize`); a
      list of names draws those; a dict of names gives the standard deviations. What was
      drawn is in ``info["randomized"]``. The default is the argument ``randomize``.

    ## Info
    ``joint_progress``, ``final_q_error``, ``is_success`` (was one at some time of the episode), ``success_now``,
    ``contact``, ``contact_fraction``, ``diverged``, ``warnings`` (how often MuJoCo warned in the last step),
    ``reward_terms``; after a reset ``randomized``.

    ## Arguments
    asset: an id, a folder or an :class:`Asset`.  hand: name of a hand.  action, observation, reward: see above.
    randomize: default of the reset option.  render_mode: None, "rgb_array" or "depth_array".  camera: "video" (where
    the asset knows it) or "overview".  width, height: px.  touch_static: whether the hand touches the static link too.
    reference: "demonstration", or "refined" for what `taa replay --refine` found for this hand.

    ## Version history
    ``TAA/<id>`` carries no version: the asset's folder says what it was made of.
    """

    metadata = {"render_modes": ["rgb_array", "depth_array"], "render_fps": round(1 / CONTROL_PERIOD)}

    def __init__(self, asset: str | os.PathLike | Asset, hand: str = "points",
                 reward: str | Mapping[str, float] = "dense", render_mode: str | None = None,
                 camera: str | None = None, width: int | None = None, height: int = 480,
                 touch_static: bool = False, action: str = "residual", observation: str = "flat",
                 randomize: Any = False, reference: str = "demonstration") -> None:
        EzPickle.__init__(self, asset, hand, reward, render_mode, camera, width, height, touch_static, action,
                          observation, randomize, reference)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"no render mode is named {render_mode!r}; known: {self.metadata['render_modes']}")
        self.asset = with_reference(get_asset(asset), reference, hand)
        if camera is None:
            camera = "video" if self.asset.camera is not None else "overview"
        elif camera not in ("overview", "video") or (camera == "video" and self.asset.camera is None):
            raise ValueError(f"{self.asset.id} has no camera {camera!r}; known: overview"
                             + (", video" if self.asset.camera is not None else ""))
        self.render_mode, self._camera = render_mode, camera
        picture = self.asset.camera if camera == "video" else None
        aspect = picture["width"] / picture["height"] if picture is not None else 4 / 3
        self._size = (round(height * aspect) if width is None else width, height)
        scene = build_scene(self.asset, hand, touch_static=touch_static)
        if scene.hand is None:
            raise ValueError("the environment needs a hand; name one")
        self._rows = SingleRows(scene)
        self.task = SingleTask(scene, self._rows, action=action, reward=reward)
        self.observation_space, self.action_space = spaces_of(self.task, observation)
        self._observed, self._randomize = observation, randomize
        if self.task.goal:  # elsewhere it would make Stable-Baselines3 take the environment for a goal-conditioned one
            self.compute_reward = compute_reward
        self._renderer: Any = None
        self.task.begin(0, np.random.default_rng(0))

    @property
    def dt(self) -> float:
        """s of one step."""
        return CONTROL_PERIOD

    @property
    def model(self) -> Any:
        """The ``mujoco.MjModel``, as randomised."""
        return self._rows.model

    @property
    def data(self) -> Any:
        """The ``mujoco.MjData``."""
        return self._rows.data

    @property
    def q(self) -> float:
        """State of the object's joint, rad or m."""
        return float(self.task.q[0])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None
              ) -> tuple[Any, dict[str, Any]]:
        """See the class.

        Raises:
            ValueError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        made = self.task.begin(0, self.np_random, options, self._randomize)
        info: dict[str, Any] = {name: value[0].item() for name, value in self.task.info().items()}
        info["reward_terms"] = {}
        if made:
            info["randomized"] = made
        return self._observation(), info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See the class."""
        reward, terms, info = self.task.step_one(action)
        info["reward_terms"] = terms
        return self._observation(), reward, info["success_now"] or info["diverged"], False, info

    def reference_action(self) -> np.ndarray:
        """The action that follows the demonstrated hand in the next step."""
        return self.task.reference_action()[0]

    def get_state(self) -> dict[str, Any]:
        """Snapshot of the episode and of the generator; plain arrays and numbers, copies."""
        return {**self.task.snapshot(0), "generator": self.np_random.bit_generator.state}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Take a snapshot of :meth:`get_state`; what follows is what followed there."""
        self.task.restore(0, state)
        self.np_random.bit_generator.state = state["generator"]

    def _observation(self) -> Any:
        flat = self.task.observe_one()
        if self._observed == "flat" and not self.task.goal:
            return flat
        return {name: value[0] for name, value in observe(self.task, self._observed, flat[None]).items()}

    def render(self) -> np.ndarray | None:
        """(height, width, 3) uint8, or (height, width) float32 m for "depth_array"; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode; give one to gym.make")
            return None
        if self._renderer is None:
            import mujoco

            self._renderer = mujoco.Renderer(self.model, height=self._size[1], width=self._size[0])
            if self.render_mode == "depth_array":
                self._renderer.enable_depth_rendering()
        self._renderer.update_scene(self.data, camera=self._camera)
        return self._renderer.render().copy()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


__all__ = ["DRIVEN_SHARE", "SUCCESS_PROGRESS", "ArticulationEnv", "apply_residual", "compute_reward",
           "observe", "spaces_of"]
