"""State of one or of many simulations of a scene as arrays with a leading axis of simulations.

:class:`SingleRows` steps one ``MjData`` with ``mj_step``, :class:`BatchRows` many with ``mujoco.batch``. What is
written on top of them (:mod:`taa_envs.task`) does not know which it has: a batched episode equals a single one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

from taa_envs.hands import Controller
from taa_envs.hands.points import PointsController
from taa_envs.scene import Scene

if TYPE_CHECKING:
    import mujoco

# Model fields that an episode may change, see taa_envs.randomize.
MODEL_FIELDS = ("jnt_axis", "jnt_pos", "body_mass", "body_inertia", "dof_damping", "dof_frictionloss")


class Rows(Protocol):
    """``n`` simulations. Arrays are live: ``qpos`` (n, nq), ``qvel`` (n, nv), ``act`` (n, na), ``ctrl`` (n, nu),
    ``time`` (n,), ``sensordata`` (n, nsensordata; of the state before the last step), ``history`` (n, nhistory)."""

    n: int
    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    history: np.ndarray
    ctrl: np.ndarray
    sensordata: np.ndarray

    @property
    def time(self) -> np.ndarray:
        """(n,) s of simulation."""

    def fields(self, row: int) -> Mapping[str, np.ndarray]:
        """Model fields of one simulation, to write into; call :meth:`constants` afterwards."""

    def constants(self, row: int) -> None:
        """Derive what follows from changed model fields."""

    def clear(self, ids: np.ndarray) -> None:
        """Default state."""

    def forward(self, ids: np.ndarray) -> None:
        """Compute what follows from states that were written."""

    def step(self, ids: np.ndarray | None) -> None:
        """One time step of those simulations, None for all."""

    def snapshot(self, row: int) -> np.ndarray:
        """Full state; a copy."""

    def restore(self, row: int, state: np.ndarray) -> None:
        """Take a state of :meth:`snapshot`."""


class SingleRows:
    """One simulation on an ``mujoco.MjData`` of the scene's model: a new one, or the one given."""

    n = 1

    def __init__(self, scene: Scene, data: mujoco.MjData | None = None) -> None:
        import mujoco

        self._mujoco, self.model = mujoco, scene.model
        self.data = mujoco.MjData(scene.model) if data is None else data
        self.qpos, self.qvel = self.data.qpos[None], self.data.qvel[None]
        self.act, self.history = self.data.act[None], self.data.history[None]
        self.ctrl, self.sensordata = self.data.ctrl[None], self.data.sensordata[None]
        self._spec = mujoco.mjtState.mjSTATE_INTEGRATION

    @property
    def time(self) -> np.ndarray:
        return np.array([self.data.time])

    def fields(self, row: int) -> dict[str, np.ndarray]:
        return {name: getattr(self.model, name) for name in MODEL_FIELDS}

    def constants(self, row: int) -> None:
        self._mujoco.mj_setConst(self.model, self._mujoco.MjData(self.model))

    def clear(self, ids: np.ndarray) -> None:
        self._mujoco.mj_resetData(self.model, self.data)

    def forward(self, ids: np.ndarray) -> None:
        self._mujoco.mj_forward(self.model, self.data)

    def step(self, ids: np.ndarray | None) -> None:
        self._mujoco.mj_step(self.model, self.data)

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
        self.act, self.history = self.batch.bind("act"), self.batch.bind("history")
        self.ctrl, self.sensordata = self.batch.bind("ctrl"), self.batch.bind("sensordata")
        self._time = self.batch.bind("time")
        self._model: dict[str, np.ndarray] = {}

    @property
    def time(self) -> np.ndarray:
        return self._time.copy()

    def fields(self, row: int) -> dict[str, np.ndarray]:
        if not self._model:  # only where models differ: expanded fields are copied at every step
            self._model = {name: self.batch.expand(name) for name in MODEL_FIELDS}
        return {name: values[row] for name, values in self._model.items()}

    def constants(self, row: int) -> None:
        self.batch.set_const(np.array([row]))

    def clear(self, ids: np.ndarray) -> None:
        self.batch.reset(ids, stage=self._none)

    def forward(self, ids: np.ndarray) -> None:
        self.batch.forward(ids)

    def step(self, ids: np.ndarray | None) -> None:
        self.batch.step(ids)

    def snapshot(self, row: int) -> np.ndarray:
        return self.batch.state[row].copy()

    def restore(self, row: int, state: np.ndarray) -> None:
        self.batch.state[row] = state


class PointsRows:
    """The hand of spheres (:mod:`taa_envs.hands.points`) in every simulation at once."""

    def __init__(self, controller: PointsController, rows: Rows) -> None:
        self.weights, self.hand = controller.weights, controller.hand
        count, self._damping = len(self.weights), controller.hand.damping

        def view(array: np.ndarray, columns: np.ndarray) -> np.ndarray:
            first = int(columns[0, 0])
            if not np.array_equal(columns.ravel(), np.arange(first, first + columns.size)):
                raise RuntimeError("the compiled hand's joints are not in order")
            out = array[:, first:first + columns.size].reshape(rows.n, count, 3)
            assert np.shares_memory(out, array)
            return out

        self._here, self._speed = view(rows.qpos, controller.qpos), view(rows.qvel, controller.dof)
        self._velocity, self._target = view(rows.ctrl, controller.act), view(rows.act, controller.target)

    def targets(self, joints: np.ndarray) -> np.ndarray:
        """(..., S, 3) sphere targets of landmarks (..., 21, 3), m."""
        return self.weights @ joints

    def place(self, ids: np.ndarray, joints: np.ndarray) -> None:
        """Put the hands at landmarks (n, 21, 3) m, at rest."""
        self._here[ids] = self._target[ids] = self.weights @ joints
        self._speed[ids] = self._velocity[ids] = 0.0

    def control(self, target: np.ndarray) -> None:
        """Aim at targets (n, S, 3) m within the limits of each sphere and of the whole hand."""
        hand, here, limit = self.hand, self._here, self.hand.sphere_force
        drag = self._damping * self._speed
        pull = target - here
        pull *= hand.stiffness
        pull -= drag
        np.maximum(np.minimum(pull, limit, out=pull), -limit, out=pull)
        square = pull * pull
        # Sums written out: their rounding must not depend on how many simulations there are.
        total = np.sqrt(square[..., 0] + square[..., 1] + square[..., 2]).sum(-1)
        if total.max() > hand.total_force:
            share = (hand.total_force / np.maximum(total, hand.total_force))[:, None, None]
            target = np.where(share < 1.0, here + (pull * share + drag) / hand.stiffness, target)
        self._target[:] = target
        self._velocity[:] = 0.0

    def landmarks(self) -> np.ndarray:
        """(n, 21, 3) m; a copy."""
        return self._here[:, :21].copy()

    def velocity(self) -> np.ndarray:
        """(n, 3) m/s, mean of the landmarks'."""
        return self._speed[:, :21].mean(1)


class ControllerRows:
    """Any other hand, one simulation only, through its :class:`taa_envs.hands.Controller`."""

    def __init__(self, controller: Controller, rows: SingleRows) -> None:
        self._controller, self._data = controller, rows.data
        self._velocity = np.zeros((1, 3))

    def targets(self, joints: np.ndarray) -> np.ndarray:
        return joints

    def place(self, ids: np.ndarray, joints: np.ndarray) -> None:
        self._controller.place(self._data, joints[0])

    def control(self, target: np.ndarray) -> None:
        self._controller.control(self._data, target[0])

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
