"""``report.html``: one self-contained page with what was found, how it replays, and where every number comes from."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reconstruct.cues import HandReference, Hands, LinkMasks, Tracks
from reconstruct.film import FILM_HEIGHT, FILM_NAME, fit_height, frame_rate, replay_frames, write_mp4
from reconstruct.geometry import Geometry
from reconstruct.joint.models import JointFit
from reconstruct.report import draw, model3d, plots
from reconstruct.video import Video
from taa_envs.files import written_whole

if TYPE_CHECKING:
    from taa_envs.asset import Asset
    from taa_envs.replay import ReplayResult

__all__ = ["add_report", "refusal_report"]

HEIGHT = 480
"""Height of the report's films, px."""
REPLAY_RATE = 15.0
"""Rendered frames a second in the report; `taa replay --video` renders every one."""
MAX_REPLAY_FRAMES = 160


def add_report(asset: Asset, video: Video, hands: Hands, tracks: Tracks, fit: JointFit, masks: LinkMasks,
               geometry: Geometry, reference: HandReference, result: ReplayResult, notes: Sequence[str],
               seconds: Mapping[str, float]) -> None:  # fmt: skip
    """Write ``report.html``, ``preview.png`` and the small film into an asset's folder.

    Args:
        asset: as saved.  video: the stabilised video it was made from.
        notes: all that a user should know.  seconds: time each stage took so far.
    """
    import cv2

    rate = frame_rate(video.time)
    write_mp4(asset.path / FILM_NAME, (fit_height(f[..., ::-1], FILM_HEIGHT) for f in video.frames), rate, crf=27)
    picture = draw.preview(video, asset, fit, hands, tracks, masks)
    with written_whole(asset.path / "preview.png") as partial:
        cv2.imwrite(str(partial), picture[..., ::-1])
    portrait = video.size[1] > video.size[0]
    replay_rate = frame_rate(result.trajectory.time)
    stride = max(1, round(replay_rate / REPLAY_RATE), -(-len(result.trajectory.time) // MAX_REPLAY_FRAMES))
    assumed = {name: float(np.mean(link.assumed)) if len(link.assumed) else 0.0
               for name, link in (("moving part", geometry.moving), ("static part", geometry.static))}  # fmt: skip
    words = "; ".join(f"{share:.0%} of the {name}'s faces are assumed, not seen" for name, share in assumed.items())
    page = _page({
        "id": asset.id, "verdict": fit.verdict, "kind": fit.type, "portrait": portrait,
        "lead": _lead(fit), "facts": _facts(asset, fit, result),
        "film": _encoded(draw.overlay_frames(video, HEIGHT, hands, tracks, fit, masks), rate),
        "replay_film": _encoded(replay_frames(asset, result, "points", HEIGHT, stride), replay_rate / stride),
        "model": model3d.view(fit, geometry, reference, video.time), "packed": model3d.plotly_packed(),
        "script": (Path(__file__).parent / "model3d.js").read_text(encoding="utf-8"), "model_words": f"{words}.",
        "plot": plots.state_plot(video.time, fit, np.asarray(reference.contact, bool), result), "box": plots.BOX,
        "replay_rows": _replay_rows(result), "notes": list(dict.fromkeys(notes)),
        "numbers": _numbers(asset.provenance), "source": _source(asset.metadata), "seconds": _seconds(seconds),
        "footer": f"taa-envs {asset.metadata.get('taa_envs_version', '')}, MuJoCo {asset.metadata['mujoco_version']}, "
                  f"video sha256 {video.sha256}",
    })  # fmt: skip
    with written_whole(asset.path / "report.html") as partial:
        partial.write_text(page, encoding="utf-8")


def refusal_report(
    id: str,
    path: Path,
    video: Video | None,
    hands: Hands | None,
    tracks: Tracks | None,
    fit: JointFit | None,
    reason: str,
    notes: Sequence[str],
    seconds: Mapping[str, float],
) -> str:
    """The page of a video that was declined, with whatever was found until then."""
    film = None
    if video is not None:
        shown = None if fit is None or fit.image_line is None else fit
        film = _encoded(draw.overlay_frames(video, HEIGHT, hands, tracks, shown, None), frame_rate(video.time))
    source = [{"name": "video", "value": path.name}]
    if video is not None:
        source += [{"name": "size", "value": f"{video.size[0]} x {video.size[1]} px, {len(video)} frames used"}]
        source += [{"name": "sha256", "value": video.sha256}]
    return _page({
        "id": id, "verdict": "refused", "kind": None, "lead": "The video was looked at and no joint is claimed.",
        "refusal": reason, "film": film, "portrait": False, "notes": list(dict.fromkeys(notes)), "source": source,
        "seconds": _seconds(seconds), "box": plots.BOX, "footer": "",
    })  # fmt: skip


def _page(context: Mapping) -> str:
    from jinja2 import Environment, StrictUndefined

    text = (Path(__file__).parent / "page.html").read_text(encoding="utf-8")
    empty = dict.fromkeys(
        ("facts", "replay_film", "plot", "model", "packed", "script", "model_words", "replay_rows", "numbers",
         "refusal")
    )
    return Environment(autoescape=True, undefined=StrictUndefined).from_string(text).render({**empty, **context})


def _encoded(frames, rate: float) -> str:
    """Base64 of an MP4 of the frames."""
    with tempfile.TemporaryDirectory(prefix="taa-film-") as folder:
        file = Path(folder) / "film.mp4"
        write_mp4(file, frames, rate, crf=27)
        return base64.b64encode(file.read_bytes()).decode()


def _lead(fit: JointFit) -> str:
    sure = ", ".join(f"{k} {v:.0%}" for k, v in fit.type_probability.items() if np.isfinite(v))
    return f"{fit.reason.rstrip('.')}." + (f" Type probability: {sure}." if sure else "")


def _range_words(fit: JointFit) -> str:
    span = float(np.nanmax(fit.q) - np.nanmin(fit.q))
    if fit.type == "prismatic":
        return f"{1000 * span:.0f} mm" if fit.metric else f"{span:.2f} units"
    return f"{np.degrees(span):.0f}°"


def _facts(asset: Asset, fit: JointFit, result: ReplayResult) -> list[dict]:
    rows = [("range of motion", _range_words(fit))]
    if fit.std.get("axis_deg") is not None:
        rows.append(("axis direction, std", f"± {fit.std['axis_deg']:.1f}°"))
    if fit.residual_px is not None:
        rows.append((f"median residual, {fit.inliers} of {fit.tracks} tracks", f"{fit.residual_px:.2f} px"))
    rows += [
        ("scale, from the " + fit.scale_source if fit.metric else "scale", "metric" if fit.metric else "unknown"),
        ("replay joint progress", f"{result.joint_progress:.0%}"),
        ("replay contact", f"{result.contact_fraction:.0%}"),
        ("highest control", f"{max(result.controls.values()):.0%}" if result.controls else "–"),
    ]
    return [{"name": name, "value": value} for name, value in rows]


def _replay_rows(result: ReplayResult) -> list[dict]:
    def share(name: str, value: float) -> dict:
        return {"name": name, "value": f"{value:.0%}", "share": round(100 * min(max(value, 0.0), 1.0))}

    names = {
        "no_hand": "control: without a hand",
        "mirrored_hand": "control: mirrored hand",
        "late_hand": "control: late hand",
    }
    return [
        share("joint progress", result.joint_progress), share("largest progress on the way", result.max_progress),
        share("contact fraction", result.contact_fraction), share("final q error", result.final_q_error),
        share("wrong way", result.wrong_way),
        {"name": "deepest overlap with the part", "value": f"{1e3 * result.max_penetration_m:.1f} mm", "share": None},
        *(share(names.get(name, name), value) for name, value in result.controls.items()),
    ]  # fmt: skip


def short(value: object) -> str:
    """A number or a few of them, as people read them."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return "0" if abs(value) < 1e-9 else f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        flat = np.asarray(value, dtype=object).reshape(-1)
        return "(" + ", ".join(short(v) for v in value) + ")" if len(flat) <= 4 else f"{len(flat)} numbers"
    return str(value)


def _numbers(provenance: Mapping[str, Mapping]) -> list[dict]:
    return [
        {"name": name, "value": short(p.get("value")), "std": short(p.get("std")), "unit": p.get("unit", ""),
         "origin": p.get("origin", ""), "note": p.get("note") or ""}
        for name, p in sorted(provenance.items())
    ]  # fmt: skip


def _source(metadata: Mapping) -> list[dict]:
    source = metadata.get("source") or {}
    rows = [
        {"name": "video", "value": source.get("file", "")},
        {
            "name": "frames",
            "value": f"{source.get('frames', '?')} used of {source.get('decoded_frames', '?')} that decode, "
            f"{source.get('seconds', 0):.1f} s, {source.get('width')} x {source.get('height')} px",
        },
    ]
    rows += [{"name": p["name"], "value": f"{p['version']} ({p['licence']})"} for p in metadata.get("providers", ())]
    return rows


def _seconds(seconds: Mapping[str, float]) -> list[dict]:
    most = max([*seconds.values(), 1e-9])
    rows = [{"name": k, "value": f"{v:.1f} s", "share": round(100 * v / most)} for k, v in seconds.items()]
    return [*rows, {"name": "together", "value": f"{sum(seconds.values()):.1f} s", "share": 0}] if rows else []
