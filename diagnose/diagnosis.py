"""From a model and logs to a verdict, an extended model and the gain; see :func:`diagnose`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from diagnose.causes import CAUSES, Motion
from diagnose.fit import Fit, Problem, linearise
from diagnose.kernel import KNOTS
from diagnose.log import JointLog, LogError, check_units, drop_stale, load_log
from diagnose.noise import Noise
from diagnose.plant import Plant, isolated, load_plant
from diagnose.residual import ljung_box, trim_start, where
from diagnose.search import Found, Scored, Search, noise_floor
from diagnose.simulate import Episode, mujoco_rollouts, prepare, shown
from taa_envs.errors import TaaEnvsError
from taa_envs.files import written_whole

READING = ("delay", "bias", "gain", "bend2", "bend3", "bend4", "bend5", "play")
WINDOW = 12.0  # s; longer logs of an imposed motion are cut into windows


@dataclass
class Diagnosis:
    """What a simulation gets wrong.

    Attributes:
        verdict: consistent, explained, ambiguous or unexplained.
        data: the JSON object of the contract (without ``extended_model`` until :meth:`write`).
        plant, found: the joint and the search behind it.
        fitted, held: the two groups of episodes.
        partly: False if the extended model is the nominal one although something was found.
        curves: name of episode -> {"time", "q", "nominal", "extended"} for plots.
    """

    verdict: str
    data: dict
    plant: Plant
    found: Found
    fitted: Problem
    held: Problem
    curves: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    partly: bool = True

    @property
    def extends(self) -> bool:
        """True if the extended model differs from the nominal one."""
        mechanical = [n for n in self.found.best.causes if CAUSES[n].edit is not None]
        return self.verdict != "consistent" and self.partly and bool(mechanical)

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the causes."""
        return tuple(c["name"] for c in self.data["causes"])

    def extended_spec(self) -> mujoco.MjSpec:
        """The nominal model with what was found (of an unexplained residual, with what explains part of it)."""
        return extended(self.plant, self.found.best if self.partly else self.found.nominal, self.fitted)

    def write(self, folder: Path | str, final: Path | None = None) -> Path:
        """Write diagnosis.json, report.html and model_extended.xml; returns the folder.

        ``final`` is the folder's later name, where it is made under another one first.

        Meshes that the model names are looked up where they are: the XML holds absolute folders.
        """
        from diagnose.report import page

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        spec = self.extended_spec()
        for key in ("meshdir", "texturedir"):
            if spec.meshes or spec.textures:
                setattr(spec, key, str((self.plant.path.parent / getattr(spec, key)).resolve()))
        spec.compile()
        target = folder / "model_extended.xml"
        with written_whole(target) as partial:
            partial.write_text(spec.to_xml(), encoding="utf-8")
        self.data["extended_model"] = str((final or folder) / target.name)
        with written_whole(folder / "diagnosis.json") as partial:
            partial.write_text(json.dumps(self.data, indent=1, allow_nan=False), encoding="utf-8")
        with written_whole(folder / "report.html") as partial:
            partial.write_text(page(self), encoding="utf-8")
        return folder


