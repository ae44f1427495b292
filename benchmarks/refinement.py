"""Does image-space refinement help, and should the tracks stay in it?  ``python -m benchmarks.refinement``

Rendered clips give masks, tracks and the links' meshes. Each is then made as wrong as a model's: masks eroded or
dilated by 3 px, tracks with 1 px noise and a fifth that drift away, meshes moved by 1 deg, 5 mm and scaled by 2 %,
and a
joint that is 4 deg and 2 cm off with a state curve that is 5 % too long. The joint is scored in the meshes' own frame,
which is what an asset keeps.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.cues import LinkMasks, ProviderInfo, Tracks
from reconstruct.joint.models import JointFit
from reconstruct.providers.features import describe
from reconstruct.refine import Mesh, refine_joint
from reconstruct.synth import SynthTruth, load_truth, render_clip
from reconstruct.synth.render import LINK_CODE
from reconstruct.video import load_video

WAYS = {"start": (), "image (the paper's)": ("mask", "boundary"), "tracks": ("track",),
        "image and tracks": ("mask", "boundary", "track"),
        "image, features and tracks": ("mask", "boundary", "feature", "track")}  # fmt: skip
REDUCED = 3
"""Masks are handed over at a third of the picture's size, so their 3 px are one."""


def link_meshes(truth: SynthTruth) -> dict[str, Mesh]:
    """Meshes of both links of a rendered clip at q = 0, world, cut finely enough to be drawn back to front."""
    import mujoco
    import trimesh

    model = mujoco.MjModel.from_xml_path(str(truth.mjcf))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    out = {}
    for name in ("static", "moving"):
        parts = []
        for g in np.flatnonzero(model.geom_bodyid == model.body(name).id):
            kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
            if kind == mujoco.mjtGeom.mjGEOM_BOX:
                part = trimesh.creation.box(2 * size)
            elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
                part = trimesh.creation.cylinder(size[0], 2 * size[1])
            elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
                part = trimesh.creation.capsule(2 * size[1], size[0])
            elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
                part = trimesh.creation.icosphere(2, size[0])
            else:
                raise ValueError(f"{truth.mjcf} holds a {kind.name}, which this benchmark does not mesh")
            vertices, faces = trimesh.remesh.subdivide_to_size(part.vertices, part.faces, truth.diagonal / 10)
            R = data.geom_xmat[g].reshape(3, 3)
            parts.append(trimesh.Trimesh(vertices @ R.T + data.geom_xpos[g], faces, process=False))
        whole = trimesh.util.concatenate(parts)
        out[name] = Mesh(np.array(whole.vertices), np.array(whole.faces))
    return out


def disturbed(truth: SynthTruth, seed: int, size: float = 1.0):
    """What a model would hand over: fit, tracks, meshes, masks, and the (4, 4) similarity that moved the meshes.

    Args:
        size: of all disturbances; 0 hands over the truth.
    """
    rng = np.random.default_rng(seed)
    moving = truth.moving[:, ::REDUCED, ::REDUCED].astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    grown = [cv2.dilate(m, kernel) if k > 0 else cv2.erode(m, kernel) if k < 0 else m
             for m, k in zip(moving, rng.integers(-1, 2, len(moving)) * int(size > 0), strict=True)]  # fmt: skip
    masks = LinkMasks(np.array(grown) > 0, truth.static[:, ::REDUCED, ::REDUCED], truth.hand[:, ::REDUCED, ::REDUCED],
                      np.ones(len(moving)))  # fmt: skip
    index = np.flatnonzero(truth.tracks["link"] == LINK_CODE["moving"])[:200]
    uv = truth.tracks["uv"][index]
    uv = uv + size * rng.normal(size=uv.shape)
    astray = rng.random(len(index)) < 0.2 * size
    uv[astray] += np.cumsum(3 * rng.normal(size=(int(astray.sum()), uv.shape[1], 2)), axis=1)
    tracks = Tracks(uv, truth.tracks["visible"][index], np.zeros(len(index), int), ProviderInfo("truth", "0", "none"))
    points = truth.tracks["xyz_world"][index, 0]
    points = points + 0.01 * size * truth.diagonal * rng.normal(size=points.shape)
    lean = np.cross(truth.axis, rng.normal(size=3))
    axis = Rotation.from_rotvec(np.deg2rad(4 * size) * lean / np.linalg.norm(lean)).apply(truth.axis)
    point = None if truth.point is None else truth.point + 0.02 * size * rng.normal(size=3)
    wave = 0.02 * np.ptp(truth.q) * np.sin(np.linspace(0, 7, len(truth.q)))
    q = truth.q + size * (0.05 * truth.q + wave)
    fit = JointFit("ok", "", truth.type, {truth.type: 1.0}, axis, point, q=q - q[0], frames=np.arange(len(q)),
                   K=truth.K, T_camera_world=truth.T_camera_world[0], points=points, point_track=np.arange(len(index)),
                   metric=True)  # fmt: skip
    meshes = link_meshes(truth)
    centre = meshes["static"].vertices.mean(0)
    T = np.eye(4)
    T[:3, :3] = np.exp(0.02 * size * rng.normal()) * Rotation.from_rotvec(
        np.deg2rad(size) * rng.normal(size=3)).as_matrix()  # fmt: skip
    T[:3, 3] = centre + 0.005 * size * rng.normal(size=3) - T[:3, :3] @ centre
    meshes = {k: Mesh(m.vertices @ T[:3, :3].T + T[:3, 3], m.faces) for k, m in meshes.items()}
    return fit, tracks, meshes, masks, T


