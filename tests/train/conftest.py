"""Fixtures: an asset made as those of tests/taa_envs are."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import pytest

from taa_envs.asset import Asset, save_asset
from tests.taa_envs.made import door_arguments


@pytest.fixture(scope="session")
def train_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("assets")


@pytest.fixture(scope="session")
def door(train_root: Path) -> Asset:
    return save_asset(train_root, "door", **door_arguments())