def diagnose(model: Path | str, logs: list[Path | str | JointLog], joint: str = "joint",
             say: Callable[[str], None] = lambda line: None,
             only: Sequence[str] | None = None, known: Sequence[str] = ()) -> Diagnosis:  # fmt: skip
    """Say what the model gets wrong about a joint, from measured logs.

    Args:
        model: an MJCF file, or the id of an asset.
        logs: CSV files or :class:`~diagnose.log.JointLog`, one episode each. Every third is held out; of a single
            one, every third of its windows.
        joint: name of the joint in the model.
        say: called with a line of progress now and then.
        only: names of the causes to consider; None for all.
        known: what the logs take for granted, in words, for the list of assumptions.

    Raises:
        TaaEnvsError: the model or a log cannot be used.
    """
    path = model_path(model)
    plant = load_plant(path, joint)
    if only is not None and set(only) - set(CAUSES):
        raise TaaEnvsError(f"no such cause: {', '.join(sorted(set(only) - set(CAUSES)))}; known: {', '.join(CAUSES)}")
    if not logs:
        raise TaaEnvsError("no logs; give at least one CSV with --data")
    read = [log if isinstance(log, JointLog) else load_log(log) for log in logs]
    for log in read:
        check_units(log, plant.hinge, plant.limits)
    assumptions = [*known, "the other joints rest where the model puts them, and contacts are off",
                   "each episode's initial position and velocity are fitted, for the nominal model too"]  # fmt: skip
    episodes, names = [], []
    for log in read:
        log, stale = drop_stale(log)
        if stale:
            assumptions.append(f"{Path(log.name).name}: {stale} rows repeat the position of the row before to the last "
                               "digit while the part moves; they are left out as stale")  # fmt: skip
        e = prepare(plant, log)
        skip = trim_start(plant, e)
        if skip:
            assumptions.append(f"{Path(log.name).name}: the first {log.time[skip] - log.time[0]:.2f} s are "
                               "left out; the log says let go, but no law of motion moves the part so")  # fmt: skip
            cut = {k: getattr(log, k)[skip:] for k in ("time", "q", "torque", "force", "point")
                   if getattr(log, k) is not None}  # fmt: skip
            e = prepare(plant, replace(log, **cut))
        episodes.append(e)
        names.append(Path(log.name).name)
    driven = is_driven(plant, episodes)
    if driven:
        assumptions.append("the motion is imposed so slowly that inertia hardly matters: torques are compared at the "
                           "measured motion, and errors are in " + plant.torque_unit)  # fmt: skip
    if not any(e.u.any() for e in episodes):
        assumptions.append("no torque or force is logged: only ratios to the inertia are identifiable, and the "
                           "model's own inertia is taken as the measure")  # fmt: skip
    if len(episodes) < 3:
        episodes, names = _cut(plant, episodes, names)
    held_at = [i for i in range(len(episodes)) if i % 3 == 2] if len(episodes) > 2 else [1]
    fit_at = [i for i in range(len(episodes)) if i not in held_at]
    fitted = [episodes[i] for i in fit_at]
    motion = Motion.of(plant, fitted)
    problem = Problem(plant, fitted, motion, driven)
    held = problem.on([episodes[i] for i in held_at])
    found = Search(problem, held, say, only).run()
    return _verdict(plant, found, found.fitted, found.held, names, fit_at, held_at, assumptions)


def model_path(model: Path | str) -> Path:
    """The MJCF file of a model that is named by its file or by an asset's id."""
    if Path(model).suffix:
        return Path(model)
    from taa_envs.registry import get_asset

    return get_asset(str(model)).model_path


def is_driven(plant: Plant, episodes: list[Episode]) -> bool:
    """True if inertia explains less than a twentieth of the logged input (rms): somebody moves the part slowly."""
    a = np.concatenate([e.a for e in episodes])
    u = np.concatenate([e.u for e in episodes])
    free = float(np.mean(u == 0))
    middle = np.percentile(np.abs(a), 90)
    return free < 0.3 and plant.inertia * middle < 0.05 * float(np.sqrt(np.mean(u * u)))


def _cut(plant: Plant, episodes: list[Episode], names: list[str]) -> tuple[list[Episode], list[str]]:
    """Windows of one or two logs, so that some can be held out."""
    from diagnose.simulate import windows

    out, called = [], []
    for e, name in zip(episodes, names, strict=True):
        count = max(3, int(np.ceil(e.t[-1] / WINDOW)))
        pieces = windows(e, count)
        if len(pieces) < 2 and len(episodes) == 1:
            raise LogError(f"{name} is too short to hold part of it out; record at least 50 samples or three logs")
        out += pieces
        called += [f"{name}[{p.log.time[0]:.2f}..{p.log.time[-1]:.2f} s]" for p in pieces]
    return out, called


