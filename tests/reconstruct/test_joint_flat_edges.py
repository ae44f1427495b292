"""A plate that turns in its plane, from its straight edges, and the joint with the points that go with it."""

from pathlib import Path

import numpy as np
import pytest

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.flat_edges import Lines, lines_of, plates_of
from reconstruct.joint.flat_fit import fit_flat
from reconstruct.joint.models import VAGUE_DEG
from reconstruct.video import Video

T, FOCAL, SIZE = 40, 600.0, (640, 480)
CENTRE = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
PITCH = np.radians(35)
UP = np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])
"""Of the world, in the frame of a camera that looks down."""
ACROSS = np.array([[1.0, 0, 0], np.cross(UP, [1.0, 0, 0])])
PIVOT = np.array([0.02, 0.01, 1.0])
PLATE = [[(-0.02, -0.02), (0.18, -0.02)], [(-0.02, 0.02), (0.18, 0.02)], [(0.18, -0.02), (0.18, 0.02)],
         [(-0.02, 0.02), (-0.16, 0.07)], [(-0.02, -0.02), (-0.16, 0.03)], [(-0.16, 0.07), (-0.16, 0.03)]]  # fmt: skip
"""Ends of the edges of half of a pair of scissors, m from the pivot in its plane."""


def turned(xy: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, T, 2) px from the principal point, of points (N, 2) of the plate."""
    R = np.array([[np.cos(q), -np.sin(q)], [np.sin(q), np.cos(q)]])  # (2, 2, T)
    X = PIVOT + np.einsum("ijt,nj->nti", R, xy) @ ACROSS
    return FOCAL * X[..., :2] / X[..., 2:]


def lines(ends: np.ndarray, noise: float, rng: np.random.Generator) -> Lines:
    """Edges by their ends (E, 2, T, 2) px."""
    ends = ends + rng.normal(0, noise, ends.shape)
    way = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=-1)
    return Lines(ends.mean(1), way / length[..., None], length)


def plate_and_strays(turn_deg: float, noise: float = 0.08) -> tuple[Lines, int]:
    """The plate's edges, and after these two that slide elsewhere; and the number of the first."""
    rng, q = np.random.default_rng(3), np.radians(turn_deg) * (1 - np.cos(np.linspace(0, np.pi, T))) / 2
    own = turned(np.array(PLATE, float).reshape(-1, 2), q).reshape(len(PLATE), 2, T, 2)
    slides = np.array([[(-200.0, 60), (-160, 90)], [(150.0, -90), (150, -50)]])[:, :, None]
    slides = slides + np.linspace(0, 1, T)[:, None] * np.array([[[[8.0, 3]]], [[[-6.0, 2]]]])
    return lines(np.concatenate([own, slides]), noise, rng), len(own)


@pytest.mark.parametrize("turn_deg", [15.0, 40.0])
def test_edges_of_a_plate_tell_its_plane(turn_deg):
    given, own = plate_and_strays(turn_deg)
    best = plates_of(given, FOCAL)[0]
    off = np.degrees(np.arccos(abs(best.normal @ UP)))
    assert off < 3.0
    assert off < 3 * best.std_deg
    assert np.degrees(np.ptp(best.q)) == pytest.approx(turn_deg, rel=0.1)
    assert best.follows[:own].sum() >= own - 1
    assert best.share > 0.6
    # The axis goes through the pivot, whatever the distance of the plane.
    assert np.allclose(best.point / best.point[2], PIVOT / PIVOT[2], atol=0.02)


def test_a_wider_turn_leaves_fewer_planes():
    few, many = (plates_of(plate_and_strays(a)[0], FOCAL) for a in (50.0, 8.0))
    assert len(few) < len(many)
    assert few[0].log_p - (few[1].log_p if len(few) > 1 else -np.inf) > many[0].log_p - many[1].log_p


def test_without_edges_there_is_no_plate():
    none = Lines(np.zeros((0, T, 2)), np.zeros((0, T, 2)), np.zeros((0, T)))
    assert plates_of(none, FOCAL) == []


