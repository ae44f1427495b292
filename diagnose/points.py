"""What 3D points on the part add to a diagnosis: the joint's place, a second joint, errors in metres.

The place is looked at first (:mod:`diagnose.geometry`). What is wrong with it is put right in the model before the
dynamics are looked at, so that a tilted axis' weight or a moved pivot's inertia is not named a second time as a torque.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.stats import chi2

from diagnose.causes import CAUSES, PLACES, Motion
from diagnose.fit import Problem, fit
from diagnose.geometry import FoundGeometry, Geometry, _back, _shown, search_geometry
from diagnose.log import JointLog, LogError
from diagnose.plant import Plant, load_plant
from diagnose.search import Found, Search, candidate_of
from diagnose.simulate import Episode, prepare

HOLDS = ("viscous_damping", "coulomb_friction", "spring", "constant_torque")  # what may hold a second joint


@dataclass
class Placed:
    """The joint's place and what follows from it.

    Attributes:
        found: what the points say.  plant: the joint where it is.
        second: of a second joint its plant, search and the two groups of its episodes; None without one.
        assumptions: in words.
    """

    found: FoundGeometry
    plant: Plant
    second: tuple[Plant, Found, Problem, Problem] | None = None
    assumptions: list[str] = field(default_factory=list)

    @property
    def causes(self) -> tuple[str, ...]:
        return self.found.causes

    def reported(self) -> list[dict]:
        """The causes as the contract has them."""
        out = []
        for name in self.causes:
            evidence = {"sentence": PLACES[name].sentence, **self.found.evidence[name]}
            if name == "second_joint":
                slide = not self.found.best.twist[3:].any()  # type: ignore[index]
                evidence["kind"] = "slide" if slide else "hinge"
                if self.second is not None:
                    evidence["held_by"] = list(self.second[1].best.causes)
            out.append({"name": name, "parameters": PLACES[name].report(self.found.best), "evidence": evidence})
        return out


def look_at_points(plant: Plant, fitted: list[Episode], held: list[Episode], only: Sequence[str] | None,
                   say: Callable[[str], None]) -> Placed | None:  # fmt: skip
    """Find the joint's place from the episodes' points; None if they have none."""
    allowed = tuple(n for n in PLACES if only is None or n in only)
    if not allowed:
        return None
    if all(e.log.markers is None for e in (*fitted, *held)):
        return None
    counts = [0 if e.log.markers is None else e.log.markers.shape[1] for e in (*fitted, *held)]
    if len(set(counts)) > 1:
        raise LogError(f"the logs hold {', '.join(str(c) for c in sorted(set(counts)))} points; log the same points in "
                       "every episode, or in none")  # fmt: skip
    found = search_geometry(plant, fitted, held, allowed)
    out = Placed(found, plant)
    out.assumptions.append(f"the {len(found.best.points)} points are fixed to the part in all logs and are seen in the "
                           "world frame at the rows' times")  # fmt: skip
    if not found.causes:
        return out
    say(f"place: {' + '.join(found.causes)}")

    out.plant = _moved_to(plant, found.best, found.causes)
    if "second_joint" in found.causes:
        _hold(out, fitted, held, say)
    return out


def _moved_to(plant: Plant, geometry: Geometry, causes: tuple[str, ...], joint: str | None = None) -> Plant:
    """The nominal joint (or another of the edited model) with the place put right."""

    def edit(spec: mujoco.MjSpec) -> None:
        for name in causes:
            PLACES[name].edit(spec, plant.joint, geometry, plant)

    return load_plant(plant.path, joint or plant.joint, edit)


def weighed(placed: Placed, problem: Problem, found: Found) -> Plant | None:
    """The joint with its place moved to what its weight and inertia say as well; None if they say nothing new.

    Points know a tilt to a milliradian; the motion may know its weight better than that, and the rest would be named a
    weight or an inertia of its own. The two are one measurement if what the motion asks for lies within what the
    place's uncertainty allows (chi-squared at 0.999); then the place is updated as a Kalman filter does.
    """
    plant, geometry = placed.plant, placed.found.best
    free = [i for i in range(4) if geometry.cov[i, i] > 0]
    asked = ("gravity_torque", "inertia") if plant.hinge else ("constant_torque",)
    blurred = {*asked, "constant_torque", "spring"} & set(found.best.causes)
    if not free or not blurred or plant.static_table is not None:
        return None
    names = tuple(n for n in CAUSES if n in asked or (n in found.best.causes and n not in blurred))
    f = fit(problem, candidate_of(problem, names, found.best.fit.terms()), found.noise)
    terms = [p.term for p in f.candidate.parameters()]
    at = [terms.index(p.term) for n in asked for p in CAUSES[n].parameters]
    numbers = lambda p: np.array([*p.gravity[:2], p.inertia] if p.hinge else [p.gravity[2]])  # noqa: E731
    H = np.zeros((len(at), len(free)))
    for c, i in enumerate(free):
        step = float(np.sqrt(geometry.cov[i, i]))
        shifted = placed_at(placed, geometry, np.eye(4)[i] * step)
        H[:, c] = (numbers(_moved_to(plant, shifted, placed.causes)) - numbers(plant)) / step
    P = geometry.cov[np.ix_(free, free)]
    S = H @ P @ H.T + f.cov[np.ix_(at, at)]
    wanted = f.candidate.theta[at]
    if not np.isfinite(S).all():
        return None
    size = np.sqrt(np.diag(S)) + 1e-300
    inverse = np.linalg.pinv(S / size / size[:, None], rcond=1e-12, hermitian=True) / size / size[:, None]
    if wanted @ inverse @ wanted > chi2.ppf(0.999, len(at)):
        return None
    gain = P @ H.T @ inverse
    move, cov = np.zeros(4), np.zeros((4, 4))
    move[free] = gain @ wanted
    cov[np.ix_(free, free)] = P - gain @ H @ P
    placed.found.best = replace(placed_at(placed, geometry, move), cov=cov)
    placed.plant = _moved_to(plant, placed.found.best, placed.causes)
    return placed.plant


def placed_at(placed: Placed, geometry: Geometry, move: np.ndarray) -> Geometry:
    """The geometry with tilt and offset moved by (4,)."""
    nominal = placed.found.nominal
    tilt, offset = geometry.tilt + move[:2], geometry.offset + move[2:]
    axis = nominal.axis + tilt @ geometry.across
    return replace(geometry, tilt=tilt, offset=offset, axis=axis / np.linalg.norm(axis),
                   anchor=nominal.anchor + offset @ geometry.across)  # fmt: skip


def _hold(out: Placed, fitted: list[Episode], held: list[Episode], say: Callable[[str], None]) -> None:
    """What holds a second joint: its own motion is a log like any other."""
    plant = _moved_to(out.plant, out.found.best, out.causes, f"{out.plant.joint}_second")
    groups = []
    for episodes, geometry in ((fitted, out.found.best), (held, out.found.held)):
        groups.append([prepare(plant, JointLog(e.log.name, e.log.time, s))
                       for e, s in zip(episodes, geometry.second, strict=True)])  # fmt: skip
    problem = Problem(plant, groups[0], Motion.of(plant, groups[0]), False)
    search = Search(problem, problem.on(groups[1]), say, HOLDS).run()
    out.second = (plant, search, search.fitted, search.held)
    if search.left or not search.best.causes:
        out.assumptions.append("what holds the second joint is not known well: " + (
            search.left or "its motion does not show any torque"))  # fmt: skip
    out.assumptions.append("the two joints are taken not to push each other; what holds the second is a ratio to the "
                           "model's own mass")  # fmt: skip


def hold_second(spec: mujoco.MjSpec, placed: Placed) -> None:
    """Put what holds the second joint into a spec that has it."""
    if placed.second is None:
        return
    plant, found, problem, _ = placed.second
    terms = found.best.fit.terms()
    for name in found.best.causes:
        edit = CAUSES[name].edit
        assert edit is not None
        edit(spec, plant.joint, terms, plant, problem.motion.frame)


def body_points(plant: Plant, geometry: Geometry, episodes: list[Episode], states: list[np.ndarray],
                second: list[np.ndarray] | None) -> np.ndarray:  # fmt: skip
    """(K, 3) of the part, such that positions ``states`` (N,) of the episodes show the points best."""
    axis, anchor = geometry.axis, geometry.anchor
    total = []
    for i, (e, q) in enumerate(zip(episodes, states, strict=True)):
        back = _back(plant.hinge, axis, anchor, e.log.markers, q - plant.reference)
        if second is not None:
            back = back - second[i][:, None, None] * _moved(geometry)
        total.append(back)
    return np.nanmean(np.concatenate(total), axis=0)


def _moved(geometry: Geometry) -> np.ndarray:
    """(K, 3) how a second joint moves the points, per unit."""
    assert geometry.twist is not None
    return geometry.twist[:3] + np.cross(geometry.twist[3:], geometry.points)


def point_errors(plant: Plant, geometry: Geometry, points: np.ndarray, episodes: list[Episode],
                 states: list[np.ndarray], second: list[np.ndarray] | None) -> list[np.ndarray]:  # fmt: skip
    """Measured minus shown points at simulated positions, each (N,) of lengths in m / sqrt(3): per coordinate."""
    out = []
    for i, (e, q) in enumerate(zip(episodes, states, strict=True)):
        shown = _shown(plant.hinge, geometry.axis, geometry.anchor, points, q - plant.reference)
        if second is not None:
            angle = (q - plant.reference) * plant.hinge  # a slide does not turn it
            turn = _shown(plant.hinge, geometry.axis, np.zeros(3), _moved(geometry), angle)
            shown = shown + second[i][:, None, None] * turn
        out.append(np.sqrt(np.nanmean((e.log.markers - shown) ** 2, axis=(1, 2))))
    return out

