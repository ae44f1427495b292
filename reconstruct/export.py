"""From the stages' results to an asset folder and to the contract's joint object."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruct.cues import HandReference, ProviderInfo
from reconstruct.geometry import Geometry
from reconstruct.joint.models import JointFit
from reconstruct.video import Video
from taa_envs.checks import numbered

if TYPE_CHECKING:
    from taa_envs.asset import Asset


def plain(value: Any) -> Any:
    """JSON-ready copy: arrays to lists, numbers that are not finite to None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def joint_object(fit: JointFit, index: np.ndarray | None) -> dict:
    """The contract's joint result.

    Args:
        fit: the joint; what a refused one does not have is null.
        index: (T,) decodable frame of each working frame: the fit's rows as the contract counts frames.
    """
    q = None if fit.q is None else np.asarray(fit.q, float)
    frames = index if q is not None and index is not None and len(index) == len(q) else fit.frames
    std = {name: fit.std.get(name) for name in ("axis_deg", "point_m", "q")}
    return plain({
        "verdict": fit.verdict, "reason": fit.reason, "type": fit.type, "type_probability": fit.type_probability,
        "axis": fit.axis, "point": fit.point, "pitch": fit.pitch, "frame": "world", "K": fit.K,
        "T_camera_world": fit.T_camera_world, "q": q, "frames": frames if q is not None else None,
        "unit": fit.unit if fit.type else None, "metric": bool(fit.metric), "scale_source": fit.scale_source,
        "std": {**fit.std, **std}, "image_line": fit.image_line, "residual_px": fit.residual_px,
        "inliers": int(fit.inliers), "tracks": int(fit.tracks),
    })  # fmt: skip


def further_objects(fit: JointFit, index: np.ndarray | None) -> dict[str, dict]:
    """``joint_2``, ``joint_3`` ... as :func:`joint_object`; empty for an object with one joint."""
    return {numbered("joint", k): joint_object(other, index) for k, other in enumerate(fit.further, 2)}


def refused_joint(reason: str) -> dict:
    """The joint object where the data was declined before a joint could be fitted."""
    return joint_object(JointFit("refused", reason), None)


def number_origins(video: Video, fit: JointFit, geometry: Geometry, focal_given: bool,
                   reference: HandReference | None = None) -> dict[str, dict]:  # fmt: skip
    """Provenance of the numbers that are neither the joint's nor assumed while writing the asset."""
    focal_origin = "given" if focal_given else "observed" if video.focal_px else "fitted"
    made = {
        "camera.focal_px": {"value": float(fit.K[0, 0]), "unit": "px", "origin": focal_origin,
                            "std": fit.std.get("focal_px")},
        "scale": {"value": 1.0, "unit": "m", "origin": "fitted" if fit.metric else "assumed",
                  "std": fit.std.get("scale"),
                  "note": f"from the {fit.scale_source}; std relative" if fit.metric else
                          "no metric source: one unit is the moving part's median depth"},
        "camera.T_camera_world": {"value": fit.T_camera_world, "unit": "m", "origin": "fitted",
                                  "note": "position fitted; which way is up is assumed from the view"},
        "camera.principal_point_px": {"value": fit.K[:2, 2], "unit": "px", "origin": "assumed",
                                      "note": "the image's centre"},
    }  # fmt: skip
    if fit.residual_px is not None:
        made["joint.residual_px"] = {"value": fit.residual_px, "unit": "px", "origin": "observed"}
    if reference is not None and reference.contact.any():
        made["hand.side"] = {"value": reference.side, "origin": "observed", "note": "which hand demonstrates"}
    units = {"size": "1", "time": "s"}
    for name, std in (reference.std if reference is not None else {}).items():
        made[f"hand.{name}"] = {"value": 0.0, "unit": units.get(name, "m"), "origin": "fitted", "std": std,
                                "note": "correction of the demonstrated hand; reference.npz holds it at 0"}
    if reference is not None and {"depth", "across"} <= reference.std.keys():
        # One number for a shift in any direction, what domain randomisation draws: along the ray and twice across it.
        offset = float(np.sqrt(reference.std["depth"] ** 2 + 2 * reference.std["across"] ** 2))
        made["hand.offset"] = {"value": 0.0, "unit": "m", "origin": "fitted", "std": offset,
                               "note": "length of the demonstrated hand's unknown shift against the object"}
    return plain({**made, **geometry.provenance})


def write_asset(root: Path, asset_id: str, video: Video, fit: JointFit, geometry: Geometry, reference: HandReference,
                providers: Sequence[ProviderInfo], notes: Sequence[str], focal_given: bool = False,
                files: Mapping[str, bytes] | None = None) -> Asset:  # fmt: skip
    """Save the asset folder ``root/<asset_id>``; see :func:`taa_envs.asset.save_asset`.

    Args:
        video: the (stabilised) video that all this was made from.
        fit: verdict "ok" or "ambiguous".
        geometry, reference: world frame, metres.
        providers: who took part.
        notes: what a user should know.
        focal_given: the focal length came from the user.
        files: further files of the folder.
    """
    from taa_envs.asset import save_asset
    from taa_envs.mechanism import FurtherLink

    given = any(p.name == "given" and p.version == "scene folder" for p in providers)
    return save_asset(
        root, asset_id, joint=joint_object(fit, video.index), static=geometry.static, moving=geometry.moving,
        reference=reference,
        camera={"K": np.asarray(fit.K, float).tolist(), "T_camera_world": np.asarray(fit.T_camera_world).tolist(),
                "width": int(video.size[0]), "height": int(video.size[1])},
        provenance=number_origins(video, fit, geometry, focal_given, reference),
        source={"file": video.path.name, "sha256": video.sha256, "width": int(video.size[0]),
                "height": int(video.size[1]), "decoded_frames": int(video.decoded), "frames": len(video),
                "seconds": float(video.time[-1] - video.time[0]), "cues_given": given},
        providers=[{key: value for key, value in asdict(p).items() if key != "stage" or value} for p in providers],
        notes=list(dict.fromkeys(notes)), files=dict(files or {}),
        further=[FurtherLink(joint_object(other, video.index), link, np.asarray(other.q, float))
                 for other, link in zip(fit.further, geometry.further, strict=True)],
    )  # fmt: skip
