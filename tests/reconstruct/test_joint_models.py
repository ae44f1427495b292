"""Kinematics: transforms are rigid, compose along q, and keep the axis."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruct.joint.models import JointFit, joint_transform

unit = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: np.array(v) / np.linalg.norm(v))
)
place = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)
state = st.floats(-3, 3)


@settings(max_examples=60, deadline=None)
@given(unit, place, state, state, st.sampled_from(["revolute", "prismatic", "screw"]))
def test_transforms_are_rigid_and_compose(axis, point, a, b, kind):
    Ta, Tb, Tab = (joint_transform(kind, axis, point, q, pitch=0.1) for q in (a, b, a + b))
    np.testing.assert_allclose(Ta @ Tb, Tab, atol=1e-9)
    np.testing.assert_allclose(Ta[:3, :3] @ Ta[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(Ta[:3, :3]) == pytest.approx(1)


@settings(max_examples=40, deadline=None)
@given(unit, place, state)
def test_points_on_a_revolute_axis_stay(axis, point, q):
    on_axis = point + 0.7 * axis
    T = joint_transform("revolute", axis, point, q)
    np.testing.assert_allclose(T[:3, :3] @ on_axis + T[:3, 3], on_axis, atol=1e-9)


def test_unknown_type_lists_the_known_ones():
    with pytest.raises(ValueError, match="revolute, prismatic, screw"):
        joint_transform("ball", np.array([0, 0, 1.0]), np.zeros(3), 0.1)


def test_states_broadcast_and_projection_uses_camera():
    fit = JointFit(
        "ok", "", "prismatic", axis=np.array([1.0, 0, 0]), K=np.diag([100.0, 100, 1]), T_camera_world=np.eye(4)
    )
    assert fit.link_pose(np.zeros((5, 2))).shape == (5, 2, 4, 4)
    np.testing.assert_allclose(fit.project(np.array([[1.0, 2.0, 4.0]])), [[25.0, 50.0]])
    assert fit.unit == "m"
