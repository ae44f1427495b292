"""Which causes? Forward search with backward pruning and swaps, then the question what else would do as well.

A set of causes is preferred by the Bayesian criterion of the whitened residual. A cause stays only if, without it,
both the fitted and the held-out episodes become clearly less likely and its parameters are clearly not zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from diagnose.causes import CAUSES, UNNAMED
from diagnose.fit import Candidate, Fit, Problem, fit_many, starts, whiten
from diagnose.simulate import KNOTS

MOST = 4  # causes in a set
FIT_MARGIN = 8.0  # nats of the Bayesian criterion on the fitted episodes
HELD_MARGIN = 3.0  # nats of log-likelihood on the held-out episodes
HELD_GAIN = 0.98  # of the held-out error without the cause
SURE = 4.0  # standard deviations from nothing
RIVAL = 4.0  # nats within which two sets explain equally well
KEEP = 6  # candidates that go from windows to whole episodes
NOISY = 3.4  # times the floor that fast changes show, is the most that slow noise may add up to
PIECES = 10  # windows of an episode in the first stage of a fit


@dataclass
class Scored:
    """A fit with its judgement.

    Attributes:
        fit, held: on the two groups of episodes; of the held-out ones only the initial states are fitted.
        bic: half the Bayesian criterion on the fitted episodes, nats.
        held_loglik: of the held-out episodes under the fit's noise model.

    Both count an error beyond :data:`NOISY` times the noise floor at a tenth of its samples' worth: an autoregression
    follows any smooth error, and such an error is no noise.
    """

    fit: Fit
    held: Fit
    bic: float
    held_loglik: float

    @property
    def causes(self) -> tuple[str, ...]:
        return self.fit.causes

    @property
    def score(self) -> float:
        """Nats, larger is better."""
        return -self.bic + self.held_loglik


@dataclass
class Found:
    """What the search says.

    Attributes:
        best: the chosen set (maybe empty).  nominal: the empty set.
        rivals: sets that explain as well.  ranking: every set that was tried, best first.
        free: the best set with free torques over q and over velocity beside it.
        unexplained: True if something is left that the library does not explain.
        left: why, in words.
    """

    best: Scored
    nominal: Scored
    rivals: list[Scored] = field(default_factory=list)
    ranking: list[Scored] = field(default_factory=list)
    free: Scored | None = None
    unexplained: bool = False
    left: str = ""


class Search:
    """One search; remembers every set it fitted.

    Args:
        fitted, held: the problem on the two groups of episodes.
        say: called with a line at each step.
    """

    def __init__(self, fitted: Problem, held: Problem, say: Callable[[str], None] = lambda line: None) -> None:
        self.fitted, self.held, self.say = fitted, held, say
        self.floor = noise_floor(fitted)
        self.done: dict[tuple[str, ...], Scored] = {}
        skip = set()
        if not fitted.plant.hinge:
            skip |= {n for n, c in CAUSES.items() if c.hinge_only}
        inputs = np.concatenate([e.u for e in fitted.episodes])
        if fitted.driven or np.ptp(inputs) == 0:
            skip |= {"time_delay"}  # without an input (or with the position as input) a delay is a later start
        if fitted.driven:
            skip |= {"inertia", "sensor_bias", "sensor_gain", "sensor_distortion"}  # not shown by slow motion
        self.names = [n for n in CAUSES if n not in skip]

    def score(self, sets: list[tuple[str, ...]], known: dict[str, float] | None = None, keep: int | None = None
              ) -> list[Scored]:  # fmt: skip
        """Fit the sets that were not fitted yet, all together; with ``keep``, only the most promising starts."""
        sets = [_sorted(s) for s in sets]
        new = [s for s in dict.fromkeys(sets) if s not in self.done]
        candidates = []
        for s in new:
            single = s in ((n,) for n in self.names)
            candidates += starts(self.fitted, s, known, most=2 if single else 1) if s else [Candidate((), np.zeros(0))]
            if known and s:  # the regression knows better than the smaller set what its terms are beside each other
                candidates += starts(self.fitted, s, None, most=1)
        fits = fit_many(self.fitted, candidates, pieces=PIECES, keep=keep)
        best: dict[tuple[str, ...], Fit] = {}
        for f in fits:
            if f.causes not in best or f.bic() + self.gross(f) < best[f.causes].bic() + self.gross(best[f.causes]):
                best[f.causes] = f
        new = [s for s in new if s in best]
        if new:
            chosen = [best[s] for s in new]
            held = fit_many(self.held, [f.candidate for f in chosen], iterations=5, whitened=0, fixed=True,
                            pieces=0)  # fmt: skip
            for s, f, h in zip(new, chosen, held, strict=True):
                self.done[s] = self._scored(f, h)
        return [self.done[s] for s in sets if s in self.done]

    def gross(self, fit: Fit) -> float:
        """Nats that a fit's error costs beyond what can be noise."""
        return 0.1 * fit.n * max(0.0, float(np.log(fit.rmse / (NOISY * self.floor))))

    def _scored(self, fit: Fit, held: Fit) -> Scored:
        return Scored(fit, held, fit.bic() + self.gross(fit), _loglik(held, fit) - self.gross(held))

    def run(self) -> Found:
        nominal = self.score([()])[0]
        current = nominal
        for size in range(1, MOST + 1):
            grown = [s for n in self.names if (s := _with(current.causes, n)) is not None]
            if size == 1:  # hardly anything moves without some friction, and what else is wrong shows only beside it
                grown += [s for rub in ("viscous_damping", "coulomb_friction") for n in self.names
                          if (s := _with((rub,), n)) is not None and len(s) == 2]  # fmt: skip
            known = current.fit.terms()
            trials = self.score(grown, known, keep=KEEP if size > 1 else 2 * KEEP)
            # Far from the noise, what leaves the smallest error comes first; near it, what is likeliest.
            picks = {id(t): t for t in (max(trials, key=lambda t: t.score), min(trials, key=lambda t: t.fit.rss))}
            swapped = [t for p in picks.values() for t in self._swaps(p, grown=size > 1)]
            best = max([*picks.values(), *swapped], key=lambda t: t.score)
            best = self._polish(self._prune(best))
            if current.bic - best.bic < FIT_MARGIN or best.held_loglik - current.held_loglik < HELD_MARGIN:
                break
            self.say(f"{' + '.join(best.causes)}: error {best.fit.rmse:.4g}, held out {best.held.rmse:.4g}")
            if set(best.causes) == set(current.causes):
                break
            current = best
        current = self._sure(current)
        found = Found(current, nominal)
        found.rivals = self._rivals(current)
        found.free, found.unexplained, found.left = self._left(current)
        found.ranking = sorted(self.done.values(), key=lambda s: -s.score)
        return found

    def _swaps(self, base: Scored, grown: bool) -> list[Scored]:
        """The set with each of its causes replaced by each other one."""
        if not grown:
            return []
        sets = []
        for old in base.causes:
            rest = tuple(n for n in base.causes if n != old)
            wider = [_with(rest, n) for n in self.names if n != old]
            sets += [s for s in wider if s is not None and len(s) == len(rest) + 1]
        return self.score(sets, keep=KEEP)

    def _prune(self, best: Scored) -> Scored:
        """Drop causes whose absence the criterion does not mind."""
        while len(best.causes) > 1:
            smaller = self.score([tuple(n for n in best.causes if n != old) for old in best.causes])
            top = max(smaller, key=lambda s: s.score)
            if top.bic - best.bic >= FIT_MARGIN and top.held_loglik <= best.held_loglik - HELD_MARGIN:
                return best
            best = top
        return best

    def _polish(self, best: Scored) -> Scored:
        """Fit the chosen set to the end; the search only goes as far as it needs to compare."""
        if not best.causes:
            return best
        f = fit_many(self.fitted, [best.fit.candidate], iterations=25,
                     initial=[None if self.fitted.driven else best.fit.initial])[0]  # fmt: skip
        h = fit_many(self.held, [f.candidate], iterations=5, whitened=0, fixed=True)[0]
        better = self._scored(f, h)
        if better.score <= best.score:
            return best
        self.done[best.causes] = better
        return better

    def _sure(self, best: Scored) -> Scored:
        """Keep only causes that are clearly not zero and that improve the held-out episodes beyond the margin."""
        while best.causes:
            drop = None
            for name in best.causes:
                without = self.score([tuple(n for n in best.causes if n != name)])[0]
                helps = (without.held_loglik <= best.held_loglik - HELD_MARGIN
                         and without.bic - best.bic >= FIT_MARGIN
                         and best.held.rmse <= HELD_GAIN * without.held.rmse)  # fmt: skip
                if best.fit.z(name) < SURE or not helps:
                    drop = without
                    break
            if drop is None:
                return best
            best = drop
        return best

    def _rivals(self, best: Scored) -> list[Scored]:
        """Other sets, no larger, that explain the data as well and do not contain the chosen one."""
        if not best.causes:
            return []
        if len(best.causes) == 1:  # pairs may have crowded single causes out of the first round
            self.score([(n,) for n in self.names])
        else:
            self._swaps(best, grown=True)
        extra = set(best.causes)
        out = [s for c, s in self.done.items()
               if c and not extra <= set(c) and len(s.fit.candidate.theta) <= len(best.fit.candidate.theta) + 1
               and len(c) <= len(best.causes) and not _contains(c, best.causes)
               and best.score - s.score < RIVAL
               and all(s.fit.z(n) > 2 for n in c)]  # fmt: skip
        return sorted(out, key=lambda s: -s.score)[:8]

    def _left(self, best: Scored) -> tuple[Scored | None, bool, str]:
        """Is anything left? Free torques over q and velocity are given the chance to show it."""
        c = best.fit.candidate
        start = Candidate(c.causes, np.concatenate([c.theta, np.zeros(2 * KNOTS)]), spline=True)
        f = fit_many(self.fitted, [start], initial=[None if self.fitted.driven else best.fit.initial])[0]
        h = fit_many(self.held, [f.candidate], iterations=5, whitened=0, fixed=True)[0]
        free = self._scored(f, h)
        gain = free.held_loglik - best.held_loglik
        ratio = free.held.rmse / best.held.rmse
        if gain > 2 * HELD_MARGIN and ratio < 0.9 and best.bic - free.bic > FIT_MARGIN:
            return free, True, ("free torques over position and velocity cut the held-out error to "
                                f"{ratio:.2f} of what the named causes leave")  # fmt: skip
        if set(best.causes) & set(UNNAMED):
            return free, True, "the position reading itself is bent: its scale changes over the range"
        floor = self.floor
        if best.fit.rmse > NOISY * floor and lasting(best.fit.residuals) > 0.4:
            return free, True, (f"the error left is {best.fit.rmse / floor:.1f} times the noise and smooth, and no "
                                "torque that depends on position and velocity explains it")  # fmt: skip
        return free, False, ""


