"""States in frames in which the points of a joint are lost, by the straight edges of its link.

A door of even paint that swings by ninety degrees shows some points before it is seen on edge, and others after. The
axis is held by either group, but how far the one is from the other is held by nothing, and an interpolation says
anything. Once the joint is known the link's straight edges are lines in space, by the frames that its own points hold
together, and where these are in the other pictures says what is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from reconstruct.cues import Tracks
from reconstruct.joint.models import JointFit, placed
from reconstruct.joint.photometric import Pictures
from reconstruct.joint.result import image_line, moving_frames
from reconstruct.joint.unseen.going import LIFE, Going
from reconstruct.joint.unseen.outline import Edges
from reconstruct.joint.unseen.search import states_shown
from reconstruct.joint.unseen.settle import settled
from reconstruct.joint.world import assumed_up, world_from_camera
from reconstruct.providers.edge_tracks import Segments
from reconstruct.video import Video

OPEN = 0.1
"""Standard deviation of a state over the stroke from which on it is looked for."""
ROUNDS = 8
"""Outlines at most, each by the states that the last one found."""


def with_unseen_states(fit: JointFit, video: Video, pictures: Pictures, points: Tracks, rims: Callable[[], Tracks],
                       segments: Callable[[], Sequence[Segments]]) -> JointFit:  # fmt: skip
    """The joint with the states that its own tracks leave open found by the straight edges of its link.

    Axis and place stay as they are, and so do the most frames that its own tracks hold together. States that nothing
    shows go with those around as they did before, and are no better known.

    Args:
        fit: a joint up to scale before a resting camera, or a refusal.
        pictures: of the video's frames.
        points: all point tracks off arms.  rims: for the moving straight edges off arms.
        segments: for the straight edges of every picture.
    """
    if fit.verdict == "refused" or video.warp is not None or fit.q is None or fit.members is None:
        return fit
    if not (np.asarray(fit.std["q"]) > OPEN * np.ptp(fit.q)).any():
        return fit
    going = Going.of(fit, video, points, rims())
    before = going.together(fit.members, fit.q)
    if before.sum() < LIFE or not np.ptp(fit.q[before]) > 0:
        return fit
    q, found, outline = fit.q.copy(), before, going.outline(fit.q, before)
    if outline is None:
        return fit
    edges = Edges(segments(), pictures.covered, pictures.centre, before)
    for _ in range(ROUNDS):
        last = found
        q, found = states_shown(outline, edges, going, q, before, found)
        outline = going.outline(q, found) or outline
        if (found == last).all():
            break
    if found.sum() == before.sum():
        return fit
    q, std = settled(q, before, found, outline, going, fit.std)
    # Where nothing is shown the states go with those around as they did before.
    T, moved = np.arange(len(q)), np.where(found, q - fit.q, 0.0)
    moved = np.interp(T, T[found], moved[found])
    q, open_ = fit.q + moved, np.asarray(fit.std["q"])
    as_before = np.hypot(open_, moved)
    if not found[0]:
        std = np.where(before, as_before, np.hypot(std, np.median(open_[before])))
    std = np.minimum(np.where(found, std, as_before), np.ptp(q))
    std[0] = 0.0
    reason = f"{fit.reason}; its edges show {int((found & ~before).sum())} of {len(q)} states"
    return replace(from_first(fit, video, q, std), reason=reason)


def from_first(fit: JointFit, video: Video, q: np.ndarray, std: np.ndarray) -> JointFit:
    """The joint with other states, from the new first one on, in the world that goes with them.

    Args:
        q: (T,) relative to the old first state.  std: (T,) relative to the new one.
    """
    first = fit.link_pose(q[0])
    points = fit.points @ first[:3, :3].T + first[:3, 3]
    q, axis = q - q[0], fit.axis
    if q[int(np.argmax(np.abs(q)))] < 0:
        q, axis = -q, -axis
    out = replace(fit, q=q, axis=axis, points=points, std={**fit.std, "q": std},
                  moving_frames=moving_frames(q, video.time))  # fmt: skip
    C = np.asarray(out.T_camera_world)
    far = out.link_pose(q[int(np.argmax(np.abs(q)))])
    start, end = (x @ C[:3, :3].T + C[:3, 3] for x in (points, points @ far[:3, :3].T + far[:3, 3]))
    turned = C[:3, :3] @ axis
    up, _ = assumed_up(fit.type, turned, start, end)
    origin = np.median(start, axis=0) if fit.point is None else C[:3, :3] @ fit.point + C[:3, 3]
    out = placed(out, world_from_camera(up, turned, origin) @ C)
    return replace(out, image_line=image_line(out))
