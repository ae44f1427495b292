"""Shape of the moving link from pixels alone, against furniture that others modelled.

    python -m benchmarks.geometry                         # every object, renders and reconstructs it
    python -m benchmarks.geometry --only microwave --work build/geometry --pictures docs/images
    python -m benchmarks.geometry --shipped               # the assets that ship, against the clips they were made from

Each object of furniture_sim is rendered with a hand (:mod:`benchmarks.furniture`), reconstructed from the video and
compared: Chamfer distance (mean of both directions' mean nearest distances, outer surfaces) of the moving link at the
first frame over its true diagonal, after the monocular scale is taken out, that is, along the camera's rays. One more
column has the same where the true joint is given to the geometry stage. A clip that fails is a row like any other.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from reconstruct.synth.animation import look_at

SAMPLES = 20_000
SIZE = (640, 360)
FRAMES = 60


def surface_points(solids: list[tuple[np.ndarray, np.ndarray]], seed: int = 0) -> np.ndarray:
    """(n, 3) points of the outer surface of several meshes: what lies inside another one's hull is left out."""
    import trimesh
    from scipy.spatial import ConvexHull

    meshes = [trimesh.Trimesh(v, f, process=False) for v, f in solids]
    area = np.array([m.area for m in meshes])
    hulls = [ConvexHull(v).equations for v, _ in solids]
    # A hull stands for a mesh only where it nearly is its hull.
    convex = [m.is_watertight and m.volume > 0.9 * m.convex_hull.volume for m in meshes]
    out = []
    for i, mesh in enumerate(meshes):
        points, _ = trimesh.sample.sample_surface(mesh, max(50, int(SAMPLES * area[i] / area.sum())), seed=seed + i)
        keep = np.ones(len(points), bool)
        for j, eq in enumerate(hulls):
            if j != i and convex[j]:
                keep &= (points @ eq[:, :3].T + eq[:, 3] > -1e-4).any(1)
        out.append(np.asarray(points)[keep])
    return np.concatenate(out)


