"""States that no point of a joint shows: found by the link's edges where these are seen, left open where not."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.models import JointFit, joint_transform
from reconstruct.joint.photometric import Pictures
from reconstruct.joint.unseen import from_first, with_unseen_states
from reconstruct.joint.unseen.outline import Edges, Outline
from reconstruct.joint.unseen.search import _best_path, _not_alone
from reconstruct.providers.edge_tracks import all_segments, edge_tracks
from reconstruct.video import Video

T, W, H, F = 40, 320, 240, 300.0
K = np.array([[F, 0, (W - 1) / 2], [0, F, (H - 1) / 2], [0, 0, 1.0]])
AXIS, POINT = np.array([0.0, 1.0, 0.0]), np.array([-0.2, 0.0, 1.2])
DOOR = np.array([[-0.2, -0.2, 1.2], [0.2, -0.2, 1.2], [0.2, 0.2, 1.2], [-0.2, 0.2, 1.2]])
Q = np.radians(85) * 0.5 * (1 - np.cos(np.pi * np.clip((np.arange(T) - 3) / (T - 7), 0, 1)))
"""A door that opens towards the camera."""
FIRST, LAST = slice(0, 16), slice(22, T)
"""Frames in which points are seen, of which none in both."""
OFF = 0.5


def project(X: np.ndarray) -> np.ndarray:
    x = X @ K.T
    return x[..., :2] / x[..., 2:]


WAY = np.array([-0.8, 0.0, -0.6])
STROKE = 0.3 * Q / Q[-1]
"""A drawer that comes out to the left."""


def at(q: float, X: np.ndarray, kind: str = "revolute") -> np.ndarray:
    """Where the link's points are; a hinge's states count the other way round here."""
    G = joint_transform(kind, -AXIS if kind == "revolute" else WAY, POINT, q)
    return X @ G[:3, :3].T + G[:3, 3]


def film(seen: bool = True, kind: str = "revolute") -> Video:
    """The door before a mottled wall with some lines that rest; without the door if it is not to be seen."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=(H, W)).astype(np.float32), (0, 0), 4)
    wall = np.repeat((150 + 8 * noise / noise.std()).clip(110, 190).astype(np.uint8)[..., None], 3, axis=2)
    for x in (30, 250, 290):
        cv2.line(wall, (x, 20), (x + 8, 220), (60, 60, 90), 2, cv2.LINE_AA)
    frames = []
    for q in Q if kind == "revolute" else STROKE:
        picture = wall.copy()
        if seen:
            corners = (project(at(q, DOOR, kind)) * 16).round().astype(int)
            cv2.fillPoly(picture, [corners], (60, 40, 90), cv2.LINE_AA, 4)
        frames.append(picture)
    return Video(Path("door.mp4"), "0" * 64, (W, H), np.arange(T) / 24, np.arange(T), T, np.stack(frames), 1.0)


def pictures(video: Video, covered: slice | None = None) -> Pictures:
    hidden = np.zeros((T, H, W), bool)
    if covered is not None:
        hidden[covered] = True
    return Pictures(np.stack([cv2.cvtColor(f, cv2.COLOR_BGR2GRAY) for f in video.frames]), hidden, K[:2, 2])


def tracks(kind: str = "revolute") -> Tracks:
    """Of points on the door, half of them in its first frames and half in its last."""
    rng = np.random.default_rng(1)
    X = np.column_stack([rng.uniform(-0.18, 0.18, (60, 2)), np.full(60, 1.2)])
    uv = np.stack([project(at(q, X, kind)) for q in (Q if kind == "revolute" else STROKE)], axis=1)
    uv = uv + rng.normal(0, 0.1, (60, T, 2))
    visible = np.zeros((60, T), bool)
    visible[:30, FIRST], visible[30:, LAST] = True, True
    reference = np.where(np.arange(60) < 30, 0, T - 1)
    uv = np.where(visible[..., None], uv, np.nan).astype(np.float32)
    return Tracks(uv, visible, reference, ProviderInfo("points", "0", "Apache-2.0"))