def tracks_of(given: Lines, per_edge: int = 3, apart: float = 14.0) -> Tracks:
    """Points along edges, as the edges' tracker hands them on; full px are working px."""
    s = apart * (np.arange(per_edge) - (per_edge - 1) / 2)
    uv = given.middle[:, None] + s[:, None, None] * given.along[:, None] + CENTRE
    uv, slip = uv.reshape(-1, T, 2), np.repeat(given.along, per_edge, axis=0)
    reference = np.repeat(np.arange(len(given.length)) % T, per_edge)
    return made(uv, slip, reference)


def made(uv: np.ndarray, slip: np.ndarray, reference: np.ndarray) -> Tracks:
    no = np.zeros(len(uv), bool)
    return Tracks(uv.astype(np.float32), np.ones(uv.shape[:2], bool), reference, ProviderInfo("t", "1", "Apache-2.0"),
                  slip.astype(np.float32), no, no.copy())  # fmt: skip


def points(count: int, turn_deg: float) -> Tracks:
    """Tracks of points of the plate."""
    rng, q = np.random.default_rng(5), np.radians(turn_deg) * (1 - np.cos(np.linspace(0, np.pi, T))) / 2
    xy = np.stack([rng.uniform(0.03, 0.17, count), rng.uniform(-0.018, 0.018, count)], axis=1)
    uv = turned(xy, q) + CENTRE + rng.normal(0, 0.15, (count, T, 2))
    return made(uv, np.zeros((count, T, 2)), np.zeros(count, int))


VIDEO = Video(Path("none.mp4"), "0" * 64, SIZE, np.arange(T) / 30, np.arange(T), T,
              np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (T, SIZE[1], SIZE[0], 3)), 1.0)  # fmt: skip


def test_lines_are_found_again_in_their_points():
    given, _ = plate_and_strays(20.0)
    tracks = tracks_of(given)
    found, of = lines_of(tracks.uv - CENTRE, tracks.slip, tracks.reference, 14.0)
    assert len(found.length) == len(given.length)
    for e in range(len(given.length)):
        rows = np.flatnonzero(of == of[3 * e])
        assert list(rows) == [3 * e, 3 * e + 1, 3 * e + 2]
        assert np.allclose(found.middle[of[3 * e]], given.middle[e], atol=1e-3)
    assert np.allclose(found.length, 42.0)


def test_the_joint_of_a_plate_has_its_axis_its_states_and_the_points_that_follow():
    given, own = plate_and_strays(30.0)
    found = fit_flat(VIDEO, points(12, 30.0), tracks_of(given), FOCAL)
    assert found is not None
    assert found.probability > 0.9
    fit = found.fit
    assert fit.type == "revolute"
    axis = np.asarray(fit.T_camera_world)[:3, :3] @ fit.axis
    assert np.degrees(np.arccos(min(1.0, abs(axis @ UP)))) < 3.0
    assert fit.std["axis_deg"] < VAGUE_DEG
    assert np.degrees(np.ptp(fit.q)) == pytest.approx(30.0, rel=0.05)
    assert set(np.arange(12)) <= set(fit.members)
    assert np.all(fit.members < 12 + 3 * own)


def test_edges_that_few_points_follow_are_no_joint():
    given, _ = plate_and_strays(30.0)
    assert fit_flat(VIDEO, points(4, 30.0), tracks_of(given), FOCAL) is None


def test_edges_that_slide_are_no_plate():
    rng = np.random.default_rng(7)
    ends = rng.uniform(-100, 100, (6, 2, 1, 2)) + np.linspace(0, 1, T)[:, None] * np.array([25.0, 10.0])
    uv = rng.uniform(-80, 80, (12, 1, 2)) + np.linspace(0, 1, T)[:, None] * np.array([25.0, 10.0]) + CENTRE
    edges = tracks_of(lines(ends, 0.08, rng))
    assert fit_flat(VIDEO, made(uv, np.zeros((12, T, 2)), np.zeros(12, int)), edges, FOCAL) is None
