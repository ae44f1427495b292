"""One joint from point tracks of a static camera, without depth: the public entry of this room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.answers import better_known, doubtful
from reconstruct.joint.bundle import Observations, State, refine, solve_depths
from reconstruct.joint.cameras import camera_moves, joints_between
from reconstruct.joint.evidence import free_motion
from reconstruct.joint.faces import by_faces
from reconstruct.joint.finish import Finished, NoLink, Starts, bundle_of_state, finish
from reconstruct.joint.groups import Rigid, two_bodies
from reconstruct.joint.handheld import JOINS, Path, at_rest, filmed, path_from_rest, scaled_to_link
from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import JointFit
from reconstruct.joint.parallels import along_edges
from reconstruct.joint.paths import Paths, held
from reconstruct.joint.photometric import Pictures
from reconstruct.joint.plates import as_plate
from reconstruct.joint.polish import Bundle
from reconstruct.joint.regions import least_missed, swept_by_regions
from reconstruct.joint.result import FREELY, MIN_INLIERS, result_of, why_not_believed
from reconstruct.joint.select import (
    distinct,
    explained,
    global_profile,
    image_speed,
    key_frames,
    motion_stretches,
    observations,
    search,
    search_regions,
    sharpened,
    worth,
)
from reconstruct.joint.slight import slight_motion
from reconstruct.joint.sweep import EXACT_PX, SMALL, Swept, placed_on, sweep
from reconstruct.joint.view import Still, View
from reconstruct.joint.weigh import APART_DEG, apart_deg
from reconstruct.video import Video

MOVING_SHARE = 0.012
"""A track moves if its extent exceeds this share of the image diagonal."""
SIMPLER = 1.05
RIVAL, RIVALS = 0.9, 4
"""Hinges that explain this share of what the best one does are polished too, so many at most."""
DEPTHS = 0.68
"""What the compensation of a moving camera leaves depends on the depth, and the link's own is not known: it is taken to
be what this share of the resting points stays under, one standard deviation."""
STROKE_STDS = 8.0
"""Stroke over its standard deviation up to which two groups of tracks before a moving camera are one body."""
DEPTHS_OF_LINK = np.exp(-np.linspace(np.log(0.7), np.log(2.8), 5))
"""Of a link before a hand-held camera over the scene's, that are tried."""
EXACT = 1.2
"""Noise over the least that is believed, up to which a sweep's joint leaves nothing to look for."""
MOST = 0.5
"""Of the tracks of a region, the share by which a joint of it alone has to be followed before a resting camera."""
NO_LINK = "no joint: the points of the tracks that agree with the best one are those of no one body"
NO_STROKE = "nothing moves: the rigid groups of tracks stand still against each other"
APART = "the camera moves, and hardly any frame shows the scene and the part together"
NO_SCENE = "the camera moves, and too few points of a static scene are followed"
NO_SLIDE = "a slide is more probable, but its points would move as a free body, those of the hinge do not"
BESIDE = "what moves beside it, its shadow maybe, follows it but roughly"
STRAYS = "most of what leaves its place does not follow it"
ANY_DEG = float(np.degrees(np.sqrt(np.pi - 2)))
"""Root of the mean square angle between an axis and one at random. Three such answers from pixels were 50 deg and more
off, stated to 8 to 10."""
ALONE = "all that is followed moves as one body: the camera may go round it as well as the part may turn"
DEFAULT_FOCAL = 0.8
"""Prior mean over the image's long side: phones and webcams lie between 0.65 and 0.95."""
PRIOR_STD = 0.12
"""Prior standard deviation of its logarithm."""
KNOWN_STD = 0.02
"""Standard deviation that is stated for a focal length that was given."""
FREE_SHARE = 1 / 4
"""A joint is refuted if this share of the points that move most follow a free rigid body but not the joint. Real hinges
and slides, with flexing parts, drifting tracks and an imperfect camera, leave 0 to 0.15; what is lifted away leaves
0.3 and more, though shadows that swing with the arm make a hinge of a part of it."""

