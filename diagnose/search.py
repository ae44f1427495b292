"""Which causes? Best subsets of a regression, fits of the best of them, then the question what else would do as well.

A set of causes is preferred by the Bayesian criterion of the whitened residual, all sets under the noise that the best
of them leaves (:mod:`diagnose.noise`). A cause stays only if, without it, both the fitted and the held-out episodes
become clearly less likely and the held-out error clearly larger.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from diagnose.causes import CAUSES, UNNAMED
from diagnose.dominant import CUT, SAME, WITHOUT, Steady, steadiness
from diagnose.dominant import RIVAL as RIVAL_ERROR
from diagnose.fit import Candidate, Fit, Problem, bounds, fit, scales
from diagnose.noise import Excess, Noise, estimate, excess
from diagnose.screen import Guess, Regression, joins, shortlist, tangents
from diagnose.simulate import FINE, SHORT

MOST = 4  # causes in a set
FIT_MARGIN = 8.0  # nats of the Bayesian criterion on the fitted episodes
HELD_MARGIN = 3.0  # nats of log-likelihood on the held-out episodes
HELD_GAIN = 0.98  # of the held-out error without the cause
SURE = 4.0  # standard deviations of a cause's decisive parameters from nothing
RIVAL = 4.0  # nats within which two sets explain equally well
FAR = 8.0  # times what the best regression leaves: sets beyond are not fitted
TOP = 5  # sets of one size that are fitted
ROUNDS = 4  # of looking around the best set
SHARP = ("stribeck_friction", "end_stop", "detent")  # want short steps


@dataclass
class Scored:
    """A fit with its judgement.

    Attributes:
        fit, held: on the two groups of episodes; of the held-out ones only their own unknowns are fitted.
        score: nats of both, smaller is better.
    """

    fit: Fit
    held: Fit

    @property
    def causes(self) -> tuple[str, ...]:
        return self.fit.causes

    @property
    def score(self) -> float:
        return self.fit.nats + 0.5 * self.held.chi2


@dataclass
class Found:
    """What the search says.

    Attributes:
        best: the chosen set (maybe empty).  nominal: the empty set.  noise: of the measurement.
        fitted, held: the two groups of episodes, in the steps that the fits were made with.
        rivals: sets that explain as well.  without: of each chosen cause, the best set's remainder.
        ranking: every set that was fitted under the final noise, best first.
        free: the best set with free torques over q and over velocity beside it; None if nothing asked for it.
        left: why something is left that the library does not explain; empty if nothing is.
        excess: slow residual beyond the noise.
        dominant: causes of the best set that are sure although something is left; see :mod:`diagnose.dominant`.
        steady: of each of the best set's mechanical causes, how steady; empty unless something is left.
    """

    best: Scored
    nominal: Scored
    noise: Noise
    fitted: Problem
    held: Problem
    rivals: list[Scored] = field(default_factory=list)
    without: dict[str, Scored] = field(default_factory=dict)
    ranking: list[Fit] = field(default_factory=list)
    free: Scored | None = None
    left: str = ""
    excess: Excess | None = None
    dominant: tuple[str, ...] = ()
    steady: dict[str, Steady] = field(default_factory=dict)


class Search:
    """One search; remembers every set it fitted.

    Args:
        fitted, held: the problem on the two groups of episodes.
        say: called with a line at each step.
        only: names of the causes to consider; None for all.
    """

    def __init__(self, fitted: Problem, held: Problem, say: Callable[[str], None] = lambda line: None,
                 only: Iterable[str] | None = None) -> None:  # fmt: skip
        self.fitted, self.held, self.say = fitted, held, say
        self.coarse = fitted
        self.smallest = rounding(fitted) / np.sqrt(12)
        self.noise = self.generous = Noise(k=noise_floor(fitted))
        self.done: dict[tuple[str, ...], Fit] = {}
        self.judged: dict[tuple[str, ...], Fit] = {}
        skip = set()
        if not fitted.plant.hinge:
            skip |= {n for n, c in CAUSES.items() if c.hinge_only}
        inputs = np.concatenate([e.u for e in fitted.episodes])
        if fitted.driven or np.ptp(inputs) == 0:
            skip |= {"time_delay"}  # without an input (or with the position as input) a delay is a later start
        if fitted.driven:  # not shown by slow motion
            skip |= {"inertia", "sensor_bias", "sensor_gain", "sensor_distortion", "backlash"}
        self.names = [n for n in CAUSES if n not in skip and (only is None or n in only)]

    def run(self) -> Found:
        self._start()
        best = self._best()
        for _ in range(ROUNDS):
            self._listen(best)
            self._look_around(best)
            now = self._best()
            if now.causes == best.causes:
                break
            self.say(f"{' + '.join(now.causes)}: error {now.rmse:.4g}")
            best = now
        best = self._sure(self._best())
        self._listen(best)
        self._look_around(best, rivals=True)
        scored = self._judge(best.causes)
        found = Found(scored, self._judge(()), self.noise, self.fitted, self.held)
        found.without = {n: self._judge(_less(best.causes, n)) for n in best.causes}
        found.rivals = self._rivals(scored)
        self._left(found)
        if found.left:
            self._dominant(found)
        found.ranking = sorted(self.done.values(), key=lambda f: f.nats)
        return found

    # Fits

    def _fit(self, guesses: Iterable[Guess]) -> None:
        """Fit the sets of some guesses under the present noise; of a set that was fitted, only a better fit counts."""
        known = set(self.done)
        for g in guesses:
            key = _sorted(g.causes)
            if key in known:
                continue
            f = fit(self.fitted, candidate_of(self.fitted, key, g.values), self.noise)
            if key not in self.done or f.chi2 < self.done[key].chi2:
                self.done[key] = f

    def _best(self) -> Fit:
        return min(self.done.values(), key=lambda f: f.nats)

    def _start(self) -> None:
        regression = Regression(self.fitted)
        lists = shortlist(self.fitted, *regression.blocks(self.names), regression.y, MOST, TOP)
        leaves = {k: guesses[0].rss for k, guesses in lists.items() if guesses}
        most = max(leaves)
        size = next(k for k in sorted(leaves) if leaves[k] <= 1.2 * leaves[most])
        self._fit([Guess((), {}, 0.0)])
        for k in range(max(size - 1, 1), min(size + 1, most) + 1):
            guesses = [regression.refine(g) for g in lists.get(k, [])]
            # Far behind in the regression is far behind in the fit; near the noise all are near.
            self._fit(g for g in guesses if g.rss <= FAR * leaves[most])

    def _listen(self, best: Fit) -> None:
        """Take the noise that the best set leaves, and fit again under it what may still compete."""
        old = self.noise
        before, step = self.fitted, SHORT if set(best.causes) & set(SHARP) else FINE
        sharpen = not before.driven and before.episodes[0].step > step + 1e-9
        if sharpen:
            self.fitted, self.held = before.stepped(step), self.held.stepped(step)
            best = fit(self.fitted, best.candidate, self.noise, iterations=6,
                       local=self.fitted.moved(best.local, before))  # fmt: skip
        self.noise, self.generous = estimate(best.residuals, self.smallest)
        if not sharpen and abs(self.noise.std / old.std - 1) < 0.03 and abs(self.noise.phi - old.phi) < 0.02:
            self.noise = old
            return
        fits, self.done, self.judged = list(self.done.values()), {}, {}
        cost = [0.5 * sum(float(np.sum(self.noise.whiten(r) ** 2)) for r in f.residuals)
                + 0.5 * len(f.candidate.theta) * np.log(f.n) for f in fits]  # fmt: skip
        order = np.argsort(cost)
        for i in order:
            f = fits[i]
            if cost[i] > cost[order[0]] + 60 and f.causes:
                continue
            local = self.fitted.moved(f.local, before) if sharpen else f.local
            self.done[f.causes] = fit(self.fitted, f.candidate, self.noise, local=local, iterations=6)

    def _look_around(self, best: Fit, rivals: bool = False) -> None:
        """Fit the sets near the best one that its derivatives say might do as well or better."""
        local = self.coarse.moved(best.local, self.fitted)
        groups, F, y = tangents(self.coarse, best, local, self.noise, self.names)
        most = min(len(best.causes) + (not rivals), MOST)
        lists = shortlist(self.fitted, groups, F, y, max(most, 1), 10)
        here = 0.5 * lists_rss(lists, best.causes, best.chi2)
        wanted = []
        for guesses in lists.values():
            for g in guesses:
                count = sum(len(CAUSES[n].parameters) for n in g.causes)
                gap = 0.5 * g.rss - here + 0.5 * (count - len(best.candidate.theta)) * np.log(best.n)
                if gap < 15.0 and _sorted(g.causes) not in self.done:
                    wanted.append((gap, g))
        wanted.sort(key=lambda w: w[0])
        self._fit(g for _, g in wanted[:8])

    def _judge(self, causes: tuple[str, ...]) -> Scored:
        """A set with its held-out episodes under the present noise."""
        if causes not in self.done:
            best = self._best()
            self.done[causes] = fit(self.fitted, candidate_of(self.fitted, causes, best.terms()), self.noise,
                                    local=best.local)  # fmt: skip
        f = self.done[causes]
        if causes not in self.judged:
            self.judged[causes] = fit(self.held, f.candidate, self.noise, iterations=6, fixed=True)
        return Scored(f, self.judged[causes])

    # Judgements

    def _sure(self, best: Fit) -> Fit:
        """Keep only causes that are clearly there and that improve the held-out episodes beyond the margin."""
        while best.causes:
            full = self._judge(best.causes)
            losses = []
            for name in best.causes:
                without = self._judge(_less(best.causes, name))
                helps = (full.fit.z(name) >= SURE and without.fit.nats - full.fit.nats >= FIT_MARGIN
                         and 0.5 * (without.held.chi2 - full.held.chi2) >= HELD_MARGIN
                         and full.held.rmse <= HELD_GAIN * without.held.rmse)  # fmt: skip
                losses.append((helps, without.score, without))
                for special in CAUSES[name].contains:  # a special case of the cause may do as well
                    plain = self._judge(_sorted((*_less(best.causes, name), special)))
                    losses.append((plain.fit.nats - full.fit.nats >= FIT_MARGIN, plain.score, plain))
            worst = min(losses, key=lambda x: (x[0], x[1]))
            if worst[0]:
                return best
            best = worst[2].fit
        return best

    def _rivals(self, best: Scored) -> list[Scored]:
        """Other sets, no larger, that explain the data as well and do not contain the chosen one."""
        if not best.causes:
            return []
        out = []
        for causes, f in self.done.items():
            if (not causes or len(causes) > len(best.causes) or _contains(causes, best.causes)
                    or len(f.candidate.theta) > len(best.fit.candidate.theta) + 1
                    or f.nats - best.fit.nats > RIVAL + 10.0):  # fmt: skip
                continue
            other = self._judge(causes)
            gap = 0.5 * (f.chi2 - best.fit.chi2 + other.held.chi2 - best.held.chi2)
            if gap < RIVAL and all(f.z(n) > 2 for n in causes):
                out.append(other)
        scaled = self._scaled(best.causes)
        if scaled is not None:
            # From zero a fit does not find its way to another period; from the exact equivalent it is there.
            f = fit(self.fitted, candidate_of(self.fitted, scaled, self._scaled_terms(best)), self.noise,
                    local=best.fit.local)  # fmt: skip
            if scaled not in self.done or f.chi2 < self.done[scaled].chi2:
                self.done[scaled] = f
                self.judged.pop(scaled, None)
            other = self._judge(scaled)
            if 0.5 * (other.fit.chi2 - best.fit.chi2 + other.held.chi2 - best.held.chi2) < RIVAL:
                out.append(other)
        return sorted(out, key=lambda s: s.score)[:8]

    def _scaled(self, causes: tuple[str, ...]) -> tuple[str, ...] | None:
        """Without any logged input a larger inertia is the same as all torques smaller: that set, however large."""
        if "inertia" not in causes or any(e.u.any() for e in self.fitted.episodes):
            return None
        p = self.fitted.plant
        torques = {"gravity_torque": p.hinge and any(p.gravity[:2]), "viscous_damping": p.damping[0] > 0,
                   "coulomb_friction": p.frictionloss > 0, "spring": p.stiffness > 0}  # fmt: skip
        names = {*_less(causes, "inertia"), *(n for n, there in torques.items() if there)}
        return _sorted(n for n in names if not any(n in CAUSES[m].contains for m in names)) if names else None

    def _scaled_terms(self, best: Scored) -> dict[str, float]:
        """The best set's terms with its inertia turned into a factor on all torques, the nominal ones too."""
        p, terms = self.fitted.plant, best.fit.terms()
        ratio = p.inertia / (p.inertia + terms["inertia"])
        strengths = ("damping", "drag", "coulomb", "stiction", "stiffness", "spring_torque", "torque", "gravity_sin",
                     "gravity_cos", "stop_stiffness", "stop_damping", "detent_strength")  # fmt: skip
        out = {k: v * ratio if k in strengths else v for k, v in terms.items() if k != "inertia"}
        own = {"gravity_sin": p.gravity[0], "gravity_cos": p.gravity[1], "damping": p.damping[0],
               "coulomb": p.frictionloss, "stiffness": p.stiffness}  # fmt: skip
        return out | {k: out.get(k, 0.0) + (ratio - 1) * v for k, v in own.items() if v}

    def _left(self, found: Found) -> None:
        """Is anything left? Slow residual beyond the noise says so, and free torques over q and velocity."""
        best = found.best
        if set(best.causes) & set(UNNAMED):
            found.left = "the position reading itself is bent: its scale changes over the range"
        if best.causes and best.held.rmse > 2.5 * best.fit.rmse and best.held.rmse > 3 * self.noise.std:
            found.left = found.left or ("what fits some episodes does not carry over: the held-out error is "
                                        f"{best.held.rmse / best.fit.rmse:.1f} times that of the fitted ones")
        residuals = best.fit.residuals + best.held.residuals
        _, generous = estimate(residuals, self.smallest)
        found.excess = excess(residuals, generous)
        if found.excess.sigmas < 3.0 and not found.left:
            return
        f = fit(self.fitted, best.fit.candidate, self.noise, iterations=6, local=best.fit.local, spline=True)
        h = fit(self.held, f.candidate, self.noise, iterations=6, fixed=True)
        found.free = Scored(f, h)
        ratio = h.rmse / best.held.rmse
        if 0.5 * (best.held.chi2 - h.chi2) > 2 * HELD_MARGIN and ratio < 0.9:
            found.left = found.left or ("free torques over position and velocity cut the held-out error to "
                                        f"{ratio:.2f} of what the named causes leave")  # fmt: skip
        elif found.excess.there:
            found.left = found.left or (f"slow errors of {found.excess.share:.1f} times the noise are left, and no "
                                        "torque that depends on position and velocity explains them")  # fmt: skip

    def _dominant(self, found: Found) -> None:
        """Of a set that leaves something: the causes that are sure, and what would do in their place."""
        best = found.best
        mechanical = tuple(n for n in best.causes if CAUSES[n].edit is not None)
        if best.held.rmse > CUT * found.nominal.held.rmse or not mechanical:
            return
        found.steady = steadiness(mechanical, best.fit.terms(), self.fitted, self.held)
        found.dominant = tuple(n for n in mechanical if found.steady[n].deviation <= SAME
                               and found.without[n].held.rmse >= WITHOUT * best.held.rmse)  # fmt: skip
        found.rivals = []
        for name in found.dominant:
            rest = _less(best.causes, name)
            for other in self.names:
                if (other in UNNAMED or other in best.causes or name in CAUSES[other].contains
                        or not joins(list(rest), other)):  # fmt: skip
                    continue
                scored = self._judge(_sorted((*rest, other)))
                if scored.held.rmse <= RIVAL_ERROR * best.held.rmse or (
                        name == "gravity_torque" and other == "inertia" and self._same_as_inertia(best)):  # fmt: skip
                    found.rivals.append(scored)

    def _same_as_inertia(self, best: Scored) -> bool:
        """True if an added weight is but a multiple of the model's own and no input is logged: then it is one thing
        with less inertia, whatever else is left."""
        terms, (sine, cosine, _) = best.fit.terms(), self.fitted.plant.gravity
        own, added = np.array([sine, cosine]), np.array([terms["gravity_sin"], terms["gravity_cos"]])
        if any(e.u.any() for e in self.fitted.episodes) or not own.any():
            return False
        own /= np.linalg.norm(own)
        return bool(np.linalg.norm(added - (added @ own) * own) < 0.1 * np.linalg.norm(added))


