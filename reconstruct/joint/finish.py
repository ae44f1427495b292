"""From the best guesses of the search to the answer: bundle adjustment of every type on all tracks and frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruct.joint.bundle import Observations, State, transport
from reconstruct.joint.cameras import before_the_link, smoother_before_the_link
from reconstruct.joint.halves import halves, widened
from reconstruct.joint.paths import Paths, held
from reconstruct.joint.polish import (
    HOLDERS,
    ROBUST_SIGMAS,
    Bundle,
    Sightings,
    anchor_of,
    cheapest,
    place_points,
    polish,
    radius_cost,
    residuals,
    robust_loss,
)
from reconstruct.joint.states import held_only, in_sight_only
from reconstruct.joint.twist import Twist, twist_of_joint
from reconstruct.joint.uncertainty import (
    Spread,
    clusters,
    compact,
    lasting_error,
    shared_error,
    shared_weights,
    spread,
    strayed,
)
from reconstruct.joint.view import Still, View
from reconstruct.joint.weigh import Rival, strongest_rival, turn_deg, type_probabilities

MIN_COMMON = 8
FLEX_PX, FLEX_SIGMAS = 1.0, 4.0
"""How far real parts flex and tracks drift together without a residual that shows it, once errors are seen to be shared
at all: so many working px, and no more than so many times the noise that is seen."""
RELATIVE = (0.05, 3.0)
"""Least and most noise of a scene over the link's that is believed."""
MOST_FRAMES, MOST_TRACKS = 220, 400
"""Bounds of one bundle adjustment; further frames get their state afterwards, further tracks their point."""
FREE_FRAMES, MOST_STILL = 100, 200
"""The same where the camera's poses are unknown: six more numbers a frame make a step dear."""
COARSE_FRAMES = 40
"""Frames of the first round before a moving camera, which finds every type's best joint."""
NEAR, HELD = 4.0, 30.0
"""A hinge is as near as hinges are if the logarithm of its radius is within two standard deviations of the prior; and
how much more than it is worth the prior counts to get there."""
NO_SCREW = 1e-3
"""A thread less probable than this in the first round is not looked at again: the hinge is its special case."""


class NoLink(Exception):
    """The points of the tracks are no one body by any type: too few are before the camera and near each other."""


@dataclass(frozen=True)
class Finished:
    """The answer.

    Attributes:
        bundle: the most probable type's, over all frames, mean depth of the link 1.
        sight: its observations, (n, T).  members: (n,) indices into the tracks given.
        spread: its uncertainty.  probability: of each type.
        view: focal length and camera, whose path is fitted together with the joint where it moves.
        rival: the most probable of the other axes that were among the starts.
        once: the bundle as one adjustment of all tracks found it, before halves of the link and the tracks without
            strays led to a better one; that where None. A free body is fitted once as well, and is held against this.
        lost: number of frames that show tracks of the link, of which too few agree on a state; 0 for tracks with slip.
        doubt: why the axis is not certain though its spread is small; "" where it is.
        alone_deg: what the tracks alone hold the axis to, where edges of the picture gave it; else None.
    """

    bundle: Bundle
    sight: Sightings
    members: np.ndarray
    spread: Spread
    probability: dict[str, float]
    view: View
    rival: Rival | None = None
    once: Bundle | None = None
    lost: int = 0
    doubt: str = ""
    alone_deg: float | None = None

    @property
    def axis_deg(self) -> float:
        """Standard deviation of the axis, another one that is as probable included."""
        if self.rival is None:
            return self.spread.axis_deg
        return float(np.hypot(self.spread.axis_deg, np.sqrt(self.rival.probability) * self.rival.apart_deg))


def bundle_of_state(s: State, obs: Observations, frames: np.ndarray) -> Bundle:
    """A key-frame state as a start for all frames, with the link's median depth as the unit.

    Args:
        s, obs: of the search.  frames: (T,) frame numbers.
    """
    rays = obs.ref_rays
    zero = replace(
        obs,
        xy=np.concatenate([obs.xy, np.zeros((len(rays), 1, 2))], axis=1),
        seen=np.concatenate([obs.seen, np.zeros((len(rays), 1), bool)], axis=1),
    )
    q = np.interp(frames, obs.frames, s.q)
    X = transport(replace(s, q=np.concatenate([s.q, q[:1]])), zero)[0][:, -1]
    unit = max(float(np.median(X[:, 2])), 1e-6)
    X, q = X / unit, q - q[0]
    if s.kind == "prismatic":
        q = q / unit
    point = s.point / unit
    twist, speed = twist_of_joint(s.kind, s.axis, point, anchor_of(s.kind, X, s.axis, point))
    return Bundle(s.kind, twist, q * speed, X)


