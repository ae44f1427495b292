"""Reward terms: each one's sign, and that numbers and arrays agree."""

from __future__ import annotations

import numpy as np
import pytest

from taa_envs.reward import SCALES, TERMS, RewardInputs, goal_reward, reward_scales, reward_terms, scalar_terms


def inputs(**changed: object) -> RewardInputs:
    base = {"driven": 0.0, "moved": 0.0, "contact": False, "distance": 0.05, "penetration": 0.0,
            "action": np.zeros(7), "previous_action": np.zeros(7), "success": False}
    return RewardInputs(**{**base, **changed})


def term(name: str, **changed: object) -> float:
    return float(reward_terms(inputs(**changed), SCALES["dense"])[name])


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


def test_arrays_agree_with_numbers() -> None:
    rng = np.random.default_rng(0)
    n = 5
    many = {"driven": rng.random(n), "moved": rng.normal(size=n), "contact": rng.random(n) > 0.5,
            "distance": rng.random(n), "penetration": 0.01 * rng.random(n), "action": rng.normal(size=(n, 7)),
            "previous_action": rng.normal(size=(n, 7)), "success": rng.random(n) > 0.5}
    batch = reward_terms(inputs(**many), SCALES["dense"])
    assert set(batch) == set(TERMS)
    for i in range(n):
        one = reward_terms(inputs(**{k: v[i] for k, v in many.items()}), SCALES["dense"])
        plain = {k: v[i].tolist() for k, v in many.items()}
        assert scalar_terms(**plain, scales=SCALES["dense"]) == pytest.approx(one, abs=1e-15)
        for name in TERMS:
            assert one[name] == pytest.approx(batch[name][i], abs=1e-15)


def test_goals() -> None:
    achieved = np.array([[0.94, 1.0], [0.951, 0.79], [0.951, 0.81], [1.2, 1.0]])
    np.testing.assert_array_equal(goal_reward(achieved, np.array([1.0, 0.8])), [-1, -1, 0, 0])
    np.testing.assert_array_equal(goal_reward(achieved, achieved), 0)  # what was reached is reached


def test_scales() -> None:
    assert reward_scales("sparse") == {"success": 1.0} and reward_scales({"reach": 2}) == {"reach": 2.0}
    with pytest.raises(ValueError, match="known: progress"):
        reward_scales({"speed": 1.0})
