"""Shadows among the tracks: what is asked without them, and when a joint is none of a part's.

The shadow of a hand slides over a table as exactly as a drawer, and together with a part's own tracks a shadow bends
the joint, or makes it none. Some edges of shadows are seen to be such (``Tracks.cast``: what lies beneath rests),
others only may be (``Tracks.shade``: both sides have one colour); points beside the first see them in their windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.answers import alone_deg, contradicts
from reconstruct.joint.fit import moving_tracks
from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import JointFit
from reconstruct.joint.paths import beside
from reconstruct.video import Video

LIT_TRACKS, LIT_SHARE = 40, 0.5
"""What has to be left of the tracks that move for those on edges of brightness alone to be left out. Where most are on
such edges the world is grey, and they say nothing of shadows (three real clips: 68 to 76 %)."""
HARDLY_SHADOWS, SOME_SHADOWS, SHADOWS = 0.1, 0.4, 0.75
"""Shares of the tracks that follow a joint (of all that moves, where none is found) on edges of shadows: below the
first they are left in; from the second on it is asked for without them (right answers on rendered clips have up to
0.33, wrong ones 0.35 to 1); from the third on it is a shadow's."""
GREY = 0.4
"""Share of all tracks, resting ones too, on edges of brightness alone from which on the world is grey, and these say
nothing of shadows (rendered clips: 0.11 to 0.36; real ones, a suitcase, a stapler and a dishwasher: 0.44 to 0.71)."""
SHARPER = 2.0
"""How many times less a joint's tracks have to miss it by without the edges of some shadows."""
FEW = 0.25
"""Of the tracks that follow a joint, the share that another has to be followed by to be the more exact one."""
BESIDE_PX = 10.0
"""Working px within which a track is on the shadow of which another is on the edge: the windows of both see it."""


def off_shadows(video: Video, tracks: Tracks) -> Tracks:
    """The tracks without what may be the edge of a shadow, or the same where too little that moves would be left."""
    if tracks.shade is None:
        return tracks
    moving = moving_tracks(video, tracks)
    left = int((~tracks.shade[moving]).sum())
    if left == len(moving) or left < max(LIT_TRACKS, LIT_SHARE * len(moving)):
        return tracks
    return without(tracks, tracks.shade)


def unless_a_shadow(fit: JointFit, video: Video, tracks: Tracks, ask: Callable[[Tracks], JointFit]) -> JointFit:
    """The joint, or where many of its tracks are on shadows, what is found without these.

    First it is asked for without what is seen to be the edge of one; where that is but some of it, a sure answer counts
    that its tracks follow far more exactly, or where nothing was found any that is no shadow's, and any that
    contradicts the joint makes it doubtful. Then without all that may be on one, where that is much of what still
    agrees; a sure answer counts that its tracks follow no less exactly, unless it confirms the joint and knows the axis
    no better, or both before are doubtful and many times as many tracks follow them. It is asked so as well where much
    of the joint was on edges and some of what is left may be; any sure answer that contradicts it makes the joint
    doubtful. What counts is doubtful too where a sure one with all contradicts it beside a doubtful one. Where more of
    the tracks off the edges follow the first joint, and no less exactly, than another that is found among these, the
    more exact one counts and is doubtful. In a grey world only many edges are asked of.

    Where nothing is found without the edges, a joint is refused if nearly all of it are such edges or it is doubtful by
    itself, else ambiguous; of these two the second, and a sure one in its place, where one of the same type is found
    without all that may be on a shadow and its tracks follow it more exactly. What is found without the edges is
    ambiguous where nearly all of it may be on a shadow too, and refused where it is doubtful besides. Nothing is
    refused where one of the same type is found without all that may be on a shadow, however doubtful: a part beside its
    own shadow. Of doubtful ones the one counts that its tracks follow most exactly.

    Args:
        fit: the joint of all these tracks, or a refusal.
        ask: for the joint of some.
    """
    refused = fit.verdict == "refused"
    agree = moving_tracks(video, tracks) if refused else fit.point_track
    if tracks.cast is None or not len(agree) or np.mean(cast := tracks.cast[agree]) < HARDLY_SHADOWS:
        return fit
    many = np.mean(cast) >= SOME_SHADOWS
    if not many and _grey(tracks):
        return fit
    uncast = ask(without(tracks, tracks.cast))
    if refused and not many and uncast.verdict != "ok":
        return fit
    some = not many and not refused
    if some and _sharper(uncast, fit, SHARPER):
        return replace(uncast, reason=f"without what is on a shadow's edge, {uncast.reason}")
    again = fit if some else uncast
    if again.verdict == "refused":
        ask_lit = lambda: ask(without(tracks, maybe_shadows(video, tracks)))  # noqa: E731
        return fit if refused else _nothing_without(fit, cast, ask_lit)
    if many and np.sum(~cast) > again.inliers and _sharper(fit, again) and contradicts(again, fit):
        return _most_exact(fit, again, again)
    may = maybe_shadows(video, tracks)
    share = 0.0 if _grey(tracks) else float(np.mean(may[again.point_track]))
    asked = share >= SOME_SHADOWS or (many and (_doubtful(again) or share >= HARDLY_SHADOWS))
    lit = ask(without(tracks, may)) if asked else again
    confirmed = share >= SOME_SHADOWS and _confirms(lit, again)
    few = _doubtful(fit) and _doubtful(again) and lit.inliers < FEW * max(fit.inliers, again.inliers)
    if share >= SOME_SHADOWS and not confirmed and not few and _sharper(lit, again):
        twice_sure = fit.verdict == "ok" and _doubtful(again) and contradicts(lit, fit)
        words = f"without what may be on a shadow, {lit.reason}"
        return replace(lit, verdict="ambiguous" if twice_sure else "ok", reason=words)
    if some:
        told = _doubtful(fit) or contradicts(uncast, fit)
        return _most_exact(fit, uncast, lit if asked else uncast) if told else fit
    if share < SHADOWS and (_doubtful(again) or (lit.verdict == "ok" and contradicts(lit, again))):
        return _most_exact(fit, again, lit)
    if share < SHADOWS or confirmed:
        return replace(again, reason=f"without what is on a shadow's edge, {again.reason}")
    return fit if refused and not many else _mostly_shadows(fit, again, lit, share)


