"""Windows, extension of a window's hypothesis to the whole video, and scoring on all tracks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from reconstruct.joint.bundle import Observations, State, refine, reprojection, solve_depths, transport
from reconstruct.joint.groups import farthest, neighbours, paths_of_patch
from reconstruct.joint.hypotheses import Hypothesis, prismatic_hypotheses, revolute_hypotheses
from reconstruct.joint.paths import Paths, held

SCORE_PX = 3.0
"""Scale of the robust score, working px."""
WORTH_PX = (3.0, 1.5, 0.75, 0.375)
"""Scales over whose mean joints are compared: rendered tracks err by a tenth of a px, real ones by one."""


def image_speed(uv: np.ndarray) -> np.ndarray:
    """(T - 1,) upper image speed of moving tracks (N, T, 2), px a frame; zero where too few are seen."""
    step = np.linalg.norm(np.diff(uv, axis=1), axis=-1)
    seen = np.isfinite(step)
    return np.array(
        [np.quantile(step[seen[:, t], t], 0.9) if seen[:, t].sum() > 3 else 0.0 for t in range(step.shape[1])]
    )


def key_frames(uv: np.ndarray, count: int = 28) -> np.ndarray:
    """(K,) frames spread evenly over the accumulated motion of moving tracks (N, T, 2).

    First and last frame in which anything is seen are among them.
    """
    anything = np.flatnonzero(np.isfinite(uv[..., 0]).any(0))
    if not len(anything):
        return anything
    first, last = anything[0], anything[-1]
    speed = image_speed(uv[:, first : last + 1])
    if not len(speed):
        return anything[:1]
    total = np.concatenate([[0], np.cumsum(speed + 0.03 * speed.max() + 1e-9)])
    return first + np.unique(np.searchsorted(total, np.linspace(0, total[-1], count)).clip(0, last - first))


def motion_stretches(uv: np.ndarray, time: np.ndarray, gap: float = 0.4, shortest: float = 0.25) -> list[slice]:
    """Stretches of motion between rests, the one with most motion first.

    Args:
        uv: (N, T, 2) moving tracks.  time: (T,) s.
        gap: rests shorter than this do not divide, s.  shortest: shorter stretches are dropped, s.
    """
    speed = image_speed(uv)
    speed = np.convolve(speed, np.ones(5) / 5, mode="same")
    active = np.flatnonzero(speed > 0.25 * np.quantile(speed, 0.97))
    if not len(active):
        return []
    breaks = np.flatnonzero(np.diff(time[active]) > gap)
    out = []
    for part in np.split(active, breaks + 1):
        if time[part[-1] + 1] - time[part[0]] >= shortest:
            # The rests beside it show where the part starts and ends.
            lo = np.searchsorted(time, time[part[0]] - 0.5 * gap)
            hi = np.searchsorted(time, time[part[-1] + 1] + 0.5 * gap)
            out.append((float(speed[part].sum()), slice(int(lo), int(hi))))
    return [span for _, span in sorted(out, key=lambda x: -x[0])]


def observations(
    paths: Paths,
    focal_work: float,
    centre: np.ndarray,
    frames: np.ndarray,
    limit: int,
    rng: np.random.Generator,
    diagonal: float,
) -> tuple[Observations, np.ndarray]:
    """Key-frame observations of moving tracks, thinned so that no textured spot dominates.

    Returns:
        observations, and (N,) indices into the paths of the tracks kept.
    """
    keys = paths.at(frames)
    ids = np.flatnonzero(keys.seen.sum(1) >= 4)
    keys, moved = keys[ids], paths[ids].moved()
    uv, seen = keys.uv, keys.seen
    middle = np.array([np.flatnonzero(s)[s.sum() // 2] for s in seen])
    place = uv[np.arange(len(ids)), middle]
    # Weight by the reciprocal of the number of neighbours in time and place: area counts, not texture.
    near = (np.linalg.norm(place[:, None] - place[None], axis=-1) < 0.02 * diagonal) & (
        np.abs(middle[:, None] - middle[None]) <= 3
    )
    weight = 1.0 / np.sqrt(near.sum(1))
    motion = np.nanmax(moved[:, frames], axis=1) - np.nanmin(moved[:, frames], axis=1)
    reach = np.linalg.norm(motion, axis=1)
    weight *= np.clip(reach / (0.06 * diagonal), 0.05, 1.0) * coherence(moved)
    if len(ids) > limit:
        pick = np.sort(rng.choice(len(ids), limit, replace=False, p=weight**2 / np.sum(weight**2)))
        ids, uv, seen, middle, weight, keys = ids[pick], uv[pick], seen[pick], middle[pick], weight[pick], keys[pick]
    xy = np.where(seen[..., None], (uv - centre) / focal_work, 0.0)
    return Observations(xy, seen, middle, weight, 1.0 / focal_work, frames, keys.slip), ids


def coherence(uv: np.ndarray) -> np.ndarray:
    """(N,) extent of each track's path over half its length, in [0, 1]: jitter and random walks score low.

    A point that goes and comes back has 1, as has one that goes once.
    """
    step = np.diff(uv[:, ::3], axis=1)
    path = np.nansum(np.linalg.norm(step, axis=-1), axis=1)
    extent = np.linalg.norm(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=-1)
    return np.clip(2 * extent / np.maximum(path, 1e-6), 0, 1) ** 2


def window_hypotheses(obs: Observations, rng: np.random.Generator, windows: int = 10) -> list[Hypothesis]:
    """Hypotheses from windows around several reference key frames, both directions of time."""
    K = len(obs.frames)
    found: list[Hypothesis] = _global_hypotheses(obs, rng)
    for ref in np.unique(np.linspace(0, K - 1, windows).round().astype(int)):
        for span in (np.arange(ref, K), np.arange(ref, -1, -1)):
            for length in {min(len(span), K // 3), len(span)}:
                keys = span[:length]
                if length < 5:
                    continue
                found += _one_window(obs, keys, rng)
    return found


def global_profile(obs: Observations) -> np.ndarray:
    """(K,) signed, accumulated image speed of the fastest tracks: a first guess of q up to scale.

    A reversal shows as tracks that turn back between consecutive intervals.
    """
    xy = np.where(obs.seen[..., None], obs.xy, np.nan)
    step = np.diff(xy, axis=1)
    length = np.linalg.norm(step, axis=-1)
    K = len(obs.frames)
    speed = np.zeros(K - 1)
    sign = np.ones(K - 1)
    for k in range(K - 1):
        ok = np.isfinite(length[:, k])
        if ok.sum() < 4:
            continue
        order = np.argsort(length[ok, k])
        share = np.cumsum(obs.weight[ok][order]) / obs.weight[ok].sum()
        speed[k] = length[ok, k][order][np.searchsorted(share, 0.85).clip(0, ok.sum() - 1)]
        if k:
            both = ok & np.isfinite(length[:, k - 1])
            dot = np.sum(step[both, k] * step[both, k - 1], axis=-1) * obs.weight[both]
            sign[k] = sign[k - 1] * (-1 if dot.sum() < 0 else 1)
    return np.concatenate([[0], np.cumsum(speed * sign)])


def _global_hypotheses(obs: Observations, rng: np.random.Generator, rounds: int = 4) -> list[Hypothesis]:
    """Hypotheses from tracks of all reference frames at once, each against its own reference."""
    profile = global_profile(obs)
    span = np.ptp(profile)
    if span < 6 * obs.px:
        return []
    profile /= span
    K, m = len(obs.frames), 7
    out: list[Hypothesis] = []
    for _ in range(rounds):
        n = min(90, len(obs.ref))
        ids = rng.choice(len(obs.ref), n, replace=False, p=obs.weight / obs.weight.sum())
        rays, slip = np.full((n, m, 3), np.nan), np.zeros((n, m, 2))
        local = np.zeros((n, m))
        for row, i in enumerate(ids):
            keys = np.flatnonzero(obs.seen[i])
            keys = keys[np.unique(np.linspace(0, len(keys) - 1, m).round().astype(int))]
            keys = np.roll(keys, -(len(keys) // 2))  # the middle one is the reference
            rays[row, : len(keys)] = np.concatenate([obs.xy[i, keys], np.ones((len(keys), 1))], axis=1)
            local[row, : len(keys)] = profile[keys] - profile[keys[0]]
            if obs.slip is not None:
                slip[row, : len(keys)] = obs.slip[i, keys]
        args = (rays, np.arange(K), local, obs.weight[ids], 3.0 * obs.px, rng)
        more = dict(whole=profile, slip=None if obs.slip is None else slip)
        out += revolute_hypotheses(*args, **more) + prismatic_hypotheses(*args, **more)
    return out


def _one_window(obs: Observations, keys: np.ndarray, rng: np.random.Generator, most: int = 70) -> list[Hypothesis]:
    at_ref = obs.seen[:, keys[0]]
    # Tracks seen at the reference and in most of the window; the window ends where too few are left.
    for end in range(len(keys), 4, -3):
        k = keys[:end]
        long = at_ref & (obs.seen[:, k].mean(1) > 0.8) & obs.seen[:, k[-1]]
        if long.sum() >= 8:
            break
    else:
        return []
    ids = np.flatnonzero(long)
    if len(ids) > most:
        ids = np.sort(rng.choice(ids, most, replace=False, p=obs.weight[ids] / obs.weight[ids].sum()))
    if len(k) > 9:
        k = k[np.unique(np.linspace(0, len(k) - 1, 9).round().astype(int))]
    rays = np.concatenate([obs.xy[ids][:, k], np.ones((len(ids), len(k), 1))], axis=-1)
    rays[~obs.seen[ids][:, k]] = np.nan
    slip = None if obs.slip is None else obs.slip[ids][:, k]
    moved = np.linalg.norm(held(rays[..., :2] - rays[:, :1, :2], slip), axis=-1)
    top = np.nanmax(moved, axis=1)
    w = obs.weight[ids] * np.clip(top / (30 * obs.px), 0, 1)
    # The profile is read off the tracks that move most: the others are the static link, or jitter.
    strong = np.argsort(-w)[: max(4, len(ids) // 4)]
    profile = np.nan_to_num(np.nanmedian(moved[strong], axis=0))
    if profile.max() < 6 * obs.px:
        return []
    profile = profile / profile.max()
    tol = 3.0 * obs.px
    if (w > 0).sum() < 8:
        return []
    args = (rays, k, profile, w, tol, rng)
    return revolute_hypotheses(*args, slip=slip) + prismatic_hypotheses(*args, slip=slip)


PATCHES, PATCH_SIZES = 18, (30, 80)
"""Neighbourhoods whose own motion is read, and their tracks."""


def patch_states(obs: Observations, rng: np.random.Generator) -> list[State]:
    """Hinges from neighbourhoods that are taken for flat pieces of one body, refined on all tracks; best first.

    The windows' hypotheses assume that the joint turns as the picture moves. A door that is seen from its front at last
    moves fast there and turns slowly; a neighbourhood's own path (groups.py) has its own angles.
    """
    x = np.where(obs.seen[..., None], obs.xy, np.nan)
    long = np.flatnonzero(obs.seen.sum(1) >= 6)
    if len(long) < 8:
        return []
    carried: list[State] = []
    for n, track in enumerate(long[farthest(x[long], min(PATCHES, len(long)), rng)]):
        patch, r = neighbours(x, obs.seen, track, PATCH_SIZES[n % len(PATCH_SIZES)])
        if len(patch) < 8:
            continue
        keys = np.flatnonzero(obs.seen[patch].sum(0) >= 5)
        for R, t in paths_of_patch(x[patch], obs.seen[patch], r, 1.0 / obs.px):
            if (h := _hinge_of_path(R[keys], t[keys], keys)) is not None:
                carried.append(extend(h, obs))
    carried.sort(key=lambda s: -explained(s, obs, 2 * SCORE_PX)[0])
    fined = [_refined(s, obs) for s in carried[:PATCHES]]
    return sorted(fined, key=lambda s: -worth(s, obs))


def _refined(s: State, obs: Observations) -> State:
    """The better of a wide and a narrow refinement, sharpened.

    A wide one reaches further, but an arm's many tracks pull at it.
    """
    both = [refine(s, obs, scales=scales, iterations=6) for scales in ((10.0, 5.0), (4.0, 2.0))]
    return sharpened(max(both, key=lambda r: explained(r, obs)[0]), obs)


def sharpened(s: State, obs: Observations) -> State:
    """The state refined down to errors of a working px, or as it was where that is worth less."""
    return max((s, refine(s, obs, scales=(2.0, 1.0), iterations=5)), key=lambda r: worth(r, obs))


def _hinge_of_path(R: np.ndarray, t: np.ndarray, keys: np.ndarray) -> Hypothesis | None:
    """The hinge nearest to a body's poses (K, 3, 3), (K, 3) before a resting camera: d_t = (I - D_t) c."""
    if len(keys) < 5:
        return None
    D = R @ R[0].T
    d = t - D @ t[0]
    turns = Rotation.from_matrix(D).as_rotvec()
    axis = np.linalg.svd(turns)[2][0]
    q = np.unwrap(turns @ axis)
    sides = np.concatenate([(np.eye(3) - D).reshape(-1, 3), 0.05 * axis[None]])
    point = np.linalg.lstsq(sides, np.append(d.ravel(), 0.0))[0]
    point -= axis * (axis @ point)
    size = np.linalg.norm(point)
    return Hypothesis("revolute", axis, point / size, keys, q, 0.0) if size > 1e-6 else None


