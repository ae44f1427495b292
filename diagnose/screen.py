"""Which sets of causes are worth a fit? Best subsets of a linear regression.

The equation of motion, integrated twice along the measured motion, is linear in nearly everything a cause may change:

    I q(t) = I (a + b t) + double integral of [u + s(q) - d(v) - sum_k theta_k f_k(q, v)] dt dt

with the smoothed motion on the right and a free straight line in every window, so that neither initial states nor
differences of noisy positions are needed. Causes that are not linear in a place or a width bring a list of shapes.
Integral (weak) regression of equations of motion: after Schaeffer and McCalla (2017), Messenger and Bortz (2021).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from diagnose.causes import CAUSES
from diagnose.fit import Fit, Problem, linearise
from diagnose.integrals import freed, once, twice
from diagnose.noise import Noise
from diagnose.simulate import Episode

WINDOW = 1.5  # s
REST, LONG, FEW = 0.03, 0.1, 12  # of the speed: at rest below; s: for so long; rows that a window needs
BEAM = 24  # sets of one size that are extended
SHAPES = 2  # starts of one set (places, widths)


@dataclass(frozen=True)
class Block:
    """Columns that a cause in one shape adds, and the terms that the shape fixes."""

    name: str
    terms: tuple[str, ...]
    shape: dict[str, float]
    columns: np.ndarray


@dataclass(frozen=True)
class Guess:
    """A set of causes with the regression's values. rss: what it leaves."""

    causes: tuple[str, ...]
    values: dict[str, float]
    rss: float


