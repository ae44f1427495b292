"""Reward terms and scores of other people's replays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.reward import reward_scales
from taa_envs.scoring import score_actions, score_joint_log
from tests.taa_envs.made import terms


def test_motion_without_contact_earns_nothing() -> None:
    assert terms(moved=0.1)["progress"] == 0.0
    assert terms(moved=0.1, driven=0.1)["progress"] == pytest.approx(0.1)


def test_motion_the_wrong_way_costs() -> None:
    assert terms(moved=-0.1)["progress"] == pytest.approx(-0.1)


def test_reach_costs_more_the_farther_the_hand() -> None:
    far, near = (terms(distance=d)["reach"] for d in (0.5, 0.05))
    assert -1 < far < near < 0 == terms(contact=True)["reach"]


@given(st.floats(0, 1))
def test_penetration_is_bounded(depth: float) -> None:
    assert -1 <= terms(penetration=depth)["penetration"] <= 0


def test_scales_select_and_weigh(door: Asset) -> None:
    for reward, wanted in (("sparse", {"success": 1.0}), ({"success": 3}, {"success": 3.0})):
        env = ArticulationEnv(door, reward=reward)
        env.reset(seed=0)
        done = False
        while not done:
            _, total, done, _, info = env.step(np.zeros(8))
        assert info["reward_terms"] == wanted and total == sum(wanted.values())
    with pytest.raises(ValueError, match="known: dense, sparse"):
        reward_scales("generous")
    with pytest.raises(ValueError, match="known: progress"):
        reward_scales({"style": 1})


def test_the_demonstration_itself_scores_full(door: Asset) -> None:
    scores = score_joint_log(door, door.reference.time, door.reference.q)
    assert scores["joint_progress"] == pytest.approx(1) and scores["final_q_error"] == pytest.approx(0)
    assert scores["wrong_way"] == 0


def test_scores_of_a_joint_that_falls_back(door: Asset) -> None:
    end = door.demo["q_demo_end"]
    scores = score_joint_log(door, np.array([0, 0.1, 0.5, 0.7]), np.array([0, -0.1 * end, 0.8 * end, 0.5 * end]))
    assert scores["joint_progress"] == pytest.approx(0.5) and scores["max_progress"] == pytest.approx(0.8)
    assert scores["wrong_way"] == pytest.approx(0.1) and scores["final_q_error"] == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize("time, q, message", [
    ([0, 1], [0], "equal length"), ([], [], "equal length"),
    ([0, np.nan], [0, 1], "finite"), ([0, 0], [0, 1], "increase")])
def test_logs_that_are_no_logs(door: Asset, time: list, q: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        score_joint_log(door, np.array(time), np.array(q))


def test_zero_actions_score_as_the_replay(door: Asset) -> None:
    scores = score_actions(door, np.zeros((150, 8)))
    assert scores["is_success"] and scores["joint_progress"] >= 0.95
    assert score_actions(door, np.zeros((150, 7))) == scores
    assert score_actions(door, np.zeros((150, 63)))["joint_progress"] < 0.1  # stays where the demonstration began
    with pytest.raises(ValueError, match="actions must be"):
        score_actions(door, np.zeros((150, 3)))