def fit(points: Tracks) -> JointFit:
    """Right in the first frames; the last are off by a turn that nothing holds."""
    q, std = Q.copy(), np.full(T, 0.01)
    q[LAST] -= OFF
    q[FIRST.stop : LAST.start] = np.interp(np.arange(16, 22), [15, 22], [q[15], q[22]])
    std[FIRST.stop :] = np.ptp(q)
    std[0] = 0.0
    X = np.array([[-0.1, -0.1, 1.2], [0.1, -0.1, 1.2], [0.1, 0.1, 1.2], [-0.1, 0.1, 1.2], [0.0, 0.0, 1.2]])
    return JointFit("ok", "30 tracks agree", "revolute", {"revolute": 1.0}, -AXIS, POINT, None, q, np.arange(T), K,
                    np.eye(4), X, np.arange(5), std={"axis_deg": 0.2, "point_m": 0.002, "q": std},
                    members=np.arange(60))  # fmt: skip


def asked(f: JointFit, video: Video, p: Pictures, kind: str = "revolute") -> JointFit:
    every = all_segments(video, p)
    return with_unseen_states(f, video, p, tracks(kind), lambda: edge_tracks(video, p, every), lambda: every)


def test_edges_bridge_what_points_do_not() -> None:
    video = film()
    f = fit(tracks())
    out = asked(f, video, pictures(video))
    off = np.abs(out.q - Q)
    assert np.degrees(off.max()) < 1.5 and np.degrees(np.abs(f.q - Q).max()) > 25
    assert np.all(off[1:] < 3 * out.std["q"][1:]) and out.std["q"][1:].max() < 0.1 * np.ptp(Q)
    np.testing.assert_array_equal(out.q[FIRST], f.q[FIRST])
    np.testing.assert_array_equal(out.std["q"][FIRST], f.std["q"][FIRST])
    assert "its edges show 24 of 40 states" in out.reason and out.verdict == "ok"
    np.testing.assert_allclose(out.T_camera_world[:3, :3] @ out.axis, f.axis, atol=1e-9)


def test_edges_bridge_a_drawer() -> None:
    video, f = film(kind="prismatic"), fit(tracks())
    q = STROKE.copy()
    q[LAST] -= 0.08
    q[16:22] = np.interp(np.arange(16, 22), [15, 22], [q[15], q[22]])
    std = {**f.std, "q": np.where(np.arange(T) < 16, 0.001, np.ptp(q))}
    f = replace(f, type="prismatic", axis=WAY, point=None, q=q, std=std)
    out = asked(f, video, pictures(video), "prismatic")
    assert np.abs(out.q - STROKE).max() < 0.005 and np.abs(f.q - STROKE).max() > 0.07
    assert np.all(np.abs(out.q - STROKE)[1:] < 3 * out.std["q"][1:]) and out.std["q"].max() < 0.1 * 0.3
    assert out.point is None


def test_a_first_state_that_nothing_showed_moves_the_points_to_where_it_is() -> None:
    video, f = film(), fit(tracks())
    # The last frames are right, and nothing shows the first: state 0 is what is OFF in truth.
    q = np.interp(np.arange(T), np.r_[0, np.arange(LAST.start, T)], np.r_[0, Q[LAST] - OFF])
    std = {**f.std, "q": np.where(np.arange(T) > 0, np.ptp(q), 0.0)}
    wrong = replace(f, q=q, points=at(OFF, f.points), std=std, members=np.arange(30, 60))
    assert np.degrees(np.abs(wrong.q - Q).max()) > 25
    out = asked(wrong, video, pictures(video))
    np.testing.assert_allclose(out.q, Q, atol=np.radians(2))
    inside = out.project(out.points)
    np.testing.assert_allclose(inside, project(f.points), atol=3.0)
    assert out.std["q"][1:].max() < 0.2 * np.ptp(Q)