def lists_rss(lists: dict[int, list[Guess]], causes: tuple[str, ...], default: float) -> float:
    """What the regression says that a set leaves."""
    same = [g.rss for g in lists.get(len(causes), []) if set(g.causes) == set(causes)]
    return min(same, default=default)


def noise_floor(problem: Problem) -> float:
    """Standard deviation of what is fast in the measurement, from the data alone: what a local cubic over 13 samples
    leaves, corrected for the freedom of the cubic; never below a rounding step / sqrt(12)."""
    e = np.concatenate([(ep.u if problem.driven else ep.log.q) - _again(ep, problem.driven) for ep in problem.episodes])
    # The centre of a cubic over 13 points takes 0.175 of the noise's variance with it.
    white = 1.4826 * float(np.median(np.abs(e))) / np.sqrt(1 - 0.175)
    return max(white, rounding(problem) / np.sqrt(12), 1e-9 * problem.motion.span, 1e-12)


def rounding(problem: Problem) -> float:
    """The measurement's rounding step, 0 if none shows."""
    y = np.concatenate(problem.measured)
    values = np.unique(y)
    steps = np.diff(values)
    steps = steps[steps > 1e-9]
    return float(np.median(steps)) if len(steps) and len(values) < 0.5 * len(y) else 0.0


