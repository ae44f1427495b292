"""What the finding is worth: the extended model, its held-out error in MuJoCo, the numbers of the report."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from diagnose.causes import CAUSES, free_torques
from diagnose.fit import Candidate, Problem, fit, linearise
from diagnose.kernel import KNOTS
from diagnose.noise import Noise
from diagnose.plant import Plant, isolated, load_plant
from diagnose.points import Placed, body_points, point_errors
from diagnose.residual import where
from diagnose.search import Found, Scored, noise_floor
from diagnose.simulate import mujoco_rollouts, shown

if TYPE_CHECKING:
    from diagnose.diagnosis import Diagnosis

READING = ("delay", "bias", "gain", "bend2", "bend3", "bend4", "bend5", "play")


def extended(plant: Plant, scored: Scored, problem: Problem) -> mujoco.MjSpec:
    """A spec of the nominal model with the fitted causes (and free torques) edited in.

    Measurement faults leave it as it is.
    """
    spec = plant.spec()
    terms, frame = scored.fit.terms(), problem.motion.frame
    order = sorted(scored.causes, key=lambda n: n == "inertia" and terms.get("inertia", 0) < 0)
    for name in order:
        edit = CAUSES[name].edit
        if edit is not None:
            edit(spec, plant.joint, terms, plant, frame)
    if scored.fit.candidate.spline is not None:
        free_torques.edit(spec, plant.joint, scored.fit.candidate.spline, plant, frame)
    return spec


def errors(plant: Plant, scored: Scored, held: Problem, fitted: Problem) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Held-out residuals with MuJoCo itself in place of the fit's own integrator, and its positions: (N,) each."""
    if held.driven:
        return scored.held.residuals, [e.q for e in held.episodes]
    model = isolated(extended(plant, scored, fitted), plant.joint)
    # The integrator's half-step convention differs from the fit's; its initial states are found anew from the fit's.
    terms = {k: v for k, v in scored.fit.terms().items() if k in READING}
    frame = fitted.motion.frame
    h = model.opt.timestep
    out, states = [], []
    for e, local in zip(held.episodes, scored.held.local, strict=True):
        slopes = linearise(held.on([e]), scored.fit.candidate, [local], Noise(), []).back[0]
        x = local.copy()
        x[1] += 0.5 * (e.step - h) * e.a[0]
        best: np.ndarray | None = None
        for _ in range(3):
            Q, V = mujoco_rollouts(model, e, [x])
            read = e.log.q - shown(plant, frame, terms, Q[0], V[0], e.t, h)
            if best is not None and read @ read >= best @ best:
                break
            done = best is not None and read @ read > 0.999 * (best @ best)
            best, state = read, (Q[0], V[0])
            if done:
                break
            # The fit's integrator says how the initial state moves the readings.
            J = (slopes[0] @ slopes[1])[: len(read), :2]
            x[:2] += np.linalg.lstsq(J, read, rcond=None)[0]
        assert best is not None
        out.append(best)
        states.append(shown(plant, frame, {}, *state, e.t, h))
    return out, states


class Measure:
    """Held-out errors of the nominal and of the extended model; sets ``holds`` of the diagnosis.

    Attributes:
        nominal, extended: residuals of each held-out episode, (N,), in ``unit``: of the joint's position, of the torque
            where the motion is imposed, and of points on the part (root mean square of their coordinates, m) where
            points are logged.
        in_q: the same of the joint's position (or torque), nominal and extended.  floor: the noise, in ``unit``.
        scored: fraction of ``nominal`` that is left, of everything that may be put into the model.
    """

    def __init__(self, result: Diagnosis) -> None:
        found, plant, placed = result.found, result.plant, result.placed
        fitted, held, best = result.fitted, result.held, found.best
        self.unit = plant.torque_unit if fitted.driven else plant.unit
        self.floor = float(noise_floor(held))
        old = plant
        if plant.edit is not None:  # the nominal model has its joint where the file has it
            old = load_plant(plant.path, plant.joint)
            wrong = replace(held, plant=old)
            nothing = fit(wrong, Candidate((), np.zeros(0)), found.noise, fixed=True)
            before = errors(old, Scored(found.nominal.fit, nothing), wrong, replace(fitted, plant=old))
        else:
            before = errors(plant, found.nominal, held, fitted)
        if found.left:  # take into the model what helps held-out episodes
            options = {"nothing": found.nominal} | ({"causes": best} if best.causes else {})
            if found.free is not None and not fitted.driven:
                options["free"] = found.free
            tried = {k: errors(plant, s, held, fitted) for k, s in options.items()}
            result.holds = min(tried, key=lambda k: rms(tried[k][0]))
            after = tried[result.holds]
        else:
            after = errors(plant, best, held, fitted) if best.causes or plant.edit is not None else before
        self.in_q = before[0], after[0]
        self.nominal, self.extended = self.in_q
        if placed is not None and not fitted.driven:
            self.unit = "m"
            self._points(result, old, before[1], after[1])

    def _points(self, result: Diagnosis, old: Plant, before: list[np.ndarray], after: list[np.ndarray]) -> None:
        placed = result.placed
        assert placed is not None
        terms = result.found.best.fit.terms()
        found, fitted, held = placed.found, result.fitted, result.held
        plain = [e.log.q for e in fitted.episodes]
        true = [(q - terms.get("bias", 0.0)) / (1 + terms.get("gain", 0.0)) for q in plain]
        points = body_points(old, found.nominal, fitted.episodes, plain, None)
        self.nominal = point_errors(old, found.nominal, points, held.episodes, before, None)
        second = None
        seen = found.best.second if placed.second is not None else None
        if placed.second is not None:
            plant, search, problem, other = placed.second
            second = errors(plant, search.best, other, problem)[1]
        points = body_points(placed.plant, found.best, fitted.episodes, true, seen)
        self.extended = point_errors(placed.plant, found.best, points, held.episodes, after, second)
        self.floor = found.noise.std


