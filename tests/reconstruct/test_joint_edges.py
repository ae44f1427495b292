"""Joints that tracks on one straight edge follow, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.cues import Hands, ProviderInfo
from reconstruct.joint.answers import FACTOR
from reconstruct.joint.edges import on_one_edge, on_parallels, unless_one_edge
from reconstruct.joint.models import JointFit
from reconstruct.pipeline import joint_off_the_arm
from tests.reconstruct.joint_scenes import made, make_scene


def door():
    return make_scene("revolute", [0, 1, 0.1], [-0.3, 0, 1.5], [[0.05, 0.5], [-0.3, 0.3], [-0.05, 0.05]], 0.8)


def with_places(scene, uv):
    """The scene's video with tracks (N, T, 2), working px, that are always seen."""
    n = len(uv)
    return replace(scene.tracks, uv=scene.video.to_full(uv).astype(np.float32), visible=np.ones(uv.shape[:2], bool),
                   reference=np.zeros(n, int), slip=None)  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(st.floats(0, np.pi), st.floats(0, 30), st.integers(0, 9))
def test_a_line_is_told_from_a_face_whichever_way_it_goes(angle, strays_px, seed):
    scene, rng = door(), np.random.default_rng(seed)
    T = len(scene.video)
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    run, width = rng.uniform(-80, 80, 100), rng.uniform(-6, 6, 100)
    way = 200 + np.arange(T)[:, None] * across
    uv = run[:, None, None] * along + rng.normal(scale=0.4, size=(100, T, 2)) + way
    uv[:8] += strays_px * across
    assert on_one_edge(scene.video, with_places(scene, uv), np.arange(100))
    face = uv + width[:, None, None] * across
    assert not on_one_edge(scene.video, with_places(scene, face), np.arange(100))
    # A line for a while is a face seen edge-on.
    face = np.where(np.arange(T)[:, None] < T // 2, uv, face)
    assert not on_one_edge(scene.video, with_places(scene, face), np.arange(100))


@pytest.mark.parametrize(("found", "turn", "verdict", "type_", "words"), [
    ("ok", 70.0, "ambiguous", "revolute", "without the tracks on one straight edge, made"),
    ("ok", 1.0, "ok", "revolute", "without the tracks on one straight edge, made"),
    ("refused", 0.0, "ambiguous", "prismatic", "all tracks that agree lie on one straight edge"),
    ("on another edge", 70.0, "ambiguous", "prismatic", "all tracks that agree lie on one straight edge"),
])  # fmt: skip
def test_what_an_edge_alone_follows_is_no_sure_joint(found, turn, verdict, type_, words, monkeypatch):
    scene = door()
    T = len(scene.video)
    uv = np.random.default_rng(0).uniform(100, 300, (120, 1, 2)) + np.zeros((1, T, 1))
    uv[:40, :, 1] = 150 + np.arange(T)
    uv[40:80, :, 1] = 350 - np.arange(T)
    tracks = with_places(scene, uv)

    first = made("ok", 0.0, 0.1, np.arange(40), kind="revolute" if verdict == "ok" else "prismatic")
    asked = []

    def ask(some):
        asked.append(some)
        if found == "refused":
            return JointFit("refused", "nothing moves")
        return made("ok", turn, 0.1, np.arange(40, 80) if found == "on another edge" else np.arange(40, 120))

    fit = unless_one_edge(first, scene.video, tracks, ask)
    assert (fit.verdict, fit.type) == (verdict, type_)
    assert fit.reason.startswith(words)
    assert len(asked) == 1 and not asked[0].visible[:40].any() and asked[0].visible[40:].all()
    # The pipeline asks so too; a joint of a face is not asked again.
    face = made("ok", 0.0, 0.1, np.arange(40, 120))
    assert unless_one_edge(face, scene.video, tracks, ask) is face
    answers = iter([first, ask(tracks)])
    monkeypatch.setattr("reconstruct.joint.fit.fit_joint", lambda *_, **__: next(answers))
    nobody = Hands((), None, ProviderInfo("made", "0", "Apache-2.0"))
    assert joint_off_the_arm(scene.video, tracks, nobody, None, 0, lambda _: None).reason.startswith(words)


def sliding(scene, uv, angle, length=0.98):
    """Tracks that slide along edges at these angles (N,), rad, either way."""
    slip = length * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None] * np.ones((1, uv.shape[1], 1))
    slip[::2] *= -1
    return replace(with_places(scene, uv), slip=slip.astype(np.float32))


@settings(max_examples=40, deadline=None)
@given(st.floats(0, np.pi), st.floats(0, 1), st.integers(0, 9))
def test_parallel_edges_are_told_from_edges_of_two_directions_and_from_corners(angle, other, seed):
    scene, rng = door(), np.random.default_rng(seed)
    uv = rng.uniform(100, 400, (100, 1, 2)) + np.zeros((1, len(scene.video), 1))
    ids, angles = np.arange(100), angle + np.radians(rng.uniform(-4, 4, 100))
    assert on_parallels(sliding(scene, uv, angles), ids)
    assert not on_parallels(sliding(scene, uv, angles, 0.5), ids)
    assert not on_parallels(with_places(scene, uv), ids)
    few = int(50 * other)
    turned = np.where(ids < few, angles + np.pi / 2, angles)
    assert on_parallels(sliding(scene, uv, turned), ids) == (few <= 10)
    assert on_parallels(sliding(scene, uv, turned), ids[few:])


def test_what_parallel_edges_alone_follow_is_no_sure_joint():
    scene = door()
    uv = np.random.default_rng(0).uniform(100, 300, (120, 1, 2)) + np.arange(len(scene.video))[None, :, None]
    tracks = sliding(scene, uv, np.where(np.arange(120) < 40, 0.3, np.linspace(0, np.pi, 120)))
    first, other = made("ok", 0.0, 0.1, np.arange(40)), made("ok", 70.0, 0.1, np.arange(40, 120))
    fit = unless_one_edge(first, scene.video, tracks, lambda some: other)
    assert fit.verdict == "ambiguous" and fit.axis is other.axis
    assert fit.reason == f"without the tracks on parallel edges, {other.reason}"
    fit = unless_one_edge(first, scene.video, tracks, lambda some: JointFit("refused", "nothing moves"))
    assert fit.verdict == "ambiguous" and fit.reason.startswith("all tracks that agree slide along parallel edges")
    assert fit.std["axis_deg"] == FACTOR * first.std["axis_deg"]
    assert unless_one_edge(other, scene.video, tracks, lambda some: first) is other
