"""State of one or of many simulations of a scene as arrays with a leading axis of simulations.

:class:`SingleRows` steps one ``MjData`` with ``mj_step``, :class:`BatchRows` many with ``mujoco.batch``. What is
written on top of them (:mod:`taa_envs.task`) does not know which it has: a batched episode equals a single one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from taa_envs import kernels
from taa_envs.hands import Controller
from taa_envs.hands.points import PointsController
from taa_envs.scene import CONTROL_PERIOD, SUBSTEPS, Scene, touch_history

if TYPE_CHECKING:
    import mujoco


class Rows(Protocol):
    """``n`` simulations. Arrays are live: ``qpos`` (n, nq), ``qvel`` (n, nv), ``act`` (n, na), ``ctrl`` (n, nu),
    ``time`` (n,); of the state before the last step ``sensordata`` (n, nsensordata), ``link_pos`` (n, 3) and
    ``link_mat`` (n, 3, 3) of the moving link; ``touches`` (n, SUBSTEPS, 10), what :func:`taa_envs.scene.touch_history`
    finds; ``warnings`` (n, kinds) int32, how often MuJoCo warned since it began anew."""

    n: int
    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    link_pos: np.ndarray
    link_mat: np.ndarray
    touches: np.ndarray
    sensordata: np.ndarray
    warnings: np.ndarray

    @property
    def time(self) -> np.ndarray:
        """(n,) s of simulation; good until the next step."""

    def fields(self, row: int, names: Sequence[str]) -> Mapping[str, np.ndarray]:
        """Those model fields of one simulation, to write into; call :meth:`constants` afterwards."""

    def constants(self, row: int) -> None:
        """Derive what follows from changed model fields."""

    def clear(self, ids: np.ndarray) -> None:
        """Default state."""

    def forward(self, ids: np.ndarray) -> None:
        """Compute what follows from states that were written."""

    def step(self, ids: np.ndarray | None, count: int = 1) -> None:
        """So many time steps of those simulations, None for all."""

    def snapshot(self, row: int) -> np.ndarray:
        """Full state; a copy."""

    def restore(self, row: int, state: np.ndarray) -> None:
        """Take a state of :meth:`snapshot`."""


def _touches(scene: Scene, history: np.ndarray) -> np.ndarray:
    """(n, SUBSTEPS, 10) view of histories (n, nhistory); (n, 0, 10) in a scene without a hand."""
    if scene.hand is None:
        return np.empty((len(history), 0, 10))
    out = history[:, touch_history(scene)].reshape(len(history), SUBSTEPS, 10)
    assert np.shares_memory(out, history)
    return out


class SingleRows:
    """One simulation on an ``mujoco.MjData`` of the scene's model: a new one, or the one given."""

    n = 1

    def __init__(self, scene: Scene, data: mujoco.MjData | None = None) -> None:
        import mujoco

        self._mujoco, self.model = mujoco, scene.model
        self.data = mujoco.MjData(scene.model) if data is None else data
        self.qpos, self.qvel = self.data.qpos[None], self.data.qvel[None]
        self.act, self.ctrl = self.data.act[None], self.data.ctrl[None]
        self.sensordata, body = self.data.sensordata[None], scene.model.body("moving").id
        self.link_pos, self.link_mat = self.data.xpos[None, body], self.data.xmat[None, body].reshape(1, 3, 3)
        self.touches = _touches(scene, self.data.history[None])
        self.warnings, self._time = self.data.warning.number[None], np.zeros(1)
        self._spec = mujoco.mjtState.mjSTATE_INTEGRATION

    @property
    def time(self) -> np.ndarray:
        self._time[0] = self.data.time
        return self._time

    def fields(self, row: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        return {name: getattr(self.model, name) for name in names}

    def constants(self, row: int) -> None:
        self._mujoco.mj_setConst(self.model, self._mujoco.MjData(self.model))

    def clear(self, ids: np.ndarray) -> None:
        self._mujoco.mj_resetData(self.model, self.data)

    def forward(self, ids: np.ndarray) -> None:
        self._mujoco.mj_forward(self.model, self.data)

    def step(self, ids: np.ndarray | None, count: int = 1) -> None:
        self._mujoco.mj_step(self.model, self.data, count)

    def snapshot(self, row: int) -> np.ndarray:
        state = np.empty(self._mujoco.mj_stateSize(self.model, self._spec))
        self._mujoco.mj_getState(self.model, self.data, state, self._spec)
        return state

    def restore(self, row: int, state: np.ndarray) -> None:
        self._mujoco.mj_setState(self.model, self.data, state, self._spec)
        # What mj_forward computes is then current; the warm start it leaves is taken back.
        self._mujoco.mj_forward(self.model, self.data)
        self._mujoco.mj_setState(self.model, self.data, state, self._spec)


class BatchRows:
    """Many simulations on ``mujoco.batch.Batch``, each with model fields of its own."""

    def __init__(self, scene: Scene, n: int, threads: int = 0) -> None:
        import mujoco
        from mujoco.batch import Batch

        self.n, self._none = n, int(mujoco.mjtStage.mjSTAGE_NONE)
        self.batch = Batch(scene.model, n, threads)
        self.qpos, self.qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self.act, self.ctrl = self.batch.bind("act"), self.batch.bind("ctrl")
        self.sensordata, body = self.batch.bind("sensordata"), scene.model.body("moving").id
        self.link_pos = self.batch.bind("xpos")[:, body]
        self.link_mat = self.batch.bind("xmat")[:, body].reshape(n, 3, 3)
        self.touches = _touches(scene, self.batch.bind("history"))
        self._time, self.warnings = self.batch.bind("time").reshape(n), self.batch.warning[..., 1]
        self._model: dict[str, np.ndarray] = {}

    @property
    def time(self) -> np.ndarray:
        return self._time.copy()

    def fields(self, row: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        for name in names:
            if name not in self._model:  # only where models differ: expanded fields are copied at every step
                self._model[name] = self.batch.expand(name)
        return {name: self._model[name][row] for name in names}

    def constants(self, row: int) -> None:
        self.batch.set_const(np.array([row]))

    def clear(self, ids: np.ndarray) -> None:
        self.batch.reset(ids, stage=self._none)

    def forward(self, ids: np.ndarray) -> None:
        self.batch.forward(ids)

    def step(self, ids: np.ndarray | None, count: int = 1) -> None:
        self.batch.step(ids, nstep=count)

    def snapshot(self, row: int) -> np.ndarray:
        return self.batch.state[row].copy()

    def restore(self, row: int, state: np.ndarray) -> None:
        self.batch.state[row] = state


class PointsRows:
    """The hand of spheres (:mod:`taa_envs.hands.points`) in every simulation at once.

    Attributes:
        weights: (S, 21), targets are ``weights @ landmarks``; the first 21 are the landmarks.
        aimed: (n, S, 3) m, where the spheres were last aimed at.
    """

    def __init__(self, controller: PointsController, rows: Rows) -> None:
        self.weights, self.hand, self._rows = controller.weights, controller.hand, rows
        count = len(self.weights)

        def view(array: np.ndarray, columns: np.ndarray) -> np.ndarray:
            first = int(columns[0, 0])
            if not np.array_equal(columns.ravel(), np.arange(first, first + columns.size)):
                raise RuntimeError("the compiled hand's joints are not in order")
            out = array[:, first:first + columns.size].reshape(rows.n, count, 3)
            assert np.shares_memory(out, array)
            return out

        self._here, self._speed = view(rows.qpos, controller.qpos), view(rows.qvel, controller.dof)
        self._velocity, self._target = view(rows.ctrl, controller.ctrl), view(rows.act, controller.target)
        self._landmarks, self._landmark_speed = self._here[:, :21], self._speed[:, :21]
        self.aimed = np.zeros((rows.n, count, 3))
        self._states = self.aimed, self._here, self._speed, self._target, self._velocity
        hand, self._everyone = controller.hand, np.arange(rows.n)
        self._jump, self._glide = (
            np.array([hand.stiffness, hand.damping, ahead, hand.sphere_force, hand.total_force, rate])
            for ahead, rate in ((0.0, 0.0), (CONTROL_PERIOD, 1 / CONTROL_PERIOD)))

    def targets(self, joints: np.ndarray) -> np.ndarray:
        """(..., S, 3) sphere targets of landmarks (..., 21, 3), m."""
        return self.weights @ joints

    def place(self, ids: np.ndarray, joints: np.ndarray) -> None:
        """Put the hands at landmarks (n, 21, 3) m, at rest."""
        self._here[ids] = self._target[ids] = self.aimed[ids] = self.weights @ joints
        self._speed[ids] = self._velocity[ids] = 0.0

    def control(self, target: np.ndarray) -> None:
        """Aim at targets (n, S, 3) m within the limits of each sphere and of the whole hand, for one substep."""
        kernels.drive(self._everyone, target, *self._states, self._jump)

    def advance(self, target: np.ndarray, ids: np.ndarray | None) -> None:
        """One environment step, in which the targets move evenly to targets (n, S, 3) m.

        The whole hand's limit holds for the forces at the step's end as they can be foreseen, each sphere that is held
        back going on as fast as it goes: where it binds, the targets move to where the hand just keeps it.
        """
        kernels.drive(self._everyone if ids is None else ids, target, *self._states, self._glide)
        self._rows.step(ids, SUBSTEPS)

    def landmarks(self) -> np.ndarray:
        """(n, 21, 3) m; a view of the states."""
        return self._landmarks

    def velocity(self) -> np.ndarray:
        """(n, 21, 3) m/s, of the landmarks; a view of the states."""
        return self._landmark_speed


class ControllerRows:
    """Any other hand, one simulation only, through its :class:`taa_envs.hands.Controller`; targets are landmarks.

    Attributes:
        aimed: (1, 21, 3) m, the landmarks that the last step ended aiming at.
    """

    def __init__(self, controller: Controller, rows: SingleRows) -> None:
        self.weights = np.eye(21)
        self._controller, self._rows, self._data = controller, rows, rows.data
        self._velocity, self.aimed = np.zeros((1, 21, 3)), np.zeros((1, 21, 3))

    def targets(self, joints: np.ndarray) -> np.ndarray:
        return joints

    def place(self, ids: np.ndarray, joints: np.ndarray) -> None:
        self._controller.place(self._data, joints[0])
        self.aimed[:] = joints

    def control(self, target: np.ndarray) -> None:
        self._controller.control(self._data, target[0])

    def advance(self, target: np.ndarray, ids: np.ndarray | None) -> None:
        """One environment step, in which the landmarks aimed at move evenly to others (1, 21, 3) m."""
        way = target[0] - self.aimed[0]
        for k in range(SUBSTEPS):
            self._controller.control(self._data, self.aimed[0] + (k / SUBSTEPS) * way)
            self._rows.step(None)
        self.aimed[:] = target

    def landmarks(self) -> np.ndarray:
        return self._controller.landmarks(self._data)[None]

    def velocity(self) -> np.ndarray:
        """Zero: a controller does not say; landmarks and the last action are observed."""
        return self._velocity


def hand_rows(scene: Scene, rows: Rows) -> PointsRows | ControllerRows:
    """Drives the scene's hand in those simulations.

    Raises:
        ValueError: the scene has no hand, or it cannot be batched.
    """
    if scene.hand is None:
        raise ValueError("the environment needs a hand; name one")
    if isinstance(scene.hand, PointsController):
        return PointsRows(scene.hand, rows)
    if isinstance(rows, SingleRows):
        return ControllerRows(scene.hand, rows)
    raise ValueError("this hand runs one simulation at a time; use hand='points' or vectorization_mode='sync'")
