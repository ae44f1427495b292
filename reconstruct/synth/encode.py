"""Frames to an MP4 file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError


def write_video(path: Path, frames: np.ndarray, rate: float) -> None:
    """Encode (T, H, W, 3) uint8 RGB frames as MP4 (MPEG-4 part 2, which every OpenCV build can write).

    Raises:
        TaaError: no encoder here, or the file does not hold every frame.
    """
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, (frames.shape[2], frames.shape[1]))
    if not writer.isOpened():
        raise TaaError("this OpenCV cannot write MP4 video; install opencv-python-headless from its wheel")
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    check = cv2.VideoCapture(str(path))
    count = 0
    while check.grab():
        count += 1
    if count != len(frames):
        raise TaaError(f"only {count} of {len(frames)} frames were encoded to {path}; is the disk full?")