Starts = Mapping[str, Sequence[tuple[State, Observations] | Bundle]]


def finish(starts: Starts, paths: Paths, ids: np.ndarray, view: View, still: Still | None = None,
           refuted: str | None = None) -> Finished:  # fmt: skip
    """Polish every type on the same tracks and decide between them.

    Args:
        starts: per type, states with depths of the tracks `ids` and their key-frame observations, or bundles of these
            tracks in all frames. The one that fits best after polishing counts.
        paths: N tracks, px from the principal point.
        ids: (n,) tracks that the answer is fitted to.
        view: focal length and camera.
        still: the resting scene, where the camera moves and its path in `view` is but an estimate: it is refined
            together with the joint, whose uncertainty then holds the camera's.
        refuted: a type that is out of the question, however probable it is beside the others.

    Raises:
        NoLink: fewer than MIN_COMMON points make sense as those of one link.
    """
    T = paths.uv.shape[1]
    some = _spread_out(T, MOST_FRAMES if still is None else COARSE_FRAMES)
    pick = _spread_out(len(ids), MOST_TRACKS)
    # Until the errors are known they are taken to last: a focal length's prior has to hold against a few strays.
    sight = _held_frames_only(view.sightings(paths[ids[pick]], some, lasting=100.0))
    best: dict[str, Bundle] = {}
    others: dict[str, list[Bundle]] = {}
    for kind, several in starts.items():
        tried = []
        for start in several:
            b = start if isinstance(start, Bundle) else bundle_of_state(*start, some)
            q = b.q[some] if len(b.q) > len(some) else b.q
            tried.append(polish(replace(b, X=b.X[pick], q=q - q[0]), sight))
        best[kind] = min(tried, key=lambda b: b.cost + radius_cost(b, sight))
        others[kind] = [b for b in tried if b is not best[kind]]
    # Tracks that make sense as points of one link, by every type if these are nearly all of them.
    sane = [compact(b.X) & (b.X[:, 2] > 0) for b in best.values()]
    keep = np.logical_and.reduce(sane)
    if keep.sum() < max(MIN_COMMON, 0.8 * max(s.sum() for s in sane)):
        keep = sane[int(np.argmin([b.cost for b in best.values()]))]
    if keep.sum() < MIN_COMMON:
        raise NoLink
    members = ids[pick[keep]]
    sight = sight.of(keep)
    best = {kind: replace(b, X=b.X[keep]) for kind, b in best.items()}
    if still is None:
        best = {kind: polish(b, sight) for kind, b in best.items()}
        best, sight = held_only(best, sight) if view.R is None and sight.slip is None else (best, sight)
    else:
        best = _across_kinds(best, sight)
        scenes, views = dict.fromkeys(best, still), dict.fromkeys(best, view)
        best, sight = in_sight_only(*_together(best, sight, paths, scenes, views))
        best = _hinge_of_screw(best, sight)
    sight = _errors(best, sight, view.restless)
    best = _across_kinds(best, sight) if still is None else {k: polish(b, sight) for k, b in best.items()}
    probability = _ruled_out(type_probabilities(best, sight), refuted)
    if probability.get("screw", 1.0) < NO_SCREW:
        del best["screw"]

    # Now that the motion is known, on all frames whatever follows it joins in, and the types are weighed on all of it.
    kind = _winner(probability)
    best, members, still, views = _on_all_frames(best, kind, sight, paths, members, still, view)
    view = views[kind]
    some = _spread_out(T, MOST_FRAMES if still is None else FREE_FRAMES)
    best = {k: replace(b, q=b.q[some] - b.q[some[0]]) for k, b in best.items()}
    lead = best[kind]
    # Errors last as long as in the first round, in frames of this one.
    like = view.sightings(paths[members], some, max(1.0, sight.lasting * len(some) / len(sight.frames)))
    more, X = followers(lead, paths, np.setdiff1d(np.arange(len(paths)), members), view, like)
    members, X = np.concatenate([members, more]), np.concatenate([lead.X, X])
    sight = _held_frames_only(view.sightings(paths[members], some, lasting=100.0))
    bound = _spread_out(len(members), MOST_TRACKS)
    few, lost = sight.of(bound), np.zeros(0, int)
    points = dict.fromkeys(best, X)
    if still is not None:
        # Before a path of its own a type has points of its own.
        far = {k: np.tile(np.median(b.X, axis=0), (len(more), 1)) for k, b in best.items() if k != kind}
        points |= {k: np.concatenate([best[k].X, far[k]]) for k in far}
    best = {k: place_points(replace(b, X=points[k][bound]), views[k].before(few)) for k, b in best.items()}
    if still is None:
        best = {k: polish(b, few, iterations=30) for k, b in best.items()}
        shown = few.seen.any(0)
        best, few = held_only(best, few) if view.R is None and few.slip is None else (best, few)
        lost = some[shown & ~few.seen.any(0)]
    else:
        apart = ~np.isin(still.ids, members)
        rest = replace(still, ids=still.ids[apart], X=still.X[apart])
        rests = {k: rest.before(views[k], paths, b.log_focal) for k, b in best.items()}
        best, few = in_sight_only(*_together(best, few, paths, rests, views))
    few = _errors(best, few, view.restless)
    best = {k: polish(b, few) for k, b in best.items()}
    once, last, sure, probability, rival = _decided(best, others if still is None else None, few, refuted)
    weight = few.weight
    if few.link is not None:
        view = view.corrected(last, some)
        last, weight = replace(last, X=last.X[few.link], R=None, t=None), weight[few.link]
        once = last
    sight = replace(sight, weight=np.interp(np.arange(len(members)), bound, weight), lasting=few.lasting)
    sight.seen[bound] = few.seen[: len(bound)]
    every = _held_frames_only(view.sightings(paths[members], np.arange(T), few.lasting))
    every = replace(every, weight=sight.weight)
    sight.seen[:, np.isin(some, lost)], every.seen[:, lost] = False, False

    def whole(b: Bundle) -> Bundle:
        """With the points of all tracks, and states in all frames."""
        if len(bound) < len(members):
            b = place_points(replace(b, X=X), sight, rounds=4)
        return states_of_all_frames(b, every, some) if len(some) < T else b

    if len(some) < T:
        sure = replace(sure, q=np.interp(np.arange(T), some, sure.q))
    first = None if once is last else whole(once)
    rival = None if rival is None else replace(rival, joint=whole(rival.joint))
    return Finished(whole(last), every, members, sure, probability, view, rival, first, len(lost))