ROUNDS = 5
"""Of a hand-held camera's path and the tracks that it explains: points off the plane of the compensation leave their
place in the picture until they are known to rest."""
TRIES = 3
"""Draws of the search before a joint is refused, the second with two regions of the picture besides, the third with
three: where most of what moves is a shadow or an arm, a draw may find nothing better than that."""
PARTS = (slice(0, 7), slice(3, 10))
"""Tenths of the motion that are asked alone where all of it follows no joint, of trackers that do not measure how well
the picture holds a point: these lose a door that is seen on edge, and go on saying where it is."""
PART_TURN_DEG = 30.0
"""Turn from which a hinge is believed of a part of the motion: over a short way every motion turns about something."""
SHARED, MANY = 0.5, 2.0
"""Of the tracks of a joint, the share that another's have to hold, to be the same motion's; and how many times more of
them stand against a sure one."""
LUCKIER, SHARPER = 1.1, 3.0
"""What a later draw, or another stretch of the video, has to explain more than those before it; or, if a draw explains
no less, how many times less its points have to miss the joint by."""


def fit_joint(
    video: Video,
    tracks: Tracks,
    focal_px: float | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    camera_moving: bool | None = None,
    pictures: Pictures | None = None,
) -> JointFit:
    """Joint type, axis, states and the moving link's points from tracks of one camera.

    Args:
        video: stabilised video (sizes, times; no pixel is read).
        tracks: point tracks of everything that moves, hands excluded as far as known.
        focal_px: focal length in full px; the video's own or a typical one when None.
        seed: of the random subsets.
        progress: called with the done share.
        camera_moving: whether the camera moves; judged from how many tracks keep their place when None. A moving one
            is found together with the joint, from the static scene's tracks; the world is then up to the first camera.
            Where it is not said and all tracks move as one body, the answer is "ambiguous", its type no surer than one
            half and half of the prior: it may be the camera that moves.
        pictures: of the video's frames, working px. Where the camera rests, a hinge that straight edges around the
            link or its whole faces hold better than the tracks do is taken along or from these; one whose link's
            tracks keep to a plate that turns in its plane is taken so without them.

    Returns:
        A JointFit up to scale (median depth of the link = 1), or one with verdict "refused".
    """
    rng = np.random.default_rng(seed)
    tell = progress or (lambda _: None)
    paths = _paths(video, tracks)
    h, w = video.frames.shape[1:3]
    known = focal_px or video.focal_px
    full = known or DEFAULT_FOCAL * max(video.size)
    camera = _Camera(full * video.scale, np.array([(w - 1) / 2, (h - 1) / 2]), float(np.hypot(h, w)))

    view = View(camera.focal, 0.0 if known else PRIOR_STD)
    all_moves = camera_moving is None and camera_moves(paths.uv, camera.diagonal)
    if camera_moving or all_moves:
        fit = _moving_camera(video, paths - camera.centre, view, full, seed)
        # Tracks on nothing but the part look like a moving camera too: then there are no two rigid groups.
        if camera_moving or fit is not None:
            return fit or JointFit("refused", NO_SCENE, tracks=len(paths))
    if video.warp is not None:
        camera = _with_path(camera, paths, video.warp)
    answer, before, most, sigma = None, None, 0.0, np.nan
    for k in range(TRIES):
        draw = _one_draw(video, paths, camera, view, known, rng, pictures, lambda x, k=k: tell((k + x) / TRIES), k + 1)
        fit = draw.fit
        # Asked often enough something may pass for a joint: a later draw has to explain what the others missed, or no
        # less by far more exactly.
        sharp = draw.explained > most and SHARPER * draw.sigma < sigma
        if fit.verdict != "refused" and (draw.explained > LUCKIER * most or sharp):
            answer, before = fit, draw.done
            break
        answer = answer or fit
        if draw.explained > most:
            most, sigma = draw.explained, draw.sigma
        if fit.inliers == 0:
            break  # this was no bad luck: there is nothing to draw from
    assert answer is not None
    if video.warp is None and (answer.verdict != "refused" or answer.inliers < MIN_INLIERS):
        sure = answer.verdict == "ok"
        slight = _slight(video, paths - camera.centre, camera, view, known, pictures, before, sure)
        if slight is not None and before is not None:
            slight = better_known(slight, answer)
        answer = slight or answer
    elif answer.verdict == "refused" and tracks.slip is None:
        answer = _of_a_part(video, paths, camera, view, known, rng, pictures) or answer
    tell(1.0)
    if all_moves and answer.verdict != "refused":
        p = or_by_prior(answer.type_probability)
        return replace(answer, verdict="ambiguous", reason=f"{ALONE}; {answer.reason}", type_probability=p)
    return answer


