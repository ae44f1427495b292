"""Where assets are found, and their registration as ``TAA/<id>``.

Search path, first found wins: the assets shipped with the package, each folder in ``$TAA_ASSETS``, the user's data
folder. A folder without an ``asset.json`` is somebody else's and passed over. An asset that is not valid never stops an
import: it is left out, and one warning line names what was left out.
"""

from __future__ import annotations

import math
import os
import warnings
from pathlib import Path

import gymnasium

from taa_envs.asset import ID_PATTERN, Asset, load_asset, read_metadata
from taa_envs.errors import AssetError, UnknownAsset

NAMESPACE = "TAA"
ENTRY_POINT = "taa_envs.env:ArticulationEnv"
VECTOR_ENTRY_POINT = "taa_envs.vector:BatchedArticulationEnv"
CONTROL_PERIOD = 0.02  # s, of one environment step
TIME_LIMIT_SHARE = 1.5  # of the demonstration's length, before an episode is truncated

_warned: set[str] = set()


def shipped_folder() -> Path:
    """The assets that ship: inside an installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


def user_folder() -> Path:
    """The user's data folder, where ``taa reconstruct`` writes by default; it may not exist yet."""
    import platformdirs

    return Path(platformdirs.user_data_dir("taa-envs", appauthor=False)) / "assets"


def search_folders() -> list[Path]:
    """Folders of asset folders, in order of precedence."""
    given = [Path(p).expanduser() for p in os.environ.get("TAA_ASSETS", "").split(os.pathsep) if p]
    folders: list[Path] = []
    for folder in (shipped_folder(), *given, user_folder()):
        if folder not in folders:
            folders.append(folder)
    return folders


NAMED = 3
"""Folders that a warning names; of the rest it gives the number."""


def _warn_once(left_out: list[str]) -> None:
    """One line for what was not yet warned about."""
    new = [words for words in left_out if words not in _warned]
    _warned.update(new)
    if new:
        more = f"; and {len(new) - NAMED} more" if len(new) > NAMED else ""
        warnings.warn("; ".join(new[:NAMED]) + more, stacklevel=4)


def _scan() -> dict[str, tuple[Path, dict]]:
    found: dict[str, tuple[Path, dict]] = {}
    left_out: list[str] = []
    for root in search_folders():
        try:
            entries = sorted(root.iterdir()) if root.is_dir() else []
        except OSError as error:
            left_out.append(f"assets in {root} were left out: {error}")
            continue
        for folder in entries:
            if folder.name.startswith("."):
                continue  # being written
            try:
                if not (folder / "asset.json").exists():
                    continue  # not an asset at all
                if not ID_PATTERN.fullmatch(folder.name):
                    raise AssetError(f"{folder.name!r} is not an asset id")
                metadata = read_metadata(folder)
            except (AssetError, OSError) as error:
                left_out.append(f"asset folder {folder} was left out: {error}")
                continue
            if folder.name in found:
                first = found[folder.name][0]
                left_out.append(f"asset folder {folder} was left out: {first} comes first on the search path")
                continue
            found[folder.name] = (folder, metadata)
    _warn_once(left_out)
    return found


def find_assets() -> dict[str, Path]:
    """Id -> folder of every asset on the search path whose ``asset.json`` is valid."""
    return {asset_id: folder for asset_id, (folder, _) in _scan().items()}


def find_asset(asset_id: str) -> Path:
    """Folder of an asset.

    Raises:
        UnknownAsset: there is none of that id; the message lists those there are.
    """
    asset_id = asset_id.removeprefix(f"{NAMESPACE}/")
    assets = find_assets()
    if asset_id not in assets:
        known = ", ".join(sorted(assets)) or "none yet; make one with `taa reconstruct`"
        raise UnknownAsset(f"no asset is named {asset_id[:80]!r}; known: {known}")
    return assets[asset_id]


def get_asset(asset: str | os.PathLike | Asset) -> Asset:
    """The asset of an id, of a folder's path, or the asset itself.

    Raises:
        UnknownAsset: no asset has that id.
        AssetError: its folder is not valid.
    """
    if isinstance(asset, Asset):
        return asset
    if isinstance(asset, str) and ID_PATTERN.fullmatch(asset.removeprefix(f"{NAMESPACE}/")):
        return load_asset(find_asset(asset))
    return load_asset(asset)


def max_episode_steps(duration: float) -> int:
    """Time limit of an episode, in steps, for a demonstration of duration s."""
    return math.ceil(TIME_LIMIT_SHARE * duration / CONTROL_PERIOD) + math.ceil(0.5 / CONTROL_PERIOD)


def register_assets() -> list[str]:
    """Look for assets and register each as ``TAA/<id>``; forgets those that are gone.

    Returns:
        The environment ids, sorted.
    """
    assets = _scan()
    for env_id, spec in list(gymnasium.registry.items()):
        if spec.entry_point == ENTRY_POINT:
            del gymnasium.registry[env_id]
    for asset_id, (folder, metadata) in assets.items():
        gymnasium.register(id=f"{NAMESPACE}/{asset_id}", entry_point=ENTRY_POINT, vector_entry_point=VECTOR_ENTRY_POINT,
                           max_episode_steps=max_episode_steps(metadata["demo"]["duration"]),
                           kwargs={"asset": str(folder)})
    return sorted(f"{NAMESPACE}/{asset_id}" for asset_id in assets)