def extended(plant: Plant, scored: Scored, problem: Problem) -> mujoco.MjSpec:
    """A spec of the nominal model with the fitted causes edited in (measurement faults leave it as it is)."""
    spec = mujoco.MjSpec.from_file(str(plant.path))
    terms = scored.fit.terms()
    order = sorted(scored.causes, key=lambda n: n == "inertia" and terms.get("inertia", 0) < 0)
    for name in order:
        edit = CAUSES[name].edit
        if edit is not None:
            edit(spec, plant.joint, terms, plant, problem.motion.frame)
    return spec


def _errors(plant: Plant, scored: Scored, held: Problem, fitted: Problem) -> list[np.ndarray]:
    """Held-out residuals with MuJoCo itself in place of the fit's own integrator, a list of (N,)."""
    if held.driven:
        return scored.held.residuals
    model = isolated(extended(plant, scored, fitted), plant.joint)
    # The integrator's half-step convention differs from the fit's; its initial states are found anew from the fit's.
    terms = {k: v for k, v in scored.fit.terms().items() if k in READING}
    frame = fitted.motion.frame
    h = model.opt.timestep
    out = []
    for e, local in zip(held.episodes, scored.held.local, strict=True):
        slopes = linearise(held.on([e]), scored.fit.candidate, [local], Noise(), []).back[0]
        x = local.copy()
        x[1] += 0.5 * (e.step - h) * e.a[0]
        best = None
        for _ in range(3):
            Q, V = mujoco_rollouts(model, e, [x])
            read = e.log.q - shown(plant, frame, terms, Q[0], V[0], e.t, h)
            if best is not None and read @ read > 0.999 * (best @ best):
                best = min(best, read, key=lambda r: float(r @ r))
                break
            best = read
            # The fit's integrator says how the initial state moves the readings.
            J = (slopes[0] @ slopes[1])[: len(read), :2]
            x[:2] += np.linalg.lstsq(J, read, rcond=None)[0]
        out.append(best)
    return out


