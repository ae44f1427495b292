"""Decoding: only the frames that decode, container times, upright, bounded memory."""

from __future__ import annotations

import hashlib
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from reconstruct.errors import TaaError

WORK_LONG_SIDE = 960
"""Long side, in pixels, of the working frames on which pixels are looked at."""
MAX_WORK_FRAMES = 900
MAX_WORK_RATE = 31.0


@dataclass(frozen=True)
class Video:
    """The working frames of one video.

    Every uv in this project is in *full* pixels (the upright video as decoded), centre of the
    top-left pixel (0, 0); ``to_work``/``to_full`` convert to the smaller working frames.

    Attributes:
        path: source file.
        sha256: hex digest of the source file.
        size: (width, height) of the upright full-size frame, px.
        time: (T,) container time of each working frame, s.
        index: (T,) which decodable frame (counted from 0) each working frame is.
        decoded: number of frames that decode.
        frames: (T, h, w, 3) uint8 BGR working frames, memory-mapped from disk.
        scale: working px per full px.
        focal_px: focal length from metadata, full px, or None.
        notes: what was odd about the file (corrupt frames, odd times), for the report.
    """

    path: Path
    sha256: str
    size: tuple[int, int]
    time: np.ndarray
    index: np.ndarray
    decoded: int
    frames: np.ndarray
    scale: float
    focal_px: float | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def diagonal(self) -> float:
        """Full-size image diagonal, px."""
        return float(np.hypot(*self.size))

    def to_work(self, uv: np.ndarray) -> np.ndarray:
        """(..., 2) full px -> working px."""
        return (np.asarray(uv, float) + 0.5) * self.scale - 0.5

    def to_full(self, uv: np.ndarray) -> np.ndarray:
        """(..., 2) working px -> full px."""
        return (np.asarray(uv, float) + 0.5) / self.scale - 0.5

    def with_frames(self, frames: np.ndarray, *notes: str) -> Video:
        """The same video with other pixels (for instance stabilised ones)."""
        return replace(self, frames=frames, notes=self.notes + notes)


def _is_corrupt(image: np.ndarray) -> bool:
    """A frame without content: grey or black filler that decoders emit before the first key frame."""
    return float(image[::8, ::8].std()) < 2.0


def load_video(path: str | Path, scratch: Path | None = None, long_side: int = WORK_LONG_SIDE) -> Video:
    """Decode a video into working frames.

    Args:
        path: video file.
        scratch: folder for the frame store; a temporary one when None.
        long_side: working frames are shrunk (never enlarged) to this long side, px.

    Raises:
        TaaError: no such file, not a video, or fewer than two frames decode.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        raise TaaError(f"no such file: {path}; give the path of a video")
    cap = cv2.VideoCapture(str(path))
    if not cap.isOpened():
        raise TaaError(f"not a video that OpenCV can decode: {path}; convert it to H.264 MP4")
    cap.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    # First pass: which frames decode and when. `grab` skips colour conversion, so it is cheap.
    times, rate = [], cap.get(cv2.CAP_PROP_FPS) or 30.0
    while cap.grab():
        times.append(cap.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
    cap.release()
    if len(times) < 2:
        raise TaaError(f"fewer than two frames decode in {path}; is the file cut off?")
    time = np.asarray(times)
    notes: list[str] = []
    if not np.all(np.diff(time) > 0):
        notes.append("container times are not increasing; nominal rate used")
        time = np.arange(len(time)) / rate
    span = time[-1] - time[0]
    stride = max(1, round((len(time) - 1) / span / MAX_WORK_RATE), -(-len(time) // MAX_WORK_FRAMES))
    store_dir = Path(scratch) if scratch else Path(tempfile.mkdtemp(prefix="taa-"))
    store_dir.mkdir(parents=True, exist_ok=True)

    cap = cv2.VideoCapture(str(path))
    cap.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    store = None
    kept: list[int] = []
    size = (0, 0)
    scale = 1.0
    leading = 0
    for i in range(len(time)):
        if not cap.grab():
            break
        if i % stride:
            continue
        ok, image = cap.retrieve()
        if not ok or image is None:
            continue
        if store is None:
            if _is_corrupt(image):
                leading += 1
                continue
            size = (image.shape[1], image.shape[0])
            scale = min(1.0, long_side / max(size))
            shape = (round(size[1] * scale), round(size[0] * scale))
            count = len(range(0, len(time), stride))
            store = np.lib.format.open_memmap(
                store_dir / "frames_work.npy", mode="w+", dtype=np.uint8, shape=(count, *shape, 3)
            )
        if (image.shape[1], image.shape[0]) != size:
            notes.append(f"frame {i} has another size; dropped")
            continue
        if scale < 1.0:
            image = cv2.resize(image, (store.shape[2], store.shape[1]), interpolation=cv2.INTER_AREA)
        store[len(kept)] = image
        kept.append(i)
    cap.release()
    if store is None or len(kept) < 2:
        raise TaaError(f"fewer than two frames with content decode in {path}")
    if leading:
        notes.append(f"{leading} leading frames without content dropped")
    store.flush()
    with path.open("rb") as f:
        sha = hashlib.file_digest(f, "sha256").hexdigest()
    index = np.asarray(kept)
    return Video(path, sha, size, time[index], index, len(time), store[: len(kept)], scale, None, tuple(notes))