def extend(h: Hypothesis, obs: Observations) -> State:
    """Carry a window's states to all key frames, one frame after the other (incremental structure from motion)."""
    K = len(obs.frames)
    known = np.zeros(K, bool)
    known[h.frames] = True
    order = np.argsort(h.frames)
    q = np.interp(np.arange(K), h.frames[order], h.q[order])
    lo, hi = h.frames.min(), h.frames.max()
    known[lo : hi + 1] = True
    span = max(np.ptp(h.q), 1e-3)
    point = np.zeros(3) if h.point is None else h.point
    s = State(h.kind, h.axis, point, q, np.ones(len(obs.ref)))
    while True:
        now = _restricted(obs, known)
        s = solve_depths(s, now, sweeps=1)
        if known.all():
            break
        X, _ = transport(s, now)
        r2 = np.sum(reprojection(X, now) ** 2, axis=-1)
        count = now.seen.sum(1)
        good = (count >= 3) & (r2.sum(1) / np.maximum(count, 1) < (2 * SCORE_PX) ** 2)
        for t, neighbour in ((lo - 1, lo), (lo - 2, lo), (hi + 1, hi), (hi + 2, hi)):
            if not 0 <= t < K:
                continue
            use = good & obs.seen[:, t]
            s.q[t] = _search_state(s, now, obs, use, t, s.q[neighbour], span)
            known[t] = True
        lo, hi = max(lo - 2, 0), min(hi + 2, K - 1)
    # Depths so far belong to the first known key frame of each track; solve them on the tracks' own references.
    return solve_depths(s, obs, sweeps=2)


