"""Logs made ready for simulation, and the joint under a log's own inputs, many variants of it at once.

:func:`readings` is the fit's own integrator (:mod:`diagnose.kernel`); :func:`mujoco_rollouts` is MuJoCo itself, for the
numbers that are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from diagnose import kernel
from diagnose.kernel import KNOTS, TERMS
from diagnose.log import JointLog
from diagnose.plant import Plant

COARSE, FINE, SHORT = 5e-3, 2.5e-3, 1.25e-3  # s, longest step of a search, of what is reported, of sharp causes
EVEN = 0.02  # rows further apart than the median by more than this share leave open when a held input changed

__all__ = ["COARSE", "FINE", "KNOTS", "SHORT", "TERMS", "Episode", "Frame", "held", "mujoco_rollouts", "prepare",
           "readings", "smooth", "windows"]  # fmt: skip


@dataclass(frozen=True)
class Episode:
    """One log (or a window of one) ready to simulate.

    Attributes:
        log: the measurement.  t: (N,) s from its start.
        step: s.  torque: (K,) input over each step.
        edges: (M, K) what each change of a held input adds if it happened one row earlier; only of changes between
            rows that are not evenly spaced, where nobody knows when between the two rows the input changed.
        q, v, a: (N,) smoothed position, velocity, acceleration.  u: (N,) input at the samples.
    """

    log: JointLog
    t: np.ndarray
    step: float
    torque: np.ndarray
    edges: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray

    @property
    def start(self) -> np.ndarray:
        """(2 + M,) guess of what is unknown of this episode alone: initial q and v (half a step early), edges."""
        return np.concatenate([[self.q[0], self.v[0] - 0.5 * self.step * self.a[0]], np.full(len(self.edges), 0.5)])

    def stepped(self, most: float) -> Episode:
        """The same with steps of at most so many seconds."""
        return _on_grid(self, most)


def held(u: np.ndarray) -> bool:
    """True if the input is piecewise constant: then a sample holds until the next, else it is interpolated."""
    return bool(np.mean(np.diff(u) == 0) > 0.5)


def prepare(plant: Plant, log: JointLog, most: float = COARSE) -> Episode:
    """Put a log's input on a fine even grid and smooth its motion.

    An input that is constant between most samples (a held torque, let go) acts from its row's time until the next
    row's; any other is interpolated, but a fall to exactly 0 (letting go) stays a jump.
    """
    t = log.time - log.time[0]
    u = plant.input_torque(log)
    nothing = np.zeros((0, 0))
    return _on_grid(Episode(log, t, log.dt, np.zeros(0), nothing, *smooth(t, log.q), u), most)


def _on_grid(e: Episode, most: float) -> Episode:
    dt = float(np.median(np.diff(e.t)))
    step = dt / max(1, int(np.ceil(dt / most - 1e-9)))
    count = int(np.ceil(e.t[-1] / step - 1e-9)) + 1
    middle = np.arange(count) * step
    torque = sum(_input_at(e.t, e.u, middle + s * step) for s in SPREAD) / len(SPREAD)
    return replace(e, step=step, torque=torque, edges=_edges(e.t, e.u, middle, step))


def _edges(t: np.ndarray, u: np.ndarray, middle: np.ndarray, step: float) -> np.ndarray:
    """See :class:`Episode`; on a grid of steps about the times ``middle``."""
    gap, dt, out = np.diff(t), float(np.median(np.diff(t))), []
    if held(u) and u.any():
        for k in np.flatnonzero(np.diff(u) != 0):
            # Evenly spaced rows are taken to be written by what holds the input: it changes at the row.
            if np.abs(gap[max(k - 1, 0) : k + 2] - dt).max() > EVEN * dt:
                inside = sum((middle + s * step >= t[k]) & (middle + s * step < t[k + 1]) for s in SPREAD) / len(SPREAD)
                out.append((u[k + 1] - u[k]) * inside)
    return np.array(out).reshape(len(out), len(middle))


# A velocity step at time k h stands for the input from (k - 1/2) h to (k + 1/2) h: positions are then second-order
# exact. Taking the input at k h instead is the half-sample shift that reads as a false friction.
SPREAD = (-0.375, -0.125, 0.125, 0.375)


def _input_at(t: np.ndarray, u: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The input between samples, at times ``middle``."""
    before = np.clip(np.searchsorted(t, middle, side="right") - 1, 0, len(t) - 1)
    after = np.minimum(before + 1, len(t) - 1)
    torque = u[before].copy()
    if not held(u):
        free = (u[after] == 0) & (u[before] != 0)
        share = np.clip((middle - t[before]) / np.maximum(t[after] - t[before], 1e-12), 0, 1)
        torque = np.where(free, u[before], u[before] + share * (u[after] - u[before]))
    return torque