def _mostly_shadows(fit: JointFit, again: JointFit, lit: JointFit, share: float) -> JointFit:
    """What becomes of a joint that is found without the edges of shadows, so much of which may be on them too."""
    words = f"without the edges of one, {share:.0%} of the tracks that agree may be on it too"
    if again.verdict == "ok":
        # Its type is the part's, or says nothing of it.
        p = or_by_prior(again.type_probability)
        reason = f"what moves may be a shadow: {words}; {again.reason}"
        return replace(again, verdict="ambiguous", reason=reason, type_probability=p)
    if lit.type == again.type == fit.type:
        return _most_exact(fit, again, lit)
    return _refuse(again, f"{words}, and {_first(again.reason)}")


def _nothing_without(fit: JointFit, cast: np.ndarray, ask_lit: Callable[[], JointFit]) -> JointFit:
    """What becomes of a joint that is none without the edges of shadows.

    Args:
        cast: (n,) bool, which of its tracks are on these.  ask_lit: for what is found without all that may be on one.
    """
    words = f"{int(cast.sum())} of the {len(cast)} tracks that agree lie on the edge of one"
    nearly_all = np.mean(cast) >= SHADOWS
    if nearly_all or fit.verdict != "ok":
        lit = ask_lit()
        if lit.type != fit.type:
            return _refuse(fit, words if nearly_all else f"{words}, and {_first(fit.reason)}")
        if _sharper(lit, fit):
            return replace(lit, verdict="ambiguous", reason=f"without what may be on a shadow, {lit.reason}")
    p, reason = or_by_prior(fit.type_probability), f"part of what moves is a shadow: {words}; {fit.reason}"
    return replace(fit, verdict="ambiguous", reason=reason, type_probability=p)


def maybe_shadows(video: Video, tracks: Tracks) -> np.ndarray:
    """(N,) bool, which tracks may be a shadow's: on its edge, on an edge of brightness alone, or for more than half of
    the time beside a track that is on a shadow's edge.

    Args:
        tracks: with ``cast``.
    """
    assert tracks.cast is not None
    may = tracks.cast if tracks.shade is None else tracks.cast | tracks.shade
    return may | beside(video.to_work(tracks.uv), tracks.visible, tracks.cast, BESIDE_PX)


def _grey(tracks: Tracks) -> bool:
    return tracks.shade is not None and bool(np.mean(tracks.shade) >= GREY)


def _sharper(joint: JointFit, than: JointFit, times: float = 1.0) -> bool:
    """Whether a joint is sure, and its tracks miss it so many times less."""
    after, before = joint.residual_px, than.residual_px
    return joint.verdict == "ok" and after is not None and before is not None and times * after <= before


def _confirms(other: JointFit, joint: JointFit) -> bool:
    """Whether both are sure of one joint, whose axis the other knows no better."""
    if (other.verdict, joint.verdict) != ("ok", "ok"):
        return False
    known = "axis_deg" in other.std and "axis_deg" in joint.std
    return known and not contradicts(other, joint) and bool(alone_deg(other) >= alone_deg(joint))


def _doubtful(joint: JointFit) -> bool:
    return joint.verdict == "ambiguous"


def _most_exact(fit: JointFit, again: JointFit, lit: JointFit) -> JointFit:
    """Of joints found with shadows' edges, without these, and without all that may be on a shadow, one of which is no
    refusal, the one of more than a few tracks that these miss least; doubtful, however sure it is by itself."""
    found = [(again, "without what is on a shadow's edge"), (lit, "without what may be on a shadow"),
             (fit, "part of what moves may be a shadow")]  # fmt: skip
    found = [x for x in found if x[0].residual_px is not None]
    few = FEW * max(x[0].inliers for x in found)
    best, words = min((x for x in found if x[0].inliers >= few), key=lambda x: float(x[0].residual_px or 0.0))
    return replace(best, verdict="ambiguous", reason=f"{words}, {best.reason}")


def without(tracks: Tracks, out: np.ndarray) -> Tracks:
    """The tracks with some, (N,) bool, never seen: the others keep their numbers."""
    return replace(tracks, visible=tracks.visible & ~out[:, None])


def _refuse(joint: JointFit, words: str) -> JointFit:
    return JointFit("refused", f"what moves is a shadow: {words}", tracks=joint.tracks, inliers=joint.inliers)


def _first(reason: str) -> str:
    """Of a reason, what comes before the advice."""
    return reason.split("; ")[0]
