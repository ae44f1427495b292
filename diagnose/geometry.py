"""Is the joint where the model has it? From 3D points on the moving part, whatever the position sensor says.

A point b_k of the part, counted from the anchor a at the reference position, is seen at

    x_k(t) = a + R(n, theta_t) b_k  (+ s_t R(n, theta_t) (w x b_k + u), a second joint on the part)

for a hinge with the axis n; for a slide at a + b_k + theta_t n. The joint's motion theta_t is free in every frame, so
that neither a fault of the position sensor nor one of the dynamics is taken for one of the geometry. Axis, pivot and
points are fitted by Gauss-Newton with theta_t eliminated frame by frame (variable projection: Golub and Pereyra 1973).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from diagnose.noise import Excess, Noise, estimate, excess
from diagnose.plant import Plant
from diagnose.simulate import Episode

FIT_MARGIN, HELD_MARGIN, HELD_GAIN, SURE, RIVAL = 8.0, 3.0, 0.98, 4.0, 4.0  # as in :mod:`diagnose.search`
SHARE = 0.5  # of the excess on held-out episodes that a second joint's direction must explain there
SETS = ((), ("axis_misalignment",), ("pivot_offset",), ("axis_misalignment", "pivot_offset"))


@dataclass(frozen=True)
class Sight:
    """The points of one episode. x: (N, K, 3) m, NaN where not seen.  q: (N,) a guess of the joint's motion."""

    x: np.ndarray
    q: np.ndarray


@dataclass
class Geometry:
    """A joint's place fitted to points.

    Attributes:
        causes: what was free of ``axis_misalignment`` and ``pivot_offset``.
        axis, anchor: (3,) world.  points: (K, 3) of the part at q = 0, from the anchor.
        tilt: (2,) tangents along ``across``.  offset: (2,) m along ``across``.  cov: (4, 4) of both, 0 where fixed.
        residuals: of each episode (N, K, 3) m.  theta: of each episode (N,).
        twist: (6,) u then w of a second joint, per unit of s; None for none.  second: of each episode s (N,).
        twist_cov: (3, 3) of its direction.  second_std: of one s.
        chi2: in units of the noise's power at low frequency.  n: number of values.
    """

    causes: tuple[str, ...]
    axis: np.ndarray
    anchor: np.ndarray
    across: np.ndarray
    points: np.ndarray
    tilt: np.ndarray
    offset: np.ndarray
    cov: np.ndarray
    residuals: list[np.ndarray]
    theta: list[np.ndarray]
    chi2: float
    n: int
    twist: np.ndarray | None = None
    second: list[np.ndarray] = field(default_factory=list)
    twist_cov: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    second_std: float = 0.0

    @property
    def rmse(self) -> float:
        """Of a coordinate, m."""
        e = np.concatenate([r[np.isfinite(r)] for r in self.residuals])
        return float(np.sqrt(np.mean(e * e)))

    def z(self, name: str) -> float:
        """Standard deviations of a cause's two numbers, jointly, from nothing."""
        i = slice(0, 2) if name == "axis_misalignment" else slice(2, 4)
        value = (self.tilt, self.offset)[name != "axis_misalignment"]
        block = self.cov[i, i]
        if not np.isfinite(block).all() or np.any(np.diag(block) <= 0):
            return 0.0
        return float(np.sqrt(max(value @ np.linalg.solve(block, value), 0.0)))


def across(axis: np.ndarray) -> np.ndarray:
    """(2, 3) unit vectors across an axis (3,)."""
    first = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def sights(plant: Plant, episodes: list[Episode]) -> list[Sight]:
    """The episodes' points with the measured positions as a guess of the motion."""
    return [Sight(e.log.markers, e.q - plant.reference) for e in episodes if e.log.markers is not None]


