"""Assets for other programs: a folder of MJCF, URDF or USD that needs nothing else.

:func:`export_asset` writes, :func:`taa_envs.exports.check.check_export` reads back with the format's own loader and
compares.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError

FORMATS = ("mjcf", "urdf", "usd")


def cannot_hold(asset: Asset, kind: str) -> str | None:
    """Why a format cannot hold an asset's joints; None where it can."""
    joints = (asset.joint, *asset.further)
    if kind != "mjcf" and any(joint["type"] == "screw" for joint in joints):
        return (f"{kind.upper()} has no screw joint: it cannot couple a turn to an advance; export mjcf instead")
    if kind == "usd" and len(joints) > 1:
        return f"the USD export holds one joint, this object has {len(joints)}; export mjcf or urdf instead"
    return None


def export_asset(asset: Asset, kind: str, target: Path) -> Path:
    """Write ``target/`` (made here, must not exist).

    Args:
        kind: one of :data:`FORMATS`.

    Returns:
        The file to open: ``model.xml``, ``<id>.urdf`` or ``<id>.usda``.

    Raises:
        TaaEnvsError: the format cannot hold this joint, or its package is not installed.
    """
    from taa_envs.exports.urdf import write_urdf
    from taa_envs.exports.usd import write_usd

    writers: dict[str, Callable[[Asset, Path], Path]] = {"mjcf": _write_mjcf, "urdf": write_urdf, "usd": write_usd}
    if kind not in writers:
        raise TaaEnvsError(f"unknown format {kind!r}; known: {', '.join(FORMATS)}")
    if reason := cannot_hold(asset, kind):
        raise TaaEnvsError(reason)
    target.mkdir(parents=True)
    return writers[kind](asset, target)


def _write_mjcf(asset: Asset, folder: Path) -> Path:
    shutil.copyfile(asset.model_path, folder / "model.xml")
    shutil.copytree(asset.path / "meshes", folder / "meshes")
    return folder / "model.xml"