def _decided(best: dict[str, Bundle], others: Mapping[str, Sequence[Bundle]] | None, s: Sightings, refuted: str | None
             ) -> tuple[Bundle, Bundle, Spread, dict[str, float], Rival | None]:  # fmt: skip
    """The type, and its joint at its best.

    Args:
        best: of every type, the start that was better in the first round.
        others: those that were not; None before a camera whose path is fitted with the joint, where every one would
            need its own.
        s: their observations.  refuted: as of :func:`finish`.

    Returns:
        The joint as one adjustment found it, the better one that halves of the link, the other starts and the tracks
        without strays lead to, its uncertainty, the types' probabilities, and the most probable other axis.
    """
    if others is None:
        probability = _ruled_out(type_probabilities(best, s, _near([best["revolute"]], s)), refuted)
        last = best[_winner(probability)]
        return last, last, spread(last, s), probability, None

    def again(kind: str) -> list[Bundle]:
        return [_refitted(b, best[kind], s) for b in others.get(kind, [])]

    best, near = dict(best), []
    hinges = [best["revolute"], *again("revolute")]
    if _winner(_ruled_out(type_probabilities(best, s), refuted)) == "prismatic":
        near = _near([*hinges, polish(best["revolute"], s, hold=HELD)], s)
    else:
        # Until the errors are known the priors weigh much, and strays prefer what they will: on all frames another
        # start may be the better one.
        best["revolute"] = cheapest(hinges, s)
    probability = _ruled_out(type_probabilities(best, s, near), refuted)
    once = best[_winner(probability)]
    other = [b for b in hinges if b is not once] if once.kind == "revolute" else again(once.kind)
    better, several = halves(once, s)
    clean = _without_strays([better, *(b for b in best.values() if b is not once), *other], s)
    every = [polish(b, clean) for b in (better, *other)]
    last = cheapest(every, clean)
    # Halves scatter with the strays in them: what misleads is not always told from the link.
    sure = widened(spread(last, clean), better, several)
    return once, last, sure, probability, strongest_rival(last, every, clean)


