"""Where axes are likely before a camera that is held level."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reconstruct.joint.plates import half_sphere
from reconstruct.joint.upright import log_prior


def seen_from(pitch_deg: float) -> np.ndarray:
    """(3,) up in the frame of a camera that looks down by this."""
    p = np.radians(pitch_deg)
    return np.array([0.0, -np.cos(p), -np.sin(p)])


def test_it_is_a_density():
    axes = half_sphere(4000)
    assert np.mean([np.exp(log_prior(a)) for a in axes]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("pitch_deg", [10.0, 25.0, 40.0])
def test_a_vertical_axis_is_looked_down_on(pitch_deg):
    up = seen_from(pitch_deg)
    assert log_prior(up) > log_prior(up * [1, 1, -1]) + 0.5
    assert log_prior(up) > 1.0


def test_an_axis_across_the_view_is_likelier_than_a_leaning_one():
    leaning = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    assert log_prior(np.array([1.0, 0.0, 0.0])) > log_prior(leaning) + 0.5


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_no_axis_is_ruled_out_and_its_sign_does_not_matter(v):
    axis = np.array(v) / np.linalg.norm(v)
    assert log_prior(axis) > np.log(0.19)
    assert log_prior(-axis) == pytest.approx(log_prior(axis))
