"""What a diagnosis is compared with: every number of the joint fitted at once, and a small residual network.

Neither names a cause. Both see the fitted episodes only and are scored on the held-out ones, each with its own
initial states fitted, as the diagnosis is.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from diagnose.plant import isolated
from diagnose.simulate import Episode, mujoco_rollouts, shown

if TYPE_CHECKING:
    from diagnose.diagnosis import Diagnosis
    from diagnose.fit import Problem

HIDDEN = 16  # units of the network's hidden layer
NUMBERS = ("damping", "drag", "friction", "stiffness", "torque", "armature")


def baselines(result: Diagnosis) -> dict[str, float]:
    """Held-out root mean square errors of ``all_parameters`` (mujoco.sysid) and ``residual_network``.

    Raises:
        ValueError: the motion of the logs is imposed; there is nothing to roll out.
    """
    if result.fitted.driven:
        raise ValueError("baselines need logs that move by themselves")
    return {"all_parameters": all_parameters(result.fitted, result.held),
            "residual_network": residual_network(result.fitted, result.held)}  # fmt: skip


def _applied(problem: Problem, x: np.ndarray) -> mujoco.MjModel:
    """The joint with damping, drag, friction, stiffness, constant torque and armature added."""
    model = isolated(problem.plant.spec(), problem.plant.joint)
    model.dof_damping[0] += x[0]
    model.dof_dampingpoly[0, 0] += x[1]
    model.dof_frictionloss[0] += x[2]
    stiffness = model.jnt_stiffness[0]
    total = stiffness + x[3] + 1e-6 * problem.motion.torque
    model.qpos_spring[0] = (stiffness * model.qpos_spring[0] + x[3] * problem.motion.frame.middle + x[4]) / total
    model.jnt_stiffness[0] = total
    model.dof_armature[0] += x[5]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _residuals(problem: Problem, model: mujoco.MjModel, starts: np.ndarray) -> list[np.ndarray]:
    out = []
    for e, start in zip(problem.episodes, starts, strict=True):
        Q, V = mujoco_rollouts(model, e, [np.concatenate([start, np.full(len(e.edges), 0.5)])])
        read = shown(problem.plant, problem.motion.frame, {}, Q[0], V[0], e.t, model.opt.timestep)
        out.append((e.log.q - read) / problem.motion.span)
    return out


def all_parameters(fitted: Problem, held: Problem) -> float:
    """Everything that the joint's MJCF holds as a number, fitted together by ``mujoco.sysid``."""
    # A plain import makes mypy read the package, which then hides the names that MuJoCo's compiled module adds.
    sysid = importlib.import_module("mujoco.sysid")
    m, p = fitted.motion, fitted.plant
    unit = np.array([m.torque / m.speed, m.torque / m.speed**2, m.torque, m.torque / m.span, m.torque, p.inertia])
    starts = np.array([e.start[:2] for e in fitted.episodes])
    low = np.array([-p.damping[0] / unit[0], -1.0, -p.frictionloss / unit[2], -1.0, -3.0, -0.3])
    params = sysid.ParameterDict({
        "joint": sysid.Parameter("joint", np.full(6, 0.01), np.minimum(low, 0.0), np.full(6, 5.0)),
        "starts": sysid.Parameter("starts", np.zeros(starts.size), np.full(starts.size, -2.0),
                                  np.full(starts.size, 2.0))})  # fmt: skip
    widths = np.array([0.05 * m.span, 0.2 * m.speed])

    def residual(x: np.ndarray, _) -> tuple[list[np.ndarray], None, None]:
        model = _applied(fitted, x[:6] * unit)
        return _residuals(fitted, model, starts + x[6:].reshape(-1, 2) * widths), None, None

    best, _ = sysid.optimize(params, residual, optimizer="scipy", verbose=False, max_iters=20)
    model = _applied(fitted, best.as_vector()[:6] * unit)
    return _held_out(held, lambda e, start: _residuals(held.on([e]), model, start[None])[0] * m.span)


def residual_network(fitted: Problem, held: Problem) -> float:
    """One hidden layer over position and velocity, fitted to the torque that the nominal model lacks."""
    import torch

    m, p = fitted.motion, fitted.plant
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(2, HIDDEN), torch.nn.Tanh(), torch.nn.Linear(HIDDEN, 1)).double()
    x = torch.tensor(np.stack([(m.q - m.frame.middle) / m.span, m.v / m.speed], axis=1))
    y = torch.tensor(m.residual / m.torque)[:, None]
    optimizer = torch.optim.LBFGS(net.parameters(), max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = ((net(x) - y) ** 2).mean() + 1e-6 * sum((w * w).sum() for w in net.parameters())
        loss.backward()
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    w1, b1, w2, b2 = (w.detach().numpy() for w in net.parameters())

    def missing(q: float, v: float) -> float:
        h = np.tanh(w1 @ np.array([(q - m.frame.middle) / m.span, v / m.speed]) + b1)
        return float(w2[0] @ h + b2[0]) * m.torque

    def error(e: Episode, start: np.ndarray) -> np.ndarray:
        q, v, far = float(start[0]), float(start[1]), 10 * m.span
        path, speed = np.empty(len(e.torque) + 1), np.empty(len(e.torque) + 1)
        path[0], speed[0] = q, v
        for k, u in enumerate(e.torque):
            # ``missing`` stands for what the nominal model needs less than it has: it is taken away.
            f = u + float(p.static(np.array(q))) - p.damping[0] * v - p.damping[1] * v * abs(v) - missing(q, v)
            v += e.step / p.inertia * f
            v -= np.sign(v) * min(abs(v), e.step / p.inertia * p.frictionloss)
            q = min(max(q + e.step * v, m.frame.middle - far), m.frame.middle + far)
            path[k + 1], speed[k + 1] = q, v
        return e.log.q - shown(p, m.frame, {}, path, speed, e.t, e.step)

    coarse = held.stepped(5e-3)
    return _held_out(coarse, error)


def _held_out(held: Problem, error) -> float:
    """Root mean square over the episodes of error(episode, start (2,)), each start fitted."""
    m = held.motion
    total, count = 0.0, 0
    for e in held.episodes:
        start = e.start[:2].copy()
        r = error(e, start)
        eps = np.array([1e-3 * m.span, 1e-3 * m.speed])
        for _ in range(3):
            J = np.stack([(error(e, start + d) - r) / d.sum() for d in np.diag(eps)], axis=1)
            trial = start - np.linalg.lstsq(J, r, rcond=None)[0]
            s = error(e, trial)
            if s @ s >= 0.999 * (r @ r):
                break
            start, r = trial, s
        total, count = total + float(r @ r), count + len(r)
    return float(np.sqrt(total / count))
