"""Fitting sets of causes to episodes: bounded Gauss-Newton, many candidates in one batch of rollouts.

Unknown beside the causes' parameters are each episode's initial position and velocity. A fit first minimises plain
squared residuals, then residuals whitened by an autoregressive model of its own residual, so that correlated noise is
an explanation that competes with every cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from diagnose.causes import CAUSES, Motion, Parameter
from diagnose.plant import Plant
from diagnose.simulate import KNOTS, Episode, Job, extra_torque, hats, rollouts, windows

ORDER = 3  # of the noise's autoregression


@dataclass(frozen=True)
class Problem:
    """Episodes to explain.

    Attributes:
        plant: the nominal joint.  episodes: what is fitted.  motion: their pooled motion.
        driven: True if the motion is imposed so slowly that inertia hardly matters; then the measured torque is
            compared at the measured motion instead of the position under the measured torque.
    """

    plant: Plant
    episodes: list[Episode]
    motion: Motion
    driven: bool

    def on(self, episodes: list[Episode]) -> Problem:
        return replace(self, episodes=episodes)

    @property
    def measured(self) -> list[np.ndarray]:
        return [e.u if self.driven else e.log.q for e in self.episodes]


@dataclass(frozen=True)
class Candidate:
    """A set of causes with a start: theta (P,) in the order of :meth:`parameters`; splines (free terms) last."""

    causes: tuple[str, ...]
    theta: np.ndarray
    spline: bool = False

    def parameters(self) -> list[Parameter]:
        return [p for name in self.causes for p in CAUSES[name].parameters]


@dataclass
class Fit:
    """A candidate at its optimum.

    Attributes:
        candidate: causes and values.  initial: (E, 2) q0, v0 of each episode (zeros if driven).
        residuals: measured minus predicted, a list of (N,).  rss, n: their squared sum and count.
        phi: (ORDER,) autoregression of the residual.  innovation: its standard deviation.
        loglik: Gaussian, of the whitened residuals.  cov: (P, P) covariance of theta.
    """

    candidate: Candidate
    initial: np.ndarray
    residuals: list[np.ndarray]
    rss: float
    n: int
    phi: np.ndarray = field(default_factory=lambda: np.zeros(ORDER))
    innovation: float = 1.0
    loglik: float = -np.inf
    cov: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def causes(self) -> tuple[str, ...]:
        return self.candidate.causes

    @property
    def rmse(self) -> float:
        return float(np.sqrt(self.rss / self.n))

    def bic(self) -> float:
        """Half the Bayesian criterion, nats; smaller is better."""
        return -self.loglik + 0.5 * len(self.candidate.theta) * np.log(self.n)

    def terms(self) -> dict[str, float]:
        return {p.term: float(v) for p, v in zip(self.candidate.parameters(), self.candidate.theta, strict=False)}

    def std(self) -> dict[str, float]:
        return {p.term: float(np.sqrt(max(self.cov[i, i], 0)))
                for i, p in enumerate(self.candidate.parameters())}  # fmt: skip

    def z(self, name: str) -> float:
        """How many standard deviations the cause is away from not being there (its best decisive parameter).

        Friction at its lower bound is not there; a correlated pair counts by its joint distance.
        """
        names = [p.term for p in self.candidate.parameters()]
        index = [names.index(t) for t in CAUSES[name].decisive]
        block = self.cov[np.ix_(index, index)]
        value = self.candidate.theta[index]
        if not np.isfinite(block).all() or np.any(np.diag(block) <= 0):
            return 0.0
        return float(np.sqrt(max(value @ np.linalg.solve(block + 1e-12 * np.diag(np.diag(block)), value), 0.0)))


def predict(problem: Problem, columns: Sequence[tuple[dict[str, float], int, float, float, np.ndarray | None]]
            ) -> list[np.ndarray]:  # fmt: skip
    """What the log would show; one (N,) a column (terms, episode, q0, v0, spline (2 KNOTS,) or None)."""
    p, frame = problem.plant, problem.motion.frame
    if not problem.driven:
        jobs = [Job(t, e, q, v, None if s is None else s[:KNOTS], None if s is None else s[KNOTS:])
                for t, e, q, v, s in columns]  # fmt: skip
        return rollouts(p, problem.episodes, jobs, frame)
    out = []
    b1, b2, b3 = p.damping
    for t, e, _, _, s in columns:
        ep = problem.episodes[e]
        q, v = (ep.q - t.get("bias", 0.0)) / (1 + t.get("gain", 0.0)), ep.v
        speed = np.abs(v)
        rub = p.frictionloss + t.get("coulomb", 0.0)
        if "stiction" in t:
            rub = rub + t["stiction"] * np.exp(-np.minimum((v / t["stribeck_velocity"]) ** 2, 80))
        need = (p.inertia + t.get("inertia", 0.0)) * ep.a - p.static(q) + rub * np.sign(v) + b3 * v**3
        need = need + (b1 + t.get("damping", 0.0)) * v + (b2 + t.get("drag", 0.0)) * v * speed
        need = need - extra_torque({k: np.asarray(x) for k, x in t.items()}, q, v, frame)
        if s is not None:
            need = need - hats(q, *frame.q, np.broadcast_to(s[:KNOTS], (len(q), KNOTS)))
            need = need - hats(v, *frame.v, np.broadcast_to(s[KNOTS:], (len(q), KNOTS)))
        out.append(need)
    return out


def whiten(x: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Innovations of x (N, ...) along its first axis, (N - ORDER, ...)."""
    out = x[ORDER:].copy()
    for k, f in enumerate(phi, 1):
        out -= f * x[ORDER - k : len(x) - k]
    return out


