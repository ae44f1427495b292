"""Reward terms: each one's sign."""

from __future__ import annotations

import numpy as np
import pytest

from taa_envs.reward import SCALES, goal_reward, reward_scales
from tests.taa_envs.made import terms


def term(name: str, **changed: object) -> float:
    return SCALES["dense"][name] * terms(**changed)[name]


def test_every_term_has_its_sign() -> None:
    assert term("progress", driven=0.1, moved=0.1) > 0
    assert term("progress", driven=0.0, moved=0.1) == 0  # gravity, a spring or a throw
    assert term("progress", driven=0.0, moved=-0.1) < 0
    assert 0 > term("reach") > term("reach", distance=0.5)
    assert term("reach", contact=True, distance=0.5) == 0
    assert term("action_rate", action=np.ones(7)) < 0 == term("action_rate", action=np.ones(7),
                                                              previous_action=np.ones(7))
    assert term("penetration", penetration=0.004) == 0 > term("penetration", penetration=0.008)
    assert term("penetration", penetration=1.0) == term("penetration", penetration=0.1)
    assert term("success", success=True) > 0 == term("success")


def test_goals() -> None:
    achieved = np.array([[0.94, 1.0], [0.951, 0.79], [0.951, 0.81], [1.2, 1.0]])
    np.testing.assert_array_equal(goal_reward(achieved, np.array([1.0, 0.8])), [-1, -1, 0, 0])
    np.testing.assert_array_equal(goal_reward(achieved, achieved), 0)  # what was reached is reached


def test_scales() -> None:
    assert reward_scales("sparse") == {"success": 1.0} and reward_scales({"reach": 2}) == {"reach": 2.0}
    with pytest.raises(ValueError, match="known: progress"):
        reward_scales({"speed": 1.0})
