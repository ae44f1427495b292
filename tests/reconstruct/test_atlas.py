"""Pictures of meshes: every texel is a point of the surface, and every point finds its texel again."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.geometry.atlas import BUDGET, charts_of, make_atlas
from taa_envs.asset import AssetError, save_asset
from taa_envs.exports.usd import read_obj
from tests.taa_envs.made import door_arguments


def shape(kind: str) -> trimesh.Trimesh:
    if kind == "box":
        return trimesh.creation.box(extents=(0.4, 0.3, 0.02))
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=0.1, height=0.3, sections=24)
    ring = trimesh.creation.annulus(r_min=0.05, r_max=0.1, height=0.04, sections=20)
    return ring


@pytest.mark.parametrize("kind", ["box", "cylinder", "ring"])
def test_a_picture_of_places_gives_each_place_back(kind):
    """Paint each texel with where it is: the image at a face's uv must then say where the face's points are."""
    mesh = shape(kind)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    atlas = make_atlas(vertices, faces, 800.0)
    low, span = vertices.min(0), float(np.ptp(vertices, axis=0).max())
    skin = atlas.skin(np.round((atlas.points - low) / span * 200 + 20).clip(0, 255).astype(np.uint8))
    assert skin.image.shape[:2] == atlas.size
    rng = np.random.default_rng(0)
    weight = rng.dirichlet([2.0, 2, 2], len(faces))
    place = np.einsum("fk,fkd->fd", weight, vertices[faces])
    uv = np.einsum("fk,fkd->fd", weight, skin.uv)
    h, w = skin.image.shape[:2]
    column, row = (uv[:, 0] * w - 0.5).round().astype(int), ((1 - uv[:, 1]) * h - 0.5).round().astype(int)
    found = low + (skin.image[row, column].astype(float) - 20) / 200 * span
    area = mesh.area_faces
    large = area > np.median(area) * 0.5
    texel = np.sqrt(mesh.area / len(atlas.points))
    assert np.abs(found - place)[large].max() < 2.5 * texel + span / 200


@pytest.mark.parametrize("kind", ["box", "cylinder", "ring"])
def test_charts_look_one_way_and_no_texel_serves_two(kind):
    mesh = shape(kind)
    atlas = make_atlas(np.array(mesh.vertices), np.array(mesh.faces), 800.0)
    chart = charts_of(np.array(mesh.faces), np.array(mesh.face_normals), mesh.area_faces)
    assert set(chart) == set(range(chart.max() + 1))
    for k in range(chart.max() + 1):
        n = mesh.face_normals[chart == k]
        assert (n @ n.T).min() > np.cos(np.radians(51))  # two faces within 25 deg of a third
    assert len(np.unique(atlas.texel, axis=0)) == len(atlas.texel)
    assert np.abs(np.linalg.norm(atlas.directions, axis=1) - 1).max() < 1e-9
    distance = np.abs(trimesh.proximity.signed_distance(mesh, atlas.points[::97]))
    assert distance.max() < 4 * np.sqrt(mesh.area / len(atlas.points))  # the margin runs a little past the edges


@settings(max_examples=15, deadline=None)
@given(st.floats(10, 1e6), st.floats(1e-3, 1e3))
def test_the_image_stays_within_its_budget_at_any_scale(density, scale):
    mesh = shape("ring")
    atlas = make_atlas(np.array(mesh.vertices) * scale, np.array(mesh.faces), density)
    assert atlas.size[0] * atlas.size[1] < 2.5 * BUDGET + 4000
    assert np.isfinite(atlas.points).all() and len(atlas.texel) > 0


def skinned(link):
    atlas = make_atlas(np.asarray(link.vertices, float), np.asarray(link.faces), 500.0)
    link.skin = atlas.skin(np.tile(np.uint8([200, 30, 40]), (len(atlas.points), 1)))
    return link


def test_an_asset_carries_its_picture(tmp_path):
    arguments = door_arguments()
    skinned(arguments["moving"])
    asset = save_asset(tmp_path, "door", **arguments)
    from PIL import Image

    image = np.asarray(Image.open(asset.path / "meshes" / "moving.png"))
    assert image.shape == arguments["moving"].skin.image.shape and (image == [200, 30, 40]).all()
    vertices, faces, uv = read_obj(asset.path / "meshes" / "moving.obj")
    assert np.allclose(vertices[faces], np.asarray(arguments["moving"].vertices)[arguments["moving"].faces], atol=1e-4)
    assert np.allclose(uv, arguments["moving"].skin.uv, atol=1e-5)
    model = mujoco.MjModel.from_xml_path(str(asset.model_path))
    assert model.mesh_texcoordnum[model.mesh("moving").id] > 0


def test_a_skin_that_does_not_fit_is_refused(tmp_path):
    arguments = door_arguments()
    link = skinned(arguments["moving"])
    link.skin = dataclasses.replace(link.skin, uv=link.skin.uv[:-1])
    with pytest.raises(AssetError, match="skin needs uv"):
        save_asset(tmp_path, "door", **arguments)
    assert not list(tmp_path.iterdir())
