"""A joint beside what a hand carries: a hook that pulls a door, a cloth, the cup that goes into the cupboard.

A tool goes with the hand, as no part on a joint does, and a body that is carried freely refutes every joint of it and
the part together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from reconstruct.cues import Hands, Tracks
from reconstruct.hand.carried import carried, path_px
from reconstruct.joint.kinds import or_by_prior
from reconstruct.joint.models import JointFit
from reconstruct.joint.result import FREELY
from reconstruct.joint.shadows import without
from reconstruct.video import Video

RESTS = 0.25
"""Of the way of the hand that carries, the share during which a part on a joint has to rest. A hand goes to a part and
leaves it (a hook that opens a door: 0.55); the rest of a pot's lid that is lifted, and the shadow of a parcel, go
whenever it goes (0.03 to 0.10)."""


def unless_carried(fit: JointFit, video: Video, tracks: Tracks, hands: Hands, ask: Callable[[Tracks], JointFit]
                   ) -> JointFit:  # fmt: skip
    """The joint, or where a body that is carried freely refutes it the one that is found without what the hands carry,
    if its part rests for RESTS of the way of the hand that carries most; doubtful, as few films have shown it.

    Args:
        fit: the joint of these tracks, or a refusal.
        tracks: of a camera that rests, else nothing is asked.
        ask: for the joint of some.
    """
    if fit.verdict != "refused" or FREELY not in fit.reason or video.warp is not None:
        return fit
    held = carried(tracks, hands) & tracks.visible.any(1)
    if not held.any():
        return fit
    again = ask(without(tracks, held.any(0)))
    if again.verdict == "refused" or again.moving_frames is None:
        return fit
    way = path_px(hands.tracks[int(np.argmax(held.sum(1)))])
    rests = ~(again.moving_frames[1:] | again.moving_frames[:-1])
    if way[rests].sum() < RESTS * way.sum():
        return fit
    words = f"without what a hand carries ({int(held.any(0).sum())} tracks), {again.reason}"
    return replace(again, verdict="ambiguous", reason=words, type_probability=or_by_prior(again.type_probability))
