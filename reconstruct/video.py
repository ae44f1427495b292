"""Decoding: only the frames that decode, container times, upright, one shot, bounded memory."""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from reconstruct.container import FORMATS, MAX_DECODED, MIN_SIDE, open_video
from reconstruct.errors import Refused, TaaError

WORK_LONG_SIDE = 960
"""Long side, in pixels, of the working frames on which pixels are looked at."""
MAX_WORK_FRAMES = 900
MAX_WORK_RATE = 31.0
"""Frames a second; a little over 30 so that the jitter of a 30 Hz clip drops nothing."""
SETTLE_SECONDS = 0.5
"""Cameras hunt for exposure and decoders lack references only at the very start."""
TAIL_SHARE = 0.1
"""What follows a cut in the last half second, and in this share of the frames, is another shot's or broken."""
LONGEST_GAP = 60.0
"""s; a longer one between two frames, far beyond the clip's usual spacing, is a broken time stamp."""
FLAT_GREY = 2.0
JUMP_GREY = 8.0
RAMP_SECONDS, RAMP_GAIN, RAMP_TOTAL = 2.0, 0.01, np.log(2.0) / 2
"""A picture that brightens or darkens from its start on by 1 % a frame, half a stop in all, 2 s at most, settles."""
THUMB = 64


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
        warp: (T, 3, 3) homographies, working px, that took the frames of a moving camera to its first view; None where
            the camera rests.
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
    warp: np.ndarray | None = None

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


def load_video(
    path: str | Path,
    scratch: Path | None = None,
    long_side: int = WORK_LONG_SIDE,
    progress: Callable[[float], None] | None = None,
) -> Video:
    """Decode a video into working frames.

    Only one full-size frame is in memory at a time: working frames go straight to a memory-mapped
    file. Leading frames before the decoder and the camera's exposure have settled are dropped, and what
    follows a cut at the very end.

    Args:
        path: video file.
        scratch: folder for the frame store, left to the caller to remove; when None a temporary
            one that goes away with the video.
        long_side: working frames are shrunk (never enlarged) to this long side, px.
        progress: called with the share done, 0 to 1.

    Raises:
        TaaError: no such file, not a video, or fewer than two frames decode.
        Refused: the video has a camera cut before its very end.
    """
    import cv2

    path = Path(path)
    if not path.is_file():
        raise TaaError(f"no such file: {path}; give the path of a video")
    try:
        with path.open("rb") as f:
            sha = hashlib.file_digest(f, "sha256").hexdigest()
    except OSError as error:
        raise TaaError(f"cannot read {path} ({error.strerror}); check its permissions") from error
    notes: list[str] = []
    time = _container_times(path, notes)
    wanted = choose_frames(time)

    store = None
    size, scale = (0, 0), 1.0
    kept: list[int] = []
    thumbs: list[np.ndarray] = []
    other_size = flat = 0
    cap = open_video(path)
    try:
        following = iter(wanted)
        target = next(following)
        for i in range(len(time)):
            if not cap.grab():
                break
            if i < target:
                continue
            target = next(following, len(time))
            ok, image = cap.retrieve()
            if not ok or image is None:
                continue
            if store is None:
                if float(image[::8, ::8].std()) < FLAT_GREY:
                    # Grey or black filler that decoders emit before the first key frame.
                    flat += 1
                    continue
                size = (image.shape[1], image.shape[0])
                if min(size) < MIN_SIDE or max(size) > 8 * min(size):
                    raise TaaError(f"{path} has frames of {size[0]} x {size[1]} px; at least {MIN_SIDE} px a side and "
                                   "no strip longer than 8 to 1 can be worked on")  # fmt: skip
                scale = min(1.0, long_side / max(size))
                store = _frame_store((len(wanted), round(size[1] * scale), round(size[0] * scale), 3), scratch)
            if (image.shape[1], image.shape[0]) != size:
                other_size += 1
                continue
            if scale < 1.0:
                image = cv2.resize(image, (store.shape[2], store.shape[1]), interpolation=cv2.INTER_AREA)
            store[len(kept)] = image
            kept.append(i)
            thumbs.append(_thumb(image))
            if progress:
                progress(i / len(time))
    finally:
        cap.release()
    if store is None or len(kept) < 2:
        raise TaaError(f"fewer than two frames with content decode in {path}; export the video again")
    if other_size:
        notes.append(f"{other_size} frames of another size dropped")
    index = np.asarray(kept)
    first = count_unsettled(np.asarray(thumbs), time[index])
    if first + flat:
        notes.append(f"{first + flat} leading frames dropped (corrupt, empty or before the exposure settled)")
    frames, index = store[first : len(kept)], index[first:]
    if len(index) < 2:
        raise TaaError(f"fewer than two settled frames in {path}; export the video again")
    cut = find_cut(frames, np.asarray(thumbs[first:]))
    if cut is not None and _is_tail(time[index], cut):
        notes.append(f"{len(index) - cut} frames after a cut at the very end dropped")
        frames, index, cut = frames[:cut], index[:cut], None
    if cut is not None:
        raise Refused(
            f"the camera cuts at {time[index[cut]]:.2f} s; give one unbroken shot (trim the video there and try again)"
        )
    focal, note = _focal(path, size)
    notes += [note] if note else []
    return Video(path, sha, size, time[index], index, len(time), frames, scale, focal, tuple(notes))