def _restricted(obs: Observations, known: np.ndarray) -> Observations:
    seen = obs.seen & known
    first = np.where(seen.any(1), seen.argmax(1), obs.ref)
    return replace(obs, seen=seen, ref=first)


def _search_state(
    s: State, now: Observations, obs: Observations, use: np.ndarray, t: int, start: float, span: float
) -> float:
    """The state in key frame t by a one-dimensional search over tracks whose depth is known."""
    if use.sum() < 3:
        return float(start)
    sub = np.flatnonzero(use)
    grid = start + span * np.linspace(-0.5, 0.5, 31)
    rays = now.ref_rays[sub]
    # One pseudo observation per track and candidate: reuse transport by writing the candidates as key frames.
    cand = Observations(
        np.broadcast_to(obs.xy[sub, t][:, None], (len(sub), 31 + len(s.q), 2)).copy(),
        np.concatenate([np.zeros((len(sub), len(s.q)), bool), np.ones((len(sub), 31), bool)], axis=1),
        now.ref[sub],
        obs.weight[sub],
        obs.px,
        np.arange(31 + len(s.q)),
        None if obs.slip is None else np.repeat(obs.slip[sub, t][:, None], 31 + len(s.q), axis=1),
    )
    cand.xy[np.arange(len(sub)), now.ref[sub]] = rays[:, :2]
    trial = replace(s, q=np.concatenate([s.q, grid]), depth=s.depth[sub])
    X, _ = transport(trial, cand)
    r2 = np.sum(reprojection(X, cand)[:, len(s.q) :] ** 2, axis=-1)
    cost = np.sum(obs.weight[sub][:, None] * np.minimum(r2, (3 * SCORE_PX) ** 2), axis=0)
    k = int(np.argmin(cost))
    if 0 < k < 30:  # parabola through the minimum
        a, b, c = cost[k - 1 : k + 2]
        shift = 0.5 * (a - c) / (a - 2 * b + c + 1e-12)
        return float(grid[k] + np.clip(shift, -1, 1) * (grid[1] - grid[0]))
    return float(grid[k])


