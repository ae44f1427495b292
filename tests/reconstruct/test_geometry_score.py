"""The geometry benchmark: the truth scores nothing, a shift scores its size; furniture is staged as it should be."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from benchmarks.furniture import build_furniture, list_furniture
from benchmarks.geometry import into_truth, meshes_of, score, table
from reconstruct.synth.animation import animate, look_at
from reconstruct.synth.clips import build_clip
from reconstruct.synth.hand_model import landmarks
from reconstruct.synth.staging import skin_radii


def stage(clip, scale: float, shift: float = 0.0):
    """A truth, a joint and a surface as a reconstruction in another world and of another size would give them."""
    T_true = look_at(clip.camera, clip.target)
    truth = SimpleNamespace(type=clip.model.kind, axis=clip.model.axis, point=clip.model.point,
                            diagonal=clip.model.diagonal, T_camera_world=T_true[None])  # fmt: skip
    to_camera = lambda x: (np.asarray(x) @ T_true[:3, :3].T + T_true[:3, 3]) * scale  # noqa: E731
    joint = {"type": clip.model.kind, "axis": (T_true[:3, :3] @ clip.model.axis).tolist(),
             "point": to_camera(clip.model.point).tolist(), "q": [0.0, 1.0], "T_camera_world": np.eye(4)}  # fmt: skip
    mesh = trimesh.util.concatenate([trimesh.Trimesh(v, f) for v, f in meshes_of(clip)])
    vertices = to_camera(mesh.vertices + [0, 0, shift])
    return truth, joint, SimpleNamespace(vertices=vertices, faces=np.array(mesh.faces))


@pytest.mark.parametrize("scale", [1.0, 0.7])
def test_the_truth_scores_next_to_nothing_at_any_scale(scale):
    clip = build_clip("box")
    row = score(clip, *stage(clip, scale))
    assert row["chamfer"] < 0.01 and row["scale"] == pytest.approx(scale) and row["angle_deg"] < 1e-4


def test_a_shift_scores_as_much_as_it_is():
    clip = build_clip("box")
    thin = score(clip, *stage(clip, 1.0, shift=0.05))
    assert 0.03 < thin["chamfer"] * thin["diagonal_m"] <= 0.055


def test_the_camera_is_the_centre_of_the_scale():
    T = look_at(np.array([0.2, -1.0, 0.5]), np.zeros(3))
    x = np.array([[0.1, 0.2, 0.3]])
    assert np.allclose(into_truth(x, T, T, 1.0), x)
    centre = np.array([0.2, -1.0, 0.5])
    assert np.allclose(into_truth(x, T, T, 2.0) - centre, (x - centre) / 2)


def test_failures_are_rows():
    good = {"object": "b", "joint": "revolute", "chamfer": 0.02, "words": ""}
    text = table([{"object": "a", "words": "no joint"}, good])
    assert "| a |" in text and "no joint" in text and "2.0%" in text


@pytest.mark.parametrize("name", list_furniture() or [pytest.param("none", marks=pytest.mark.skip("no furniture_sim"))])
def test_furniture_is_touched_and_moved(name):
    clip = build_furniture(name)
    assert clip.model.kind == ("prismatic" if name == "slidecabinet" else "revolute")
    assert 0 < clip.model.q_end <= clip.model.q_range[1] + 1e-9
    motion = animate(clip, 24, 6.0, 0)
    held = np.linalg.inv(motion.T_world_moving[12]) @ motion.T_world_hand[12]
    joints = landmarks(clip.pose, clip.side) @ held[:3, :3].T + held[:3, 3]
    gap = np.min([-trimesh.proximity.signed_distance(trimesh.convex.convex_hull(v), joints) - skin_radii()
                  for v, _ in meshes_of(clip)], axis=0)  # fmt: skip
    assert -0.008 < gap.min() < 0.006  # some skin touches, none is deep inside
