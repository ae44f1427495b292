"""Hinges along edges of the picture: directions that are found, joints that take them, and what is left alone."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.joint.finish import Finished
from reconstruct.joint.parallels import WORTH_DEG, along_edges, edge_directions
from reconstruct.joint.photometric import Pictures
from reconstruct.joint.polish import Bundle, Sightings, parallel_deg, polish, positions
from reconstruct.joint.result import result_of
from reconstruct.joint.twist import Twist, twist_of_joint
from reconstruct.joint.uncertainty import spread
from reconstruct.joint.view import View
from reconstruct.joint.weigh import Rival
from reconstruct.video import Video

W, H, FOCAL, T = 640, 480, 600.0, 24
CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])
BOX = Rotation.from_euler("yx", [35, 25], degrees=True).as_matrix().T
"""Rows: the directions of the box's edges, camera frame."""


def pictures(directions: np.ndarray) -> Pictures:
    """Of a box of shaded faces whose edges go along three directions (rows), 2 away, with noise."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    X = corners * [0.45, 0.35, 0.4] @ directions + [0, 0, 2.2]
    px = FOCAL * X[:, :2] / X[:, 2:] + CENTRE
    faces = [[k for k in range(8) if corners[k, axis] == side] for axis in range(3) for side in (-1, 1)]
    grey = np.full((H, W), 200, np.uint8)
    for face in sorted(faces, key=lambda f: -X[f].mean(0)[2]):
        shade = 60 + 25 * faces.index(face)
        cv2.fillConvexPoly(grey, cv2.convexHull(np.round(px[face] * 16).astype(np.int32)), shade, cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(scale=2, size=(T, H, W))
    return Pictures(np.clip(grey + noise, 0, 255).astype(np.uint8), np.zeros((T, H, W), bool), CENTRE)


def door(axis: np.ndarray, turn_deg: float, noise: float = 0.3, seed: int = 0) -> Finished:
    """The joint that tracks on a door of the box hold, which turns about its left edge."""
    rng = np.random.default_rng(seed)
    across = BOX[0]
    point = np.array([0, 0, 2.2]) - 0.45 * across
    X = point + rng.uniform(0.05, 0.85, (60, 1)) * across + rng.uniform(-0.35, 0.35, (60, 1)) * axis
    twist, speed = twist_of_joint("revolute", axis, point, X.mean(0))
    q = speed * np.radians(turn_deg) * np.sin(np.linspace(0, np.pi / 2, T)) ** 2
    blank = Sightings(np.zeros((60, T, 2)), np.ones((60, T), bool), np.ones(60), FOCAL)
    truth = Bundle("revolute", twist, q, X)
    cam = positions(truth, blank)[1]
    sight = replace(blank, uv=FOCAL * cam[..., :2] / cam[..., 2:] + rng.normal(scale=noise, size=(60, T, 2)))
    b = polish(truth, sight, iterations=40)
    return Finished(b, sight, np.arange(60), spread(b, sight), {"revolute": 1.0}, View(FOCAL))


def off_deg(joint: Finished, axis: np.ndarray) -> float:
    return float(np.degrees(np.arccos(min(1.0, abs(joint.bundle.twist.axis @ axis)))))


def test_the_edges_of_a_box_are_found_in_the_picture():
    found = edge_directions(pictures(BOX), FOCAL, np.array([[-150.0, -120], [150, 120]]))
    best = found.along[np.argsort(-found.weight)[:3]]
    assert found.weight.sum() == pytest.approx(1.0)
    off = np.degrees(np.arccos(np.clip(np.abs(best @ BOX.T).max(0), 0, 1)))
    assert off.max() < 0.5


def test_where_there_are_no_edges_no_direction_is_found():
    rng = np.random.default_rng(0)
    grain = rng.normal(120, 3, (T, H, W)).astype(np.uint8)
    none = Pictures(grain, np.zeros(grain.shape, bool), CENTRE)
    box = np.array([[-150.0, -120], [150, 120]])
    assert len(edge_directions(none, FOCAL, box).along) == 0
    all_covered = replace(pictures(BOX), covered=np.ones((T, H, W), bool))
    assert len(edge_directions(all_covered, FOCAL, box).along) == 0


@pytest.mark.parametrize("seed", range(3))
def test_a_door_that_opens_a_little_turns_about_an_edge_of_its_box(seed):
    joint = door(BOX[1], 4.0, seed=seed)
    assert joint.axis_deg > 2 * WORTH_DEG
    out = along_edges(joint, pictures(BOX))
    assert out is not joint
    assert off_deg(out, BOX[1]) < 1.0
    assert off_deg(out, BOX[1]) < 2 * out.axis_deg < 2 * joint.axis_deg
    assert np.all(out.spread.q[1:] > 0)


@pytest.mark.parametrize("seed", range(3))
def test_an_axis_that_goes_along_no_edge_is_left_as_the_tracks_have_it(seed):
    slanted = Rotation.from_rotvec(np.radians(40) * BOX[0]).apply(BOX[1])
    joint = door(slanted, 12.0, noise=0.15, seed=seed)
    assert joint.axis_deg > WORTH_DEG
    assert along_edges(joint, pictures(BOX)) is joint


def dragged(joint: Finished, px: float, seed: int) -> Finished:
    """The joint that its tracks hold if a third of them slides along, by about so many px."""
    rng, s = np.random.default_rng(seed + 100), joint.sight
    along = (np.sin(np.linspace(0, np.pi / 2, T)) ** 2)[:, None] * np.array([0.76, 0.64])
    uv = s.uv.copy()
    uv[:18] += px * rng.uniform(0.5, 1.5, (18, 1, 1)) * along
    sight = replace(s, uv=uv)
    b = polish(joint.bundle, sight, iterations=40)
    return replace(joint, bundle=b, sight=sight, spread=spread(b, sight))


@pytest.mark.parametrize("px, seed", [(1.0, 0), (1.0, 1), (1.5, 0), (1.5, 2)])
def test_tracks_that_slide_alike_do_not_outweigh_edges_by_their_own_word(px, seed):
    joint = dragged(door(BOX[1], 5.0, noise=0.1, seed=seed), px, seed)
    assert off_deg(joint, BOX[1]) > 2 * joint.axis_deg, "it is sure, and wrong"
    out = along_edges(joint, pictures(BOX))
    assert off_deg(out, BOX[1]) < 0.5 * off_deg(joint, BOX[1])
    assert off_deg(out, BOX[1]) < 2 * out.axis_deg
    assert out.alone_deg >= joint.axis_deg


@pytest.mark.parametrize("seed", range(2))
def test_what_they_hold_is_stated_no_better_than_it_is_far_from_a_more_probable_edge(seed):
    joint = dragged(door(BOX[1], 4.0, noise=0.1, seed=seed), 1.5, seed)
    assert off_deg(joint, BOX[1]) > 4 * joint.axis_deg
    out = along_edges(joint, pictures(BOX))
    assert out.bundle is joint.bundle
    assert off_deg(out, BOX[1]) < 2 * out.axis_deg
    assert np.all(out.spread.q >= joint.spread.q) and out.spread.point > joint.spread.point


def test_what_tracks_hold_and_slides_are_not_asked():
    joint = door(BOX[1], 60.0, noise=0.05)
    assert joint.axis_deg < WORTH_DEG and along_edges(joint, pictures(BOX)) is joint
    vague = door(BOX[1], 6.0)
    slide = replace(vague, bundle=replace(vague.bundle, kind="prismatic"))
    assert along_edges(slide, pictures(BOX)) is slide


def test_what_its_tracks_leave_in_doubt_stays_ambiguous():
    alone = door(BOX[1], 6.0)
    joint = replace(alone, rival=Rival(10.0, 0.3, alone.bundle))
    out = along_edges(joint, pictures(BOX))
    assert out is not joint and out.doubt
    frames = np.zeros((T, H, W, 3), np.uint8)
    video = Video(Path("video"), "0" * 64, (W, H), np.arange(T) / 30.0, np.arange(T), T, frames, 1.0, None)
    fit = result_of(video, out, FOCAL, 60, "", 0.02)
    assert fit.verdict == "ambiguous" and "alone" in fit.reason
    assert result_of(video, replace(out, doubt=""), FOCAL, 60, "", 0.02).verdict == "ok"


def test_a_direction_is_known_worse_where_the_focal_length_is_not_known():
    sight = door(BOX[1], 6.0).sight
    assert parallel_deg(replace(sight, focal_std=0.12)) > 2 * parallel_deg(sight)


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw"])
def test_the_axis_by_a_step_is_its_derivative(kind):
    w = np.zeros(3) if kind == "prismatic" else np.array([0.0, 0.5, -1.2])
    t = Twist(np.zeros(3), np.array([1.0, 0, 0]), w + (0.2 * np.array([1.0, 0, 0]) if kind == "screw" else 0))
    Z, h = t.tangent(kind), 1e-6
    for k in range(Z.shape[1]):
        by = (t.moved(h * Z[:, k], kind).axis - t.moved(-h * Z[:, k], kind).axis) / (2 * h)
        np.testing.assert_allclose(t.axis_by_step(Z)[:, k], by, atol=1e-6)
