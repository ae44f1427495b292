"""Fitting sets of causes to episodes: bounded Gauss-Newton on whitened residuals.

Unknown beside the causes' parameters are things of each episode alone: its initial position and velocity and, where
rows are uneven, when between two rows a held input changed. They are eliminated episode by episode.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from diagnose.causes import CAUSES, Motion, Parameter
from diagnose.kernel import INDEX, KNOTS, TERMS
from diagnose.noise import Noise
from diagnose.plant import Plant
from diagnose.simulate import Episode, needed, readings

EDGE_WEIGHT = 12.0**0.5  # 1 / the standard deviation of a change that may lie anywhere between two rows
ENOUGH = 0.02  # of chi-squared: smaller gains end a fit


@dataclass(frozen=True)
class Problem:
    """Episodes to explain.

    Attributes:
        plant: the nominal joint.  episodes: what is fitted.  motion: the pooled motion of the fitted episodes.
        driven: True if the motion is imposed so slowly that inertia hardly matters; then the measured torque is
            compared at the measured motion instead of the position under the measured torque.
    """

    plant: Plant
    episodes: list[Episode]
    motion: Motion
    driven: bool

    def on(self, episodes: list[Episode]) -> Problem:
        return replace(self, episodes=episodes)

    def stepped(self, most: float) -> Problem:
        """With steps of at most so many seconds."""
        return self if self.driven else self.on([e.stepped(most) for e in self.episodes])

    def moved(self, local: list[np.ndarray], old: Problem) -> list[np.ndarray]:
        """What belongs to each episode, from the same episodes in other steps: velocities are half a step early."""
        out = [x.copy() for x in local]
        for x, a, b in zip(out, old.episodes, self.episodes, strict=True):
            x[1] += 0.5 * (a.step - b.step) * a.a[0]
        return out

    @property
    def measured(self) -> list[np.ndarray]:
        return [e.u if self.driven else e.log.q for e in self.episodes]

    def predict(self, k: int, rows: np.ndarray, local: np.ndarray, splines: np.ndarray | None = None) -> np.ndarray:
        """What log k would show under rows (B, terms), local (B, L): (B, N)."""
        e = self.episodes[k]
        if not self.driven:
            return readings(self.plant, self.motion.frame, e, rows, local, splines)
        return np.array([needed(self.plant, self.motion.frame, e, row, None if splines is None else splines[i])
                         for i, row in enumerate(rows)])  # fmt: skip


@dataclass(frozen=True)
class Candidate:
    """A set of causes with values theta (P,) in the order of :meth:`parameters`; spline: (2 KNOTS,) free torques."""

    causes: tuple[str, ...]
    theta: np.ndarray
    spline: np.ndarray | None = None

    def parameters(self) -> list[Parameter]:
        return [p for name in self.causes for p in CAUSES[name].parameters]


@dataclass
class Fit:
    """A candidate at its optimum.

    Attributes:
        candidate: causes and values.  local: what is unknown of each episode, a list of (2 + M,).
        residuals: measured minus predicted, a list of (N,).
        chi2: of the whitened residuals (and the edges' prior).  n: number of residuals.
        cov: (P, P) covariance of theta.
    """

    candidate: Candidate
    local: list[np.ndarray]
    residuals: list[np.ndarray]
    chi2: float
    n: int
    cov: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def causes(self) -> tuple[str, ...]:
        return self.candidate.causes

    @property
    def rmse(self) -> float:
        return float(np.sqrt(sum(float(r @ r) for r in self.residuals) / self.n))

    @property
    def nats(self) -> float:
        """Half the Bayesian criterion under the noise of the fit; smaller is better."""
        return 0.5 * self.chi2 + 0.5 * len(self.candidate.theta) * float(np.log(self.n))

    def terms(self) -> dict[str, float]:
        return {p.term: float(v) for p, v in zip(self.candidate.parameters(), self.candidate.theta, strict=True)}

    def std(self) -> dict[str, float]:
        return {p.term: float(np.sqrt(max(self.cov[i, i], 0)))
                for i, p in enumerate(self.candidate.parameters())}  # fmt: skip

    def z(self, name: str) -> float:
        """How many standard deviations the cause's decisive parameters are away, jointly, from not being there."""
        names = [p.term for p in self.candidate.parameters()]
        index = [names.index(t) for t in CAUSES[name].decisive]
        block = self.cov[np.ix_(index, index)]
        value = self.candidate.theta[index]
        if not np.isfinite(block).all() or np.any(np.diag(block) <= 0):
            return 0.0
        return float(np.sqrt(max(value @ np.linalg.solve(block + 1e-12 * np.diag(np.diag(block)), value), 0.0)))


def scales(parameters: list[Parameter], motion: Motion) -> np.ndarray:
    return np.array([p.scale(motion) for p in parameters])


def bounds(parameters: list[Parameter], motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    lo, hi = np.array([p.bounds(motion) for p in parameters], float).reshape(-1, 2).T
    return lo, hi


@dataclass
class Linear:
    """A candidate's neighbourhood, whitened and free of what belongs to each episode alone.

    Attributes:
        r: residuals, list of (N,).  w: whitened and projected, one (sum N,) vector.  J: (sum N, P).
        chi2: of the whitened residuals before projection.
        back: per episode (Q, R, whitened residual, whitened J) to find the local unknowns' step.
    """

    r: list[np.ndarray]
    w: np.ndarray
    J: np.ndarray
    chi2: float
    back: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]


def rows_of(candidate: Candidate, steps: list[tuple[str, float]], shape: dict[str, float] | None = None) -> np.ndarray:
    """The candidate's row for the kernel, then one with each term moved by its step: (1 + S, terms).

    ``shape``: places and widths of terms that have no strength (yet).
    """
    row = np.zeros(len(TERMS))
    for term, value in (shape or {}).items():
        row[INDEX[term]] = value
    for p, v in zip(candidate.parameters(), candidate.theta, strict=True):
        row[INDEX[p.term]] = v
    rows = np.tile(row, (1 + len(steps), 1))
    for i, (term, step) in enumerate(steps):
        rows[1 + i, INDEX[term]] += step
    return rows


def whole_chi2(problem: Problem, candidate: Candidate, local: list[np.ndarray], noise: Noise
               ) -> tuple[float, list[np.ndarray]]:  # fmt: skip
    """chi-squared and residuals of a candidate as it is."""
    row = rows_of(candidate, [])
    splines = None if candidate.spline is None else candidate.spline[None]
    residuals = [y - problem.predict(k, row, local[k][None], splines)[0] for k, y in enumerate(problem.measured)]
    chi2 = sum(float(np.sum(noise.whiten(r) ** 2)) for r in residuals)
    for x in local:
        chi2 += float(np.sum((EDGE_WEIGHT * (x[2:] - 0.5)) ** 2))
    return chi2, residuals


def linearise(problem: Problem, candidate: Candidate, local: list[np.ndarray], noise: Noise,
              steps: list[tuple[str, float]], knots: float = 0.0, shape: dict[str, float] | None = None,
              residuals: list[np.ndarray] | None = None) -> Linear:  # fmt: skip
    """Residuals and their derivatives by the terms of ``steps`` (per step), and by the spline's knots if ``knots``.

    ``residuals``: to take in place of the candidate's own (from shorter steps).
    """
    rows = rows_of(candidate, steps, shape)
    size = len(steps) + (2 * KNOTS if knots else 0)
    width = 0.05 * problem.motion.span * 1e-3, 0.05 * problem.motion.speed * 1e-3
    all_r, all_w, all_J, back, chi2 = [], [], [], [], 0.0
    for k, y in enumerate(problem.measured):
        own = local[k]
        n_own = 0 if problem.driven else len(own)
        total = np.concatenate([rows, np.tile(rows[:1], (size - len(steps) + n_own, 1))])
        locals_ = np.tile(own, (len(total), 1))
        eps = np.array([*width, *([0.25] * (len(own) - 2))])[:n_own]
        for i in range(n_own):
            locals_[1 + size + i, i] += eps[i]
        splines = None
        if candidate.spline is not None:
            splines = np.tile(candidate.spline, (len(total), 1))
            if knots:
                splines[1 + len(steps) : 1 + size] += knots * np.eye(2 * KNOTS)
        out = problem.predict(k, total, locals_, splines)
        r = y - out[0] if residuals is None else residuals[k]
        D = noise.whiten(np.concatenate([r[None], out[1:] - out[0]]).T)
        w, J, L = D[:, 0], D[:, 1 : 1 + size], D[:, 1 + size :] / eps if n_own else D[:, :0]
        if n_own > 2:  # rows of the edges' prior
            prior = np.zeros((n_own - 2, n_own))
            prior[:, 2:] = EDGE_WEIGHT * np.eye(n_own - 2)
            w = np.concatenate([w, EDGE_WEIGHT * (0.5 - own[2:])])
            J = np.concatenate([J, np.zeros((n_own - 2, size))])
            L = np.concatenate([L, prior])
        chi2 += float(w @ w)
        Q, R = np.linalg.qr(L)
        all_r.append(r)
        all_w.append(w - Q @ (Q.T @ w))
        all_J.append(J - Q @ (Q.T @ J))
        back.append((Q, R, w, J))
    return Linear(all_r, np.concatenate(all_w), np.concatenate(all_J), chi2, back)


def fit(problem: Problem, candidate: Candidate, noise: Noise, iterations: int = 12,
        local: list[np.ndarray] | None = None, fixed: bool = False, spline: bool = False) -> Fit:  # fmt: skip
    """Fit a candidate under a given noise.

    Args:
        local: starts of what belongs to each episode alone.
        fixed: leave theta as it is and fit the episodes' own unknowns only (held-out episodes).
        spline: fit free torques over position and velocity too.
    """
    m = problem.motion
    parameters = candidate.parameters()
    if local is None:
        local = [e.start for e in problem.episodes]
    lo, hi = bounds(parameters, m)
    unit = scales(parameters, m)
    if spline and candidate.spline is None:
        candidate = replace(candidate, spline=np.zeros(2 * KNOTS))
    knots = 1e-3 * m.torque if spline else 0.0
    theta = np.clip(candidate.theta, lo, hi)
    candidate = replace(candidate, theta=theta)
    P = 0 if fixed else len(theta)
    damp = 1e-6
    now: Linear | None = None
    held = np.zeros(P, bool)
    for _ in range(iterations + 1):
        if now is None:
            step = np.where(candidate.theta[:P] + 1e-4 * unit[:P] <= hi[:P], 1e-4, -1e-4) * unit[:P]
            now = linearise(problem, candidate, local, noise,
                            [(p.term, float(s)) for p, s in zip(parameters[:P], step, strict=True)], knots)  # fmt: skip
            scale = np.concatenate([step, np.full(now.J.shape[1] - P, knots)])
            J = now.J * (np.concatenate([unit[:P], np.full(len(scale) - P, m.torque)]) / scale)
            g, H = J.T @ now.w, J.T @ J
            if spline:  # the two splines share a constant, and a knot that the motion never visits knows nothing
                H[P:, P:] += 1e-4 * np.trace(H[P:, P:]) / (2 * KNOTS) * np.eye(2 * KNOTS)
            chi2 = now.chi2
        free = np.ones(len(g), bool)
        held = ((candidate.theta[:P] <= lo[:P]) & (g[:P] < 0)) | ((candidate.theta[:P] >= hi[:P]) & (g[:P] > 0))
        free[:P] = ~held
        move = np.zeros(len(g))
        if free.any():
            A = H[np.ix_(free, free)]
            d = np.diag(A)
            try:
                move[free] = np.linalg.solve(A + np.diag(damp * d + 1e-12 * d.max() + 1e-300), g[free])
            except np.linalg.LinAlgError:
                break
        trial = np.clip(candidate.theta[:P] + unit[:P] * np.clip(move[:P], -20, 20), lo[:P], hi[:P])
        move[:P] = (trial - candidate.theta[:P]) / unit[:P]
        turned = move * np.concatenate([unit[:P], np.full(len(g) - P, m.torque)]) / scale
        next_local = []
        for own, (Q, R, w, jac) in zip(local, now.back, strict=True):
            if problem.driven:
                next_local.append(own)
                continue
            delta = np.linalg.lstsq(R, Q.T @ (w - jac @ turned), rcond=1e-12)[0]
            next_local.append(own + delta / (1.0 if damp < 1e-3 else 1.0 + damp))
        other = replace(candidate, theta=np.concatenate([trial, candidate.theta[P:]]))
        if spline:
            other = replace(other, spline=candidate.spline + m.torque * move[P:])
        trial_chi2, _ = whole_chi2(problem, other, next_local, noise)
        if trial_chi2 < chi2:
            gained = chi2 - trial_chi2
            candidate, local, damp, now = other, next_local, max(damp / 10, 1e-9), None
            if gained < ENOUGH + 1e-6 * chi2:
                break
        else:
            if trial_chi2 - chi2 < ENOUGH or damp > 1e4:
                break
            damp = max(10 * damp, 1e-4)
    if now is None:
        step = np.where(candidate.theta[:P] + 1e-4 * unit[:P] <= hi[:P], 1e-4, -1e-4) * unit[:P]
        now = linearise(problem, candidate, local, noise,
                        [(p.term, float(s)) for p, s in zip(parameters[:P], step, strict=True)])  # fmt: skip
        scale = step
    return Fit(candidate, local, now.r, now.chi2, sum(len(r) for r in now.r),
               _covariance(now.J[:, :P] / scale[:P] * unit[:P], unit[:P], held) if P else np.zeros((0, 0)))


def _covariance(J: np.ndarray, unit: np.ndarray, held: np.ndarray) -> np.ndarray:
    """(P, P) from derivatives by parameters in their scales; parameters on a bound have none, blind ones inf."""
    P = len(unit)
    cov = np.zeros((P, P))
    k = np.flatnonzero(~held)
    if len(k):
        A = J[:, k].T @ J[:, k]
        d = np.sqrt(np.maximum(np.diag(A), 1e-300))
        inverse = np.linalg.pinv(A / d / d[:, None], rcond=1e-13, hermitian=True) / d / d[:, None]
        cov[np.ix_(k, k)] = inverse * unit[k] * unit[k][:, None]
        for i in k[np.diag(A) < 1e-12]:
            cov[i, i] = np.inf
    return cov