def noise_floor(problem: Problem) -> float:
    """Standard deviation of the measurement noise, from the data alone: what a local cubic over 13 samples leaves,
    corrected for the freedom of the cubic; never below a rounding step / sqrt(12)."""
    e = np.concatenate([(ep.u if problem.driven else ep.log.q) - _again(ep, problem.driven) for ep in problem.episodes])
    values = np.sort(np.concatenate([np.unique(ep.u if problem.driven else ep.log.q) for ep in problem.episodes]))
    steps = np.diff(values)
    steps = steps[steps > 1e-9]
    rounding = float(np.median(steps)) if len(steps) and len(values) < 0.5 * len(e) else 0.0
    # The centre of a cubic over 13 points takes 4 x 1/13 x 9/4 of the noise's variance with it.
    white = 1.4826 * float(np.median(np.abs(e))) / np.sqrt(1 - 0.175)
    return max(white, rounding / np.sqrt(12), 1e-12)


def _again(ep, driven: bool) -> np.ndarray:
    if not driven:
        return ep.q
    from diagnose.simulate import smooth

    return smooth(ep.t, ep.u)[0]


def lasting(residuals: list[np.ndarray], lag: int = 5) -> float:
    """Correlation of the residual with itself a few samples later; noise has lost most of it by then."""
    pairs = [(r[lag:], r[:-lag]) for r in residuals]
    top = sum(float(a @ b) for a, b in pairs)
    return top / max(sum(0.5 * float(a @ a + b @ b) for a, b in pairs), 1e-300)


def _loglik(held: Fit, fit: Fit) -> float:
    """Of held-out residuals under the noise that the fit found."""
    w = np.concatenate([whiten(r, fit.phi) for r in held.residuals])
    s2 = fit.innovation**2
    return float(-0.5 * len(w) * np.log(2 * np.pi * s2) - 0.5 * (w @ w) / s2)


def _with(causes: tuple[str, ...], name: str) -> tuple[str, ...] | None:
    """The set with one more cause; special cases give way to what contains them; None if nothing changes."""
    if name in causes or any(name in CAUSES[c].contains for c in causes):
        return None
    return _sorted((*[c for c in causes if c not in CAUSES[name].contains], name))


def _contains(larger: tuple[str, ...], smaller: tuple[str, ...]) -> bool:
    """True if ``larger`` is ``smaller`` with causes made more general."""
    return all(c in larger or any(c in CAUSES[x].contains for x in larger) for c in smaller)


def _sorted(causes: tuple[str, ...]) -> tuple[str, ...]:
    order = list(CAUSES)
    return tuple(sorted(causes, key=order.index))
