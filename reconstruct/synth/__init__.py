"""Rendered videos of a hand that moves an articulated object, with everything about them known."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from reconstruct.synth.animation import FRAME_RATE, animate
from reconstruct.synth.clips import build_clip, list_clips
from reconstruct.synth.staging import Clip
from reconstruct.synth.truth import SynthTruth, load_truth, write_cues

__all__ = ["SynthTruth", "list_clips", "load_truth", "render_clip", "render_clips", "render_described", "write_cues"]

DEFAULT_SIZE = (960, 540)


def render_clip(
    name: str, out: str | Path, seed: int = 0, frames: int | None = None, size: tuple[int, int] | None = None
) -> Path:
    """Render one clip and its ground truth.

    Args:
        name: one of :func:`list_clips`.
        out: parent folder; the clip goes to ``out/<name>``, which is replaced.
        seed: textures, skin, the hand's tremor and sensor noise; 0 is the published clip.
        frames: number of frames over the clip's fixed duration of 4 s (default 120).
        size: (width, height) px, both even (default 960 x 540).

    Returns:
        The clip's folder: ``video.mp4``, ``truth.json``, ``truth.npz``, ``object.xml``.

    Raises:
        ValueError: unknown name, fewer than 8 frames, or an odd size.
        TaaError: no OpenGL without a display, or the video cannot be encoded.
    """
    return render_described(build_clip(name, seed), out, seed, frames, size)


def render_described(
    clip: Clip, out: str | Path, seed: int = 0, frames: int | None = None, size: tuple[int, int] | None = None
) -> Path:
    """Render a clip that somebody else described, to ``out/<clip.name>``; see :func:`render_clip`."""
    from reconstruct.synth.encode import write_video
    from reconstruct.synth.render import render
    from reconstruct.synth.truth import write_truth

    count, (w, h) = frames or clip.frames, size or DEFAULT_SIZE
    if count < 8 or w % 2 or h % 2:
        raise ValueError(f"need at least 8 frames and an even size, not {count} frames of {w} x {h}")
    rate = FRAME_RATE * count / clip.frames
    motion = animate(clip, count, rate, seed)
    rendered = render(clip, motion, (w, h), seed)
    folder = Path(out) / clip.name
    # Written under another name first: a folder with the final name is always whole.
    part = Path(out) / f".{clip.name}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    write_video(part / "video.mp4", rendered.image, rate)
    write_truth(part, clip, motion, rendered, seed)
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
    return folder


def render_clips(
    out: str | Path,
    names: Iterable[str] | None = None,
    seed: int = 0,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Path]:
    """Render several clips, all by default; ``progress`` is called with each name before it is rendered.

    Returns:
        Each clip's folder.
    """
    names = list(names) if names is not None else list_clips()
    unknown = sorted(set(names) - set(list_clips()))
    if unknown:
        raise ValueError(f"unknown clip {unknown[0]!r}; known: {', '.join(list_clips())}")
    out_folders = {}
    for name in names:
        if progress:
            progress(name)
        out_folders[name] = render_clip(name, out, seed, frames, size)
    return out_folders