def choose_frames(time: np.ndarray) -> np.ndarray:
    """Which frames to work on: evenly in time, at most MAX_WORK_RATE a second and MAX_WORK_FRAMES in all.

    Args:
        time: (N,) increasing times, s; their spacing may vary.

    Returns:
        (M,) indices into ``time``, increasing, the first frame included.
    """
    spacing = max(1.0 / MAX_WORK_RATE, (time[-1] - time[0]) / (MAX_WORK_FRAMES - 1))
    if len(time) <= MAX_WORK_FRAMES and np.min(np.diff(time)) >= 1.0 / MAX_WORK_RATE:
        return np.arange(len(time))
    chosen = [0]
    for i in range(1, len(time)):
        if time[i] - time[chosen[-1]] >= spacing * (1 - 1e-6):
            chosen.append(i)
    return np.asarray(chosen)


def count_unsettled(thumbs: np.ndarray, time: np.ndarray) -> int:
    """How many leading frames come before the picture's last jump within the first half second, and the ramp after.

    A jump is a change of the mean picture between neighbours that is large in itself and against
    the clip's usual change: exposure hunting, a broken reference frame, a stale buffer.
    A ramp is a gain of the whole picture that goes on from frame to frame (an exposure that settles):
    bright things bloom with it, so that their edges move though nothing does.

    Args:
        thumbs: (T, h, w, 3) uint8 small frames.  time: (T,) s.
    """
    change = np.abs(np.diff(thumbs.astype(np.float32), axis=0)).mean(axis=(1, 2, 3))
    limit = max(JUMP_GREY, 10.0 * float(np.median(change)))
    early = time[1:] - time[0] <= SETTLE_SECONDS
    jumps = np.flatnonzero((change > limit) & early)
    first = int(jumps[-1]) + 1 if len(jumps) else 0
    return first + _ramp(thumbs[first:], time[first:])


def _ramp(thumbs: np.ndarray, time: np.ndarray) -> int:
    """Length of the brightness's ramp at the start, frames; 0 where it is too small or too long to be one."""
    gains: list[float] = []
    grey = thumbs[time - time[0] <= RAMP_SECONDS].astype(np.float32).mean(axis=-1).reshape(-1, thumbs[0, ..., 0].size)
    for before, after in itertools.pairwise(grey):
        told = (np.minimum(before, after) > 8.0) & (np.maximum(before, after) < 240.0)
        gains.append(float(np.median(np.log(after[told] / before[told]))) if told.any() else 0.0)
        if len(gains) >= 3 and max(map(abs, gains[-3:])) < RAMP_GAIN:
            total = abs(sum(gains[:-3]))
            return len(gains) - 3 if total >= RAMP_TOTAL else 0
    return 0


def find_cut(frames: np.ndarray, thumbs: np.ndarray) -> int | None:
    """The first frame of a new shot, or None.

    A cut is a pair of neighbours whose pictures do not correlate although those before and after
    do, and between which hardly a corner can be tracked. A flash or an exposure step keeps its
    corners; a fast pan has no single worst pair.

    Args:
        frames: (T, h, w, 3) uint8.  thumbs: (T, h', w', 3) uint8 small copies.
    """
    grey = thumbs.astype(np.float32).mean(axis=-1).reshape(len(thumbs), -1)
    grey -= grey.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(grey, axis=1)
    alike = np.sum(grey[1:] * grey[:-1], axis=1) / np.maximum(norm[1:] * norm[:-1], 1e-6)
    for i in np.flatnonzero(alike < 0.8):
        around = np.r_[alike[max(0, i - 4) : i], alike[i + 1 : i + 5]]
        if len(around) and alike[i] > np.median(around) - 0.15:
            continue
        if _trackable(frames[i], frames[i + 1]) < 0.2:
            return int(i) + 1
    return None