def explained(s: State, obs: Observations, scale: float = SCORE_PX) -> tuple[float, np.ndarray]:
    """Explained motion: how much better than "static" the joint explains all tracks.

    Returns:
        (sum over tracks, (N,) explained share of each track's motion, at most 1, negative where "static" is better).
    """
    return _explained_at(s, obs, (scale,))[0]


def worth(s: State, obs: Observations) -> float:
    """What a joint explains, in the mean over the sizes that the tracks' errors may have (:data:`WORTH_PX`).

    At three pixels alone a hinge that turns by a few degrees explains a lid that turns by ninety, and the shadow beside
    it better than the right one does. No size is right for all; the mean stands for not knowing it (after Barath et
    al., "MAGSAC: Marginalizing Sample Consensus", CVPR 2019).
    """
    return float(np.mean([total for total, _ in _explained_at(s, obs, WORTH_PX)]))


def _explained_at(s: State, obs: Observations, scales: Sequence[float]) -> list[tuple[float, np.ndarray]]:
    """:func:`explained` at each of these scales, working px."""
    r2 = np.sum(reprojection(transport(s, obs)[0], obs) ** 2, axis=-1)
    sane = (s.depth > 0.1 * np.median(s.depth)) & (s.depth < 10 * np.median(s.depth))
    out = []
    for scale in scales:
        share, amount = explained_by(r2, obs, obs.seen, scale)
        share = np.where(sane, share, 0)
        out.append((total_explained(share, amount, obs), share))
    return out


