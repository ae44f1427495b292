"""Small motions: a joint found without any guess, at the noise of the tracks."""

import numpy as np
import pytest

from reconstruct.joint.fit import moving_tracks
from reconstruct.joint.paths import Paths
from reconstruct.joint.polish import polish
from reconstruct.joint.select import key_frames, observations
from reconstruct.joint.sweep import sweep
from reconstruct.joint.view import View
from tests.reconstruct.joint_scenes import FOCAL, H, W, make_scene

CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])


def small_motion(kind, axis, stroke, strays, seed):
    """A link seen from 0.75 m, of whose tracks further `strays` slide along edges: tracks, and which are right."""
    box = [[-0.15, 0.15], [-0.2, -0.02], [-0.12, -0.02]]
    scene = make_scene(kind, axis, [0.0, 0.1, 0.75], box, stroke, frames=40, points=80, impostors=0, noise=0.08,
                       seed=seed)  # fmt: skip
    rng = np.random.default_rng(seed)
    uv = scene.tracks.uv.astype(float) - CENTRE
    link = rng.choice(80, strays)
    begin = uv[link, np.isfinite(uv[link][..., 0]).argmax(1)][:, None]
    way = uv[link] - begin
    slid = rng.normal(size=(strays, 1, 2)) * np.linalg.norm(way, axis=-1, keepdims=True) * 0.3
    edge = begin + rng.uniform(0.5, 1.1, (strays, 1, 1)) * way + slid
    return scene, np.concatenate([uv, edge]), np.arange(len(uv) + strays) < 80


def searched(scene, uv):
    seen = np.flatnonzero(np.isfinite(uv[..., 0]).any(1))
    moving = seen[np.linalg.norm(np.nanmax(uv[seen], axis=1) - np.nanmin(uv[seen], axis=1), axis=-1) > 4]
    keys = key_frames(uv[moving])
    return moving, observations(Paths(uv[moving]), FOCAL, np.zeros(2), keys, 260, np.random.default_rng(0),
                                float(np.hypot(W, H)))[0]  # fmt: skip


@pytest.mark.parametrize(
    "kind, axis, stroke, strays",
    [
        ("revolute", [0.2, 1, -0.6], 0.15, 40),
        ("prismatic", [0.3, 0.2, -1], 0.06, 30),
    ],
)
def test_no_guess_is_needed(kind, axis, stroke, strays):
    scene, uv, link = small_motion(kind, axis, stroke, strays, 3)
    moving, obs = searched(scene, uv)
    found = sweep(Paths(uv), moving, obs, moving, [], View(FOCAL))
    assert found is not None
    # Of the sliding points hardly any is left; most of the link's are there.
    assert link[found.ids].mean() > 0.9 and link[found.ids].sum() > 0.7 * link[moving].sum()
    first = found.starts[kind][0]  # which type it is, is not the sweep's to say: a slide is a hinge far away
    assert first.q.shape == (uv.shape[1],)
    best = polish(first, View(FOCAL).sightings(Paths(uv[found.ids]), np.arange(uv.shape[1])))
    assert best.sigma < 0.12
    assert np.degrees(np.arccos(min(1.0, abs(best.twist.axis @ scene.axis)))) < 3


def test_too_few_tracks_are_no_joint():
    scene, uv, _ = small_motion("revolute", [1, 0.1, 0.15], 0.17, 0, 2)
    moving, obs = searched(scene, uv)
    assert sweep(Paths(uv), moving[:6], obs, moving[:6], [], View(FOCAL)) is None
    assert len(moving_tracks(scene.video, scene.tracks))
