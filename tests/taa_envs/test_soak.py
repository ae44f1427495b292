"""A slice of ``python -m benchmarks.soak``, and MuJoCo's warnings where a user sees them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from benchmarks.soak import soak
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.kernels import BAD
from taa_envs.vector import BatchedArticulationEnv


@pytest.mark.slow
def test_random_actions_do_no_harm(door: Asset) -> None:
    row = soak(door, 4000, 8, 0)
    assert row["fine"] and row["steps"] >= 4000 and row["not_finite"] == row["outside"] == row["warnings"] == 0


def test_a_warning_of_mujoco_is_in_info(door: Asset, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT where it is
    env = ArticulationEnv(door)
    env.reset(seed=0)
    zero = np.zeros(env.action_space.shape, np.float32)
    assert env.step(zero)[-1]["warnings"] == 0
    kinds = mujoco.mjtWarning
    bad = kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC
    assert [BAD, BAD + 1, BAD + 2] == [int(k) for k in bad]
    env.data.qvel[3] = np.nan
    _, _, terminated, _, info = env.step(zero)
    assert info["warnings"] >= 1 and info["diverged"] and terminated
    assert env.reset(seed=0)[1]["warnings"] == 0 and env.step(zero)[-1]["warnings"] == 0

    many = BatchedArticulationEnv(door, 3)
    many.reset(seed=0)
    many.task.rows.qvel[1, 3] = np.nan
    info = many.step(np.zeros(many.action_space.shape, np.float32))[-1]
    assert info["warnings"][1] >= 1 and info["warnings"][[0, 2]].tolist() == [0, 0]
    assert info["diverged"].tolist() == [False, True, False]