def _dominant(tries: Sequence[_Consensus]) -> _Consensus:
    """Of the joints of several stretches, those with more motion first: a later one has to explain clearly more.

    Two drawers of one chest explain the same to a hundredth, and the last digits would choose.
    """
    found = tries[0]
    for other in tries[1:]:
        if other.explained > LUCKIER * found.explained:
            found = other
    return found


def _of_a_part(video: Video, paths: Paths, camera: _Camera, view: View, known: float | None, rng: np.random.Generator,
               pictures: Pictures | None) -> JointFit | None:  # fmt: skip
    """The hinge that a part of the motion follows, of which the rest knows nothing, or None; arguments of _one_draw."""
    moving = _moving(paths, camera)
    path = np.cumsum(image_speed(paths.uv[moving]))
    cuts = np.concatenate([[0], np.searchsorted(path, path[-1] * np.arange(1, 10) / 10) + 1, [len(video)]])
    for part in PARTS:
        span = slice(int(cuts[part.start]), int(cuts[part.stop]))
        fit = _one_draw(video, _only(paths, span), camera, view, known, rng, pictures, lambda _: None).fit
        if fit.verdict == "ok" and fit.type == "revolute" and np.ptp(fit.q) > np.radians(PART_TURN_DEG):
            words = f"frames {span.start} to {span.stop - 1} of {len(video)} follow it, and all together no joint"
            return replace(fit, reason=f"{fit.reason}; {words}")
    return None


def _slight(video: Video, paths: Paths, camera: _Camera, view: View, known: float | None, pictures: Pictures | None,
            before: Finished | None, sure: bool) -> JointFit | None:  # fmt: skip
    """The joint of a motion of few pixels, or None if there is none to believe; px from the principal point.

    Args:
        before: another joint, which competes: there is none to believe unless more tracks follow, most of its own among
            them.  sure: of it; then MANY times more have to, and most of all that leave their place.
    """
    found = slight_motion(paths, view, None if before is None or sure else len(before.members))
    if found is None:
        return None
    starts, ids, together = found
    times = MANY if sure else 1.0
    if before is not None:
        if not _more(ids, before.members, times):
            return None
        every = view.sightings(paths[ids], np.arange(paths.uv.shape[1]), lasting=100.0)
        others = [] if before.rival is None else [before.rival.joint]
        for b in (before.bundle, *others):
            starts.setdefault(b.kind, []).append(placed_on(b, every))
    try:
        done = finish(starts, paths, ids, view)
    except NoLink:
        return None
    if why_not_believed(done, _restlessness(paths, camera, 0.5)):
        return None
    if before is not None and not _more(done.members, before.members, times):
        return None
    done, note = _better_held(done, pictures, "; the motion is slight")
    fit = result_of(video, done, camera.focal / video.scale, len(paths), note, KNOWN_STD if known else None)
    if together:
        return fit
    fit = doubtful(fit, STRAYS)
    return replace(fit, std={**fit.std, "axis_deg": max(fit.std["axis_deg"], ANY_DEG)}, alone_deg=None)


