"""What an answer says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruct.joint.answers import open_states_told
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