def cause_of(name: str, found: Found, problem: Problem) -> dict:
    """One cause as the contract has it; a spring's torque is counted from the middle of the motion.

    Where something is left, intervals are as wide as the strength differs between parts of the data.
    """
    plant, fit, middle = problem.plant, found.best.fit, problem.motion.frame.middle
    terms, std = fit.terms(), fit.std()
    inertia = "kg m^2" if plant.hinge else "kg"
    unsteady = found.steady[name].deviation if found.left and name in found.steady else 0.0
    parameters = {}
    for p in CAUSES[name].parameters:
        unit = p.unit.format(q=plant.unit, t=plant.torque_unit, i=inertia)
        v, s = terms[p.term], std[p.term]
        half = max(1.96 * (s if np.isfinite(s) else abs(v)), unsteady * abs(v))
        parameters[p.name] = {"value": v, "unit": unit, "ci95": [v - half, v + half]}
    if name == "spring":
        k, at = terms["stiffness"], terms["spring_torque"]
        rest = middle + at / k
        index = [p.term for p in fit.candidate.parameters()].index("stiffness")
        g = np.array([-at / k**2, 1 / k])
        s = float(np.sqrt(max(g @ fit.cov[index : index + 2, index : index + 2] @ g, 0)))
        parameters.pop("torque_at_middle")
        parameters["rest"] = {"value": rest, "unit": plant.unit, "ci95": [rest - 1.96 * s, rest + 1.96 * s]}
    without = found.without[name]
    evidence = {"sentence": CAUSES[name].sentence, "z": fit.z(name), "nats_fit": without.fit.nats - fit.nats,
                "nats_heldout": 0.5 * (without.held.chi2 - found.best.held.chi2),
                "heldout_rmse_without": without.held.rmse}  # fmt: skip
    if name in found.steady:
        evidence["steady"] = {"largest_deviation": found.steady[name].deviation, "where": found.steady[name].where}
    return {"name": name, "parameters": parameters, "evidence": evidence}


def remainder_of(found: Found, fitted: Problem, held: Problem, measure: Measure) -> dict:
    """What is left beside the best set: why it is no noise, where it lives, how large against what is explained."""
    best = found.best
    unit = fitted.plant.torque_unit if fitted.driven else fitted.plant.unit
    explained = np.sqrt(max(found.nominal.held.rmse**2 - best.held.rmse**2, 0.0))
    return {"why": found.left, "where": where(fitted.plant, held.episodes, best.held.residuals, unit),
            "rmse": best.held.rmse, "explained_rmse": float(explained), "times_noise": best.held.rmse / found.noise.std,
            "partly": [n for n in best.causes if n not in found.dominant],
            "free_torques": _free_torques(found, fitted)}  # fmt: skip


def _free_torques(found: Found, fitted: Problem) -> dict | None:
    """The free torques beside the best set: knots over position and over velocity, and the torque at each."""
    if found.free is None or found.free.fit.candidate.spline is None:
        return None
    frame, values = fitted.motion.frame, found.free.fit.candidate.spline
    return {"position": np.linspace(*frame.q, KNOTS).tolist(), "torque_over_position": values[:KNOTS].tolist(),
            "velocity": np.linspace(*frame.v, KNOTS).tolist(), "torque_over_velocity": values[KNOTS:].tolist(),
            "unit": fitted.plant.torque_unit, "heldout_rmse": found.free.held.rmse}  # fmt: skip


def rms(residuals: list[np.ndarray]) -> float:
    e = np.concatenate(residuals)
    return float(np.sqrt(np.mean(e * e)))


def gain(before: list[np.ndarray], after: list[np.ndarray], draws: int = 1000) -> tuple[float, list[float]]:
    """Ratio of held-out errors with a 95 % interval from blocks of a quarter of an episode drawn again."""
    pairs = []
    for b, a in zip(before, after, strict=True):
        for part in np.array_split(np.arange(len(b)), 4):
            pairs.append((float(b[part] @ b[part]), float(a[part] @ a[part])))
    table = np.array(pairs)
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(table), (draws, len(table)))
    s = table[pick].sum(axis=1)
    r = np.sqrt(s[:, 1] / np.maximum(s[:, 0], 1e-300))
    total = table.sum(axis=0)
    return float(np.sqrt(total[1] / max(total[0], 1e-300))), [float(x) for x in np.percentile(r, [2.5, 97.5])]


__all__ = ["Measure", "Placed", "cause_of", "errors", "extended", "gain", "remainder_of", "rms"]
