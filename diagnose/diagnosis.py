"""From a model and logs to a verdict, an extended model and the gain; see :func:`diagnose`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from diagnose.causes import CAUSES, PLACES, Motion, backlash
from diagnose.fit import Candidate, Problem, fit
from diagnose.log import JointLog, LogError, check_units, drop_stale, load_log
from diagnose.measure import Measure, cause_of, extended, gain, remainder_of, rms
from diagnose.noise import Noise
from diagnose.plant import Plant, load_plant
from diagnose.points import Placed, hold_second, look_at_points, weighed
from diagnose.residual import ljung_box, shortened, trim_start
from diagnose.search import Found, Scored, Search, noise_floor
from diagnose.simulate import Episode, prepare
from taa_envs.errors import TaaEnvsError
from taa_envs.files import written_whole

WINDOW = 12.0  # s; longer logs of an imposed motion are cut into windows


@dataclass
class Diagnosis:
    """What a simulation gets wrong.

    Attributes:
        verdict: consistent, explained, ambiguous or unexplained.
        data: the JSON object of the contract (without ``extended_model`` until :meth:`write`).
        plant, found: the joint and the search behind it.
        fitted, held: the two groups of episodes.
        placed: what points on the part say; None without points.
        holds: what the extended model holds of an unexplained residual: "nothing", "causes" or "free" (torques beside
            them).
        curves: name of episode -> {"time", "q", "nominal", "extended"} for plots.
    """

    verdict: str
    data: dict
    plant: Plant
    found: Found
    fitted: Problem
    held: Problem
    curves: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    placed: Placed | None = None
    holds: str = "causes"

    @property
    def extends(self) -> bool:
        """True if the extended model differs from the nominal one."""
        mechanical = any(CAUSES[n].edit is not None for n in self.found.best.causes)
        moved = self.placed is not None and bool(self.placed.causes)
        changed = moved or (self.holds != "nothing" and mechanical) or self.holds == "free"
        return self.verdict != "consistent" and changed

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the causes."""
        return tuple(c["name"] for c in self.data["causes"])

    def extended_spec(self) -> mujoco.MjSpec:
        """The nominal model with what was found (of an unexplained residual, with what explains part of it)."""
        spec = extended(self.plant, self.chosen, self.fitted)
        if self.placed is not None:
            hold_second(spec, self.placed)
        return spec

    def model_with_reading(self) -> mujoco.MjSpec:
        """The extended model and, of a reading with play, a pointer that shows it (:mod:`diagnose.causes.backlash`)."""
        spec = self.extended_spec()
        if "backlash" in self.chosen.causes and self.verdict in ("explained", "ambiguous"):
            backlash.add_pointer(spec, self.plant.joint, self.chosen.fit.terms()["play"], self.plant)
        return spec

    @property
    def chosen(self) -> Scored:
        """What the extended model holds."""
        if self.holds == "free" and self.found.free is not None:
            return self.found.free
        return self.found.best if self.holds == "causes" else self.found.nominal

    def write(self, folder: Path | str, final: Path | None = None) -> Path:
        """Write diagnosis.json, report.html and model_extended.xml; returns the folder.

        ``final`` is the folder's later name, where it is made under another one first.

        Meshes that the model names are looked up where they are: the XML holds absolute folders.
        """
        from diagnose.report import page

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        spec = self.model_with_reading()
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
        logs: CSV files or :class:`~diagnose.log.JointLog`, one episode each. Every third is held out (see
            :func:`_held_out`); of a single one, every third of its windows.
        joint: name of the joint in the model.
        say: called with a line of progress now and then.
        only: names of the causes to consider; None for all.
        known: what the logs take for granted, in words, for the list of assumptions.

    Raises:
        TaaEnvsError: the model or a log cannot be used.
    """
    path = model_path(model)
    plant = load_plant(path, joint)
    library = (*CAUSES, *PLACES)
    if only is not None and set(only) - set(library):
        raise TaaEnvsError(f"no such cause: {', '.join(sorted(set(only) - set(library)))}; known: {', '.join(library)}")
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
            e = shortened(plant, e, skip)
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
    held_at = _held_out(plant, episodes, driven)
    fit_at = [i for i in range(len(episodes)) if i not in held_at]
    fitted = [episodes[i] for i in fit_at]
    held = [episodes[i] for i in held_at]
    placed = look_at_points(plant, fitted, held, only, say)
    if placed is not None:
        assumptions += placed.assumptions
        plant = placed.plant
    problem = Problem(plant, fitted, Motion.of(plant, fitted), driven)
    found = Search(problem, problem.on(held), say, only).run()
    if placed is not None and placed.causes and (better := weighed(placed, found.fitted, found)) is not None:
        plant = better
        problem = replace(problem, plant=plant, motion=Motion.of(plant, fitted))
        found = Search(problem, problem.on(held), say, only).run()
    return _verdict(plant, found, placed, names, fit_at, held_at, assumptions)


def model_path(model: Path | str) -> Path:
    """The MJCF file of a model that is named by its file or by an asset's id."""
    if Path(model).suffix:
        return Path(model)
    from taa_envs.registry import get_asset

    return get_asset(str(model)).model_path


def _one_way(episodes: list[Episode]) -> bool:
    """True if less than a fiftieth of the way is in the other direction."""
    ways = np.concatenate([np.diff(e.q) for e in episodes])
    back, forth = float(-ways[ways < 0].sum()), float(ways[ways > 0].sum())
    return min(back, forth) < 0.02 * (back + forth)