def _is_tail(time: np.ndarray, cut: int) -> bool:
    """Whether frames from ``cut`` on are but the end of those at (T,) times, s."""
    return bool(time[-1] - time[cut] <= SETTLE_SECONDS and len(time) - cut <= TAIL_SHARE * len(time))


def _trackable(a: np.ndarray, b: np.ndarray) -> float:
    """Share of a's corners that are found in b and back again."""
    import cv2

    grey_a, grey_b = (cv2.equalizeHist(cv2.cvtColor(x, cv2.COLOR_BGR2GRAY)) for x in (a, b))
    corners = cv2.goodFeaturesToTrack(grey_a, 300, 0.01, 8)
    if corners is None or len(corners) < 20:
        return 0.0
    to, ok, _ = cv2.calcOpticalFlowPyrLK(grey_a, grey_b, corners, None, winSize=(21, 21), maxLevel=4)
    back, ok2, _ = cv2.calcOpticalFlowPyrLK(grey_b, grey_a, to, None, winSize=(21, 21), maxLevel=4)
    good = (ok.ravel() > 0) & (ok2.ravel() > 0) & (np.linalg.norm(back - corners, axis=-1).ravel() < 1.0)
    return float(good.mean())


def _container_times(path: Path, notes: list[str]) -> np.ndarray:
    """(N,) increasing times of the frames that decode; `grab` skips colour conversion, so this pass is cheap."""
    import cv2

    cap = open_video(path)
    try:
        rate, claimed = cap.get(cv2.CAP_PROP_FPS), cap.get(cv2.CAP_PROP_FRAME_COUNT)
        times = []
        while cap.grab():
            times.append(cap.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
            if len(times) > MAX_DECODED:
                raise TaaError(f"{path} has more than {MAX_DECODED} frames; cut it to the part that matters")
    finally:
        cap.release()
    if len(times) < 2:
        raise TaaError(f"fewer than two frames decode in {path}; give a video, not a picture or a cut-off file")
    if claimed > len(times) + 1:
        notes.append(f"the container claims {claimed:.0f} frames, {len(times)} decode")
    time = np.asarray(times)
    step = np.diff(time)
    increasing = bool(np.isfinite(time).all() and (step > 0).all())
    if not increasing or step.max() > max(LONGEST_GAP, 100 * float(np.median(step))):
        rate = rate if 1.0 <= rate <= 1000.0 else 30.0
        what = "jump" if increasing else "do not increase"
        notes.append(f"container times {what}; {rate:.4g} frames a second assumed")
        time = np.arange(len(time)) / rate
    return time


def _frame_store(shape: tuple[int, int, int, int], scratch: Path | None) -> np.memmap:
    """A disk-backed array whose space is reserved, so that a full disk is an error here and not a crash later."""
    folder = Path(scratch) if scratch else Path(tempfile.mkdtemp(prefix="taa-"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "frames_work.npy"
        store = np.lib.format.open_memmap(file, mode="w+", dtype=np.uint8, shape=shape)
        with file.open("r+b") as f:
            os.posix_fallocate(f.fileno(), 0, file.stat().st_size)
    except BaseException:
        if scratch is None:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    if scratch is None:
        weakref.finalize(store._mmap, shutil.rmtree, folder, True)  # type: ignore[attr-defined]
    return store


def _thumb(image: np.ndarray) -> np.ndarray:
    import cv2

    f = THUMB / max(image.shape[:2])
    return cv2.resize(image, (max(1, round(image.shape[1] * f)), max(1, round(image.shape[0] * f))),
                      interpolation=cv2.INTER_AREA)  # fmt: skip


def _focal(path: Path, size: tuple[int, int]) -> tuple[float | None, str | None]:
    """Focal length in full px from the container's metadata, and a note on where it comes from.

    Phones that record it give the 35 mm equivalent: the focal length of a lens that sees the same
    diagonal on a 36 x 24 mm frame. A crop by electronic stabilisation is not part of it.
    """
    import subprocess

    import imageio_ffmpeg

    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-protocol_whitelist", "file,pipe",
                   "-format_whitelist", ",".join(FORMATS), "-i", f"file:{path}", "-f", "ffmetadata", "-"]  # fmt: skip
        text = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=30).stdout
    except (OSError, RuntimeError, subprocess.TimeoutExpired):
        return None, None
    for line in text.splitlines():
        key, _, value = line.partition("=")
        if "focal" in key.lower() and "35mm" in key.lower():
            try:
                mm = float(value)
            except ValueError:
                continue
            if 8.0 <= mm <= 300.0:
                px = mm / float(np.hypot(36.0, 24.0)) * float(np.hypot(*size))
                return px, f"focal length {px:.0f} px from metadata ({mm:g} mm equivalent)"
    return None, None
