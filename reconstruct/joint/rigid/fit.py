"""The joint from tracks with depth: first poses, hypotheses, robust refinement, type, uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import VAGUE_DEG, JointFit
from reconstruct.joint.rigid.bundle import (
    CUT,
    State,
    bending,
    bridged,
    estimate_noise,
    points_of,
    refine,
    residuals,
    weigh,
)
from reconstruct.joint.rigid.evidence import HOLDING, weigh_types
from reconstruct.joint.rigid.kabsch import Poses, hypotheses, register
from reconstruct.joint.rigid.normal import OWN, covariance, normal_equations
from reconstruct.joint.rigid.observe import Noise, Observations, observe, robust_mean, static_field
from reconstruct.joint.rigid.twist import KINDS, make

MIN_TRACKS = 8
KEYS, SAMPLE = 24, 150
"""Frames and tracks of the search; the last refinements take all."""
DECIDE_FRAMES, DECIDE_TRACKS = 32, 160
CERTAIN = 0.9
TRIES = {"prismatic": 2, "revolute": 3, "screw": 1}
"""Hypotheses of each type that are refined; a screw is also started from the best hinge."""
HOPELESS = 400.0
"""A type whose robust cost is so much above the best one's needs no closer look."""
AGREE = 0.35
"""Share of the link's observations that has to agree with the joint."""
SURE = 0.9
EXCITED = 8.0


def fit_rigid(uv: np.ndarray, visible: np.ndarray, depth: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray,
              link: np.ndarray | None = None, metric: bool = True, seed: int = 0) -> JointFit:  # fmt: skip
    """Joint type, axis, pivot, states and their uncertainty from tracks of known depth and known cameras.

    Args:
        uv: (N, T, 2) px.  visible: (N, T) bool.  depth: (N, T) m along the optical axis, NaN where unknown.
        K: (3, 3) px.  T_world_camera: (T, 4, 4).
        link: (N,) bool, tracks on the moving link as masks say; told from the motion itself when None.
        metric: depths are in metres.
        seed: of the random subsets.

    Returns:
        A JointFit in the world of the cameras, states for every frame with q = 0 in the first; or one that is refused.
    """
    rng = np.random.default_rng(seed)
    depth = np.asarray(depth, float)
    N, T = visible.shape
    if link is None:
        link = moving_tracks(observe(uv, visible, depth, K, T_world_camera, np.zeros(N, bool)))
    obs = observe(uv, visible, depth, K, T_world_camera, np.asarray(link, bool))
    usable = obs.seen.sum(1) >= 2
    if (usable & obs.link).sum() < MIN_TRACKS:
        return _refused(f"only {int((usable & obs.link).sum())} tracks lie on something that moves; "
                        "film more of the moving part", N)  # fmt: skip
    field, noise = static_field(obs)
    world = obs.lift(field)
    world[~obs.link] = np.nan
    keys = key_frames(world)
    part = np.flatnonzero(obs.link & (obs.ranged[:, keys].sum(1) >= 2))
    if len(keys) < 3 or len(part) < MIN_TRACKS:
        return _refused("the tracks are too short to follow the part; film it without long occlusion", N)
    part = np.sort(rng.choice(part, min(SAMPLE, len(part)), replace=False))
    poses = register(world[np.ix_(part, keys)])
    if poses is None:
        return _refused("no rigid motion is shared by enough tracks; track more points on the part", N)
    found = hypotheses(poses, rng)
    if not found:
        return _refused("nothing moves: the part's pose is the same in every frame; film it while it moves", N)
    states, keys, noise = _search(found, poses, obs, field, keys, part, noise)
    every = np.arange(T)
    # The type is decided on a part of frames and tracks, and on everything only where that part does not tell.
    probability: dict[str, float] = {}
    parts = ((_thin(every, DECIDE_FRAMES, keys), _sample(obs, DECIDE_TRACKS, rng)), (every, np.arange(N)))
    for frames, tracks in parts:
        some = obs.of(tracks, frames)
        over = {k: _spread(st, keys, frames, some, field) for k, st in states.items()}
        best, probability, told = _decide(over, some, noise)
        if max(probability.values()) > CERTAIN or len(frames) == T:
            break
    whole = _spread(best, frames, every, obs, field)
    whole, _ = refine(whole, obs, told, 3.0, iterations=3, tolerance=1e-3)
    best, kept, noise = _polish(whole, obs, told)
    best = bridged(best, kept)
    best, _ = refine(best, kept, noise, None, iterations=5, stiff=bending(best, kept), tolerance=1e-7)
    reason = _why_not(best, obs, noise, poses, world, keys, part)
    if reason:
        return replace(_refused(reason, N), type_probability=probability)
    return _result(best, kept, noise, probability, metric)