def _better_held(done: Finished, pictures: Pictures | None, note: str) -> tuple[Finished, str]:
    """The joint before a resting camera, as that of a plate or, where there are pictures, along edges and by its faces,
    where these hold it better; and the words."""
    if (plate := as_plate(done)) is not done:
        return plate, f"{note}; the link is taken as a plate that turns in its plane"
    if pictures is None:
        return done, note
    if (parallel := along_edges(done, pictures)) is not done:
        note = f"{note}; the axis is taken along edges in the picture"
    if (exact := by_faces(parallel, pictures)) is parallel:
        return parallel, note
    # Faces say which axis it is, but not which of two that lie far apart.
    doubt = parallel.doubt if done.rival is not None else ""
    return replace(exact, doubt=doubt, alone_deg=None), f"{note}; its faces' pixels hold the axis"


def _more(ids: np.ndarray, than: np.ndarray, times: float = 1.0) -> bool:
    """Whether these are so many times more tracks, most of the others among them."""
    return len(ids) > times * len(than) and np.isin(than, ids).mean() > SHARED


def _one_draw(video: Video, paths: Paths, camera: _Camera, view: View, known: float | None, rng: np.random.Generator,
              pictures: Pictures | None, tell: Callable[[float], None], regions: int = 1) -> _Draw:  # fmt: skip
    """The joint before a camera that rests or is held in a hand, by one draw of hypotheses.

    Args:
        paths: of all tracks, working px.
        known: focal length in full px, None where the prior's mean is taken.
        pictures: whose faces may hold the joint better than the tracks do; None where the tracks are all there is.
        regions: of the picture that are searched by themselves besides, if more than one.
    """
    note, no_slide = "", False
    found = _consensus(paths, camera, rng, lambda x: tell(0.85 * x), regions)

    def refused(reason: str, members: np.ndarray, sigma: float = np.nan) -> _Draw:
        return _Draw(JointFit("refused", reason, tracks=len(paths), inliers=len(members)), found.explained, sigma)

    if found.refusal and found.scattered:
        # Several parts may have moved one after the other: look at one stretch of motion at a time.
        stretches = motion_stretches(paths.uv[_moving(paths, camera)], video.time)
        tries = [
            _consensus(_only(paths, span), camera, rng, lambda _: None) for span in stretches[:3] if len(stretches) > 1
        ]
        tries = [t for t in tries if not t.refusal]
        if tries:
            found = _dominant(tries)
            note = f"; no joint explains the whole video: the dominant of {len(stretches)} stretches of motion is taken"
    if found.refusal:
        return refused(found.refusal, found.members)
    tell(0.9)
    try:
        if video.warp is None:
            restless = _restlessness(paths, camera, 0.5)
            starts, members = _sharpened(found, paths - camera.centre, view, camera)
            done = finish(starts, paths - camera.centre, members, view)
            reason = why_not_believed(done, restless)
            if done.bundle.kind == "prismatic" and FREELY in (reason or ""):
                # There is no joint only if every type is refuted, however few of the tracks speak for the other.
                hinge = finish(starts, paths - camera.centre, members, view, refuted="prismatic")
                if no_slide := not why_not_believed(hinge, restless):
                    done, reason = hinge, None
        else:
            done, restless, words = _hand_held(found, paths, video.warp, view, camera)
            note += words
            reason = why_not_believed(done, restless)
    except NoLink:
        return refused(NO_LINK, found.members)

    def answer(done: Finished, note: str) -> _Draw:
        if video.warp is None:
            done, note = _better_held(done, pictures, note)
        full = camera.focal / video.scale
        fit = result_of(video, done, full, len(paths), note, KNOWN_STD if known else None)
        return _Draw(fit, found.explained, done.bundle.sigma, done)

    draw = refused(reason, done.members, done.bundle.sigma) if reason else answer(done, note)
    if video.warp is None and draw.fit.verdict != "ok" and regions == 1 and not _is_small(found, camera):
        other = _of_a_region(found, paths - camera.centre, view, done.bundle.sigma)
        if other is not None and not why_not_believed(other, restless):
            beside = answer(other, f"{note}; {BESIDE}")
            if beside.fit.verdict == "ok":
                return beside
    return replace(draw, fit=doubtful(draw.fit, NO_SLIDE)) if no_slide else draw