def _near(hinges: Sequence[Bundle], s: Sightings) -> list[Bundle]:
    """Those that are as near as hinges are."""
    return [b for b in hinges if radius_cost(b, s) < NEAR * b.sigma**2 * s.lasting and turn_deg(b) < 360]


def _errors(best: dict[str, Bundle], sight: Sightings, restless: float) -> Sightings:
    """The sightings with what their errors are like: strayed stretches gone, how long errors last, and weights.

    Errors are judged by the type that fits best. A stretch has strayed if it leaves every type's points: what only the
    best one's contradict would be evidence against that type, taken away.
    """
    lead = min(best.values(), key=lambda b: b.cost)
    sigma = max(lead.sigma, 0.05)
    cluster = clusters(lead, sight.link)
    e = residuals(lead, sight)
    others = [(residuals(b, sight), max(b.sigma, 0.05)) for b in best.values() if b is not lead]
    rho = 0.0
    for _ in range(2):
        # Gross outliers are not the noise.
        r = np.where((sight.seen & (np.sum(e**2, axis=-1) < (4 * sigma) ** 2))[..., None], e, 0.0)
        rho, lasting = shared_error(r, sight.seen, cluster), lasting_error(r, sight.seen)
        link = np.ones(len(e), bool) if sight.link is None else sight.link
        lost = np.zeros(sight.seen.shape, bool)
        # Only with a moving camera, whose path a stray bends; before a resting one the loss deals with single tracks,
        # and many that leave a joint's points together say that there is no such joint.
        for body in (link, ~link) if sight.free else ():
            lost[body] = strayed(e[body], sight.seen[body], sigma, lasting)
            for other, scale in others:
                lost[body] &= strayed(other[body], sight.seen[body], scale, lasting)
        sight = replace(sight, seen=sight.seen & ~lost, lasting=lasting)
    # Errors that neighbours share are no noise: they stay for as long as the tracks do. So does what the compensation
    # of a moving camera leaves, which the joint may take up until no residual shows it.
    flex = min(FLEX_PX, FLEX_SIGMAS * sigma)
    alike = (flex**2 * rho + restless**2) * 0.5 * float(sight.seen.sum(1).mean()) / sigma**2
    return replace(sight, weight=shared_weights(rho, cluster), lasting=max(sight.lasting, alike))


def _without_strays(joints: Sequence[Bundle], sight: Sightings) -> Sightings:
    """The sightings of a link without the stretches in which tracks have left the points of every joint at hand.

    A stray that stays within reach of the loss bends the axis of a small motion. Types are weighed, and a joint is
    believed, with them: many that leave its points together say that there is no such joint.
    """
    lost = sight.seen.copy()
    for b in joints:
        lost &= strayed(residuals(b, sight), sight.seen, max(b.sigma, 0.05), sight.lasting)
    return replace(sight, seen=sight.seen & ~lost)


def _held_frames_only(sight: Sightings) -> Sightings:
    """The sightings without frames that fewer than HOLDERS tracks show: any one track is followed by some states, and a
    stray that goes on alone takes them out of all bounds. Of tracks without slip :func:`held_only` asks more."""
    return sight if sight.slip is None else replace(sight, seen=sight.seen & (sight.seen.sum(0) >= HOLDERS))