class Regression:
    """The regression of one problem.

    Attributes:
        y: (N,) the measured motion (or torque, if the motion is imposed) that the nominal model leaves, with every
            window's straight line taken out.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        m, plant = problem.motion, problem.plant
        ends = np.cumsum([0] + [len(e.t) for e in problem.episodes])
        self.parts = [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        self.slope = (plant.static(m.q + 1e-5) - plant.static(m.q - 1e-5)) / 2e-5
        self.lines: list[np.ndarray] = []  # an orthonormal basis of each window's lines, in the order of its rows
        self.rest = np.zeros(len(m.q), bool)  # rows that say nothing
        y = np.empty(len(m.q))
        if problem.driven:
            self.y = m.residual
            return
        for e, part in zip(problem.episodes, self.parts, strict=True):
            known = m.residual[part] + plant.inertia * m.a[part] - e.u
            y[part] = e.log.q - (twice(known, e.t) + _driven(e, e.torque)) / plant.inertia
            edges = [_driven(e, p) / plant.inertia for p in e.edges]
            for rows in self._windows(e, part):
                t = e.t[rows] - e.t[rows].mean()
                Q = np.linalg.qr(np.stack([np.ones(len(t)), t, *(x[rows] for x in edges)], axis=1))[0]
                self.lines.append(Q)
        self.y = self._free(y)

    def _windows(self, e: Episode, part: slice) -> list[np.ndarray]:
        """Rows of each window, broken where the part is at rest: what sticks is held by any friction up to its level,
        and the sign of its noisy velocity is no torque's. Its rows are left out."""
        still = np.abs(e.v) < REST * self.problem.motion.speed
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
        dead = np.zeros(len(e.t), bool)
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if e.t[min(b, len(e.t) - 1)] - e.t[a] >= LONG:
                dead[a:b] = True
        moves = np.flatnonzero(np.diff(np.concatenate([[True], dead, [True]]).astype(int)))
        out = []
        for a, b in zip(moves[::2], moves[1::2], strict=True):
            if b - a < FEW:
                dead[a:b] = True
                continue
            out += np.array_split(np.arange(a, b), max(1, int(round((e.t[b - 1] - e.t[a]) / WINDOW))))
        self.rest[part] = dead
        return out

    def _free(self, x: np.ndarray) -> np.ndarray:
        if not self.lines:
            return x.copy()
        table = x if x.ndim == 2 else x[:, None]
        return freed(table, self.rest, *self._windowed).reshape(x.shape)

    @cached_property
    def _windowed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The lines as :func:`diagnose.integrals.freed` takes them."""
        widths = np.array([Q.shape[1] for Q in self.lines])
        starts = np.cumsum([0] + [len(Q) for Q in self.lines])
        basis = np.zeros((starts[-1], widths.max()))
        for a, Q in zip(starts, self.lines, strict=False):
            basis[a : a + len(Q), : Q.shape[1]] = Q
        return starts, widths, basis

    def columns(self, name: str, shape: dict[str, float]) -> tuple[tuple[str, ...], np.ndarray]:
        """Terms that a cause adds linearly in one shape, and their columns (N, terms)."""
        m, plant = self.problem.motion, self.problem.plant
        force = CAUSES[name].features(m, shape)
        reading = CAUSES[name].reading(m, shape)
        terms = tuple(dict.fromkeys((*force, *reading)))
        out = np.zeros((len(m.q), len(terms)))
        for k, term in enumerate(terms):
            f, r = force.get(term), reading.get(term)
            if self.problem.driven:
                out[:, k] = 0.0 if f is None else f
                continue
            for e, part in zip(self.problem.episodes, self.parts, strict=True):
                col = np.zeros(len(e.t))
                if term == "inertia":
                    col = -e.log.q / plant.inertia
                elif f is not None:
                    col = -twice(f[part], e.t) / plant.inertia
                if r is not None:
                    x = r[part]
                    col = col + x - twice(self.slope[part] * x, e.t) / plant.inertia
                    col = col + plant.damping[0] / plant.inertia * once(x, e.t)
                out[part, k] = col
        return terms, self._free(out)

    def blocks(self, names: list[str]) -> tuple[list[Block], np.ndarray]:
        """All causes in all their shapes, and their columns F (N, K)."""
        out, tables, first = [], [], 0
        for name in names:
            for shape in CAUSES[name].shapes(self.problem.motion):
                terms, table = self.columns(name, shape)
                out.append(Block(name, terms, shape, np.arange(first, first + len(terms))))
                tables.append(table)
                first += len(terms)
        return out, np.concatenate(tables, axis=1)

    def refine(self, guess: Guess) -> Guess:
        """Move the places and widths of a guess to where the regression leaves least (all else solved anew)."""
        m = self.problem.motion
        limits = {p.term: (*p.bounds(m), p.scale(m)) for n in guess.causes for p in CAUSES[n].parameters}
        fixed, moving = [], []
        for name in guess.causes:
            shapes = CAUSES[name].shapes(m)
            if shapes[0]:
                moving.append((name, tuple(shapes[0])))
            else:
                fixed.append((name, *self.columns(name, {})))
        if not moving:
            return guess
        keys = [(name, t) for name, terms in moving for t in terms]
        best: list[Guess] = [guess]

        def left(x: np.ndarray) -> float:
            values = {t: float(np.clip(v * limits[t][2], *limits[t][:2])) for (_, t), v in zip(keys, x, strict=True)}
            parts = [*fixed, *((n, *self.columns(n, {t: values[t] for t in ts})) for n, ts in moving)]
            F = np.concatenate([p[2] for p in parts], axis=1)
            size = np.sqrt((F * F).sum(axis=0)) + 1e-300
            c = np.linalg.lstsq(F / size, self.y, rcond=1e-8)[0]
            r = self.y - (F / size) @ c
            rss = float(r @ r)
            if rss < best[0].rss:
                terms = [t for p in parts for t in p[1]]
                best[0] = Guess(guess.causes, {**values, **dict(zip(terms, map(float, c / size), strict=True))}, rss)
            return rss

        start = np.array([guess.values[t] / limits[t][2] for _, t in keys])
        simplex = np.concatenate([start[None], start + 0.3 * np.eye(len(start))])
        minimize(left, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 25 * len(start)})
        return best[0]


def _driven(e: Episode, torque: np.ndarray) -> np.ndarray:
    """Double integral of an input (K,) over the episode's steps, at its samples."""
    place = np.concatenate([[0.0], np.cumsum(np.cumsum(torque)) * e.step**2])
    return np.interp(e.t, np.arange(len(place)) * e.step, place)


def tangents(problem: Problem, base: Fit, local: list[np.ndarray], noise: Noise, names: list[str]
             ) -> tuple[list[Block], np.ndarray, np.ndarray]:  # fmt: skip
    """The same from derivatives of simulated readings about a fit: close to it, exact.

    ``local``: what belongs to each episode, in the steps of ``problem`` (which may be longer than the fit's).
    """
    m = problem.motion
    out: list[Block] = []
    steps: list[tuple[str, float, dict[str, float]]] = []
    mine = base.terms()
    for name in names:
        cause = CAUSES[name]
        terms = [p.term for p in cause.parameters]
        if name in base.causes:  # about its own values, all of its parameters are linear
            shape_list = [{}]
        else:
            shape_list = cause.shapes(m)[:: 1 if len(cause.shapes(m)) < 4 else 3]  # near a fit, fewer will do
        for shape in shape_list:
            block_terms = [t for t in terms if t not in shape]
            first = len(steps)
            for t in block_terms:
                p = next(x for x in cause.parameters if x.term == t)
                lo, hi = p.bounds(m)
                s = 1e-4 * p.scale(m)
                steps.append((t, s if mine.get(t, 0.0) + s <= hi else -s, shape))
            out.append(Block(name, tuple(block_terms), shape, np.arange(first, len(steps))))
    # Terms of a shape (places, widths) only act beside a strength: linearise shape by shape.
    J = None
    for key in dict.fromkeys(tuple(sorted(s[2].items())) for s in steps):
        at = [i for i, s in enumerate(steps) if tuple(sorted(s[2].items())) == key]
        lin = linearise(problem, base.candidate, local, noise, [steps[i][:2] for i in at], shape=dict(key),
                        residuals=base.residuals)
        if J is None:
            J, w = np.zeros((len(lin.w), len(steps))), lin.w
        J[:, at] = lin.J / np.array([steps[i][1] for i in at])
    target = w.copy()
    for b in out:
        if b.name in base.causes:
            target = target + J[:, b.columns] @ np.array([mine[t] for t in b.terms])
    return out, J, target