def _sharpened(found: _Consensus, paths: Paths, view: View, camera: _Camera) -> tuple[Starts, np.ndarray]:
    """Starts and tracks for the end: the search's own, or where the motion is small those of a sweep.

    Args:
        paths: of all tracks, px from the principal point.
    """
    if found.obs is None or not _is_small(found, camera):
        return found.starts, found.members
    swept = sweep(paths, found.moving, found.obs, found.members, found.bundles(found.obs), view)
    return (found.starts, found.members) if swept is None else (swept.starts, swept.ids)


def _is_small(found: _Consensus, camera: _Camera) -> bool:
    """Whether the motion is one of which the search's pixels say too little."""
    return found.obs is not None and np.ptp(global_profile(found.obs)) / found.obs.px <= SMALL * camera.diagonal


def _swept_before_path(found: _Consensus, paths: Paths, view: View, depth: float, small: bool) -> Swept | None:
    """The best joint of several sweeps, from the search's tracks and from all that leaves its place: in the compensated
    picture what is near the camera goes as its parallax does, and the search may have found that. Where neither is as
    exact as tracks are, from those of regions: beside shadows that go as it goes a part is a small share of all.

    Args:
        paths: all tracks, px from the principal point, as filmed.  view: with the camera's path.
        depth: the scene's, in its unit.  small: whether the motion is.

    Returns:
        None if too few tracks follow any joint, or if they follow one of the search's: of a large motion that one's
        tracks are more.
    """
    if found.obs is None:
        return None
    rivals = found.bundles(found.obs)
    depths = DEPTHS_OF_LINK * depth
    pools = (found.members, found.moving)
    several = [sweep(paths, found.moving, found.obs, pool, rivals, view, depths) for pool in pools]
    tries = [swept for swept in several if swept is not None]
    if not any(swept.lead.sigma < EXACT * EXACT_PX for swept in tries):
        tries += swept_by_regions(paths, found.moving, found.obs, view, rivals, depths)
    best = least_missed(tries, paths, found.moving, view)
    if best is None or small:
        return best
    lead = best.lead
    same = any(b.kind == lead.kind and apart_deg(b, lead) < APART_DEG for b in rivals)
    return None if same else best


def _of_a_region(found: _Consensus, paths: Paths, view: View, than: float) -> Finished | None:
    """The joint before a resting camera that most tracks of one region of the picture follow, SHARPER than those of
    another that is in doubt, whose noise is ``than`` px; or None. paths: of all tracks, px from the principal point.

    Beside its shadow a part is a small share of what moves, and no joint follows both but in pixels.
    """
    if found.obs is None:
        return None
    exact = max(than / SHARPER, EXACT * EXACT_PX)
    tries = swept_by_regions(paths, found.moving, found.obs, view)
    tries = [swept for swept in tries if swept.share > MOST and swept.lead.sigma < exact]
    if (best := least_missed(tries, paths, found.moving, view)) is None:
        return None
    try:
        done = finish(best.starts, paths, best.ids, view)
    except NoLink:
        return None
    return done if SHARPER * done.bundle.sigma < than else None


