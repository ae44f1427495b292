"""Camera poses by structure from motion (COLMAP through pycolmap) on what does not move.

Only a camera that changes place can be reconstructed so; one that stands still or only turns has no parallax, and is
refused with a line that says so. Hands are masked out, and so is all that moves against the background.

Source: Schoenberger and Frahm, Structure-from-Motion Revisited, CVPR 2016.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reconstruct.errors import TaaError
from reconstruct.providers.hub import work_to_full_K
from reconstruct.providers.make import Made, Request
from reconstruct.providers.world import upright
from reconstruct.video import Video

FRAMES = 48
"""Frames that are reconstructed; the poses between them are interpolated."""
MIN_SHARE = 0.6
MIN_TURN_DEG = 1.0
"""Least angle under which points are seen from the two ends of the camera's way."""


def camera(request: Request) -> Made:
    """``camera.npz``: one K, poses in a world with z up, lengths in an arbitrary unit.

    Raises:
        TaaError: fewer than 60 % of the chosen frames could be placed, or the camera does not change its place.
    """
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    video, work = request.video, request.work / "colmap"
    shutil.rmtree(work, ignore_errors=True)
    (work / "images").mkdir(parents=True)
    frames = np.unique(np.linspace(0, len(video) - 1, min(FRAMES, len(video))).round().astype(int))
    _write(video, frames, request, work)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE", mask_path=str(work / "masks"))
    focal = (request.video.focal_px or 0) * video.scale
    h, w = video.frames.shape[1:3]
    if focal:
        reader.camera_params = f"{focal},{w / 2},{h / 2}"
    database = work / "database.db"
    pycolmap.set_random_seed(request.seed)
    pycolmap.extract_features(database, work / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                              device=pycolmap.Device.cpu)  # fmt: skip
    request.tell(0.3)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    request.tell(0.6)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.multiple_models = request.seed, False
    options.ba_refine_focal_length = not focal
    models = pycolmap.incremental_mapping(database, work / "images", work, options=options)
    request.tell(1.0)
    if not models:
        raise TaaError("structure from motion found no model: the camera hardly changes its place or the background "
                       "has no texture; choose --camera none (a still camera) or da3")  # fmt: skip
    best = max(models.values(), key=lambda m: m.num_reg_images())
    K, poses, note = read_model(best, video, frames)
    arrays = {"K": K, "T_world_camera": upright(poses) @ poses, "metric": np.array(False)}
    notes = ("COLMAP knows no gravity and no scale; which way is up is assumed from how a camera is held", *note)
    return Made({"camera": arrays}, f"pycolmap {pycolmap.__version__}", notes=notes)


def read_model(model: Any, video: Video, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """A reconstruction whose images are named ``NNNNNN.png`` by working frame, as intrinsics and poses.

    Args:
        model: ``pycolmap.Reconstruction`` of working frames.  video: for sizes.  frames: the images asked for.

    Returns:
        K (3, 3) full px, T_any_camera (T, 4, 4) in the model's world, notes.

    Raises:
        TaaError: too few of the frames are in it, or the camera does not change its place.
    """
    known, poses = [], []
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        T = np.eye(4)
        T[:3] = np.asarray(image.cam_from_world().matrix())
        known.append(int(Path(image.name).stem))
        poses.append(np.linalg.inv(T))
    if len(known) < max(2, MIN_SHARE * len(frames)):
        raise TaaError(f"structure from motion placed only {len(known)} of {len(frames)} frames; choose --camera none "
                       "(a still camera) or da3")  # fmt: skip
    order = np.argsort(known)
    at, way = np.asarray(known)[order], np.stack(poses)[order]
    points = np.array([p.xyz for p in model.points3D.values()])
    depth = np.median(np.linalg.norm(points - way[:, :3, 3].mean(0), axis=1)) if len(points) else np.inf
    spread = np.linalg.norm(np.ptp(way[:, :3, 3], axis=0))
    if np.degrees(np.arctan2(spread, depth)) < MIN_TURN_DEG:
        raise TaaError("the camera does not change its place, so its poses cannot be told; choose --camera none")
    camera = next(iter(model.cameras.values()))
    K = np.asarray(camera.calibration_matrix(), float)
    K[:2, 2] -= 0.5  # COLMAP counts from the corner of the first pixel
    T = len(video)
    within = np.clip(np.arange(T), at[0], at[-1])
    full = np.tile(np.eye(4), (T, 1, 1))
    full[:, :3, :3] = Slerp(at, Rotation.from_matrix(way[:, :3, :3]))(within).as_matrix()
    for axis in range(3):
        full[:, axis, 3] = np.interp(within, at, way[:, axis, 3])
    missing = len(frames) - len(at)
    note = (f"structure from motion lacks {missing} of {len(frames)} frames; interpolated",) if missing else ()
    return work_to_full_K(K, video, (int(camera.width), int(camera.height))), full, note


def _write(video: Video, frames: np.ndarray, request: Request, work: Path) -> None:
    """Images and masks (black is left out) by working frame."""
    import cv2

    (work / "masks").mkdir()
    h, w = video.frames.shape[1:3]
    for t in frames:
        name = f"{t:06d}.png"
        cv2.imwrite(str(work / "images" / name), video.frames[t])
        keep = np.full((h, w), 255, np.uint8)
        if request.hands is not None:
            keep[cv2.dilate(request.hands.mask[t].astype(np.uint8), np.ones((15, 15), np.uint8)) > 0] = 0
        cv2.imwrite(str(work / "masks" / f"{name}.png"), keep)