def test_what_no_picture_shows_stays_open() -> None:
    video = film()
    f = fit(tracks())
    out = asked(f, video, pictures(video, slice(FIRST.stop, T)))
    assert out is f
    bare = film(seen=False)
    assert asked(f, bare, pictures(bare)) is f


def test_asks_only_where_a_state_is_open_before_a_resting_camera() -> None:
    video, f = film(), fit(tracks())

    def never():
        raise AssertionError("asked")

    p = pictures(video)
    for some, film_ in (
        (replace(f, std={**f.std, "q": np.full(T, 0.01)}), video),
        (replace(f, verdict="refused"), video),
        (f, replace(video, warp=np.tile(np.eye(3), (T, 1, 1)))),
    ):
        assert with_unseen_states(some, film_, p, tracks(), never, never) is some


@given(q=st.lists(st.floats(-1.2, 1.2), min_size=4, max_size=8), first=st.floats(-0.5, 0.5))
@settings(max_examples=30, deadline=None)
def test_another_first_state_moves_nothing(q: list[float], first: float) -> None:
    """Points are seen where they were in every frame whose state is the same relative to the old first one."""
    states = np.array([first, *q])
    video = replace(film(seen=False), time=np.arange(len(states)) / 24)
    f = fit(tracks())
    out = from_first(f, video, states, np.zeros(len(states)))
    assert out.q[0] == 0 and out.q[int(np.argmax(np.abs(out.q)))] >= 0
    for x, old in zip(out.q, states, strict=True):
        G, G_old = out.link_pose(x), f.link_pose(old)
        new = out.points @ G[:3, :3].T + G[:3, 3]
        np.testing.assert_allclose(out.project(new), f.project(f.points @ G_old[:3, :3].T + G_old[:3, 3]), atol=1e-6)


def test_share_of_an_outline_on_edges_is_most_in_its_state() -> None:
    video = film()
    p = pictures(video)
    X = np.concatenate([np.linspace(DOOR[k], DOOR[(k + 1) % 4], 30) for k in range(4)])
    along = np.repeat(np.roll(DOOR, -1, axis=0) - DOOR, 30, axis=0)
    outline = Outline(X, along, np.ones(120), np.repeat(np.arange(4), 30))
    known = np.zeros(T, bool)
    known[:4] = True
    edges = Edges(all_segments(video, p), p.covered, p.centre, known)
    tried = np.linspace(-0.2, 1.6, 181)
    for t in (18, 22, 26):
        on, sight = edges.share(t, outline, lambda q: joint_transform("revolute", -AXIS, POINT, q), tried, F)
        assert np.degrees(abs(tried[on.argmax()] - Q[t])) < 2 and on.max() > 0.6
        assert sight[on.argmax()] == pytest.approx(1.0, abs=0.05)
    p.covered[20] = True
    assert edges.share(20, outline, lambda q: joint_transform("revolute", -AXIS, POINT, q), tried, F)[1].max() == 0


def test_best_path_prefers_what_is_in_reach() -> None:
    shares = np.zeros((5, 50))
    shares[np.arange(5), [10, 12, 14, 16, 18]] = 0.6
    shares[:, 40] = 1.0
    np.testing.assert_array_equal(_best_path(shares, 9, 3, 1e-3), [10, 12, 14, 16, 18])


@pytest.mark.parametrize(("seen", "kept"), [
    ([1], [1]),
    ([0, 1], [0, 1]),
    ([0, 0, 1], [0, 0, 0]),
    ([1, 1, 1, 0, 0, 0, 1, 0], [1, 1, 1, 0, 0, 0, 0, 0]),
    ([0, 0, 0, 1, 0, 1], [0, 0, 0, 0, 0, 1]),
])  # fmt: skip
def test_a_frame_is_shown_with_those_around_it_however_few_there_are(seen, kept):
    """Of two frames at a video's end it was an error: more were counted about them than there are."""
    assert _not_alone(np.array(seen, bool)).tolist() == [bool(k) for k in kept]