def _hand_held(found: _Consensus, paths: Paths, warp: np.ndarray, view: View, camera: _Camera
               ) -> tuple[Finished, float, str]:  # fmt: skip
    """The joint before a camera held in a hand, whose path is fitted with it where enough of the scene rests.

    Args:
        paths: of all tracks, working px in the compensated picture.  warp: (T, 3, 3) as in :class:`Video`.

    Returns:
        The joint, by how much points at rest miss their place, px, and words for the result.
    """
    # The picture's warp hardly turns edges.
    still, as_filmed = paths - camera.centre, replace(paths, uv=filmed(paths.uv, warp)) - camera.centre
    if (path := camera.path) is None:
        restless = _restlessness(paths, camera, DEPTHS)
        view = replace(view, restless=restless if np.isfinite(restless) else 0.0)
        return finish(found.starts, still, found.members, view), restless, "; the camera moves: taken to its first view"
    leading = next(iter(found.starts.values()))[0]
    view, scene = scaled_to_link(path, leading, as_filmed, found.members, view)
    starts, members = found.starts, found.members
    depth = float(np.median(scene.X[:, 2]))
    if (swept := _swept_before_path(found, as_filmed, view, depth, _is_small(found, camera))) is not None:
        unit = float(np.median(swept.lead.X[:, 2]))
        starts = {kind: [b.scaled(1 / unit) for b in several] for kind, several in swept.starts.items()}
        view, scene, members = replace(view, t=view.t / unit), replace(scene, X=scene.X / unit), swept.ids
    done = finish(starts, as_filmed, members, view, scene)
    return done, path.sigma, "; the camera moves: its path is fitted together with the joint"


def _with_path(camera: _Camera, paths: Paths, warp: np.ndarray) -> _Camera:
    """The camera with its path and the scene that this explains, where enough rests in the compensated picture."""
    still, as_filmed = paths - camera.centre, replace(paths, uv=filmed(paths.uv, warp)) - camera.centre
    keeps = np.setdiff1d(np.arange(len(paths)), _moving(paths, camera))
    path, rest = None, keeps
    for _ in range(ROUNDS):
        further = path_from_rest(as_filmed, still.uv, rest, camera.focal, path)
        if further is None:
            break
        # A part that the path explains by and by takes it over.
        path, before = further, rest
        rest = np.union1d(keeps, at_rest(path, as_filmed, still.uv, camera.focal, missed=JOINS))
        if np.array_equal(rest, before):
            break
    if path is None:
        return camera
    return replace(camera, path=path, scene=at_rest(path, as_filmed, still.uv, camera.focal))


@dataclass(frozen=True)
class _Draw:
    """fit: joint or refusal, and done, what a joint is made of.  explained: motion of all tracks.  sigma: px, noise of
    its own, NaN without a joint."""

    fit: JointFit
    explained: float
    sigma: float
    done: Finished | None = None


@dataclass(frozen=True)
class _Camera:
    """focal: working px.  centre: (2,) working px.  diagonal: of the working frame, px.  path: of a camera in a hand,
    where enough of the scene rests.  scene: (k,) indices of the tracks that it explains as points at rest."""

    focal: float
    centre: np.ndarray
    diagonal: float
    path: Path | None = None
    scene: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


@dataclass(frozen=True)
class _Consensus:
    """The best joint of both types and the tracks that follow it, or why there is none.

    Attributes:
        starts: per type, states with depths of the following tracks, and their key-frame observations; the type
            that named the tracks first, and of each type the best first.
        members: (n,) indices of these tracks.
        explained: motion of all tracks that it explains.
        refusal: a sentence, or "".  scattered: True if too few tracks agree on anything.
        obs: what was searched.  moving: (m,) indices of the tracks that leave their place.
    """

    starts: dict[str, list[tuple[State, Observations]]] = field(default_factory=dict)
    members: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    explained: float = 0.0
    refusal: str = ""
    scattered: bool = False
    obs: Observations | None = None
    moving: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    def bundles(self, obs: Observations) -> list[Bundle]:
        """All its joints in the frames of these observations, each with the points of the tracks that follow."""
        return [bundle_of_state(*s, obs.frames) for several in self.starts.values() for s in several]


def _paths(video: Video, tracks: Tracks) -> Paths:
    """The tracks in working px."""
    return Paths(video.to_work(np.where(tracks.visible[..., None], tracks.uv, np.nan)), tracks.slip)


