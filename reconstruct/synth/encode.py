"""Frames to an MP4 file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError

QUALITY = 18
"""x264's constant rate factor: a phone's recording, not a lossless one."""


def write_video(path: Path, frames: np.ndarray, rate: float) -> None:
    """Encode (T, H, W, 3) uint8 RGB frames as H.264; the same frames give the same bytes.

    Raises:
        TaaError: the file does not hold every frame afterwards.
    """
    import cv2
    import imageio_ffmpeg

    size = (frames.shape[2], frames.shape[1])
    # One thread and no encoder banner: nothing in the file depends on the machine.
    options = [
        "-crf",
        str(QUALITY),
        "-preset",
        "veryfast",
        "-threads",
        "1",
        "-fflags",
        "+bitexact",
        "-flags:v",
        "+bitexact",
    ]
    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=rate,
        codec="libx264",
        pix_fmt_in="rgb24",
        pix_fmt_out="yuv420p",
        macro_block_size=2,
        output_params=options,
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    check = cv2.VideoCapture(str(path))
    count = 0
    while check.grab():
        count += 1
    check.release()
    if count != len(frames):
        raise TaaError(f"only {count} of {len(frames)} frames were encoded to {path}; is the disk full?")
