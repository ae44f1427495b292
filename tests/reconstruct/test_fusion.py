"""Meshes of key frames, each off by a similarity and noise, become one closed mesh a link."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from reconstruct.cues import LinkMasks
from reconstruct.errors import TaaError
from reconstruct.geometry.closing import zero_level
from reconstruct.geometry.fusion import KeyMesh, fuse_meshes, ground, noise_of, sample, similarity
from reconstruct.joint.models import JointFit

SIZE = (320, 240)
FRAMES = 9
AXIS, POINT = np.array([0.0, 0.0, 1.0]), np.array([-0.2, -0.02, 0.2])


def boxes(moves: bool) -> list[trimesh.Trimesh]:
    """A cabinet with a door that has a handle, at q = 0 (shut); it opens towards -y with negative q."""
    if moves:
        return [trimesh.creation.box(bounds=b) for b in (((-0.2, -0.05, 0.0), (0.2, -0.02, 0.4)),
                                                         ((0.13, -0.09, 0.12), (0.16, -0.05, 0.28)))]  # fmt: skip
    return [trimesh.creation.box(bounds=((-0.2, 0.0, 0.0), (0.2, 0.25, 0.4)))]


def look_at(camera: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ camera
    return T


@pytest.fixture(scope="module")
def scene():
    """Joint, masks and depth by casting rays at the true boxes."""
    K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
    T = look_at(np.array([-0.5, -1.0, 0.75]), np.array([0.0, -0.05, 0.2]))
    q = np.linspace(-1.2, -0.05, FRAMES)
    fit = JointFit("ok", "", "revolute", {"revolute": 1.0}, AXIS, POINT, None, q, np.arange(FRAMES), K, T,
                   np.zeros((3, 3)), np.arange(3), True, "given", {}, None, 0.5, 3, 3, None)  # fmt: skip
    w, h = SIZE[0] // 2, SIZE[1] // 2
    u, v = np.meshgrid((np.arange(w) + 0.5) * 2 - 0.5, (np.arange(h) + 0.5) * 2 - 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    depth, moving, static = [], [], []
    for t in range(FRAMES):
        z = []
        for moves in (False, True):
            mesh = trimesh.util.concatenate(boxes(moves))
            mesh.apply_transform(T @ (fit.link_pose(q[t]) if moves else np.eye(4)))
            origin = np.zeros_like(rays)
            where, ray, _ = mesh.ray.intersects_location(origin, rays, multiple_hits=True)
            nearest = np.full(len(rays), np.inf)
            np.minimum.at(nearest, ray, where[:, 2])
            z.append(nearest)
        depth.append(np.minimum(*z).reshape(h, w))
        moving.append(((z[1] < z[0])).reshape(h, w))
        static.append(((z[0] <= z[1]) & np.isfinite(z[0])).reshape(h, w))
    depth = np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)
    masks = LinkMasks(np.array(moving), np.array(static), np.zeros_like(moving), np.ones(FRAMES))
    return fit, masks, depth


def key_mesh(fit: JointFit, frame: int, seed: int, scale: float = 0.15, wrong: bool = False,
             exact: bool = False) -> KeyMesh:  # fmt: skip
    """What a network would give: the object as it is in the frame, scaled, turned, shifted, rough."""
    rng = np.random.default_rng(seed)
    parts = []
    for moves in (False, True):
        for mesh in boxes(moves):
            mesh = mesh.subdivide_to_size(0.03)
            mesh.apply_transform(fit.T_camera_world @ (fit.link_pose(fit.q[frame]) if moves else np.eye(4)))
            colour = (200, 60, 40) if moves else (60, 120, 200)
            colours = np.tile([*colour, 255], (len(mesh.vertices), 1))
            mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colours)
            parts.append(mesh)
    mesh = trimesh.util.concatenate(parts)
    if exact:
        return KeyMesh(frame, np.array(mesh.vertices), np.array(mesh.faces), np.array(mesh.visual.vertex_colors))
    vertices = mesh.vertices + rng.normal(0, 0.0015, mesh.vertices.shape)
    middle = vertices.mean(0)
    turn = Rotation.from_rotvec(np.radians(3.0) * rng.normal(size=3) / np.sqrt(3)).as_matrix()
    vertices = (vertices - middle) @ turn.T + middle + rng.normal(0, 0.008, 3)
    vertices = vertices * (1 + scale * rng.uniform(-1, 1))
    if wrong:
        vertices = (vertices - vertices.mean(0)) * [1.6, 0.5, 1.0] + vertices.mean(0) + [0.1, 0.2, 0]
    return KeyMesh(frame, vertices, np.array(mesh.faces), np.array(mesh.visual.vertex_colors))


def chamfer(vertices: np.ndarray, faces: np.ndarray, truth: list[trimesh.Trimesh]) -> float:
    """Mean of both mean nearest distances over the truth's diagonal."""
    a = trimesh.sample.sample_surface(trimesh.Trimesh(vertices, faces, process=False), 6000, seed=0)[0]
    whole = trimesh.boolean.union(truth, engine="manifold") if len(truth) > 1 else truth[0]
    b = trimesh.sample.sample_surface(whole, 6000, seed=1)[0]
    both = cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()
    return float(both / 2 / np.linalg.norm(np.ptp(whole.vertices, axis=0)))


