"""Fixtures: assets made by :mod:`tests.taa_envs.made`."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import pytest

from taa_envs.asset import Asset, save_asset
from tests.taa_envs.made import door_arguments, drawer_arguments


@pytest.fixture(scope="session")
def asset_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("assets")


@pytest.fixture(scope="session")
def door(asset_root: Path) -> Asset:
    return save_asset(asset_root, "door", **door_arguments())


@pytest.fixture(scope="session")
def pushed_door(asset_root: Path) -> Asset:
    return save_asset(asset_root, "pushed-door", **door_arguments(push=True))


@pytest.fixture(scope="session")
def drawer(asset_root: Path) -> Asset:
    return save_asset(asset_root, "drawer", **drawer_arguments())