def errors(truth: SynthTruth, fit: JointFit, T_mesh: np.ndarray) -> dict[str, float]:
    """Errors in the meshes' frame: axis deg, location at the moving link's centroid mm, mean |q| error deg or mm.

    Args:
        T_mesh: (4, 4) similarity that takes the true meshes to where they are now.
    """
    back = np.linalg.inv(T_mesh)
    shrink = np.cbrt(np.linalg.det(back[:3, :3]))
    axis = back[:3, :3] @ fit.axis / shrink
    out = {"axis_deg": float(np.degrees(np.arccos(np.clip(axis @ truth.axis, -1, 1))))}
    if truth.point is not None:
        # The point of each axis next to the link's centroid, compared there.
        p, c = back[:3, :3] @ fit.point + back[:3, 3], truth.centroid
        near = [x - c - ((x - c) @ a) * a for x, a in ((p, axis), (truth.point, truth.axis))]
        out["location_mm"] = float(1e3 * np.linalg.norm(near[0] - near[1]))
        out["q"] = float(np.degrees(np.abs(fit.q - truth.q).mean()))
    else:
        out["q"] = float(1e3 * np.abs(fit.q * shrink - truth.q).mean())
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--clips", nargs="+", default=["oven", "drawer", "laptop", "cabinet", "monitor", "stapler", "box"]
    )
    parser.add_argument("--rendered", type=Path, help="folder of `taa synth` to read instead of rendering")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--features", default="xfeat", help="provider of the descriptors")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the rows here as JSON")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        print("| clip | terms | axis deg | location mm | q deg or mm | outline px | s |\n" + "| --- " * 7 + "|")
        for name in args.clips:
            folder = args.rendered / name if args.rendered else render_clip(name, scratch)
            truth = load_truth(folder)
            fit, tracks, meshes, masks, T = disturbed(truth, args.seed)
            h, w = truth.moving.shape[1:]
            video = load_video(truth.video, scratch)

            def features(frames, video=video):
                return describe(video, frames, args.features)[0]

            for way in args.ways:
                use = WAYS[way]
                begin = time.monotonic()
                if use:
                    got = refine_joint(fit, tracks, meshes, masks, (w, h), features, use=use)
                    row = errors(truth, got.fit, got.T_world_mesh @ T) | {"outline_px": got.after["boundary_px"]}
                else:
                    row = errors(truth, fit, T)
                rows.append({"clip": name, "terms": way, **row, "seconds": time.monotonic() - begin})
                print("|", name, "|", way, "|", " | ".join(
                    f"{rows[-1][k]:.2f}" if k in rows[-1] else "" for k in
                    ("axis_deg", "location_mm", "q", "outline_px", "seconds")), "|", flush=True)  # fmt: skip
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
