"""Articulated objects from casual videos, as Gymnasium environments ``TAA/<id>``.

Importing this package registers every asset on the search path; :func:`register_assets` looks again.
"""

from taa_envs.asset import Asset, Reference, load_asset, save_asset
from taa_envs.errors import AssetError, AssetExists, TaaEnvsError, UnknownAsset, UnknownHand
from taa_envs.registry import find_assets, get_asset, register_assets

__all__ = ["Asset", "AssetError", "AssetExists", "Reference", "TaaEnvsError", "UnknownAsset", "UnknownHand",
           "find_assets", "get_asset", "load_asset", "register_assets", "save_asset"]

register_assets()