def fit_geometry(plant: Plant, seen: list[Sight], causes: tuple[str, ...], start: Geometry | None = None,
                 fixed: bool = False, iterations: int = 25) -> Geometry:  # fmt: skip
    """Fit the joint's place, the part's points and the motion to what is seen.

    Args:
        causes: what is free of :data:`SETS`.  start: where to begin.
        fixed: keep axis, pivot and points of ``start`` (held-out episodes), find the motion only.
    """
    two = across(plant.axis)
    tilt, offset = (np.zeros(2), np.zeros(2)) if start is None else (start.tilt.copy(), start.offset.copy())
    tilt = tilt if "axis_misalignment" in causes else np.zeros(2)
    offset = offset if "pivot_offset" in causes else np.zeros(2)
    theta = [s.q.copy() for s in seen]
    K = seen[0].x.shape[1]

    def place(t: np.ndarray, o: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axis = plant.axis + t @ two
        return axis / np.linalg.norm(axis), plant.anchor + o @ two

    axis, anchor = place(tilt, offset)
    if start is not None:
        points = start.points.copy()
    else:  # the mean of what is seen, turned back
        back = [_back(plant.hinge, axis, anchor, s.x, th) for s, th in zip(seen, theta, strict=True)]
        points = np.nanmean(np.concatenate(back), axis=0)
    free = [] if fixed else [i for i in range(4) if ("axis_misalignment", "pivot_offset")[i // 2] in causes]
    width = len(free) + (0 if fixed else 3 * K)
    length = float(np.linalg.norm(points, axis=1).max()) + 1e-6
    last, damp = np.inf, 1e-9
    state = (tilt, offset, points, theta)
    best = (state, np.zeros((width, width)), np.zeros(width), [])
    for _ in range(iterations):
        tilt, offset, points, theta = state
        axis, anchor = place(tilt, offset)
        H, g, cost, moves = np.zeros((width, width)), np.zeros(width), 0.0, []
        eps = 1e-6
        for s, th in zip(seen, theta, strict=True):
            base = _shown(plant.hinge, axis, anchor, points, th)
            r = np.where(np.isfinite(s.x), s.x - base, 0.0).reshape(len(th), -1)
            ok = np.isfinite(s.x).reshape(len(th), -1)
            D = np.where(ok, _along(plant.hinge, axis, anchor, base).reshape(len(th), -1), 0.0)
            J = np.zeros((len(th), 3 * K, width))
            for c, i in enumerate(free):
                t, o = tilt.copy(), offset.copy()
                (t if i < 2 else o)[i % 2] += eps * (1.0 if i < 2 else length)
                J[:, :, c] = (_shown(plant.hinge, *place(t, o), points, th) - base).reshape(len(th), -1) / eps
            if not fixed:
                turn = _turn(plant.hinge, axis, th)
                for k in range(K):
                    J[:, 3 * k : 3 * k + 3, len(free) + 3 * k : len(free) + 3 * k + 3] = turn * length
            J = np.where(ok[:, :, None], J, 0.0)
            size = (D * D).sum(axis=1) + 1e-300
            slip = np.einsum("nd,nd->n", D, r) / size
            lean = np.einsum("nd,ndw->nw", D, J) / size[:, None]
            rp, Jp = r - slip[:, None] * D, J - lean[:, None] * D[:, :, None]
            H += np.einsum("ndw,ndx->wx", Jp, Jp)
            g += np.einsum("ndw,nd->w", Jp, rp)
            cost += float((rp * rp).sum())
            moves.append((slip, lean))
        if cost > last * (1 + 1e-12) and damp < 1e3:
            damp = max(damp * 30, 1e-6)
            state, H, g, moves = best
        else:
            done = last - cost < 1e-10 * cost
            best, last, damp = (state, H, g, moves), cost, damp / 10
            if done:
                break
        tilt, offset, points, theta = state
        step = np.linalg.lstsq(H + damp * np.diag(np.diag(H) + 1e-12 * np.trace(H)), g, rcond=1e-13)[0]
        unit = np.array([1.0 if i < 2 else length for i in free])
        both = np.concatenate([tilt, offset])
        both[free] += step[: len(free)] * unit
        state = (both[:2], both[2:], points if fixed else points + length * step[len(free) :].reshape(K, 3),
                 [th + a - b @ step for th, (a, b) in zip(theta, moves, strict=True)])  # fmt: skip
    (tilt, offset, points, theta), H, g, moves = best
    theta = [th + a for th, (a, _) in zip(theta, moves, strict=True)]
    axis, anchor = place(tilt, offset)
    residuals = [s.x - _shown(plant.hinge, axis, anchor, points, th) for s, th in zip(seen, theta, strict=True)]
    n = sum(int(np.isfinite(r).sum()) for r in residuals)
    cov = np.zeros((4, 4))
    if free:
        A, B, C = H[: len(free), : len(free)], H[: len(free), len(free) :], H[len(free) :, len(free) :]
        information = A - B @ np.linalg.pinv(C, rcond=1e-10, hermitian=True) @ B.T
        unit = np.array([1.0 if i < 2 else length for i in free])
        with np.errstate(all="ignore"):
            inverse = np.linalg.pinv(information, rcond=1e-14, hermitian=True)
        cov[np.ix_(free, free)] = inverse * unit * unit[:, None]
    return Geometry(causes, axis, anchor, two, points, tilt, offset, cov, residuals, theta, last, n)


def _turn(hinge: bool, axis: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(N, 3, 3)."""
    return Rotation.from_rotvec(axis * theta[:, None] * (1.0 if hinge else 0.0)).as_matrix()


def _shown(hinge: bool, axis: np.ndarray, anchor: np.ndarray, points: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(N, K, 3) where the points are."""
    out = np.einsum("nij,kj->nki", _turn(hinge, axis, theta), points) + anchor
    return out if hinge else out + theta[:, None, None] * axis


def _back(hinge: bool, axis: np.ndarray, anchor: np.ndarray, x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """The points (N, K, 3) moved back to theta = 0, from the anchor."""
    if not hinge:
        return x - anchor - theta[:, None, None] * axis
    return np.einsum("nji,nkj->nki", _turn(hinge, axis, theta), x - anchor)


def _along(hinge: bool, axis: np.ndarray, anchor: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(N, K, 3) derivative by theta."""
    return np.cross(axis, x - anchor) if hinge else np.broadcast_to(axis, x.shape)


def second_joint(plant: Plant, seen: list[Sight], base: Geometry, power: float, twist: np.ndarray | None = None,
                 rounds: int = 60) -> Geometry:  # fmt: skip
    """Add one more way to move to a fitted geometry: a fixed twist of the part times a free s_t.

    A twist and the same with some of the first joint's own in it are one: what turns about an axis parallel to the
    first is reported as a slide.

    Args:
        power: of the noise at low frequency.
        twist: (6,) kept as it is (held-out episodes); None to find it.
    """
    turn = [_turn(plant.hinge, base.axis, th) for th in base.theta]
    E = [np.einsum("nji,nkj->nki", R, r).reshape(len(r), -1) for R, r in zip(turn, base.residuals, strict=True)]
    D = [np.einsum("nji,nkj->nki", R, _along(plant.hinge, base.axis, base.anchor, s.x - r)).reshape(len(r), -1)
         for R, s, r in zip(turn, seen, base.residuals, strict=True)]  # fmt: skip
    E, D, rows = np.concatenate(E), np.concatenate(D), np.cumsum([len(t) for t in base.theta])[:-1]
    ok = np.isfinite(E) & np.isfinite(D)
    E, D = np.where(ok, E, 0.0), np.where(ok, D, 0.0)
    K = len(base.points)
    size = float(np.linalg.norm(base.points - base.points.mean(axis=0), axis=1).max()) + 1e-6
    # Displacements of the K points per unit of u and of w; (3 K, 6), w scaled by the part's size.
    A = np.zeros((3 * K, 6))
    for k, b in enumerate(base.points):
        A[3 * k : 3 * k + 3, :3] = np.eye(3)
        A[3 * k : 3 * k + 3, 3:] = -_cross(b) / size
    scale = np.array([1, 1, 1, *[1 / size] * 3])
    D = D / (np.linalg.norm(D, axis=1, keepdims=True) + 1e-300)

    def follow(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        f = np.where(ok, A @ x, 0.0)
        f = f - (D * f).sum(axis=1, keepdims=True) * D
        s = (f * E).sum(axis=1) / ((f * f).sum(axis=1) + 1e-300)
        return s, f, E - s[:, None] * f

    if twist is None:
        rng = np.random.default_rng(0)
        found = (np.inf, np.zeros(6))
        for _ in range(4):
            x = rng.standard_normal(6)
            for _ in range(rounds):  # alternate: the motion given the direction, the direction given the motion
                s, _, _ = follow(x)
                F = np.where(ok[:, :, None], A, 0.0)
                F = F - np.einsum("nd,ndw->nw", D, F)[:, None, :] * D[:, :, None]
                F = s[:, None, None] * F
                new = np.linalg.lstsq(np.einsum("ndw,ndx->wx", F, F), np.einsum("ndw,nd->w", F, E), rcond=1e-8)[0]
                new /= np.linalg.norm(new) + 1e-300
                if np.linalg.norm(new - x) < 1e-9:
                    break
                x = new
            left = float((follow(x)[2] ** 2).sum())
            if left < found[0]:
                found = (left, x)
        x = found[1]
        u, w = x[:3], x[3:] / size
        # A pure turn has u across w; a pure slide has no w. The simpler one is taken if it leaves hardly more.
        best, options = found[0], []
        if np.linalg.norm(u) > 0:
            options.append(np.concatenate([u, np.zeros(3)]) / np.linalg.norm(u))
        if np.linalg.norm(w) > 0:
            n = w / np.linalg.norm(w)
            options.append(np.concatenate([u - (u @ n) * n, w]) / np.linalg.norm(w))
        pure = [(float((follow(o / scale)[2] ** 2).sum()), o) for o in options]
        twist = min(pure, key=lambda p: p[0])[1]
        if 0.5 * (pure[0][0] - best) / power < FIT_MARGIN:
            twist = pure[0][1]
    s, f, left = follow(twist / scale)
    left = np.where(ok, left, np.nan)
    back = [np.einsum("nij,nkj->nki", R, x.reshape(len(x), K, 3))
            for R, x in zip(turn, np.split(left, rows), strict=True)]  # fmt: skip
    F = np.where(ok[:, :, None], A, 0.0)
    F = (F - np.einsum("nd,ndw->nw", D, F)[:, None, :] * D[:, :, None]) * s[:, None, None]
    kind = slice(3, 6) if np.any(twist[3:]) else slice(0, 3)
    rank = slice(0, 6) if np.any(twist[3:]) else kind
    cov = np.zeros((6, 6))
    cov[rank, rank] = power * np.linalg.pinv(np.einsum("ndw,ndx->wx", F, F)[rank, rank], rcond=1e-8, hermitian=True)
    cov *= scale * scale[:, None]
    std = float(np.sqrt(power / np.mean((f * f).sum(axis=1))))
    return replace(base, residuals=back, chi2=float(np.nansum(left**2)), twist=twist, second=np.split(s, rows),
                   twist_cov=cov[kind, kind], second_std=std)  # fmt: skip


def _cross(b: np.ndarray) -> np.ndarray:
    return np.array([[0, -b[2], b[1]], [b[2], 0, -b[0]], [-b[1], b[0], 0.0]])


@dataclass
class FoundGeometry:
    """What the points say.

    Attributes:
        best: the chosen geometry on the fitted episodes; held: on the held-out ones.
        nominal, nominal_held: the model's own.
        causes: names found, ``second_joint`` among them.
        rivals: other names that do as well.  left: why something is left; empty if nothing is.
        noise: of a coordinate.  excess: slow residual beyond it.  evidence: name -> numbers.
    """

    best: Geometry
    held: Geometry
    nominal: Geometry
    nominal_held: Geometry
    causes: tuple[str, ...]
    noise: Noise
    excess: Excess
    rivals: list[tuple[str, ...]] = field(default_factory=list)
    left: str = ""
    evidence: dict[str, dict] = field(default_factory=dict)


def series(g: Geometry) -> list[np.ndarray]:
    """Residuals as one series a coordinate; where the point is not seen, nothing."""
    return [c[np.isfinite(c)] for r in g.residuals for c in r.reshape(len(r), -1).T]


def search_geometry(plant: Plant, fitted: list[Episode], held: list[Episode],
                    allowed: Sequence[str]) -> FoundGeometry:  # fmt: skip
    """What is wrong with the joint's place, judged as the causes of :mod:`diagnose.search` are."""
    seen, other = sights(plant, fitted), sights(plant, held)
    sets = [c for c in (SETS if plant.hinge else SETS[:2]) if all(n in allowed for n in c)]
    fits = {c: fit_geometry(plant, seen, c) for c in sets}
    helds = {c: fit_geometry(plant, other, c, start=f, fixed=True) for c, f in fits.items()}
    # The largest set sets the noise: power at low frequency is what slow parameters are judged by.
    most = min(fits.values(), key=lambda f: f.chi2)
    noise, generous = estimate(series(most))
    power = float(noise.spectrum(np.array([1e-3]))[0])
    nats = {c: 0.5 * f.chi2 / power + 0.5 * 2 * len(c) * np.log(f.n) for c, f in fits.items()}
    out = {c: 0.5 * h.chi2 / power for c, h in helds.items()}
    best = min(nats, key=lambda c: nats[c])
    while best:
        f = replace(fits[best], cov=fits[best].cov * power)
        losses = []
        for name in best:
            less = tuple(c for c in best if c != name)
            helps = (f.z(name) >= SURE and nats[less] - nats[best] >= FIT_MARGIN
                     and out[less] - out[best] >= HELD_MARGIN
                     and helds[best].rmse <= HELD_GAIN * helds[less].rmse)  # fmt: skip
            losses.append((helps, nats[less], less))
        worst = min(losses)
        if worst[0]:
            break
        best = worst[2]
    rivals = [c for c in sets if c and len(c) == len(best) and c != best
              and nats[c] + out[c] - nats[best] - out[best] < RIVAL]  # fmt: skip
    chosen, chosen_held = replace(fits[best], cov=fits[best].cov * power), helds[best]
    found = FoundGeometry(chosen, chosen_held, fits[()], helds[()], best, noise,
                          excess(series(chosen) + series(chosen_held), generous), rivals)  # fmt: skip
    for name in best:
        less = tuple(c for c in best if c != name)
        found.evidence[name] = {
            "z": chosen.z(name), "nats_fit": nats[less] - nats[best], "nats_heldout": out[less] - out[best],
            "heldout_rmse_without": helds[less].rmse}  # fmt: skip
    if found.excess.there:
        _second(plant, seen, other, found, "second_joint" in allowed)
    return found


def _second(plant: Plant, seen: list[Sight], other: list[Sight], found: FoundGeometry, allowed: bool) -> None:
    """The points leave the joint's paths: is it one more joint?"""
    K = len(found.best.points)
    size = found.excess.share
    found.left = f"the points leave the paths of a single joint by {size:.1f} times their noise"
    if not allowed:
        return
    if K < 3:
        found.left += "; three points or more would tell whether the part moves in a second way"
        return
    power = float(found.noise.spectrum(np.array([1e-3]))[0])
    two = second_joint(plant, seen, found.best, power)
    held = second_joint(plant, other, found.held, power, two.twist)
    # One free number a frame takes one of 3 K - 1 from the noise: give that back before looking at what is left.
    back = np.sqrt((3 * K - 1) / (3 * K - 2))
    fast, generous = estimate([back * s for s in series(two) + series(held)])
    after = excess([back * s for s in series(two) + series(held)], generous)
    before = found.held.rmse**2 - fast.std**2
    gone = found.held.rmse**2 - held.rmse**2 * back**2
    if after.there or gone < SHARE * before:
        found.left += ", and one more joint does not explain it"
        return
    found.evidence["second_joint"] = {"heldout_rmse_without": found.held.rmse, "heldout_rmse": held.rmse,
                                      "excess": size, "excess_left": after.share}  # fmt: skip
    found.best, found.held, found.left, found.excess = two, held, "", after
    found.causes = (*found.causes, "second_joint")
