"""What an answer says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.joint.answers import OPEN_DEG, open_states_told, type_no_surer
from reconstruct.joint.models import JointFit
from tests.reconstruct.joint_scenes import made

STROKE = 0.8


def door(std: np.ndarray) -> JointFit:
    """A hinge whose states of 40 frames are known so well, rad."""
    fit = made("ok", 0.0, 0.1, np.arange(30))
    return replace(fit, q=np.linspace(0, STROKE, 40), std={**fit.std, "q": std})


@pytest.mark.parametrize("count", [0, 1, 25])
def test_states_that_nothing_holds_are_told(count):
    std = np.full(40, 0.02)
    std[:count] = STROKE
    fit = door(std)
    told = open_states_told(fit)
    assert told.verdict == fit.verdict
    assert told.reason.startswith(fit.reason) and (f"in {count} of 40 frames" in told.reason) == (count > 0)


def test_a_refusal_and_states_that_are_badly_known_are_left_alone():
    refused = JointFit("refused", "nothing moves")
    assert open_states_told(refused) is refused
    vague = door(np.full(40, 0.5 * STROKE))
    assert open_states_told(vague) is vague


@pytest.mark.parametrize(("axis_deg", "p", "stated"), [(9, 0.99, 0.99), (OPEN_DEG + 1, 0.99, 0.69), (247, 0.5, 0.5)])
def test_a_type_is_no_surer_than_its_axis_is_known(axis_deg, p, stated):
    fit = made("ambiguous", 0.0, 0.1, np.arange(30), axis_deg)
    slide = replace(fit, type="prismatic", point=None, type_probability={"prismatic": p, "revolute": 1 - p})
    told = type_no_surer(slide)
    assert told.type_probability["prismatic"] == pytest.approx(stated, abs=0.01)
    assert sum(told.type_probability.values()) == pytest.approx(1.0)
    assert told.axis is slide.axis and told.verdict == "ambiguous"


def test_what_is_sure_or_refused_keeps_its_type():
    sure, refused = made("ok", 0.0, 0.1, np.arange(30), 30.0), JointFit("refused", "nothing moves")
    assert type_no_surer(sure) is sure
    assert type_no_surer(refused) is refused
