"""MP4 files that every browser plays, and the video beside its replay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.container import open_video
from reconstruct.errors import TaaError
from taa_envs.files import written_whole

if TYPE_CHECKING:
    from taa_envs.asset import Asset
    from taa_envs.replay import ReplayResult

FILM_NAME = "film.mp4"
"""File of an asset folder: the (stabilised) video at small size, one frame a row of ``reference.npz``."""
FILM_HEIGHT = 480


def frame_rate(time: np.ndarray) -> float:
    """Mean rate of (T,) times in s, frames a second, within what players accept."""
    span = float(time[-1] - time[0])
    return float(np.clip((len(time) - 1) / span if span > 0 else 30.0, 1.0, 120.0))


def write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float, crf: int = 25) -> int:
    """Encode frames as H.264 in MP4, whole or not at all.

    Args:
        frames: (h, w, 3) uint8 RGB, all of one size; an odd last row or column is cut off.
        rate: frames a second.
        crf: x264's constant quality, 18 (large, fine) to 32 (small, coarse).

    Returns:
        Number of frames written.

    Raises:
        TaaError: the encoder failed.
    """
    import imageio_ffmpeg

    writer, count, size = None, 0, (0, 0)
    with written_whole(path) as partial:
        try:
            for frame in frames:
                h, w = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
                if writer is None:
                    size = (w, h)
                    writer = imageio_ffmpeg.write_frames(
                        str(partial), size, pix_fmt_in="rgb24", pix_fmt_out="yuv420p", fps=rate, quality=None,
                        codec="libx264", macro_block_size=2, ffmpeg_log_level="error",
                        output_params=["-crf", str(crf), "-preset", "veryfast", "-movflags", "+faststart"],
                    )  # fmt: skip
                    writer.send(None)
                if (w, h) != size:
                    raise ValueError(f"frame {count} is {w} x {h}, the first is {size[0]} x {size[1]}")
                writer.send(np.ascontiguousarray(frame[:h, :w]))
                count += 1
            if writer is None:
                raise ValueError("a film needs at least one frame")
            writer.close()
        except OSError as error:
            raise TaaError(f"the film {path} could not be encoded ({str(error)[:120]}); is the disk full?") from error
        finally:
            if writer is not None:
                writer.close()
    return count


def read_mp4(path: Path) -> Iterator[np.ndarray]:
    """(h, w, 3) uint8 RGB frames of a film.

    Raises:
        TaaError: it cannot be decoded.
    """
    import cv2

    cap = open_video(path)
    try:
        while True:
            ok, image = cap.read()
            if not ok:
                return
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    finally:
        cap.release()


def fit_height(image: np.ndarray, height: int) -> np.ndarray:
    """The image scaled to a height, aspect kept, both sides even."""
    import cv2

    width = max(2, round(image.shape[1] * height / image.shape[0] / 2) * 2)
    if image.shape[:2] == (height, width):
        return image
    shrink = height < image.shape[0]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)


def label(image: np.ndarray, words: str) -> np.ndarray:
    """A copy with white words on a dark band along the top (players put their controls at the bottom)."""
    import cv2

    out = np.ascontiguousarray(image).copy()
    h, w = out.shape[:2]
    band = max(18, round(0.055 * h))
    size = band / 34.0
    while size > 0.2 and cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0] > w - 12:
        size *= 0.93
    out[:band] = out[:band] // 4
    cv2.putText(out, words, (6, round(0.7 * band)), cv2.FONT_HERSHEY_SIMPLEX, size, (240, 240, 240), 1, cv2.LINE_AA)
    return out


def rendered(
    asset: Asset,
    states: Iterable[np.ndarray],
    hand: str | object | None,
    camera: Callable[[int], object] | str,
    size: tuple[int, int],
) -> Iterator[np.ndarray]:
    """Pictures of states, made for speed on machines that render in software.

    Shadows and multisampling take nine tenths of the time there; pictures are drawn without them at
    one and a half times the size and shrunk instead.

    Args:
        states: (nq,) each.
        hand: name of a hand, a hand, or None; as for the states.
        camera: a camera's name, or the camera of the k-th picture.
        size: (width, height) px, made even.

    Yields:
        (height, width, 3) uint8 RGB.
    """
    import cv2
    import mujoco

    from taa_envs.scene import build_scene

    model = build_scene(asset, hand).model
    w, h = (v + v % 2 for v in size)
    big = (w * 3 // 2, h * 3 // 2)
    model.vis.quality.offsamples = 0
    model.vis.global_.offwidth, model.vis.global_.offheight = big
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, height=big[1], width=big[0]) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for k, state in enumerate(states):
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera=camera if isinstance(camera, str) else camera(k))
            yield cv2.resize(renderer.render(), (w, h), interpolation=cv2.INTER_AREA)


def video_view(asset: Asset, height: int) -> tuple[str, tuple[int, int]]:
    """Name of the camera that looks as the video does (where it is known) and a picture size of its shape."""
    if asset.camera is None:
        return "overview", (round(height * 4 / 3), height)
    return "video", (round(height * asset.camera["width"] / asset.camera["height"]), height)


def replay_frames(
    asset: Asset, result: ReplayResult, hand: str | object, height: int = FILM_HEIGHT, stride: int = 1
) -> Iterator[np.ndarray]:
    """The video beside the replay, one picture for every ``stride``-th sample of the replay's trajectory.

    The left half is missing where the asset has no film; its last frame is held while the replay goes on.
    """
    run = result.trajectory
    chosen = range(0, len(run.time), stride)
    film = asset.path / FILM_NAME
    source = islice(read_mp4(film), 0, None, stride) if film.is_file() else None
    camera, size = video_view(asset, height)
    left = None
    factor, unit = (1000.0, "mm") if asset.joint_type == "prismatic" else (float(np.degrees(1.0)), "deg")
    pictures = rendered(asset, (run.qpos[k] for k in chosen), hand, camera, size)
    for k, right in zip(chosen, pictures, strict=True):
        touch = "hand drives" if run.contact[k] else "no contact"
        right = label(right, f"replay {round(factor * run.q[k])} {unit}, {touch}")
        if source is not None:
            left = next(source, left)
        if left is not None:
            shown = label(fit_height(left, right.shape[0]), f"video {round(factor * run.q_demo[k])} {unit}")
            right = np.hstack([shown, np.full((right.shape[0], 4, 3), 20, np.uint8), right])
        yield right


def replay_video(asset: Asset, result: ReplayResult, hand: str | object, path: Path, height: int = FILM_HEIGHT) -> None:
    """Write the video beside the replay as MP4.

    Raises:
        TaaError: the encoder failed.
    """
    write_mp4(path, replay_frames(asset, result, hand, height), frame_rate(result.trajectory.time))
