"""Image-space refinement: derivatives of the coverage, recovery of a disturbed joint from a rendered scene's masks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh

from reconstruct.cues import LinkMasks, ProviderInfo, Tracks
from reconstruct.errors import TaaError
from reconstruct.geometry import Geometry, LinkMesh
from reconstruct.joint.models import JointFit
from reconstruct.refine import Mesh, Refinement, moved, refine_joint
from reconstruct.refine.coverage import Topology, coverage, face_ids, link_edges
from reconstruct.refine.terms import mask_term, observe
from tests.reconstruct.geometry_scenes import make_scene

SPHERE = trimesh.creation.icosphere(3, 0.5)
SIZE = (160, 120)


def ball(shift: float, scale: float, requires_grad: bool = True):
    """Coverage of a sphere 3 m away; its (shift, scale) parameters."""
    x = torch.tensor([shift, scale], dtype=torch.float64, requires_grad=requires_grad)
    v = torch.tensor(SPHERE.vertices) * x[1] + torch.tensor([0.03, 0.02, 3.0])
    v = v + torch.stack([x[0], x[0] * 0, x[0] * 0])
    uv = v[:, :2] / v[:, 2:] * 200 + torch.tensor([80.0, 60.0])
    depth, faces = v[:, 2].detach().numpy(), SPHERE.faces
    ids = face_ids(uv.detach().numpy(), depth, faces, SIZE)
    of_link = np.ones(len(faces), bool)
    edges = link_edges(ids, uv, depth, faces, of_link, Topology.of(faces))
    return coverage(ids, of_link, edges), x, edges


def test_coverage_is_the_area_of_a_sphere():
    cover, _, _ = ball(0.0, 1.0, False)
    seen_from = np.arcsin(0.5 / np.linalg.norm([0.03, 0.02, 3.0]))
    # The picture of a sphere off the axis is an ellipse; so close to the axis a circle does.
    assert float(cover.sum()) == pytest.approx(np.pi * (200 * np.tan(seen_from)) ** 2, rel=0.01)


@pytest.mark.parametrize("shift", [0.0, 0.013, 0.031])
def test_coverage_derivative_is_that_of_finite_differences(shift):
    target = ball(0.05, 1.0)[0].detach()
    cover, x, _ = ball(shift, 1.0)
    (cover - target).abs().sum().backward()
    h = 0.01
    loss = [float((ball(shift + s * h, 1.0, False)[0] - target).abs().sum()) for s in (-1, 1)]
    assert float(x.grad[0]) == pytest.approx((loss[1] - loss[0]) / (2 * h), rel=0.02)
    cover, x, _ = ball(shift, 1.0)
    cover.sum().backward()
    area = [float(ball(shift, 1 + s * 0.03, False)[0].sum()) for s in (-1, 1)]
    assert float(x.grad[1]) == pytest.approx((area[1] - area[0]) / 0.06, rel=0.02)


def test_missing_foreground_weighs_more_than_extra():
    mask = np.zeros((120, 160), bool)
    mask[40:80, 50:110] = True
    seen = observe(mask, np.zeros_like(mask), SIZE)
    _, _, edges = ball(0.0, 1.0, False)
    smaller, larger = np.zeros((120, 160)), np.zeros((120, 160))
    smaller[44:76, 54:106] = 1
    larger[36:84, 46:114] = 1
    lost, more = (float(mask_term(torch.from_numpy(m), seen, edges)) for m in (smaller, larger))
    assert lost > 2 * more > 0
    # What a hand hides counts neither way.
    hidden = observe(mask, np.ones_like(mask), SIZE)
    assert float(mask_term(torch.from_numpy(smaller), hidden, edges)) == 0


def slab_meshes(scene) -> dict[str, Mesh]:
    """The moving slab and a static post behind its hinge, cut finely."""

    def box(low, high):
        mesh = trimesh.creation.box(bounds=np.array([low, high]))
        return trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.06)

    moving, static = box(scene.low, scene.high), box([-0.1, -0.02, 0.0], [-0.02, 0.02, 0.3])
    return {"moving": Mesh(*map(np.array, moving)), "static": Mesh(*map(np.array, static))}


def masks_of(scene, meshes: dict[str, Mesh]) -> LinkMasks:
    """True masks: both links are convex, so each is the hull of its corners, filled eight times finer."""
    fit = scene.fit
    h, w = scene.masks.shape[1:]

    def filled(vertices: np.ndarray) -> np.ndarray:
        fine = np.zeros((8 * h, 8 * w), np.uint8)
        hull = cv2.convexHull(((fit.project(vertices) + 0.5) * 8 - 0.5).astype(np.float32))
        cv2.fillPoly(fine, [np.round(hull).astype(np.int32)], 1)
        return fine.reshape(h, 8, w, 8).mean((1, 3)) > 0.5

    slab, post = meshes["moving"].vertices, filled(meshes["static"].vertices)
    moving = np.array([filled(slab @ T[:3, :3].T + T[:3, 3]) for T in fit.link_pose(fit.q)])
    return LinkMasks(moving, post & ~moving, np.zeros_like(moving), np.ones(len(moving)))


@pytest.fixture(scope="module", params=["revolute", "prismatic"])
def scene(request):
    made = make_scene(request.param, hand=False)
    meshes = slab_meshes(made)
    return made, meshes, masks_of(made, meshes)


def wrong(fit: JointFit) -> JointFit:
    """3 deg, 1 cm and 6 % of the state off."""
    lean = np.cross(fit.axis, [0.3, 0.7, 0.2])
    axis = fit.axis + np.tan(np.deg2rad(3)) * lean / np.linalg.norm(lean)
    point = None if fit.point is None else fit.point + np.array([0.008, 0.006, 0.0])
    return replace(fit, axis=axis / np.linalg.norm(axis), point=point, q=1.06 * fit.q)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


HELD_DEG = {"revolute": 1.0, "prismatic": 3.0}
"""How well six silhouettes of a slab, a few pixels of parallax deep, hold the direction."""


@pytest.mark.slow
def test_masks_bring_a_wrong_joint_back_and_leave_a_right_one(scene):
    made, meshes, masks = scene
    h, w = masks.moving.shape[1:]
    for start in (wrong(made.fit), made.fit):
        got = refine_joint(start, None, meshes, masks, (w, h), count=4, use=("mask", "boundary"), stages=2)
        assert got.after["mask_px"] < 0.2
        assert angle(got.fit.axis, made.fit.axis) < HELD_DEG[made.fit.type]
        assert np.abs(got.fit.q - made.fit.q).mean() < 0.01 * np.ptp(made.fit.q)
        assert got.fit.q[0] == 0 and got.scale == 1.0 and np.array_equal(got.T_world_mesh, np.eye(4))


def exact_tracks(made, meshes, rng) -> tuple[JointFit, Tracks]:
    """The fit with 40 points of the slab, wrong by 5 mm, and their exact tracks."""
    fit = made.fit
    X = meshes["moving"].vertices[rng.choice(len(meshes["moving"].vertices), 40, replace=False)]
    T = fit.link_pose(fit.q)
    uv = fit.project(np.einsum("tij,nj->nti", T[:, :3, :3], X) + T[:, :3, 3])
    tracks = Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(40, int), ProviderInfo("drawn", "0", "none"))
    return replace(fit, points=X + 0.005 * rng.normal(size=X.shape), point_track=np.arange(40)), tracks


def test_tracks_alone_bring_a_wrong_joint_back_and_fill_all_frames(scene):
    made, meshes, masks = scene
    h, w = masks.moving.shape[1:]
    fit, tracks = exact_tracks(made, meshes, np.random.default_rng(0))
    got = refine_joint(wrong(fit), tracks, meshes, masks, (w, h), count=6, use=("track",), stages=2)
    assert got.after["track_px"] < 0.2 * got.before["track_px"]
    assert angle(got.fit.axis, fit.axis) < HELD_DEG[fit.type]
    # One camera's tracks hold a slide's length only up to scale.
    scale = 1.0 if fit.type == "revolute" else np.ptp(fit.q) / np.ptp(got.fit.q)
    assert np.abs(scale * got.fit.q - fit.q).max() < 0.03 * np.ptp(fit.q)


@pytest.mark.slow
def test_descriptors_alone_bring_a_sliding_link_closer(scene):
    """They are not invariant to turns, so it is the slide that they measure; on cells of 8 px, hence not exactly."""
    from reconstruct.providers.features import describe

    made, meshes, masks = scene
    if made.fit.type != "prismatic":
        pytest.skip("one type is enough")
    h, w = masks.moving.shape[1:]
    asked = []

    def features(frames):
        asked.extend(frames)
        return describe(made.video, frames, "xfeat")[0]

    start = replace(made.fit, q=1.06 * made.fit.q)
    got = refine_joint(start, None, meshes, masks, (w, h), features, count=5, use=("feature",), stages=1)
    assert sorted(asked) == list(got.frames), "only key frames are described"
    before, after = (np.abs((fit.q - made.fit.q)[got.frames]).mean() for fit in (start, got.fit))
    assert after < 0.7 * before


def test_a_refinement_moves_both_links_and_their_parts(scene):
    made, meshes, _ = scene
    T = np.diag([1.1, 1.1, 1.1, 1.0])
    T[:3, 3] = [0.1, 0.2, 0.3]
    part = (meshes["moving"].vertices[:4], np.array([[0, 1, 2]]))
    white = np.full((len(meshes["moving"].vertices), 4), 255, np.uint8)
    assumed = np.zeros(len(meshes["moving"].faces), bool)
    link = LinkMesh(meshes["moving"].vertices, meshes["moving"].faces, white, assumed, (part,))
    got = moved(Geometry(link, link), Refinement(made.fit, T, 1.1, {}, {}, np.arange(3)))
    expected = 1.1 * link.vertices + [0.1, 0.2, 0.3]
    for new in (got.static, got.moving):
        np.testing.assert_allclose(new.vertices, expected)
        np.testing.assert_allclose(new.parts[0][0], expected[:4])


def test_what_cannot_be_refined_is_said(scene):
    made, meshes, masks = scene
    h, w = masks.moving.shape[1:]
    with pytest.raises(TaaError, match="refused joint"):
        refine_joint(JointFit("refused", "no motion"), None, meshes, masks, (w, h))
    with pytest.raises(TaaError, match="unknown term"):
        refine_joint(made.fit, None, meshes, masks, (w, h), use=("outline",))
    empty = replace(masks, moving=np.zeros_like(masks.moving))
    with pytest.raises(TaaError, match="no moving link"):
        refine_joint(made.fit, None, meshes, empty, (w, h))