def autoregression(residuals: list[np.ndarray]) -> np.ndarray:
    """(ORDER,) least-squares autoregression pooled over episodes."""
    lagged = np.concatenate([np.stack([r[ORDER - k : len(r) - k] for k in range(1, ORDER + 1)], 1) for r in residuals])
    now = np.concatenate([r[ORDER:] for r in residuals])
    gram = lagged.T @ lagged
    return np.linalg.solve(gram + 1e-9 * (np.trace(gram) / ORDER + 1e-300) * np.eye(ORDER), lagged.T @ now)


def scales(candidate: Candidate, motion: Motion) -> np.ndarray:
    s = [p.scale(motion) for p in candidate.parameters()]
    return np.array(s + [motion.torque] * (2 * KNOTS if candidate.spline else 0))


def bounds(candidate: Candidate, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    b = [p.bounds(motion) for p in candidate.parameters()]
    b += [(-5 * motion.largest, 5 * motion.largest)] * (2 * KNOTS if candidate.spline else 0)
    lo, hi = np.array(b, float).reshape(-1, 2).T
    return lo, hi


class _State:
    """One candidate on its way: unknowns x = theta in scales, then q0, v0 of each episode."""

    def __init__(self, problem: Problem, candidate: Candidate, initial: np.ndarray | None) -> None:
        self.candidate = candidate
        self.p = len(candidate.theta)
        m = problem.motion
        n = 0 if problem.driven else len(problem.episodes)
        start = np.array([[e.q0, e.v0] for e in problem.episodes[:n]]).reshape(n, 2) if initial is None else initial
        self.unit = np.concatenate([scales(candidate, m), np.tile([0.05 * m.span, 0.05 * m.speed], n)])
        lo, hi = bounds(candidate, m)
        self.low = np.concatenate([lo, np.full(2 * n, -np.inf)]) / self.unit
        self.high = np.concatenate([hi, np.full(2 * n, np.inf)]) / self.unit
        self.x = np.clip(np.concatenate([candidate.theta, start.ravel()]) / self.unit, self.low, self.high)
        self.trial = self.x
        self.damp, self.cost, self.done, self.stale = 1e-3, np.inf, False, 0
        self.r: list[np.ndarray] = []
        self.J: list[np.ndarray] = []

    def columns(self, episodes: int, driven: bool, fixed: bool) -> list[tuple]:
        out = []
        names = [p.term for p in self.candidate.parameters()]
        for e in range(episodes):
            moves: list[int] = [-1] + ([] if fixed else list(range(self.p)))
            if not driven:
                moves += [self.p + 2 * e, self.p + 2 * e + 1]
            for k in moves:
                x = self.trial.copy()
                if k >= 0:
                    x[k] += self.eps(k)
                y = x * self.unit
                q0, v0 = (0.0, 0.0) if driven else y[self.p + 2 * e : self.p + 2 * e + 2]
                spline = y[len(names) : self.p] if self.candidate.spline else None
                out.append((dict(zip(names, y[: len(names)], strict=True)), e, q0, v0, spline))
        return out

    def eps(self, k: int) -> float:
        """A finite step away from the nearer bound."""
        return 1e-4 if self.trial[k] + 1e-4 <= self.high[k] else -1e-4


def fit_many(problem: Problem, candidates: Sequence[Candidate], iterations: int = 9, whitened: int = 4,
             initial: Sequence[np.ndarray | None] | None = None, fixed: bool = False,
             phi: np.ndarray | None = None, pieces: int = 0, keep: int | None = None) -> list[Fit]:  # fmt: skip
    """Fit all candidates together.

    Args:
        pieces: first fit each episode in so many short windows (0: do not), where there are no false minima.
        keep: go on with so many of them, those with the smallest error over the windows; the rest gets no Fit.
        iterations: of plain least squares.  whitened: of whitened least squares after that (0: none).
        initial: starts of the initial states, (E, 2) each.
        fixed: leave theta as it is and fit the initial states only (held-out episodes).
        phi: noise model to take instead of the residual's own.
    """
    if pieces and not problem.driven and not fixed:
        cut = [windows(e, pieces) for e in problem.episodes]
        first = np.cumsum([0] + [len(c) for c in cut])[:-1]
        short = problem.on([w for c in cut for w in c])
        states = [_State(short, c, None) for c in candidates]
        _minimise(short, states, 8, None, False)
        if keep is not None and len(states) > keep:
            good = sorted(np.argsort([s.cost for s in states])[:keep])
            candidates, states = [candidates[i] for i in good], [states[i] for i in good]
        ys = [s.x * s.unit for s in states]
        candidates = [replace(c, theta=y[: len(c.theta)]) for c, y in zip(candidates, ys, strict=True)]
        initial = [y[len(c.theta) :].reshape(-1, 2)[first] for c, y in zip(candidates, ys, strict=True)]
    states = [_State(problem, c, None if initial is None else initial[i]) for i, c in enumerate(candidates)]
    _minimise(problem, states, iterations, None, fixed)
    if whitened and phi is None:
        phis = [autoregression(s.r) for s in states]
        _minimise(problem, states, whitened, phis, fixed)
    out = []
    for s in states:
        n_e = 0 if problem.driven else len(problem.episodes)
        y = s.x * s.unit
        f = autoregression(s.r) if phi is None else phi
        w = np.concatenate([whiten(r, f) for r in s.r])
        sigma2 = max(float(np.mean(w * w)), 1e-30)
        J = np.concatenate([whiten(j, f) for j in s.J])
        held = (s.x <= s.low + 1e-9) | (s.x >= s.high - 1e-9)
        free = ~held if not fixed else np.zeros(len(s.x), bool)
        cov = np.zeros((s.p, s.p))
        if free[: s.p].any():
            A = J[:, free].T @ J[:, free] / sigma2
            d = np.sqrt(np.maximum(np.diag(A), 1e-300))
            inverse = np.linalg.pinv(A / d / d[:, None], rcond=1e-13, hermitian=True) / d / d[:, None]
            k = np.flatnonzero(free[: s.p])
            unit = s.unit[k]
            cov[np.ix_(k, k)] = inverse[: len(k), : len(k)] * unit * unit[:, None]
            blind = np.diag(A)[: len(k)] < 1e-12
            for i in k[blind]:
                cov[i, i] = np.inf
        e = np.concatenate(s.r)
        out.append(Fit(replace(s.candidate, theta=y[: s.p]), y[s.p :].reshape(n_e, 2), s.r, float(e @ e), len(e), f,
                       float(np.sqrt(sigma2)), -0.5 * len(w) * (np.log(2 * np.pi * sigma2) + 1), cov))  # fmt: skip
    return out


def _minimise(problem: Problem, states: list[_State], iterations: int, phis: list[np.ndarray] | None,
              fixed: bool) -> None:  # fmt: skip
    measured = problem.measured
    count = len(measured)
    for s in states:
        s.cost, s.done, s.trial, s.damp, s.stale = np.inf, False, s.x, 1e-3, 0
    for step in range(iterations + 1):
        active = [i for i, s in enumerate(states) if not s.done]
        if not active:
            return
        columns, where = [], []
        for i in active:
            c = states[i].columns(count, problem.driven, fixed)
            where.append(len(c))
            columns += c
        predictions = []
        for k in range(0, len(columns), 1500):
            predictions += predict(problem, columns[k : k + 1500])
        at = 0
        for i, n in zip(active, where, strict=True):
            mine = predictions[at : at + n]
            at += n
            _advance(states[i], mine, measured, None if phis is None else phis[i], problem.driven, fixed,
                     step == iterations)  # fmt: skip


def _advance(s: _State, predictions: list[np.ndarray], measured: list[np.ndarray], phi: np.ndarray | None,
             driven: bool, fixed: bool, last: bool) -> None:  # fmt: skip
    """Take or refuse the trial whose rollouts are given, and choose the next one."""
    each = len(predictions) // len(measured)
    r, J = [], []
    shared = 0 if fixed else s.p
    for e, y in enumerate(measured):
        block = predictions[e * each : (e + 1) * each]
        r.append(y - block[0])
        j = np.zeros((len(y), len(s.x)))
        for k in range(shared):
            j[:, k] = (block[1 + k] - block[0]) / s.eps(k)
        if not driven:
            for k in (0, 1):
                j[:, s.p + 2 * e + k] = (block[1 + shared + k] - block[0]) / s.eps(s.p + 2 * e + k)
        J.append(j)
    w = np.concatenate([x if phi is None else whiten(x, phi) for x in r])
    cost = float(w @ w)
    if cost < s.cost:
        gained = s.cost - cost
        s.stale = s.stale + 1 if gained < 1e-5 * cost else 0
        s.x, s.cost, s.r, s.J, s.damp = s.trial, cost, r, J, max(s.damp / 5, 1e-9)
    else:
        s.damp *= 8
        s.stale += s.damp > 1e5
    if s.stale >= 2 or last or len(s.x) == 0:
        s.done = True
        return
    W = np.concatenate([x if phi is None else whiten(x, phi) for x in s.J])
    w = np.concatenate([x if phi is None else whiten(x, phi) for x in s.r])
    g = W.T @ w
    # Unknowns that sit on a bound and want to leave the box stay where they are.
    free = ~(((s.x <= s.low) & (g < 0)) | ((s.x >= s.high) & (g > 0)))
    if fixed:
        free[: s.p] = False
    if not free.any():
        s.done = True
        return
    A = W[:, free].T @ W[:, free]
    d = np.diag(A)
    move = np.zeros(len(s.x))
    try:
        move[free] = np.linalg.solve(A + np.diag(s.damp * (d + 1e-9 * d.max() + 1e-300)), g[free])
    except np.linalg.LinAlgError:
        s.done = True
        return
    s.trial = np.clip(s.x + np.clip(move, -20, 20), s.low, s.high)


def starts(problem: Problem, causes: tuple[str, ...], known: dict[str, float] | None = None, most: int = 3
           ) -> list[Candidate]:  # fmt: skip
    """Starting points of a set of causes: its linear terms regressed on the torque that the nominal model lacks.

    Args:
        known: values to keep for terms that were fitted before.  most: how many starts to return.
    """
    m = problem.motion
    known = known or {}
    shapes: list[dict[str, float]] = [{}]
    for name in causes:
        own = [p.term for p in CAUSES[name].parameters]
        if all(t in known for t in own):
            options: list[dict[str, float]] = [{}]
            shapes = [{**s, **{t: known[t] for t in own}} for s in shapes]
        else:
            options = CAUSES[name].shapes(m)
        shapes = [{**s, **o} for s in shapes for o in options]
    found = []
    for shape in shapes:
        features: dict[str, np.ndarray] = {}
        for name in causes:
            features.update({t: f for t, f in CAUSES[name].features(m, shape).items()})
        if features:
            F = np.stack(list(features.values()), axis=1)
            size = np.abs(F).max(axis=0) + 1e-300
            c, *_ = np.linalg.lstsq(F / size, m.residual, rcond=1e-6)
            left = m.residual - (F / size) @ c
            linear = dict(zip(features, c / size, strict=True))
        else:
            left, linear = m.residual, {}
        values = {**shape, **linear}
        candidate = Candidate(causes, np.zeros(0))
        parameters = candidate.parameters()
        theta = np.array([values.get(p.term, 0.0) for p in parameters])
        lo, hi = bounds(candidate, m)
        unit = scales(candidate, m)
        theta = np.clip(theta, lo, hi)
        # A term that must not be negative starts off its bound, else its slope is all the fit sees of it.
        theta = np.where((theta <= lo) & (lo > -np.inf), np.minimum(lo + 0.05 * unit, hi), theta)
        found.append((float(left @ left), theta))
    found.sort(key=lambda f: f[0])
    return [Candidate(causes, theta) for _, theta in found[:most]]


Progress = Callable[[str], None]