def _moving(paths: Paths, camera: _Camera) -> np.ndarray:
    """(k,) indices of the tracks that leave their place, but for those that the camera's path explains; working px."""
    extent = np.zeros(len(paths))
    some = paths.seen.sum(1) > 1
    if some.any():
        # Sliding along an edge included: taken out, half of a moving part's tracks would not count as moving.
        uv = paths.uv[some]
        extent[some] = np.linalg.norm(np.nanmax(uv, axis=1) - np.nanmin(uv, axis=1), axis=-1)
    moving = np.flatnonzero(extent > MOVING_SHARE * camera.diagonal)
    return np.setdiff1d(moving, camera.scene)


def moving_tracks(video: Video, tracks: Tracks) -> np.ndarray:
    """(k,) indices of the tracks whose extent exceeds :data:`MOVING_SHARE` of the image diagonal."""
    h, w = video.frames.shape[1:3]
    return _moving(_paths(video, tracks), _Camera(1.0, np.zeros(2), float(np.hypot(h, w))))


def _restlessness(paths: Paths, camera: _Camera, share: float) -> float:
    """Working px, RMS, by which a share of the tracks at rest leave their place at most; infinite if there are none."""
    rest = np.setdiff1d(np.flatnonzero(paths.seen.mean(1) > 0.5), _moving(paths, camera))
    if not len(rest):
        return np.inf
    some = paths[rest]
    off = held(some.uv - np.nanmedian(some.uv, axis=1)[:, None], some.slip)
    return float(np.quantile(np.sqrt(np.nanmean(off**2, axis=(1, 2))), share))


def _consensus(paths: Paths, camera: _Camera, rng: np.random.Generator, tell: Callable[[float], None],
               regions: int = 1) -> _Consensus:  # fmt: skip
    moving = _moving(paths, camera)
    if len(moving) < MIN_INLIERS:
        return _Consensus(refusal=f"nothing moves: {len(moving)} of {len(paths)} tracks leave their place")
    keys = key_frames(paths.uv[moving])
    if len(keys) < 6:
        return _Consensus(refusal="the motion is too short: fewer than six distinct states")
    focal, centre, diagonal = camera.focal, camera.centre, camera.diagonal
    obs, _ = observations(paths[moving], focal, centre, keys, 260, rng, diagonal)
    if len(obs.ref) < MIN_INLIERS:
        return _Consensus(refusal=f"only {len(obs.ref)} moving tracks last long enough")
    ranked = search(obs, rng, progress=lambda x: tell(0.9 * x))
    if regions > 1:
        ranked = sorted(ranked + search_regions(obs, rng, regions), key=lambda s: -worth(s, obs))
    best: dict[str, State] = {}
    for s in ranked:
        best.setdefault(s.kind, s)
    if not best:
        return _Consensus(refusal="no tracks move together for long enough to draw a joint", scattered=True)
    # The hinge contains the slide: it has to explain clearly more to name the tracks of the link.
    value = {kind: worth(s, obs) * (SIMPLER if kind == "prismatic" else 1.0) for kind, s in best.items()}
    # All moving tracks, not just the sample of the search, for the consensus set.
    every, ids = observations(paths[moving], focal, centre, keys, 900, rng, diagonal)
    first: _Consensus | None = None
    for kind in sorted(best, key=lambda kind: -value[kind]):
        # There is no joint only if every type is refuted.
        s = _redepth(best[kind], every)
        s = max((sharpened(r, every) for r in (s, refine(s, every, scales=(3.0, 2.0), iterations=8))),
                key=lambda r: worth(r, every))  # fmt: skip
        total, share = explained(s, every)
        follows = share > 0.5
        link = every.of(follows)
        starts = {kind: [(replace(s, depth=s.depth[follows]), link)]}
        starts |= {k: [(_redepth(b, link), link)] for k, b in best.items() if k != kind}
        # Hinges that lean to either side of the viewing ray may explain nearly the same: the last digits tell.
        if "revolute" in best:
            near = [h for h in ranked if h.kind == "revolute" and worth(h, obs) > RIVAL * value["revolute"]]
            starts["revolute"] += [(_redepth(h, link), link) for h in distinct(near, RIVALS)[1:]]
        # What a free body follows better is asked at the end where the compensated picture bends what is near.
        why = _why_refused(s, every, follows, camera.path is None) or ""
        found = _Consensus(starts, moving[ids[follows]], total, why,
                           bool(follows.sum() < MIN_INLIERS), obs, moving)  # fmt: skip
        if not found.refusal:
            return found
        first = first or found
    assert first is not None
    return first


