"""Dense 3D tracks by TrackCraft3R, in its own environment, by its own ``scripts/inference_user_video.py``.

Its files, as its repository documents them. In: ``images_jpeg_bytes`` (T,), ``depth_map`` (T, H, W) along the optical
axis, ``extrinsics_w2c`` (T, 4, 4) with the first one the identity, ``fx_fy_cx_cy``. Out: ``track_map`` (F, h, w, 3),
for every pixel of the first frame its place in each frame of the window, in the first frame's camera.

Everything hangs on the first frame, so the window is run from the start and, reversed in time, from the end: what is
hidden in one is seen in the other.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.depth import sample_depth
from reconstruct.errors import TaaError
from reconstruct.import_scene import NEAR, project
from reconstruct.providers.make import Made, Request
from reconstruct.providers.outside import run_script, setting
from reconstruct.video import Video

WINDOW = 12
"""Frames a run: what the network was trained with; ``frames`` of the section changes it."""
POINTS = 900


def tracks(request: Request) -> Made:
    """``tracks.npz`` with ``xyz_world``.

    Raises:
        TaaError: there is no depth or camera cue, the script failed, or its output has another shape.
    """
    name = "trackcraft3r"
    section = request.settings.section(name)
    camera = request.cue("camera", "TrackCraft3R")
    depth = request.cue("depth", "TrackCraft3R")["depth"]
    video = request.video
    T = len(video)
    K = np.array(np.broadcast_to(np.asarray(camera["K"], float), (T, 3, 3)))
    pose = np.asarray(camera["T_world_camera"], float)
    count = min(int(section.get("frames", WINDOW)), T)
    stride = max(1, -(-(T - 1) // max(1, count - 1)))  # the window reaches the other end of the video
    # Both runs look at the same frames: two sets of tracks that share none would not tie their states together.
    shared = np.minimum(np.arange(count) * stride, T - 1)
    repository = setting(section, name, "repository")
    all_xyz = []
    for direction in (1, -1):
        window = shared[::direction]
        work = request.work / name
        asked, answer = work / f"input{direction:+d}.npz", work / f"dense{direction:+d}.npz"
        work.mkdir(parents=True, exist_ok=True)
        answer.unlink(missing_ok=True)
        # The script demands count * stride frames and looks at every stride-th.
        write_input(asked, video, depth, K, pose, np.repeat(window, stride))
        run_script(name, section, repository / "scripts" / "inference_user_video.py",
                   ["--checkpoint_path", setting(section, name, "checkpoint"), "--input_npz", asked,
                    "--output_npz", answer, "--num_frames", str(count), "--frame_stride", str(stride)],
                   work / f"log{direction:+d}.txt", [answer],
                   lambda share, d=direction: request.tell((share + (d < 0)) / 2))  # fmt: skip
        all_xyz.append(read_output(answer, window, T, pose, depth, video.size))
    xyz = np.concatenate(all_xyz)
    uv, z = project(xyz, K, pose)
    visible = np.isfinite(z) & (z > 0) & (uv > -0.5).all(-1) & (uv < np.array(video.size) - 0.5).all(-1)
    surface = sample_depth(depth, uv, video.size)
    visible &= ~(z > surface * (1 + NEAR)) & (np.abs(z / surface - 1) < 3 * NEAR)
    keep = visible.sum(1) >= 3
    if keep.sum() < 8:
        raise TaaError("TrackCraft3R's tracks do not lie on the depth they were given; check its checkpoint")
    arrays = {"uv": np.where(visible[..., None], uv, np.nan)[keep].astype(np.float32), "visible": visible[keep],
              "xyz_world": xyz[keep].astype(np.float32)}  # fmt: skip
    checkpoint = setting(section, name, "checkpoint")
    return Made({"tracks": arrays}, f"TrackCraft3R, {checkpoint.name}")


def write_input(file: Path, video: Video, depth: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray,
                order: np.ndarray) -> None:  # fmt: skip
    """The network's input: frames, depth and cameras in the given order, all at working size.

    Args:
        depth: (T, h, w) of any size, NaN where unknown.  K: (T, 3, 3) full px.  order: working frames.
    """
    import cv2

    h, w = video.frames.shape[1:3]
    pictures = np.empty(len(order), object)
    for n, t in enumerate(order):
        done, data = cv2.imencode(".jpg", np.asarray(video.frames[t]), [cv2.IMWRITE_JPEG_QUALITY, 95])
        if not done:
            raise TaaError("a frame cannot be written as JPEG; free some memory and try again")
        pictures[n] = data.tobytes()
    z = np.stack([cv2.resize(np.asarray(depth[t], np.float32), (w, h), interpolation=cv2.INTER_NEAREST) for t in order])
    w2c = np.linalg.inv(T_world_camera[order])
    first = K[order[0]]
    sx, sy = w / video.size[0], h / video.size[1]
    focal = [first[0, 0] * sx, first[1, 1] * sy, (first[0, 2] + 0.5) * sx - 0.5, (first[1, 2] + 0.5) * sy - 0.5]
    relative = (w2c @ np.linalg.inv(w2c[0])).astype(np.float32)
    np.savez_compressed(file, images_jpeg_bytes=pictures, depth_map=np.nan_to_num(z, nan=0.0).astype(np.float32),
                        extrinsics_w2c=relative, fx_fy_cx_cy=np.array(focal))  # fmt: skip


def read_output(file: Path, window: np.ndarray, frames: int, T_world_camera: np.ndarray, depth: np.ndarray,
                size: tuple[int, int], most: int = POINTS) -> np.ndarray:  # fmt: skip
    """(N, T, 3) world places of points spread over the first frame of the window, NaN outside it.

    Raises:
        TaaError: the file is damaged or has another shape.
    """
    try:
        with np.load(file, allow_pickle=False) as data:
            dense = np.asarray(data["track_map"], float)
    except (OSError, ValueError, KeyError, EOFError) as error:
        words = str(error)[:80]
        raise TaaError(f"cannot read TrackCraft3R's output {file} ({words}); look at the log beside it") from None
    if dense.ndim != 4 or dense.shape[0] != len(window) or dense.shape[3] != 3:
        raise TaaError(f"TrackCraft3R's track_map has shape {dense.shape}, expected ({len(window)}, height, width, 3); "
                       "its version is not supported")  # fmt: skip
    h, w = dense.shape[1:3]
    step = max(1, int(np.sqrt(h * w / most)))
    rows, columns = (a.ravel() for a in np.mgrid[step // 2 : h : step, step // 2 : w : step])
    picked = dense[:, rows, columns].transpose(1, 0, 2)
    start = T_world_camera[window[0]]
    out = np.full((len(picked), frames, 3), np.nan)
    out[:, window] = picked @ start[:3, :3].T + start[:3, 3]
    # Where the first frame has no depth the network had nothing to start from.
    uv = np.stack([(columns + 0.5) * size[0] / w - 0.5, (rows + 0.5) * size[1] / h - 0.5], -1)[:, None]
    known = np.isfinite(sample_depth(depth[window[0]][None], uv, size))[:, 0]
    return out[known & np.isfinite(out[:, window]).all((1, 2))]
