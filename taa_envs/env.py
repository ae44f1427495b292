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
from taa_envs.registry import CONTROL_PERIOD, get_asset
from taa_envs.reward import RewardInputs, reward_scales, reward_terms
from taa_envs.scene import TIMESTEP, build_scene
from taa_envs.simulation import Diverged, HandPath, Simulation, Step

SUCCESS_PROGRESS = 0.95
DRIVEN_SHARE = 0.8  # of the progress made, what contact must have driven for a success
TRANSLATION, ROTATION, CLOSURE = 0.03, 0.3, 0.5  # m, rad, share of the way: residuals of an action of 1
ACTIONS = 7
PALM = (0, 5, 9, 13, 17)
TIPS = (4, 8, 12, 16, 20)
# How far along its finger each landmark is: closing moves tips all the way, knuckles not at all.
CURL = np.array([0, 0, 1, 2, 3] + [0, 1, 2, 3] * 4) / 3.0
RANDOMIZE = {"hand": 0.01, "damping": 0.3, "frictionloss": 0.3, "friction": 0.2}
RESET_OPTIONS = ("q0", "phase", "randomize")


def apply_residual(joints: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Landmarks (21, 3) m, moved, turned about the palm and closed by an action (7,)."""
    moved = joints + (CLOSURE * action[6] * CURL)[:, None] * (joints[list(TIPS)].mean(0) - joints)
    rotvec = ROTATION * np.asarray(action[3:6], float)
    angle = float(np.linalg.norm(rotvec))
    if angle > 1e-12:
        palm, k = joints[list(PALM)].mean(0), rotvec / angle
        arm = moved - palm
        moved = (palm + arm * np.cos(angle) + np.cross(k, arm) * np.sin(angle)
                 + np.outer(arm @ k, k) * (1 - np.cos(angle)))
    return moved + TRANSLATION * np.asarray(action[:3], float)


class ArticulationEnv(gymnasium.Env, EzPickle):
    """Drive an articulated object's joint through contact, as the hand in a video did.

    The object's joint is passive: no actuator, no equality, and no write to its state during an episode. What moves it
    is the hand, whose targets are the demonstrated landmarks plus a residual. The zero action is the open-loop replay.

    ## Actions
    ``Box(-1, 1, (7,), float32)``, a residual on the reference hand at the current time:

    | index | what | of an action of 1 |
    | --- | --- | --- |
    | 0-2 | translation along x, y, z of the asset frame | 0.03 m |
    | 3-5 | rotation about x, y, z through the palm's centre | 0.3 rad |
    | 6 | closing: finger joints move towards the finger tips' mean (negative: open) | 0.5 of the way at the tips |

    ## Observations
    ``Box(-10, 10, (138,), float32)``, clipped:

    | index | what |
    | --- | --- |
    | 0 | joint: fraction of the demonstrated stroke, not clipped to [0, 1] |
    | 1 | its rate in strokes per demonstration |
    | 2 | time, as a fraction of the demonstration, at most 1 |
    | 3 | the demonstration's stroke fraction at this time |
    | 4 | 1 while the hand pushes on the moving link |
    | 5-67 | 21 landmarks where they are, from the object's centre, in units of its size |
    | 68-130 | 21 landmarks, from where they are to the reference, in units of 0.02 m |
    | 131-137 | the last action |

    ## Rewards
    ``reward="dense"`` (default), ``"sparse"`` (1 on success) or a dict of scales of the terms in
    :mod:`taa_envs.reward`.

    ## Episode
    Starts at the demonstration's first frame. Terminates on success: ``joint_progress >= 0.95``, of which at least 0.8
    was made while the hand's contact did work on the joint. Truncated (by ``gym.make``'s time limit) after one and a
    half times the demonstration. Should the simulation diverge the episode terminates and ``info["diverged"]`` is True.

    ``reset(options=...)``:

    - ``q0``: joint state to start from, within its range, rad or m.
    - ``phase``: in [0, 1], start at this fraction of the demonstration; the joint starts where the demonstration had
      it, unless q0 says otherwise.
    - ``randomize``: True, or a dict with any of ``hand`` (m, std of an offset of the whole hand), ``damping``,
      ``frictionloss``, ``friction`` (relative, uniform); drawn from the environment's seeded generator.

    ## Info
    ``joint_progress``, ``final_q_error``, ``is_success``, ``contact``, ``contact_fraction``, ``reward_terms``.

    ## Arguments
    asset: an id, a folder or an :class:`Asset`.  hand: name of a hand.  reward: see above.  render_mode: None,
    "rgb_array" or "depth_array".  camera: "video" (where the asset knows it) or "overview".  width, height: px.
    touch_static: whether the hand touches the static link too.

    ## Version history
    ``TAA/<id>`` carries no version: the asset's folder says what it was made of.
    """

    metadata = {"render_modes": ["rgb_array", "depth_array"], "render_fps": round(1 / CONTROL_PERIOD)}

    def __init__(self, asset: str | os.PathLike | Asset, hand: str = "points",
                 reward: str | Mapping[str, float] = "dense", render_mode: str | None = None,
                 camera: str | None = None, width: int | None = None, height: int = 480,
                 touch_static: bool = False) -> None:
        EzPickle.__init__(self, asset, hand, reward, render_mode, camera, width, height, touch_static)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"no render mode is named {render_mode!r}; known: {self.metadata['render_modes']}")
        self.asset = get_asset(asset)
        if camera is None:
            camera = "video" if self.asset.camera is not None else "overview"
        elif camera not in ("overview", "video") or (camera == "video" and self.asset.camera is None):
            raise ValueError(f"{self.asset.id} has no camera {camera!r}; known: overview"
                             + (", video" if self.asset.camera is not None else ""))
        self.scales = reward_scales(reward)
        self.render_mode, self._camera = render_mode, camera
        picture = self.asset.camera if camera == "video" else None
        aspect = picture["width"] / picture["height"] if picture is not None else 4 / 3
        self._size = (round(height * aspect) if width is None else width, height)
        self._scene = build_scene(self.asset, hand, touch_static=touch_static)
        if self._scene.hand is None:
            raise ValueError("the environment needs a hand; name one")
        self._hand = self._scene.hand
        self.simulation = Simulation(self._scene)
        self.frame_skip = round(CONTROL_PERIOD / TIMESTEP)
        self._path = HandPath(self.asset.reference.time, self.asset.reference.hand_joints)
        model = self._scene.model
        self._nominal = (model.dof_damping.copy(), model.dof_frictionloss.copy(), model.geom_friction.copy())
        self._stroke = self.asset.demo["q_demo_end"] - self.asset.demo["q_start"]
        self._renderer: Any = None
        self.action_space = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
        self.observation_space = spaces.Box(-10.0, 10.0, (5 + 63 + 63 + 7,), np.float32)
        self._begin(0.0, self.asset.demo["q_start"], np.zeros(3))

    @property
    def dt(self) -> float:
        """s of one step."""
        return CONTROL_PERIOD

    def _begin(self, time: float, q0: float, offset: np.ndarray) -> None:
        """time: s since the reference's first frame."""
        self._start = float(self.asset.reference.time[0]) + time
        self._offset = offset
        self._count = 0
        self._action = np.zeros(7, np.float32)
        self._driven = 0.0
        self._first = float(self.asset.stroke_fraction(q0))
        self._hit = np.zeros(len(self.asset.reference.time), bool)
        self._seen = np.zeros_like(self._hit)
        self._last = Step()
        self.simulation.reset(q0, self._path.at(self._start) + offset)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None
              ) -> tuple[np.ndarray, dict[str, Any]]:
        """See the class.

        Raises:
            ValueError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        options = dict(options or {})
        unknown = set(options) - set(RESET_OPTIONS)
        if unknown:
            raise ValueError(f"no reset option is named {', '.join(sorted(unknown))}; known: "
                             + ", ".join(RESET_OPTIONS))
        phase = float(options.get("phase", 0.0))
        if not 0.0 <= phase <= 1.0:
            raise ValueError(f"phase must lie in [0, 1], is {phase}")
        reference, model = self.asset.reference, self._scene.model
        time = phase * self.asset.demo["duration"]
        low, high = model.jnt_range[model.joint("joint").id]
        default = np.clip(np.interp(reference.time[0] + time, reference.time, reference.q), low, high)
        q0 = float(options["q0"]) if options.get("q0") is not None else float(default)
        if not low <= q0 <= high:
            raise ValueError(f"q0 must lie in the joint's range [{low:.4g}, {high:.4g}] {self.asset.unit}, is {q0:.4g}")
        self._begin(time, q0, self._randomize(options.get("randomize", False)))
        return self._observation(), self._info({})

    def _randomize(self, wanted: bool | Mapping[str, float]) -> np.ndarray:
        """Perturb the model; the hand's offset (3,) m."""
        model, dof = self._scene.model, self._scene.dof
        model.dof_damping[:], model.dof_frictionloss[:], model.geom_friction[:] = self._nominal
        if not wanted:
            return np.zeros(3)
        amounts = dict(RANDOMIZE) if wanted is True else dict(wanted)
        unknown = set(amounts) - set(RANDOMIZE)
        if unknown:
            raise ValueError(f"cannot randomize {', '.join(sorted(unknown))}; known: {', '.join(RANDOMIZE)}")
        draw = {name: float(self.np_random.uniform(-1, 1)) * min(max(float(amounts.get(name, 0.0)), 0.0), 1.0)
                for name in ("damping", "frictionloss", "friction")}
        model.dof_damping[dof] *= 1 + draw["damping"]
        model.dof_frictionloss[dof] *= 1 + draw["frictionloss"]
        model.geom_friction[self._scene.hand_geoms, 0] *= 1 + draw["friction"]
        return self.np_random.normal(0.0, max(float(amounts.get("hand", 0.0)), 0.0), 3)

    @property
    def _time(self) -> float:
        return self._start + self._count * self._scene.model.opt.timestep

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """See the class."""
        action = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        total, diverged, reference = Step(), False, self.asset.reference
        before = float(self.asset.stroke_fraction(self.simulation.q))
        for _ in range(self.frame_skip):
            t = self._time
            joints = apply_residual(self._path.at(t + self._hand.lead), action) + self._offset
            try:
                made = self.simulation.step(joints)
            except Diverged:
                diverged = True
                break
            total.add(made)
            frame = int(np.searchsorted(reference.time, t + 1e-9, side="right")) - 1
            self._seen[frame] = True
            self._hit[frame] |= made.contact
            self._count += 1
        driven = total.driven / abs(self._stroke)
        self._driven += driven
        self._last = total
        success = not diverged and self._success()
        contact_tips = self._hand.landmarks(self.simulation.data)[list(TIPS)]
        terms = reward_terms(RewardInputs(
            driven=driven, moved=float(self.asset.stroke_fraction(self.simulation.q)) - before, contact=total.contact,
            distance=0.0 if total.contact else self.simulation.surface_distance(contact_tips),
            penetration=total.penetration, action=action, previous_action=self._action, success=success), self.scales)
        self._action = action.copy()
        info = self._info(terms)
        if diverged:
            info["diverged"] = True
        return self._observation(), float(sum(terms.values())), bool(success or diverged), False, info

    def _success(self) -> bool:
        progress = float(self.asset.progress(self.simulation.q))
        made = progress - float(np.clip(self._first, 0.0, 1.0))
        return progress >= SUCCESS_PROGRESS and made > 0 and self._driven >= DRIVEN_SHARE * made

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        wanted = self.asset.reference.contact & self._seen
        return {"joint_progress": float(self.asset.progress(self.simulation.q)),
                "final_q_error": self.asset.final_q_error(self.simulation.q), "is_success": self._success(),
                "contact": bool(self._last.contact),
                "contact_fraction": float(self._hit[wanted].mean()) if wanted.any() else 0.0,
                "reward_terms": dict(terms)}

    def _observation(self) -> np.ndarray:
        asset, sim, duration = self.asset, self.simulation, self.asset.demo["duration"]
        t = self._time
        here = self._hand.landmarks(sim.data)
        demo_q = np.interp(t, asset.reference.time, asset.reference.q)
        parts = [
            [float(asset.stroke_fraction(sim.q)), sim.qvel * duration / self._stroke,
             min((t - asset.reference.time[0]) / duration, 1.0), float(asset.stroke_fraction(demo_q)),
             float(self._last.contact)],
            ((here - self._scene.centre) / self._scene.size).ravel(),
            ((self._path.at(t) + self._offset - here) / 0.02).ravel(),
            self._action,
        ]
        return np.clip(np.concatenate(parts), -10.0, 10.0).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """(height, width, 3) uint8, or (height, width) float32 m for "depth_array"; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode; give one to gym.make")
            return None
        if self._renderer is None:
            import mujoco

            self._renderer = mujoco.Renderer(self._scene.model, height=self._size[1], width=self._size[0])
            if self.render_mode == "depth_array":
                self._renderer.enable_depth_rendering()
        self._renderer.update_scene(self.simulation.data, camera=self._camera)
        return self._renderer.render().copy()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