@pytest.mark.slow
def test_noisy_meshes_of_key_frames_become_two_closed_links(scene):
    fit, masks, depth = scene
    rng = np.random.default_rng(5)
    noisy = (depth * (1 + rng.normal(0, 0.004, depth.shape))).astype(np.float32)
    keys = [key_mesh(fit, t, seed=t) for t in (0, 2, 4, 6, 8)]
    fused = fuse_meshes(keys, fit, masks, SIZE, noisy)
    assert fused.used.all()
    for moves, link in ((False, fused.static), (True, fused.moving)):
        surface = trimesh.Trimesh(link.vertices, link.faces, process=False)
        assert surface.is_watertight and surface.volume > 0
        assert chamfer(link.vertices, link.faces, boxes(moves)) < 0.03
    # Colours went with the link they belong to.
    assert np.median(fused.moving.colors[:, 0]) > 150 > np.median(fused.static.colors[:, 0])
    assert fused.provenance["fused_meshes"]["value"] == 5


@pytest.mark.slow
def test_a_mesh_that_agrees_with_no_other_is_left_out(scene):
    fit, masks, depth = scene
    keys = [key_mesh(fit, t, seed=10 + t, wrong=t == 4) for t in (0, 2, 4, 6, 8)]
    fused = fuse_meshes(keys, fit, masks, SIZE, depth)
    assert fused.used.tolist() == [True, True, False, True, True]
    assert chamfer(fused.moving.vertices, fused.moving.faces, boxes(True)) < 0.03


def test_ground_finds_the_scale_along_the_ray(scene):
    fit, _, depth = scene
    key = key_mesh(fit, 3, seed=1, scale=0.0)
    shrunk = replace(key, vertices=key.vertices * 0.7)
    S = ground(sample(shrunk), depth[3], fit.K, SIZE)
    assert np.cbrt(np.linalg.det(S[:3, :3])) == pytest.approx(1 / 0.7, rel=0.03)
    moved = shrunk.vertices @ S[:3, :3].T + S[:3, 3]
    truth = key_mesh(fit, 3, seed=1, exact=True).vertices
    assert np.median(np.linalg.norm(moved - truth, axis=1)) < 0.02
    assert np.median(np.linalg.norm(shrunk.vertices - truth, axis=1)) > 0.3


def test_without_depth_the_meshes_own_place_counts_and_a_missing_link_is_named(scene):
    fit, masks, depth = scene
    nothing = LinkMasks(np.zeros_like(masks.moving), masks.static | masks.moving, masks.hand, masks.confidence)
    with pytest.raises(TaaError, match="hold no moving link"):
        fuse_meshes([key_mesh(fit, 4, seed=0, scale=0.0)], fit, nothing, SIZE)
    with pytest.raises(TaaError, match="at least one"):
        fuse_meshes([], fit, masks, SIZE, depth)
    with pytest.raises(TaaError, match="meets its depth"):
        fuse_meshes([key_mesh(fit, 4, seed=0)], fit, masks, SIZE, np.full_like(depth, np.nan))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.5, 2.0), st.floats(0, 0.6))
def test_a_similarity_is_found_among_outliers(seed, scale, angle):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(200, 3)) * [0.3, 0.2, 0.1] + [0, 0, 1.5]
    axis = rng.normal(size=3)
    S = np.eye(4)
    S[:3, :3] = scale * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    S[:3, 3] = rng.normal(0, 0.2, 3)
    target = source @ S[:3, :3].T + S[:3, 3]
    exact = similarity(source, target, np.tile(np.eye(3), (200, 1, 1)), steps=30)
    assert np.allclose(exact, S, atol=1e-6)
    bad = rng.choice(200, 40, replace=False)
    target[bad] += rng.normal(0, 5.0, (40, 3))
    found = similarity(source, target, np.tile(np.eye(3) / 0.01, (200, 1, 1)), steps=60)
    near = np.setdiff1d(np.arange(200), bad)
    start = np.linalg.norm(source[near] - target[near], axis=1).mean()
    left = np.linalg.norm(source[near] @ found[:3, :3].T + found[:3, 3] - target[near], axis=1).mean()
    assert left < 0.02 or left < 0.2 * start


def test_depth_is_trusted_less_along_the_ray_and_far_away():
    near, far = noise_of(np.array([[0.0, 0, 0.5], [0, 0, 2.0]]))
    assert near[2, 2] < near[0, 0] and far[2, 2] == pytest.approx(near[2, 2] / 16)


def test_the_zero_level_is_a_closed_sphere():
    axis = np.linspace(-1.2, 1.2, 25)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces = zero_level(1.0 - np.linalg.norm(x, axis=-1), np.full(3, -1.2), 0.1)
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight and mesh.volume == pytest.approx(4 / 3 * np.pi, rel=0.05)
    with pytest.raises(TaaError, match="agree on any solid"):
        zero_level(np.full((5, 5, 5), -1.0), np.zeros(3), 0.1)