def _again(ep, driven: bool) -> np.ndarray:
    if not driven:
        return ep.q
    from diagnose.simulate import smooth

    return smooth(ep.t, ep.u)[0]


def candidate_of(problem: Problem, causes: tuple[str, ...], values: dict[str, float]) -> Candidate:
    """A start; a parameter that must not be negative starts off its bound, else its slope is all the fit sees of it."""
    empty = Candidate(causes, np.zeros(0))
    parameters = empty.parameters()
    lo, hi = bounds(parameters, problem.motion) if parameters else (np.zeros(0), np.zeros(0))
    unit = scales(parameters, problem.motion)
    theta = np.clip([values.get(p.term, 0.0) for p in parameters], lo, hi)
    return replace(empty, theta=np.where(theta <= lo, np.minimum(lo + 0.05 * unit, hi), theta))


def _contains(larger: tuple[str, ...], smaller: tuple[str, ...]) -> bool:
    """True if ``larger`` is ``smaller`` with causes made more general."""
    return all(c in larger or any(c in CAUSES[x].contains for x in larger) for c in smaller)


def _less(causes: tuple[str, ...], name: str) -> tuple[str, ...]:
    return tuple(c for c in causes if c != name)


def _sorted(causes: Iterable[str]) -> tuple[str, ...]:
    order = list(CAUSES)
    return tuple(sorted(causes, key=order.index))


__all__ = ["Found", "Scored", "Search", "candidate_of", "noise_floor", "rounding"]