def windows(episode: Episode, count: int) -> list[Episode]:
    """Cut an episode into at most ``count`` pieces of 25 samples or more."""
    n = len(episode.t)
    edges = np.linspace(0, n, max(1, min(count, n // 25)) + 1).astype(int)
    out = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        old = episode.log
        extra = {k: getattr(old, k)[a:b] for k in ("torque", "force", "point", "markers")
                 if getattr(old, k) is not None}  # fmt: skip
        piece = replace(episode, log=JointLog(old.name, old.time[a:b], old.q[a:b], **extra),
                        t=episode.t[a:b] - episode.t[a],
                        **{k: getattr(episode, k)[a:b] for k in ("q", "v", "a", "u")})  # fmt: skip
        out.append(_on_grid(piece, episode.step))
    return out


def smooth(t: np.ndarray, q: np.ndarray, half: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local cubic fits over 2 half + 1 samples: q, velocity, acceleration, each (N,); times may be uneven."""
    n = len(t)
    half = min(half, (n - 1) // 2)
    start = np.clip(np.arange(n) - half, 0, n - 2 * half - 1)
    index = start[:, None] + np.arange(2 * half + 1)
    x = t[index] - t[:, None]
    scale = np.abs(x).max(axis=1, keepdims=True)
    basis = (x / scale)[..., None] ** np.arange(4)
    gram = np.swapaxes(basis, 1, 2) @ basis
    c = np.linalg.solve(gram, np.swapaxes(basis, 1, 2) @ q[index][..., None])
    return c[:, 0, 0], c[:, 1, 0] / scale[:, 0], 2 * c[:, 2, 0] / scale[:, 0] ** 2


@dataclass(frozen=True)
class Frame:
    """Where the motion lies: (low, high) in q and in velocity."""

    q: tuple[float, float]
    v: tuple[float, float]

    @property
    def middle(self) -> float:
        return 0.5 * (self.q[0] + self.q[1])

    @property
    def row(self) -> np.ndarray:
        return np.array([*self.q, *self.v, self.middle])


def row_of(terms: dict[str, float]) -> np.ndarray:
    """Terms by name as a row for the kernel."""
    out = np.zeros(len(TERMS))
    for name, value in terms.items():
        out[kernel.INDEX[name]] = value
    return out


def readings(plant: Plant, frame: Frame, episode: Episode, rows: np.ndarray, local: np.ndarray,
             splines: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
    """What the sensor would show at the episode's samples, (B, N).

    Args:
        rows: (B, terms) in the order of :data:`TERMS`.  local: (B, 2 + M) as :attr:`Episode.start`.
        splines: (B, 2 KNOTS) torques at knots over q, then over velocity; None for none.
    """
    rows, local = np.atleast_2d(rows), np.atleast_2d(local)
    numbers, table = plant.row()
    out = np.empty((len(rows), len(episode.t)))
    which = np.zeros(len(rows), np.int64)
    torques = episode.torque[None]
    if len(episode.edges):
        shifts, which = np.unique(local[:, 2:], axis=0, return_inverse=True)
        torques = episode.torque + shifts @ episode.edges
        which = which.reshape(-1)
    if splines is None:
        splines = np.zeros((len(rows), 0))
    kernel.columns(rows, numbers, table, frame.row, splines, torques, which, episode.step,
                   np.ascontiguousarray(local[:, 0]), np.ascontiguousarray(local[:, 1]), episode.t, out)  # fmt: skip
    return out


def needed(plant: Plant, frame: Frame, episode: Episode, terms: np.ndarray, spline: np.ndarray | None = None
           ) -> np.ndarray:  # fmt: skip
    """The input torque that the episode's smoothed motion takes, (N,)."""
    numbers, table = plant.row()
    out = np.empty(len(episode.t))
    q = (episode.q - terms[kernel.BIAS]) / (1 + terms[kernel.GAIN])
    kernel.needed(terms, numbers, table, frame.row, np.zeros(0) if spline is None else spline, q, episode.v,
                  episode.a, out)  # fmt: skip
    return out


def mujoco_rollouts(model: mujoco.MjModel, episode: Episode, starts: Sequence[np.ndarray]
                    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """States of a model from :func:`diagnose.plant.isolated` by ``mj_step``, from each start as :attr:`Episode.start`.

    The input acts at the model's own time step. States are those before each step, at the time they belong to.

    Returns:
        positions and velocities on the model's own grid, (S, K + 1) each.
    """
    from mujoco import rollout

    h = model.opt.timestep
    count = int(np.ceil(episode.t[-1] / h)) + 1
    grid = np.arange(count) * h
    inputs = sum(_input_at(episode.t, episode.u, grid + s * h) for s in SPREAD) / len(SPREAD)
    edges = _edges(episode.t, episode.u, grid, h)
    driven = np.array([inputs + x[2:] @ edges for x in starts])
    data = mujoco.MjData(model)
    first = []
    for start in starts:
        mujoco.mj_resetData(model, data)
        data.qpos[0], data.qvel[0] = start[:2]
        state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        first.append(state)
    states, _ = rollout.rollout(model, data, np.array(first), driven[..., None],
                                control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED))  # fmt: skip
    path = np.concatenate([np.array(first)[:, None], states], axis=1)
    return path[:, :, 1], path[:, :, 1 + model.nq]


def shown(plant: Plant, frame: Frame, terms: dict[str, float], q: np.ndarray, v: np.ndarray, t: np.ndarray, step: float
          ) -> np.ndarray:  # fmt: skip
    """What the sensor shows at times t (N,) of states q, v (K + 1,) on a grid."""
    out = np.empty(len(t))
    kernel.read(row_of(terms), frame.row, q, v, t, step, out)
    return out