def _only(paths: Paths, span: slice) -> Paths:
    """Tracks as seen in some frames only."""
    uv = np.full_like(paths.uv, np.nan)
    uv[:, span] = paths.uv[:, span]
    return replace(paths, uv=uv)


def _redepth(s: State, obs: Observations) -> State:
    return solve_depths(replace(s, depth=np.ones(len(obs.ref))), obs)


def _why_refused(s: State, obs: Observations, link: np.ndarray, exact: bool) -> str | None:
    """A sentence if the best joint is not believable; exact: whether the picture is one that a free body can be asked
    of."""
    if link.sum() < MIN_INLIERS:
        return f"no joint: only {int(link.sum())} tracks agree with the best one ({s.kind})"
    free = free_motion(s, obs) if exact else None
    if free is not None and free.unexplained > FREE_SHARE:
        return (
            f"{FREELY}, not about one joint: {free.unexplained:.0%} of its points that move most "
            f"do not follow the best joint ({s.kind}, median residual {free.joint_px:.1f} px against "
            f"{free.free_px:.1f} px for a free rigid body, working pixels)"
        )
    return None


def _moving_camera(video: Video, paths: Paths, view: View, full_focal: float, seed: int) -> JointFit | None:
    """The joint between the two largest rigid groups of tracks that move against each other; px from the principal
    point. None if there are no two groups.

    Tracks on two sides of one body that are not seen together make two groups: these stand still against each other,
    and the smaller one is left out.
    """
    asked = np.ones(len(paths), bool)
    while (bodies := two_bodies(paths.uv, view.focal, seed, asked)) is not None:
        fit, stroke = _between(*bodies, video, paths, view, full_focal)
        if fit.verdict == "refused" or stroke > STROKE_STDS:
            return fit
        asked &= ~min(bodies, key=lambda body: body.members.sum()).members
    if asked.all():
        return _of_one_body(video, paths, view, full_focal, seed)
    return JointFit("refused", NO_STROKE, tracks=len(paths))


def _of_one_body(video: Video, paths: Paths, view: View, full_focal: float, seed: int) -> JointFit | None:
    """The joint between two bodies that move so little against each other that all tracks fit one, or None.

    Arguments as of _moving_camera.
    """
    if (bodies := two_bodies(paths.uv, view.focal, seed, split=True)) is None:
        return None
    fit, stroke = _between(*bodies, video, paths, view, full_focal)
    return fit if fit.verdict != "refused" and stroke > STROKE_STDS else None


def _between(static: Rigid, link: Rigid, video: Video, paths: Paths, view: View, full_focal: float
             ) -> tuple[JointFit, float]:  # fmt: skip
    """The joint between two bodies, and its stroke over the stroke's standard deviation (0 where it is refused).

    Arguments as of _moving_camera.
    """
    starts = joints_between(static, link)
    if not starts:
        return JointFit("refused", APART, tracks=len(paths), inliers=int(link.members.sum())), 0.0
    view = View(view.focal, view.focal_std, static.R, static.t)
    still = Still(np.flatnonzero(static.members), static.X[static.members])
    try:
        done = finish(starts, paths, np.flatnonzero(link.members), view, still)
    except NoLink:
        return JointFit("refused", NO_LINK, tracks=len(paths), inliers=int(link.members.sum())), 0.0
    if reason := why_not_believed(done):
        return JointFit("refused", reason, tracks=len(paths), inliers=len(done.members)), 0.0
    note = "; the camera moves: its path is fitted together with the joint"
    fit = result_of(video, done, full_focal, len(paths), note, KNOWN_STD if view.focal_std == 0 else None)
    return fit, done.spread.stroke