def _thin(every: np.ndarray, count: int, keys: np.ndarray) -> np.ndarray:
    """About `count` frames spread over all, the key frames among them."""
    return np.unique(np.concatenate([keys, np.linspace(0, len(every) - 1, min(count, len(every))).round().astype(int)]))


def _sample(obs: Observations, count: int, rng: np.random.Generator) -> np.ndarray:
    """Tracks of the link and half as many at rest."""
    out = []
    for rows, most in ((np.flatnonzero(obs.link), count), (np.flatnonzero(~obs.link), count // 2)):
        rows = rows[obs.seen[rows].sum(1) >= 2]
        out.append(np.sort(rng.choice(rows, min(most, len(rows)), replace=False)))
    return np.concatenate(out)


def moving_tracks(obs: Observations, quantile: float = 0.8) -> np.ndarray:
    """(N,) bool: tracks that no place at rest explains, by that quantile of how far their pixels are from its picture.
    """
    X = robust_mean(obs.lift())
    cam = np.einsum("tij,nj->nti", obs.T_camera_world[:, :3, :3], X) + obs.T_camera_world[:, :3, 3]
    uv = cam[..., :2] / np.maximum(cam[..., 2:], 1e-6) * obs.K[[0, 1], [0, 1]] + obs.K[:2, 2]
    miss = np.linalg.norm(uv - obs.uv, axis=-1)
    far = np.array([np.quantile(m[s], quantile) if s.any() else 0.0 for m, s in zip(miss, obs.seen, strict=True)])
    floor = np.median(far[far < np.median(far)]) if len(far) > 1 else 0.0
    return far > max(3.0, 3 * floor)


def key_frames(world: np.ndarray) -> np.ndarray:
    """Frames spread evenly over time, those that see a fair number of the link's points."""
    count = np.isfinite(world[..., 0]).sum(0)
    good = np.flatnonzero(count >= max(6, 0.15 * count.max()))
    if len(good) == 0:
        return good
    return good[np.unique(np.linspace(0, len(good) - 1, min(KEYS, len(good))).round().astype(int))]


def _search(found: list, poses: Poses, obs: Observations, field: np.ndarray, keys: np.ndarray, part: np.ndarray,
            noise: Noise) -> tuple[dict[str, State], np.ndarray, Noise]:  # fmt: skip
    """The best state of every type over key frames and a sample of tracks, by graduated non-convexity."""
    rest = np.flatnonzero(~obs.link & (obs.ranged[:, keys].sum(1) >= 2))[:SAMPLE]
    some = obs.of(np.concatenate([part, rest]), keys)
    out: dict[str, tuple[float, State]] = {}
    tried: dict[str, list] = {kind: [] for kind in KINDS}
    for twist, s in found:
        if len(tried[twist.kind]) >= TRIES[twist.kind] or any(_alike(twist, t) for t in tried[twist.kind]):
            continue
        tried[twist.kind].append(twist)
        full = np.interp(np.arange(len(keys)), poses.frames, s)
        full -= full[poses.anchor]
        st = points_of(State(twist, full, np.zeros((len(some.link), 3)), field[keys], poses.anchor), some)
        st, cost = refine(st, some, noise, 6.0, iterations=4, tolerance=1e-3)
        if twist.kind not in out or cost < out[twist.kind][0]:
            out[twist.kind] = (cost, st)
    states = {}
    least = min(cost for cost, _ in out.values())
    for kind, (cost, st) in out.items():
        for scale in (4.0, 2.5) if cost < 2 * least + HOPELESS else ():
            st, cost = refine(st, some, noise, scale, iterations=5, tolerance=1e-3)
        states[kind] = (cost, st)
    kind = min(states, key=lambda k: states[k][0])
    r, _, _ = residuals(states[kind][1], some, noise)
    noise = estimate_noise(r, states[kind][1], some, noise)
    return {kind: st for kind, (_, st) in states.items()}, keys, noise


def _spread(st: State, keys: np.ndarray, frames: np.ndarray, obs: Observations, field: np.ndarray) -> State:
    """The same joint over other frames and tracks: states in between, points from all that is seen of them.

    Args:
        keys: frame numbers of `st`.  frames: those of `obs`; they hold the anchor.
        field: (T, 3) first guess of the depth error of all frames.
    """
    s = np.interp(frames, keys, st.s)
    f = field[frames].copy()
    both = np.isin(frames, keys)
    f[both] = st.field[np.searchsorted(keys, frames[both])]
    anchor = int(np.searchsorted(frames, keys[st.anchor]))
    return points_of(State(st.twist, s, np.zeros((len(obs.link), 3)), f, anchor), obs)


def _alike(a, b) -> bool:
    return abs(a.xi * np.repeat([a.size, 1.0], 3) @ (b.xi * np.repeat([b.size, 1.0], 3))) > 0.998


def _decide(states: dict[str, State], obs: Observations, noise: Noise) -> tuple[State, dict[str, float], Noise]:
    """Refine every type on what agrees with the best one, and weigh them."""
    first = {kind: refine(st, obs, noise, 3.0, iterations=4, tolerance=1e-3) for kind, st in states.items()}
    st = first[min(first, key=lambda k: first[k][1])][0]
    st, obs, noise = _polish(st, obs, noise)
    # Observations that agree with the best are what all types have to explain: outliers do not vote.
    r, _, _ = residuals(st, obs, noise)
    good, _ = weigh(r, obs, None)
    inflation = correlation(r, good > 0)
    last = {st.twist.kind: st}
    least = min(cost for _, cost in first.values())
    lost = {kind for kind, (_, cost) in first.items() if cost > least + HOPELESS * inflation}
    lost -= HOLDING[st.twist.kind]  # worse than their own special case, they have only started badly
    if st.twist.kind == "screw":  # what it holds as special cases may only have started badly
        lost -= {kind for kind in lost if _holds(st, kind, obs, noise, inflation)}
    last |= {kind: first[kind][0] for kind in lost}
    for kind in KINDS:
        if kind not in last:
            starts = [_as_kind(st, kind), *([first[kind][0]] if kind in first else [])]
            options = [refine(o, obs, noise, 3.0, iterations=4, tolerance=1e-3) for o in starts]
            last[kind] = refine(min(options, key=lambda o: o[1])[0], obs, noise, None, iterations=4)[0]
    agreed = replace(obs, seen=good > 0, ranged=obs.ranged & (good > 0))
    probability = weigh_types(last, agreed, noise, inflation, lost).probability
    if max(probability, key=probability.get) in lost:  # judged where it was fitted, the others where they were not
        probability = weigh_types(last, agreed, noise, inflation).probability
    return last[max(probability, key=probability.get)], probability, noise


def _holds(screw: State, kind: str, obs: Observations, noise: Noise, inflation: float) -> bool:
    """Whether the simpler type, started from the screw, comes near enough to it for a closer look."""
    _, least = refine(screw, obs, noise, 3.0, iterations=4, tolerance=1e-3)
    _, cost = refine(_as_kind(screw, kind), obs, noise, 3.0, iterations=4, tolerance=1e-3)
    return cost <= least + HOPELESS * inflation


def _polish(st: State, obs: Observations, noise: Noise) -> tuple[State, Observations, Noise]:
    """From a robust kernel to least squares over what agrees: noise, tracks that can be trusted, refinement."""
    for _ in range(2):
        r, _, _ = residuals(st, obs, noise)
        noise = estimate_noise(r, st, obs, noise)
        obs = replace(obs, seen=obs.seen & trusted(r, obs)[:, None])
        obs = replace(obs, ranged=obs.ranged & obs.seen)
        st, _ = refine(st, obs, noise, None, iterations=4)
    return st, obs, noise


def trusted(r: np.ndarray, obs: Observations) -> np.ndarray:
    """(N,) bool: tracks that agree throughout.

    A track that has gone wrong goes wrong gently: for a while its error hides in the noise, and in one direction. So a
    track is dropped as a whole if more of its observations are wrong than chance allows, or if the rest is too large
    together; unless that would leave too few.
    """
    r2 = np.sum(r**2, axis=-1) * obs.seen
    n = np.maximum(obs.seen.sum(1), 1)
    wrong = (r2 > CUT).sum(1)
    # Three unit normals a time, less the three degrees of freedom of the point.
    mean = np.minimum(r2, CUT).sum(1) / n
    good = (wrong <= np.maximum(2, 0.03 * n)) & (mean < 3 * (1 + 4 * np.sqrt(2 / (3 * n)))) & (obs.seen.sum(1) >= 2)
    for rows in (np.flatnonzero(obs.link), np.flatnonzero(~obs.link)):
        if good[rows].sum() < max(MIN_TRACKS, 0.25 * len(rows)):
            good[rows] = True
    return good


def _as_kind(st: State, kind: str) -> State:
    twist, length = make(kind, st.twist.w, st.twist.v, st.twist.origin, st.twist.size)
    return replace(st, twist=twist, s=st.s * length)


def correlation(r: np.ndarray, good: np.ndarray) -> float:
    """Factor by which errors that persist from frame to frame widen everything: (1 + a) / (1 - a), at least 1."""
    both = good[:, 1:] & good[:, :-1]
    if both.sum() < 50:
        return 1.0
    a, b = r[:, 1:, :2][both], r[:, :-1, :2][both]
    rho = float(np.sum(a * b) / max(np.sqrt(np.sum(a * a) * np.sum(b * b)), 1e-12))
    rho = float(np.clip(rho, 0.0, 0.98))
    return (1 + rho) / (1 - rho)


def _why_not(st: State, obs: Observations, noise: Noise, poses: Poses, world, keys, part) -> str:
    """A reason to refuse, or an empty string."""
    r, X, cam = residuals(st, obs, noise)
    inside = np.sum(r**2, axis=-1) < CUT
    link = obs.link[:, None] & obs.seen
    agree = (inside & link).sum() / max(link.sum(), 1)
    made = st.twist.poses(st.s)
    moved = np.einsum("tij,nj->nti", made[:, :3, :3], st.points[obs.link]) + made[:, :3, 3] - st.points[obs.link, None]
    stroke = float(np.median(np.linalg.norm(moved, axis=-1).max(1)[obs.seen[obs.link].any(1)]))
    z = float(np.median(np.exp(obs.log_depth[obs.ranged])))
    # How many standard deviations of a state the states span: pure noise spans five.
    w, _ = weigh(r, obs, None)
    info = normal_equations(st, obs, noise, r, X, cam, w, 0.0).own[:, 0, 0]
    held = info[info > 0]
    spread = np.sqrt(correlation(r, w > 0) / np.median(held)) if len(held) else np.inf
    if np.ptp(st.s) < EXCITED * spread:
        return (f"nothing moves: the part's points shift by {stroke * 1e3:.1f} mm, which is not more than the noise of "
                "its states; film a larger motion")  # fmt: skip
    # The same points as a free rigid body.
    tolerance = 3 * (np.median(poses.residual) + z * (noise.px / obs.K[0, 0] + 1e-4))
    local = world[np.ix_(part, keys)][:, poses.frames]
    free = np.einsum("tij,nj->nti", poses.R, poses.points) + poses.d
    free_miss = np.linalg.norm(free - local, axis=-1)
    at = keys[poses.frames]
    joint = np.einsum("tij,nj->nti", made[at, :3, :3], st.points[part]) + made[at, :3, 3]
    joint_miss = np.linalg.norm(joint - local, axis=-1)
    known = np.isfinite(free_miss)
    free_share = np.mean(free_miss[known] < tolerance)
    lost = np.mean((free_miss[known] < tolerance) & (joint_miss[known] > 2 * tolerance)) / max(free_share, 1e-9)
    if lost > 1 / 3:
        return (f"the part moves as a free body, not about one joint: {lost:.0%} of what follows a rigid motion does "
                f"not follow the best joint ({st.twist.kind}); film one part on one joint")  # fmt: skip
    if agree < AGREE:
        return (f"no joint: only {agree:.0%} of the moving tracks' observations agree with the best one "
                f"({st.twist.kind}); the part bends, or several parts move; film one rigid part")  # fmt: skip
    return ""


def _result(st: State, obs: Observations, noise: Noise, probability: dict[str, float], metric: bool) -> JointFit:
    """Signs, units, uncertainty and the contract's fields."""
    T = len(st.s)
    r, X, cam = residuals(st, obs, noise)
    w, _ = weigh(r, obs, None)
    n = normal_equations(st, obs, noise, r, X, cam, w, bending(st, obs))
    cov_joint, cov_mixed, cov_states = covariance(n, n.d + OWN * st.anchor)
    link = obs.link & (w.sum(1) >= 2)
    pose0 = st.twist.poses(st.s[:1])[0]
    points = st.points[link] @ pose0[:3, :3].T + pose0[:3, 3]
    centre = np.median(points, axis=0)
    J, axis, point, pitch, rate = _derivatives(st, centre)
    q = rate * (st.s - st.s[0])
    place = J["axis"] if point is None else np.concatenate([J["axis"], J["point"]])
    joint_cov = place @ cov_joint @ place.T
    # q_t = rate (s_t - s_0), and the rate changes with the joint.
    grown = np.outer(st.s - st.s[0], J["rate"])
    q_var = np.einsum("td,de,te->t", grown, cov_joint, grown) + rate**2 * (cov_states @ [1.0, 1.0, -2.0])
    q_var += 2 * rate * np.einsum("td,dt->t", grown, cov_mixed - cov_mixed[:, :1])
    with_q = place @ (cov_joint @ grown.T + rate * (cov_mixed - cov_mixed[:, :1]))
    wider = correlation(r, w > 0)
    joint_cov, with_q, q_std = wider * joint_cov, wider * with_q, np.sqrt(np.maximum(wider * q_var, 0))
    if q[int(np.argmax(np.abs(q)))] < 0:
        q, axis = -q, -axis
        turned = np.repeat([-1.0, 1.0], 3)[: len(joint_cov)]
        joint_cov, with_q = turned[:, None] * joint_cov * turned, -turned[:, None] * with_q
    kind = st.twist.kind
    p = probability[kind]
    inliers = int(link.sum())
    verdict, reason = "ok", f"{inliers} tracks with depth agree"
    if p < SURE:
        names = sorted(probability, key=probability.get, reverse=True)[:2]
        verdict = "ambiguous"
        reason = (f"{names[0]} and {names[1]} explain the motion almost equally well (p = {p:.2f}); "
                  "a larger motion would tell")  # fmt: skip
    variance = np.maximum(np.diag(joint_cov), 0.0)
    std = {"axis_deg": float(np.degrees(np.sqrt(variance[:3].sum()))), "point_m": float(np.sqrt(variance[3:].sum())),
           "q": q_std, "covariance": joint_cov, "covariance_q": with_q}  # fmt: skip
    if verdict == "ok" and std["axis_deg"] > VAGUE_DEG:
        verdict = "ambiguous"
        reason = (f"{inliers} tracks with depth hold the axis to {std['axis_deg']:.0f} deg only; a larger motion would "
                  "tell")  # fmt: skip
        # What holds the axis no better tells the types apart no better: five lights that go 1 px, one of them wrong.
        probability = or_by_prior(probability)
    if kind == "screw":
        std["pitch"] = float(np.sqrt(max(wider * J["pitch"] @ cov_joint @ J["pitch"], 0.0)))
    px = np.linalg.norm(r[..., :2], axis=-1)[w > 0] * noise.px
    T_camera_world = obs.T_camera_world[0]
    fit = JointFit(verdict, reason, kind, probability, axis, point, pitch, q, np.arange(T), obs.K, T_camera_world,
                   points, np.flatnonzero(link), metric, "depth" if metric else "none", std, None,
                   float(np.median(px)) if len(px) else None, inliers, len(obs.link), _moves(q))  # fmt: skip
    from reconstruct.joint.result import image_line

    return replace(fit, image_line=image_line(fit))


def _derivatives(st: State, centre: np.ndarray):
    """Axis, its point nearest to `centre`, pitch, dq/ds; derivatives by the twist's step (central differences)."""

    def of(step):
        twist, length = st.twist.moved(step)
        axis, point, pitch, rate = twist.joint()
        if point is not None:
            point = point + axis * ((centre - point) @ axis)
        return axis, point, pitch, rate * length

    d = st.twist.basis().shape[1]
    axis, point, pitch, rate = of(np.zeros(d))
    h = 1e-6
    pairs = [(of(h * e), of(-h * e)) for e in np.eye(d)]
    slope = lambda k: np.stack([(np.asarray(a[k]) - np.asarray(b[k])) / (2 * h) for a, b in pairs], axis=-1)  # noqa: E731
    J = {"axis": slope(0), "rate": slope(3), "point": None if point is None else slope(1),
         "pitch": None if pitch is None else slope(2)}  # fmt: skip
    return J, axis, point, pitch, rate


def _moves(q: np.ndarray) -> np.ndarray:
    """(T,) bool, frames in which the state changes."""
    speed = np.abs(np.gradient(q)) if len(q) > 1 else np.zeros(len(q))
    return speed > 0.1 * np.quantile(speed, 0.95)


def _refused(reason: str, tracks: int) -> JointFit:
    return JointFit("refused", reason, tracks=tracks)