def total_explained(share: np.ndarray, amount: np.ndarray, obs: Observations) -> float:
    """Sum over tracks; the square root because a track's frames err together."""
    return float(np.sum(obs.weight * np.clip(share, 0, None) * np.sqrt(amount)))


def explained_by(
    r2: np.ndarray, obs: Observations, valid: np.ndarray, scale: float = SCORE_PX
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each track's motion that squared residuals r2 (N, K), px^2, leave explained where valid.

    Each observation has rho(displacement) to explain, with rho truncated, and is left with rho(residual): a point
    that hardly moves has hardly anything to explain, and counts against the model if that moves it. The time for
    which a track rests does not count.

    Returns:
        (N,) share in (-inf, 1], and (N,) amount of motion, about the number of frames in which the track is away.
    """
    own = obs.xy[np.arange(len(obs.ref)), obs.ref][:, None]
    moved2 = np.sum(held((obs.xy - own) / obs.px, obs.slip) ** 2, axis=-1)
    rho = lambda e2: 1 - 1 / (1 + e2 / scale**2)  # noqa: E731
    counted = obs.seen & valid
    amount = np.where(counted, rho(moved2), 0).sum(1)
    left = np.where(counted, rho(np.where(counted, r2, 0)), 0).sum(1)
    return (amount - left) / np.maximum(amount, 1.0), amount


CLEAR_SHARE, CLEAR_PX = 0.4, 1.2
"""A joint that explains this share of all motion in the picture, with residuals as small as this (working px), needs no
wider search."""


FEWEST_OF_REGION, OF_REGION = 12, 4
"""Tracks of a region below which it is not searched, and joints of one that are carried on."""


def search(
    obs: Observations,
    rng: np.random.Generator,
    coarse: int = 60,
    fine: int = 10,
    progress: Callable[[float], None] = lambda _: None,
) -> list[State]:
    """Best joints of both types, best first.

    A short search comes first: long windows from both ends and the middle, and neighbourhoods. Where one of its joints
    explains most of the motion in the picture down to the tracks' noise, the answer is clear; else every window is
    tried.
    """
    K = len(obs.frames)
    few = _global_hypotheses(obs, rng, rounds=1)
    for span in (np.arange(K), np.arange(K)[::-1], np.arange(K // 2, K), np.arange(K // 2, -1, -1)):
        few += _one_window(obs, span, rng, most=40)
    more = patch_states(obs, rng)
    first = _best_of(few, obs, coarse // 4, max(fine // 3, 2), thorough=False, more=more)
    progress(0.2)
    if first and _is_clear(first[0], obs):
        return first
    hyps = few + window_hypotheses(obs, rng)
    progress(0.5)
    out = first + _best_of(hyps, obs, coarse, fine, thorough=True, more=more)
    progress(1.0)
    return sorted(out, key=lambda s: -worth(s, obs))


def region_of(place: np.ndarray, count: int) -> np.ndarray:
    """(N,) region of the picture, of so many, that each of the places (N, 2) lies in: k-means from a row along the
    direction that they extend in."""
    off = place - place.mean(0)
    order = np.argsort(off @ np.linalg.svd(off, full_matrices=False)[2][0])
    first = place[order[((np.arange(count) + 0.5) / count * len(place)).astype(int)]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a region may lose all its tracks
        return kmeans2(place, first, minit="matrix")[1]


def search_regions(obs: Observations, rng: np.random.Generator, count: int) -> list[State]:
    """Joints of regions of the picture, each searched by itself, judged on all tracks; best first.

    Where most of what moves is a shadow or what else the part uncovers, joints that draw on both explain much of
    everything, and all starts end in one of these. The part is in one place of the picture: some region holds most of
    it and little else.

    Args:
        obs: key-frame observations of N moving tracks.  rng: of the searches.
        count: of regions, by the tracks' median places.

    Returns:
        States with the depths of all N tracks.
    """
    place = np.array([np.median(obs.xy[i, obs.seen[i]], axis=0) for i in range(len(obs.ref))])
    region = region_of(place, count)
    out: list[State] = []
    for k in range(count):
        here = region == k
        if here.sum() < FEWEST_OF_REGION:
            continue
        for s in distinct(search(obs.of(here), rng), OF_REGION):
            whole = solve_depths(replace(s, depth=np.ones(len(obs.ref))), obs)
            out += [sharpened(whole, obs)]
    return sorted(out, key=lambda s: -worth(s, obs))


def _is_clear(s: State, obs: Observations) -> bool:
    total, share = explained(s, obs)
    _, amount = explained_by(np.zeros(obs.seen.shape), obs, obs.seen)
    whole = float(np.sum(obs.weight * np.sqrt(amount)))
    link = share > 0.5
    if link.sum() < 12 or total < CLEAR_SHARE * whole:
        return False
    r = np.linalg.norm(reprojection(transport(s, obs)[0], obs), axis=-1)
    return bool(np.median(r[link][obs.seen[link]]) < CLEAR_PX)


def _best_of(hyps: list[Hypothesis], obs: Observations, coarse: int, fine: int, thorough: bool,
             more: list[State]) -> list[State]:  # fmt: skip
    """Hypotheses carried to all key frames, refined and judged on all tracks, and hinges `more`; best first."""
    out: list[State] = []
    for kind in ("revolute", "prismatic"):
        pool = sorted((h for h in hyps if h.kind == kind), key=lambda h: -h.score)[:coarse]
        states = [extend(h, obs) for h in pool]
        states.sort(key=lambda s: -explained(s, obs, 2 * SCORE_PX)[0])
        fined = [_refined(s, obs) for s in distinct(states, fine)]
        fined += more if kind == "revolute" else []
        fined.sort(key=lambda s: -worth(s, obs))
        last = [_settled(s, obs, (4.0, 2.0), 20) for s in distinct(fined, max(2, fine // 3))]
        if kind == "revolute":
            last += [_settled(_tilted_back(s, obs), obs, (4.0, 2.0), 20) for s in last[: 2 if thorough else 1]]
        if thorough:
            for s in sorted(last, key=lambda s: -worth(s, obs))[:2]:
                last += [_settled(r, obs, (10.0, 5.0, 3.0, 2.0), 12) for r in _states_anew(s, obs)]
        out += last
    return sorted(out, key=lambda s: -worth(s, obs))


def _settled(s: State, obs: Observations, scales: tuple[float, ...], iterations: int) -> State:
    """The state after a wide refinement, sharpened, or as it was: a wide one may walk away from the truth."""
    wide = refine(s, obs, scales=scales, iterations=iterations)
    return max((s, sharpened(wide, obs)), key=lambda r: worth(r, obs))


def _states_anew(s: State, obs: Observations) -> list[State]:
    """The joint with its states found afresh: by extension from a half or the middle, and from the motion profile.

    Where few tracks bridge two parts of the video, the states of one part can be off by a constant that no small step
    undoes; with the axis known, a new start finds them.
    """
    K = len(obs.frames)
    point = None if s.kind == "prismatic" else s.point
    profile = global_profile(obs)
    out = []
    for core in (np.arange(K // 4, K - K // 4), np.arange(K // 2, K), np.arange(0, K // 2)):
        if len(core) < 4 or np.ptp(s.q[core]) < 0.1 * np.ptp(s.q):
            continue
        out.append(extend(Hypothesis(s.kind, s.axis, point, core, s.q[core] - s.q[core[0]], 0.0), obs))
        # Speed in the picture is about proportional to the joint's: the core gives the factor.
        dp, dq = np.diff(profile[core]), np.diff(s.q[core])
        if np.sum(dp**2) > 0:
            q = profile * np.sum(dp * dq) / np.sum(dp**2)
            out.append(solve_depths(replace(s, q=q - q[0], depth=np.ones(len(obs.ref))), obs))
    return out


def _tilted_back(s: State, obs: Observations) -> State:
    """The twin of a joint whose axis leans towards the other side of the viewing ray.

    Under weak perspective both draw the same ellipses; which one is right shows only in small effects, so that a
    fit may settle in either.
    """
    _, per = explained(s, obs)
    X, _ = transport(s, obs)
    on_link = obs.seen & (per > 0.5)[:, None]
    if not on_link.any():
        return s
    P = np.median(X[on_link], axis=0)
    centre = s.point + s.axis * ((P - s.point) @ s.axis)
    ray = centre / np.linalg.norm(centre)
    axis = 2 * (s.axis @ ray) * ray - s.axis
    point = centre - (centre @ axis) * axis
    size = np.linalg.norm(point)
    if size < 1e-6:
        return s
    return solve_depths(replace(s, axis=axis, point=point / size), obs)


def distinct(states: list[State], count: int) -> list[State]:
    """The first `count` of different axis lines."""
    out: list[State] = []
    for s in states:
        if not any(_same(s, o) for o in out):
            out.append(s)
        if len(out) >= count:
            break
    return out


def _same(one: State, other: State) -> bool:
    """Nearly the same axis line."""
    turned = abs(one.axis @ other.axis) < 0.995
    return not turned and (one.kind == "prismatic" or one.point @ other.point > 0.995)