def chamfer(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Mean nearest distances (a to b, b to a)."""
    from scipy.spatial import cKDTree

    return float(cKDTree(b).query(a)[0].mean()), float(cKDTree(a).query(b)[0].mean())


def into_truth(points: np.ndarray, T_camera_world: np.ndarray, truth_camera: np.ndarray, scale: float) -> np.ndarray:
    """Points of the estimate's world in the truth's, by way of the camera, scaled about it."""
    camera = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    back = np.linalg.inv(truth_camera)
    return (camera / scale) @ back[:3, :3].T + back[:3, 3]


def meshes_of(clip) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and faces of the solids of a clip's moving link at frame 0."""
    import trimesh

    from reconstruct.synth.objects import Solid

    out = []
    for solid in clip.model.boxes:
        if solid.link == "moving":
            mesh = solid if isinstance(solid, Solid) else trimesh.convex.convex_hull(solid.corners())
            out.append((np.array(mesh.vertices), np.array(mesh.faces)))
    return out


def score(clip, truth, joint: dict, surface) -> dict:
    """Chamfer distance of the moving link at frame 0 as shares of its true diagonal, and what else there is to say.

    Args:
        surface: has vertices (V, 3) and faces (F, 3) of the found link, in the found world at q = 0.
    """
    from benchmarks.clips import true_errors

    true_solids = meshes_of(clip)
    right = surface_points(true_solids)
    diagonal = float(np.linalg.norm(np.ptp(np.concatenate([v for v, _ in true_solids]), axis=0)))
    errors = true_errors(joint, truth) if joint["type"] == truth.type else {"scale": 1.0, "words": joint["type"]}
    # The mesh stands at q = 0; the truth's solids are those of frame 0.
    from reconstruct.joint.models import joint_transform

    axis, point = np.array(joint["axis"]), None if joint["point"] is None else np.array(joint["point"])
    T0 = joint_transform(joint["type"], axis, point, float(joint["q"][0]))
    vertices = np.asarray(surface.vertices) @ T0[:3, :3].T + T0[:3, 3]
    moved = into_truth(vertices, np.array(joint["T_camera_world"]), truth.T_camera_world[0], errors["scale"])
    found = surface_points([(moved, np.asarray(surface.faces))])
    out, back = chamfer(found, right)
    return {"chamfer": (out + back) / 2 / diagonal, "found_to_true": out / diagonal, "true_to_found": back / diagonal,
            "diagonal_m": diagonal, **errors}  # fmt: skip


def run(name: str, work: Path, pictures: Path | None) -> dict:
    """Render, reconstruct and score one object; a row of the table."""
    from benchmarks.furniture import build_furniture
    from reconstruct.pipeline import reconstruct
    from reconstruct.store import load_stage
    from reconstruct.synth import load_truth, render_described

    begin = time.monotonic()
    clip = build_furniture(name)
    folder = work / "clips" / name
    if not (folder / "video.mp4").is_file():
        folder = render_described(clip, work / "clips", 0, FRAMES, SIZE)
    truth = load_truth(folder)
    row: dict = {"object": name, "words": ""}
    scene = work / "scenes" / name
    try:
        made = reconstruct(folder / "video.mp4", name, scene=scene, out=work / "assets", overwrite=True)
        row |= {"joint": made.joint["type"], "words": made.error or ""}
        if made.asset is not None:
            geometry = load_stage(scene / "stages" / "geometry.npz", None)
            row |= score(clip, truth, made.joint, geometry.moving)
            row["thickness"] = geometry.provenance["moving_thickness"]["origin"]
            row["progress"] = made.replay["joint_progress"]
            row["true_joint"] = with_true_joint(clip, truth, folder, scene)
            if pictures is not None:
                draw(truth, made.asset, pictures / f"geometry_{name}.png")
    except Exception as error:  # a failed clip is a row like any other
        row["words"] = f"{type(error).__name__}: {error}"
    return {**row, "seconds": time.monotonic() - begin}


def with_true_joint(clip, truth, folder: Path, scene: Path) -> float | None:
    """Chamfer share when masks and geometry are made with the true joint and camera; None where that fails."""
    from reconstruct.errors import TaaError
    from reconstruct.export import joint_object
    from reconstruct.geometry.links import build_geometry
    from reconstruct.geometry.masks import segment_links
    from reconstruct.store import load_stage
    from reconstruct.video import load_video

    hands, tracks, fit = (load_stage(scene / "stages" / f"{n}.npz", None) for n in ("hands", "tracks", "scale"))
    with tempfile.TemporaryDirectory(prefix="taa-") as scratch:
        video = load_video(folder / "video.mp4", Path(scratch))
        # The fit's own points keep their depth along the ray where the scale is right: placed by the true depth.
        T_c, T_t = np.asarray(fit.T_camera_world), truth.T_camera_world[0]
        scale = true_scale(joint_object(fit, None), truth)
        pose = fit.link_pose(float(fit.q[0]))
        points = into_truth(fit.points @ pose[:3, :3].T + pose[:3, 3], T_c, T_t, scale)
        exact = replace(fit, type=truth.type, axis=truth.axis, point=truth.point, q=truth.q[: len(video)], K=truth.K,
                        T_camera_world=T_t, points=points)  # fmt: skip
        try:
            masks = segment_links(video, hands, tracks, exact)
            geometry = build_geometry(video, hands, tracks, exact, masks)
        except TaaError:
            return None
    return score(clip, truth, joint_object(exact, None), geometry.moving)["chamfer"]


def true_scale(joint: dict, truth) -> float:
    """Ratio of found to true lengths, 1 where the type is wrong."""
    from benchmarks.clips import true_errors

    return float(true_errors(joint, truth)["scale"]) if joint["type"] == truth.type else 1.0


def draw(truth, asset, file: Path, frames: int = 3) -> None:
    """The clip above what was made of it, from the video's own camera, at a few moments."""
    import cv2
    import mujoco

    from taa_envs.scene import build_scene

    w, h = truth.size
    scene = build_scene(asset, None)
    data = mujoco.MjData(scene.model)
    capture = cv2.VideoCapture(str(truth.video))
    images = []
    while (read := capture.read())[0]:
        images.append(read[1])
    columns = []
    with mujoco.Renderer(scene.model, h, w) as renderer:
        for t in np.linspace(0.22, 0.80, frames) * (len(images) - 1):
            data.qpos[scene.qpos] = np.interp(truth.time[int(t)], asset.reference.time, asset.reference.q)
            mujoco.mj_forward(scene.model, data)
            renderer.update_scene(data, "video")
            columns.append(np.concatenate([images[int(t)], renderer.render()[..., ::-1]]))
    file.parent.mkdir(parents=True, exist_ok=True)
    picture = np.concatenate(columns, axis=1)
    cv2.imwrite(str(file), cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def shipped() -> list[dict]:
    """A row for each asset that ships: its moving link against the clip that it was made from."""
    from types import SimpleNamespace

    from benchmarks.build_assets import CLIPS, PREFIX
    from reconstruct.synth.clips import build_clip
    from taa_envs.asset import load_asset
    from taa_envs.exports.usd import read_obj
    from taa_envs.registry import shipped_folder

    rows = []
    for name in CLIPS:
        folder = shipped_folder() / (PREFIX + name)
        if not folder.is_dir():
            continue
        asset, clip = load_asset(folder), build_clip(name)
        vertices, faces, _ = read_obj(folder / "meshes" / "moving.obj")
        truth = SimpleNamespace(type=clip.model.kind, axis=clip.model.axis, point=clip.model.point,
                                diagonal=clip.model.diagonal, q=np.array([0.0, clip.model.q_end]),
                                T_camera_world=look_at(clip.camera, clip.target)[None])  # fmt: skip
        row = {"object": name, "joint": asset.joint["type"], "words": ""}
        row |= score(clip, truth, asset.joint, SimpleNamespace(vertices=vertices, faces=faces))
        rows.append({**row, "thickness": asset.provenance["moving_thickness"]["origin"]})
    return rows


def table(rows: list[dict]) -> str:
    """Markdown, one line an object, failures with nothing but their words."""
    out = ["| object | joint | axis | Chamfer / diagonal | found to true | true to found | true joint | thickness "
           "| replay | |", "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip

    def share(r: dict, key: str) -> str:
        return f"{r[key]:.1%}" if r.get(key) is not None else ""

    for r in rows:
        cells = [r["object"], r.get("joint") or "", f"{r['angle_deg']:.1f} deg" if "angle_deg" in r else "",
                 share(r, "chamfer"), share(r, "found_to_true"), share(r, "true_to_found"), share(r, "true_joint"),
                 r.get("thickness", ""), f"{r['progress']:.0%}" if "progress" in r else "", r["words"]]  # fmt: skip
        out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out)


def main(argv: list[str] | None = None) -> int:
    from benchmarks.furniture import FOLDER, list_furniture

    names = list_furniture()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=names or None, default=names)
    parser.add_argument("--work", type=Path, help="keeps clips, scenes and rows, so that a second run resumes")
    parser.add_argument("--pictures", type=Path, help="folder to draw each object into")
    parser.add_argument("--shipped", action="store_true", help="measure the assets that ship instead")
    arguments = parser.parse_args(argv)
    if arguments.shipped:
        print(table(shipped()))
        return 0
    if not names:
        print(f"error: no furniture in {FOLDER}; put furniture_sim there", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory(prefix="taa-geometry-") as scratch:
        work = arguments.work or Path(scratch)
        (work / "rows").mkdir(parents=True, exist_ok=True)
        for name in arguments.only:
            print(name, file=sys.stderr, flush=True)
            row = run(name, work, arguments.pictures)
            (work / "rows" / f"{name}.json").write_text(json.dumps(row))
        rows = [json.loads(f.read_text()) for name in names if (f := work / "rows" / f"{name}.json").is_file()]
    print(table(rows))
    found = [r["chamfer"] for r in rows if "chamfer" in r]
    print(f"{sum(c <= 0.03 for c in found)} of {len(rows)} within 3 %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
