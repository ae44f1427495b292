"""Opening video files that may be anything: one local file of a known container format, or one clear error."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from reconstruct.errors import TaaError

FORMATS = (
    "mov",
    "mp4",
    "m4a",
    "3gp",
    "3g2",
    "mj2",
    "matroska",
    "webm",
    "avi",
    "mpegts",
    "mpeg",
    "mpegvideo",
    "flv",
    "asf",
    "ogg",
    "gif",
    "h264",
    "hevc",
    "dv",
    "nut",
    "yuv4mpegpipe",
)
"""FFmpeg's names of formats that hold their own frames. Playlists (hls, concat, dash, image sequences) name other files
and addresses, which a file called ``video.mp4`` from a stranger must not make us open."""
MAX_SIDE = 16_384
MAX_PIXELS = 64_000_000
"""Of one frame; 8K has 33 million."""
MIN_SIDE = 32
"""px; below that there is nothing to track."""
MAX_DECODED = 108_000
"""Frames; an hour at 30 a second. A longer file is refused as soon as that many have been counted."""


def open_video(path: Path) -> Any:
    """A ``cv2.VideoCapture`` of a local file that reads no other file and no address; frames come upright.

    Raises:
        TaaError: it cannot be decoded, or its frames are of an impossible size.
    """
    import cv2

    # OpenCV hands these to FFmpeg when it opens a file, and offers no other way.
    options = f"protocol_whitelist;file|format_whitelist;{','.join(FORMATS)}"
    level = cv2.utils.logging.getLogLevel()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # the error below is all there is to say
    kept = os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS")
    os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = options
    try:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
        if kept is None:
            del os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"]
        else:
            os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = kept
    if not capture.isOpened():
        capture.release()
        raise TaaError(f"not a video that OpenCV can decode: {path}; convert it to H.264 MP4")
    width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        capture.release()
        raise TaaError(
            f"{path} has frames of {width} x {height} px, more than {MAX_PIXELS // 10**6} million; shrink it"
        )
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return capture