def _verdict(plant: Plant, found: Found, fitted: Problem, held: Problem, names: list[str], fit_at: list[int],
             held_at: list[int], assumptions: list[str]) -> Diagnosis:  # fmt: skip
    best, rivals = found.best, found.rivals
    floor = noise_floor(held)
    if found.left:
        verdict = "unexplained"
    elif not best.causes:
        verdict = "consistent"
    elif rivals:
        verdict = "ambiguous"
    else:
        verdict = "explained"
    unit = plant.torque_unit if fitted.driven else plant.unit
    partly = True
    nominal = _errors(plant, found.nominal, held, fitted)
    named = best.causes if verdict in ("explained", "ambiguous") else ()
    after = _errors(plant, best, held, fitted) if named else nominal
    if verdict == "unexplained":
        part = _errors(plant, best, held, fitted) if best.causes else nominal
        after = min(nominal, part, key=_rms)
        partly = after is part and bool(best.causes)
        if partly:
            assumptions.append(f"the extended model holds {', '.join(best.causes)}, which explains part of the error; "
                               "what is left biases their values beyond their intervals")  # fmt: skip
        if found.free is not None:
            left = _rms(found.free.held.residuals)
            assumptions.append(f"free torques over position and velocity ({KNOTS} knots each) beside "
                               f"{', '.join(best.causes) or 'no cause'} leave {left:.4g} {unit} of the held-out "
                               "episodes; plain MJCF has no such torque, so the model does not hold them")  # fmt: skip
    ratio, interval = _gain(nominal, after)
    causes = [_cause(n, best.fit, found, plant, fitted.motion.frame.middle) for n in named]
    experiment = None
    if verdict == "unexplained":
        causes = [{"name": "unknown", "parameters": {}, "evidence": {
            "where": where(plant, held.episodes, best.held.residuals, unit), "why": found.left,
            "partly": list(best.causes), "rmse": best.held.rmse, "parameters": {
                n: _cause(n, best.fit, found, plant, fitted.motion.frame.middle)["parameters"] for n in best.causes},
            "free_torques": _free_torques(found, fitted)}}]  # fmt: skip
        experiment = "repeat the same motion twice, then at another speed and from the other side"
    alternatives = []
    if verdict == "ambiguous":
        alternatives = [list(r.causes) for r in rivals]
        mine = set(best.causes)
        other = set(rivals[0].causes)
        experiment = "; or ".join(dict.fromkeys(
            CAUSES[n].experiment for n in sorted(mine ^ other) if CAUSES[n].experiment))  # fmt: skip
    if any(CAUSES[n].measurement for n in named):
        assumptions.append("faults of the measurement are named, not put into the extended model")
    whiteness = ljung_box(best.fit.residuals)
    data = {
        "verdict": verdict, "causes": causes, "alternatives": alternatives, "next_experiment": experiment,
        "nominal": {"heldout_rmse": _rms(nominal)}, "extended": {"heldout_rmse": _rms(after)}, "noise_floor": floor,
        "gain": {"heldout_rmse_ratio": ratio, "ci95": interval},
        "episodes": {"fit": [names[i] for i in fit_at], "heldout": [names[i] for i in held_at]},
        "extended_model": None, "assumptions": assumptions, "unit": unit,
        "whiteness": {"ljung_box": whiteness[0], "p": whiteness[1]},
        "ranking": [{"causes": list(f.causes), "nats": f.nats - found.ranking[0].nats, "rmse": f.rmse}
                    for f in found.ranking[:12]],
        "noise": {"std": found.noise.std, "phi": found.noise.phi, "theta": found.noise.theta},
    }  # fmt: skip
    result = Diagnosis(verdict, data, plant, found, fitted, held, partly=partly)
    for i, e, n, x in zip(held_at, held.episodes, nominal, after, strict=True):
        y = e.u if held.driven else e.log.q
        result.curves[names[i]] = {"time": e.t, "q": e.q, "v": e.v, "measured": y, "nominal": y - n, "extended": y - x}
    return result


def _cause(name: str, fit: Fit, found: Found, plant: Plant, middle: float) -> dict:
    """One cause as the contract has it; a spring's torque is counted from ``middle``."""
    terms, std = fit.terms(), fit.std()
    inertia = "kg m^2" if plant.hinge else "kg"
    parameters = {}
    for p in CAUSES[name].parameters:
        unit = p.unit.format(q=plant.unit, t=plant.torque_unit, i=inertia)
        v, s = terms[p.term], std[p.term]
        s = s if np.isfinite(s) else abs(v)
        parameters[p.name] = {"value": v, "unit": unit, "ci95": [v - 1.96 * s, v + 1.96 * s]}
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
    return {"name": name, "parameters": parameters, "evidence": evidence}


def _free_torques(found: Found, fitted: Problem) -> dict | None:
    """The free torques beside the best set: knots over position and over velocity, and the torque at each."""
    if found.free is None or found.free.fit.candidate.spline is None:
        return None
    frame, values = fitted.motion.frame, found.free.fit.candidate.spline
    return {"position": np.linspace(*frame.q, KNOTS).tolist(), "torque_over_position": values[:KNOTS].tolist(),
            "velocity": np.linspace(*frame.v, KNOTS).tolist(), "torque_over_velocity": values[KNOTS:].tolist(),
            "unit": fitted.plant.torque_unit, "heldout_rmse": found.free.held.rmse}  # fmt: skip


def _rms(residuals: list[np.ndarray]) -> float:
    e = np.concatenate(residuals)
    return float(np.sqrt(np.mean(e * e)))


def _gain(before: list[np.ndarray], after: list[np.ndarray], draws: int = 1000) -> tuple[float, list[float]]:
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