def shortlist(problem: Problem, groups: list[Block], F: np.ndarray, y: np.ndarray, most: int, top: int
              ) -> dict[int, list[Guess]]:  # fmt: skip
    """The best sets of each size up to ``most`` by what the regression of y (N,) on their columns of F (N, K) leaves.

    Sets come best first, each with up to :data:`SHAPES` starts.
    """
    size = np.sqrt((F * F).sum(axis=0)) + 1e-300
    G = (F / size).T @ (F / size) + 1e-10 * np.eye(F.shape[1])
    c = (F / size).T @ y
    whole = float(y @ y)
    limits: dict[str, tuple[float, float, float]] = {}
    for b in groups:
        for p in CAUSES[b.name].parameters:
            limits.setdefault(p.term, (*p.bounds(problem.motion), p.scale(problem.motion)))

    def solve(members: tuple[int, ...]) -> Guess | None:
        at = np.concatenate([groups[i].columns for i in members])
        theta = np.linalg.solve(G[np.ix_(at, at)], c[at])
        rss = whole - float(c[at] @ theta)
        terms = [t for i in members for t in groups[i].terms]
        values = {t: v for i in members for t, v in groups[i].shape.items()}
        for t, v in zip(terms, theta / size[at], strict=True):
            lo, hi, unit = limits[t]
            if not lo - 0.1 * unit <= v <= hi + 0.1 * unit:
                return None
            values[t] = float(v)
        return Guess(tuple(groups[i].name for i in members), values, max(rss, 0.0))

    out = {0: [Guess((), {}, whole)]}
    beam: list[tuple[int, ...]] = [()]
    by_size: dict[int, list[int]] = {}
    for i, b in enumerate(groups):
        by_size.setdefault(len(b.columns), []).append(i)
    for k in range(1, most + 1):
        scored: dict[tuple[int, ...], float] = {}
        for members in beam:
            at = np.concatenate([groups[i].columns for i in members]) if members else np.zeros(0, int)
            if len(at):
                B = np.linalg.solve(G[np.ix_(at, at)], np.concatenate([G[at], c[at, None]], axis=1))
                left, rest = G - G[:, at] @ B[:, :-1], c - G[:, at] @ B[:, -1]
                base = whole - float(c[at] @ B[:, -1])
            else:
                left, rest, base = G, c, whole
            names = [groups[i].name for i in members]
            for width, which in by_size.items():
                cols = np.array([groups[i].columns for i in which])
                block = left[cols[:, :, None], cols[:, None, :]] + 1e-9 * np.eye(width)
                gain = np.einsum("gi,gi->g", rest[cols], np.linalg.solve(block, rest[cols][..., None])[..., 0])
                for i, drop in zip(which, gain, strict=True):
                    if joins(names, groups[i].name):
                        key = tuple(sorted((*members, i)))
                        scored[key] = base - float(drop)
        good: dict[tuple[str, ...], tuple[tuple[int, ...], Guess]] = {}
        more: list[Guess] = []
        order = sorted(scored, key=lambda key: scored[key])
        for key in order[: 16 * BEAM]:
            names_key = tuple(sorted(groups[i].name for i in key))
            if names_key in good and sum(g.causes == good[names_key][1].causes for g in more) >= SHAPES - 1:
                continue
            guess = solve(key)
            if guess is None:
                continue
            if names_key in good:
                more.append(replace(guess, causes=good[names_key][1].causes))
            else:
                good[names_key] = (key, guess)
            if len(good) >= BEAM:
                break
        beam = [key for key, _ in good.values()]
        first = [g for _, g in good.values()][:top]
        out[k] = [x for g in first for x in (g, *(m for m in more if m.causes == g.causes))]
        if not beam:
            break
    return out


def joins(names: list[str], name: str) -> bool:
    """True if a cause may stand beside others: not twice, not beside what contains it or what it contains."""
    return not any(n == name or name in CAUSES[n].contains or n in CAUSES[name].contains for n in names)