def _spread_out(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _together(best: dict[str, Bundle], sight: Sightings, paths: Paths, stills: Mapping[str, Still],
              views: Mapping[str, View]):  # fmt: skip
    """Joint and camera in one bundle adjustment: the bundles with the scene's points and poses, and its sightings.

    Args:
        stills, views: of every type, points of the same scene and the path before it.
    """
    still = next(iter(stills.values()))
    pick = _spread_out(len(still.ids), MOST_STILL)
    scene = next(iter(views.values())).sightings(paths[still.ids[pick]], sight.frames)
    relative = np.ones(len(sight.uv) + len(pick))
    if still.sigma is not None:
        moving = max(min(b.sigma for b in best.values()), 0.05)
        relative[len(sight.uv):] = np.clip(max(still.sigma, 0.05) / moving, *RELATIVE)
    both = replace(
        sight,
        uv=np.concatenate([sight.uv, scene.uv]),
        seen=np.concatenate([sight.seen, scene.seen]),
        weight=np.concatenate([sight.weight, scene.weight]),
        slip=None if sight.slip is None else np.concatenate([sight.slip, scene.slip]),
        link=np.arange(len(sight.uv) + len(pick)) < len(sight.uv),
        relative=relative,
        free=True,
    )
    start = {}
    for k, b in best.items():
        own = views[k].before(scene)
        start[k] = replace(b, X=np.concatenate([b.X, stills[k].X[pick]]), R=own.R, t=own.t)
    return {k: polish(b, both) for k, b in start.items()}, both


def _on_all_frames(best: dict[str, Bundle], kind: str, sight: Sightings, paths: Paths, members: np.ndarray,
                   still: Still | None, view: View):  # fmt: skip
    """From the first round's frames to all, before the camera found so far: the link alone, its tracks, the scene,
    and of every type the view.

    Before a moving camera link and scene change places where the path before the link is clearly the smoother one. That
    is the same joint run backwards.
    """
    views = {k: view if still is None else view.corrected(b, sight.frames) for k, b in best.items()}
    every = views[kind]
    link = np.ones(len(sight.uv), bool) if sight.link is None else sight.link
    seen = every.sightings(paths[members], np.arange(paths.uv.shape[1]))
    out = {
        k: states_of_all_frames(replace(b, X=b.X[link], R=None, t=None), views[k].before(seen), sight.frames)
        for k, b in best.items()
    }
    if still is None or still.known or every.R is None or every.t is None:
        return out, members, still, views
    b = best[kind]
    if b.R is None or b.t is None or not smoother_before_the_link(b, sight):
        return out, members, still, views
    path = before_the_link(out[kind].twist, out[kind].q, every.R, every.t)
    others = still.ids[_spread_out(len(still.ids), MOST_STILL)]
    scene = Still(members, out[kind].X)
    out = {k: replace(b, q=-b.q, X=best[k].X[~link]) for k, b in out.items()}
    return out, others, scene, dict.fromkeys(out, replace(every, R=path[0], t=path[1]))


def _winner(probability: dict[str, float]) -> str:
    return max(probability, key=lambda k: probability[k])


def _ruled_out(probability: dict[str, float], refuted: str | None) -> dict[str, float]:
    """The probabilities of the types, that of a refuted one 0; as they are where none is refuted."""
    left = {k: 0.0 if k == refuted else max(p, 1e-300) for k, p in probability.items()}
    return {k: p / sum(left.values()) for k, p in left.items()} if refuted else probability


SURE = 20.0
"""Log-likelihood by which a further track has to prefer the joint's motion to standing still."""


def followers(
    b: Bundle, paths: Paths, ids: np.ndarray, view: View, like: Sightings, most: int = 800
) -> tuple[np.ndarray, np.ndarray]:
    """Further tracks that move with the link rather than rest, however little: those near the axis hold it best.

    Args:
        b: the fitted joint.  paths: all tracks.  ids: (m,) those to look at.
        view: focal length and camera.  like: the fit's observations, for frames and noise.

    Returns:
        (k,) indices of the followers, and (k, 3) their points.
    """
    sigma = max(b.sigma, 0.05)
    extent = np.full(len(ids), 0.0)
    some = paths[ids].at(like.frames).seen.sum(1) >= 4
    uv = paths.uv[ids[some]]
    extent[some] = np.linalg.norm(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=-1)
    ids = ids[extent > 8 * sigma]
    if not len(ids):
        return ids, np.zeros((0, 3))
    if len(ids) > most:
        ids = ids[np.linspace(0, len(ids) - 1, most).round().astype(int)]
    s = view.sightings(paths[ids], like.frames, like.lasting)
    own = len(b.X)
    trial = place_points(replace(b, X=np.tile(np.median(b.X, axis=0), (len(ids), 1))), s)
    r = residuals(trial, s)
    if view.R is None:
        middle = np.nanmedian(np.where(s.seen[..., None], s.uv, np.nan), axis=1)[:, None]
        rest = held(np.where(s.seen[..., None], s.uv - middle, 0.0), s.slip)
    else:
        resting = replace(b, q=np.zeros_like(b.q), X=trial.X)
        rest = residuals(place_points(resting, s), s)
    limit = ROBUST_SIGMAS * sigma
    cost = lambda e: np.sum(s.seen * limit**2 * (1 - limit**2 / (limit**2 + np.sum(e**2, axis=-1))), axis=1)  # noqa: E731
    gain = (cost(rest) - cost(r)) / (2 * sigma**2 * like.lasting)
    size = np.sqrt(np.nanmedian(np.where(s.seen, np.sum(r**2, axis=-1), np.nan), axis=1))
    good = (gain > SURE) & (size < 2.5 * sigma) & (trial.X[:, 2] > 0)
    good &= compact(np.concatenate([b.X, trial.X]))[own:]
    return ids[good], trial.X[good]


def _across_kinds(best: dict[str, Bundle], sight: Sightings) -> dict[str, Bundle]:
    """The best of every type, started from the others too: a slide from a hinge's chord, hinges from a bent slide."""
    out: dict[str, list[Bundle]] = {k: [b] for k, b in best.items()}
    if hinge := best.get("revolute"):
        far = int(np.argmax(np.abs(hinge.q)))
        chord = hinge.twist.pose(hinge.q[[far]])[1][0] * np.sign(hinge.q[far])
        along = hinge.twist.pose(hinge.q)[1] @ (chord / np.linalg.norm(chord))
        slide = Twist(hinge.twist.anchor, chord / np.linalg.norm(chord), np.zeros(3))
        out.setdefault("prismatic", []).append(replace(hinge, kind="prismatic", twist=slide, q=along - along[0]))
        out["screw"] = [replace(hinge, kind="screw")]
    if slide_b := best.get("prismatic"):
        size = np.linalg.norm(np.ptp(slide_b.X, axis=0))
        basis = np.linalg.svd(slide_b.twist.direction[None])[2][1:]
        for e in (*basis, *-basis):
            bent = replace(slide_b.twist, curvature=0.3 / size * e)
            out.setdefault("revolute", []).append(replace(slide_b, kind="revolute", twist=bent))
    return {
        kind: min((polish(b, sight) for b in starts), key=lambda b: b.cost + radius_cost(b, sight))
        for kind, starts in out.items()
    }


FAR = 60
"""Iterations in which a hinge that begins as a screw without its pitch gets rid of what that had explained."""


def _hinge_of_screw(best: dict[str, Bundle], sight: Sightings) -> dict[str, Bundle]:
    """The same with the screw's own hinge where that is the better one: before a camera that is fitted too the two may
    have ended on different paths."""
    screw, hinge = best.get("screw"), best["revolute"]
    if screw is None or screw.cost >= hinge.cost:
        return best
    own = polish(replace(screw, kind="revolute", twist=screw.twist.moved(np.zeros(6), "revolute")), sight, FAR)
    better = own.cost + radius_cost(own, sight) < hinge.cost + radius_cost(hinge, sight)
    return {**best, "revolute": own} if better else best


def _refitted(b: Bundle, like: Bundle, sight: Sightings) -> Bundle:
    """The joint with the points of another's tracks."""
    points = np.tile(np.median(b.X, axis=0), (len(like.X), 1))
    return polish(place_points(replace(b, X=points), sight), sight, iterations=30)


def states_of_all_frames(b: Bundle, s: Sightings, some: np.ndarray) -> Bundle:
    """States of the frames that the bundle adjustment left out: robust Gauss-Newton on one number a frame."""
    T = s.seen.shape[1]
    q = np.interp(np.arange(T), some, b.q)
    out = replace(b, q=q)
    left = np.ones(T, bool)
    left[some] = False
    span = max(np.ptp(q), 1e-9)
    for _ in range(4):
        r = residuals(out, s)
        h = 1e-5 * span
        J = (residuals(replace(out, q=out.q + h), s) - r) / h
        _, w = robust_loss(r, s, ROBUST_SIGMAS * max(b.sigma, 0.05))
        H = np.sum(w[..., None] * J * J, axis=(0, 2))
        g = np.sum(w[..., None] * J * r, axis=(0, 2))
        stiff = (b.sigma / (0.1 * span)) ** 2
        neighbours = 0.5 * (np.roll(out.q, 1) + np.roll(out.q, -1))
        step = -(g + stiff * (out.q - neighbours)) / (H + stiff)
        out = replace(out, q=np.where(left, out.q + np.clip(step, -0.1 * span, 0.1 * span), out.q))
    return out