def is_driven(plant: Plant, episodes: list[Episode]) -> bool:
    """True if inertia explains less than a twentieth of the logged input (rms): somebody moves the part slowly."""
    a = np.concatenate([e.a for e in episodes])
    u = np.concatenate([e.u for e in episodes])
    free = float(np.mean(u == 0))
    middle = np.percentile(np.abs(a), 90)
    return free < 0.3 and plant.inertia * middle < 0.05 * float(np.sqrt(np.mean(u * u)))


def _held_out(plant: Plant, episodes: list[Episode], driven: bool) -> list[int]:
    """Every third episode is held out: the third, sixth and so on, unless those (or all others) show next to nothing of
    what the model gets wrong, a stop that none of them reaches. Only the nominal model's errors decide."""
    if len(episodes) < 3:
        return [1]
    every = [[i for i in range(len(episodes)) if i % 3 == k] for k in (2, 0, 1)]
    problem = Problem(plant, episodes, Motion.of(plant, episodes), driven)
    nominal = fit(problem, Candidate((), np.zeros(0)), Noise(k=noise_floor(problem)), fixed=True, iterations=4)
    power = np.array([float(np.mean(r * r)) for r in nominal.residuals])
    seen = [min(power[k].mean(), np.delete(power, k).mean()) for k in every]
    return every[0] if seen[0] > 4 * noise_floor(problem) ** 2 else every[int(np.argmax(seen))]


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


def _verdict(plant: Plant, found: Found, placed: Placed | None, names: list[str], fit_at: list[int],
             held_at: list[int], assumptions: list[str]) -> Diagnosis:  # fmt: skip
    best, fitted, held = found.best, found.fitted, found.held
    places = placed.causes if placed is not None else ()
    displaced = placed is not None and bool(placed.found.left)
    named = found.dominant if found.left else best.causes
    rivals = [list(r.causes) for r in found.rivals]
    if placed is not None:
        rivals = [[*r, *places] for r in rivals] + [[*c, *named] for c in placed.found.rivals]
    if displaced or (found.left and not found.dominant):
        verdict = "unexplained"
    elif rivals:
        verdict = "ambiguous"
    else:
        verdict = "explained" if named or places else "consistent"
    result = Diagnosis(verdict, {}, plant, found, fitted, held, placed=placed)
    measure = Measure(result)
    unit = measure.unit
    after = measure.extended
    if found.left and result.holds != "nothing" and best.causes:
        assumptions.append(f"the extended model holds {', '.join(best.causes)}; what is left biases their values "
                           "beyond their intervals")  # fmt: skip
    if result.holds == "free":
        assumptions.append("beside them it holds free torques: over position as passive ripple, over velocity as "
                           "damping and friction")  # fmt: skip
    ratio, interval = gain(measure.nominal, after)
    causes = [*(cause_of(n, found, fitted) for n in named), *(placed.reported() if placed is not None else [])]
    alternatives, experiment = [], None
    if verdict == "unexplained":
        causes = [{"name": "unknown", "parameters": {}, "evidence": {
            **remainder_of(found, fitted, held, measure), "partly": [*best.causes, *places],
            "parameters": {n: cause_of(n, found, fitted)["parameters"] for n in best.causes}}}]  # fmt: skip
        if displaced and placed is not None:
            causes[0]["evidence"]["why"] = "; ".join(w for w in (placed.found.left, found.left) if w)
        experiment = "repeat the same motion twice, then at another speed and from the other side"
    if verdict == "ambiguous":
        alternatives = rivals
        experiment = "; or ".join(dict.fromkeys(
            text for n in sorted({*named, *places} ^ set(rivals[0]))
            if (text := (CAUSES[n] if n in CAUSES else PLACES[n]).experiment)))  # fmt: skip
    if named and _one_way([*fitted.episodes, *held.episodes]):
        assumptions.append("the part moves one way only in the logs: a torque over position may be a friction that "
                           "changes with it")  # fmt: skip
        experiment = experiment or "log the way back as well: friction turns round with the motion, a spring does not"
    if any(CAUSES[n].measurement for n in named):
        assumptions.append("faults of the measurement do not change the moving part of the extended model")
    whiteness = ljung_box(best.fit.residuals)
    result.data |= {
        "verdict": verdict, "causes": causes, "alternatives": alternatives, "next_experiment": experiment,
        "nominal": {"heldout_rmse": rms(measure.nominal)}, "extended": {"heldout_rmse": rms(after)},
        "noise_floor": measure.floor, "gain": {"heldout_rmse_ratio": ratio, "ci95": interval},
        "episodes": {"fit": [names[i] for i in fit_at], "heldout": [names[i] for i in held_at]},
        "extended_model": None, "assumptions": assumptions, "unit": unit,
        "whiteness": {"ljung_box": whiteness[0], "p": whiteness[1]},
        "ranking": [{"causes": list(f.causes), "nats": f.nats - found.ranking[0].nats, "rmse": f.rmse}
                    for f in found.ranking[:12]],
        "noise": {"std": found.noise.std, "phi": found.noise.phi, "theta": found.noise.theta},
    }  # fmt: skip
    if found.left and found.dominant:
        result.data["remainder"] = remainder_of(found, fitted, held, measure)
    for i, e, n, x in zip(held_at, held.episodes, measure.in_q[0], measure.in_q[1], strict=True):
        y = e.u if held.driven else e.log.q
        result.curves[names[i]] = {"time": e.t, "q": e.q, "v": e.v, "measured": y, "nominal": y - n, "extended": y - x}
    return result
