"""Domain randomisation from the asset's own uncertainties."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from taa_envs import randomize
from taa_envs.asset import Asset
from taa_envs.env import ArticulationEnv
from taa_envs.vector import BatchedArticulationEnv


def with_provenance(asset: Asset, **entries: dict) -> Asset:
    return dataclasses.replace(asset, provenance={**asset.provenance, **{k.replace("__", "."): v
                                                                         for k, v in entries.items()}})


def test_amounts_are_the_assets_own(door: Asset, drawer: Asset) -> None:
    std = randomize.uncertainties(door)
    assert std["axis"] == pytest.approx(np.deg2rad(1.0)) and std["point"] == std["hand"] == 0.002
    assert std["mass"] == std["damping"] == np.log(2) and "scale" not in std
    assert "point" not in randomize.uncertainties(drawer) and "hand" not in randomize.uncertainties(drawer)
    known = with_provenance(door, joint__damping={"value": 2.0, "std": 0.2, "origin": "fitted"},
                            scale={"value": 1.0, "std": 0.1, "origin": "fitted"},
                            moving__mass={"value": 3.0, "origin": "given"},
                            hand__offset={"value": 0.0, "std": 0.004, "origin": "fitted"})
    std = randomize.uncertainties(known)
    assert std["damping"] == pytest.approx(np.log(1.1)) and std["scale"] == 0.1 and std["hand"] == 0.004
    assert "mass" not in std  # given, and nothing said about how well


def test_draws_have_the_stated_spread() -> None:
    rng = np.random.default_rng(0)
    axis, point = np.array([0.0, 0.6, 0.8]), np.array([0.1, 0.2, 0.3])
    std = {"axis": 0.02, "point": 0.01, "hand": 0.005, "mass": 0.5, "scale": 0.1}
    draws = [randomize.draw(rng, std, axis, point) for _ in range(4000)]
    angles = np.array([np.arccos(d.axis @ axis) for d in draws])
    shifts = np.array([d.point - point for d in draws])
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.02, rel=0.05)
    assert np.sqrt((shifts**2).sum(1).mean()) == pytest.approx(0.01, rel=0.05)
    assert np.abs(shifts @ axis).max() < 1e-12
    assert np.sqrt((np.array([d.hand for d in draws]) ** 2).sum(1).mean()) == pytest.approx(0.005, rel=0.05)
    assert np.log([d.mass for d in draws]).std() == pytest.approx(np.hypot(0.5, 0.4), rel=0.05)
    assert all(d.damping == 1.0 for d in draws)


def test_the_model_gets_what_was_drawn_and_loses_it_again(door: Asset) -> None:
    env = ArticulationEnv(door)
    model, joint, dof = env.model, env.model.joint("joint").id, env.task.scene.dof
    body = env.model.body("moving").id
    before = {name: getattr(model, name).copy() for name in ("jnt_axis", "jnt_pos", "body_mass", "body_inertia",
                                                             "dof_damping", "dof_M0")}
    _, info = env.reset(seed=0, options={"randomize": True})
    made = info["randomized"]
    np.testing.assert_array_equal(model.jnt_axis[joint], made["axis"])
    np.testing.assert_array_equal(model.jnt_pos[joint], made["point"])
    assert model.body_mass[body] == pytest.approx(before["body_mass"][body] * made["mass"])
    np.testing.assert_allclose(model.dof_damping[dof], before["dof_damping"][dof] * made["damping"])
    assert model.dof_M0[dof] != before["dof_M0"][dof]
    env.reset()
    for name, value in before.items():
        np.testing.assert_allclose(getattr(model, name), value, rtol=1e-12)


def test_names_choose(door: Asset) -> None:
    env = ArticulationEnv(door, randomize=["damping"])
    _, info = env.reset(seed=0)
    made = info["randomized"]
    assert made["damping"] != 1 and made["mass"] == 1 and not made["hand"].any()
    _, info = env.reset(options={"randomize": {"hand": 0.01}})
    assert info["randomized"]["hand"].any() and info["randomized"]["damping"] == 1
    for bad in ({"hand": -1.0}, {"hand": float("nan")}):
        with pytest.raises(ValueError, match="finite"):
            env.reset(options={"randomize": bad})


def test_fitted_springs_are_drawn_and_taken_back(door: Asset) -> None:
    assert not {"stiffness", "armature", "springref"} & set(randomize.uncertainties(door))  # armature is only assumed
    fitted = with_provenance(door, joint__stiffness={"value": 1.5, "std": 0.3, "origin": "fitted"},
                             joint__armature={"value": 0.02, "std": 0.005, "origin": "fitted"},
                             joint__springref={"value": 0.2, "std": 0.05, "origin": "fitted"})
    std = randomize.uncertainties(fitted)
    assert (std["stiffness"], std["armature"], std["springref"]) == pytest.approx((np.log(1.2), np.log(1.25), 0.05))
    draws = [randomize.draw(np.random.default_rng(k), std, np.eye(3)[2], np.zeros(3)) for k in range(2000)]
    assert np.log([d.stiffness for d in draws]).std() == pytest.approx(np.log(1.2), rel=0.07)
    assert np.log([d.armature for d in draws]).std() == pytest.approx(np.log(1.25), rel=0.07)
    assert np.std([d.springref for d in draws]) == pytest.approx(0.05, rel=0.07)

    single, batch = ArticulationEnv(fitted), BatchedArticulationEnv(fitted, 2, threads=1)
    dof, joint, qpos = single.task.scene.dof, single.model.joint("joint").id, single.task.scene.qpos
    model = single.model
    # The door has no spring: a factor on none is none.
    before = model.dof_armature[dof], model.qpos_spring[qpos]
    made = single.reset(seed=5, options={"randomize": True})[1]["randomized"]
    assert model.dof_armature[dof] == before[0] * made["armature"] != before[0] and model.jnt_stiffness[joint] == 0
    assert model.qpos_spring[qpos] == before[1] + made["springref"] != before[1]
    batch.reset(seed=[5, 6], options={"randomize": True})
    field = batch.task.rows.fields(0, randomize.SPRING_FIELDS)
    assert field["dof_armature"][dof] == model.dof_armature[dof]
    assert field["qpos_spring"][qpos] == model.qpos_spring[qpos]
    for _ in range(5):
        a, b = single.step(np.zeros(8)), batch.step(np.zeros((2, 8)))
    np.testing.assert_allclose(a[0], b[0][0], rtol=0, atol=1e-10)
    single.reset(options={"randomize": False})
    assert (model.dof_armature[dof], model.qpos_spring[qpos]) == before


def test_axis_and_point_err_together_where_the_asset_says_how() -> None:
    """A hinge seen from the front: its tilt and its shift are one and the same error."""
    axis, point = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    lever = np.zeros((6, 1))
    lever[0], lever[3] = 0.01, 0.005  # tilts towards x and shifts along x at once
    joint = lever @ lever.T + 1e-8 * np.eye(6)
    rng = np.random.default_rng(0)
    draws = [randomize.draw(rng, {"axis": 0.01, "point": 0.005}, axis, point, joint) for _ in range(4000)]
    tilt, shift = np.array([d.axis for d in draws])[:, :2], np.array([d.point for d in draws])[:, :2]
    assert np.corrcoef(tilt[:, 0], shift[:, 0])[0, 1] > 0.99
    assert np.sqrt((tilt**2).sum(1).mean()) == pytest.approx(0.01, rel=0.05)
    assert np.sqrt((shift**2).sum(1).mean()) == pytest.approx(0.005, rel=0.05)
    assert tilt[:, 1].std() < 0.1 * tilt[:, 0].std()


def test_a_stated_covariance_is_used_and_a_broken_one_is_not(door: Asset) -> None:
    C = np.diag([1e-4, 1e-4, 0, 4e-6, 4e-6, 0])
    std = {"axis_deg": 1.0, "point_m": 0.002}
    stated = dataclasses.replace(door, joint={**door.joint, "std": {**std, "covariance": C.tolist()}})
    assert np.array_equal(randomize.covariance(stated), C)
    for broken in (None, [[1.0]], "much", [[None] * 6] * 6):
        other = dataclasses.replace(door, joint={**door.joint, "std": {**std, "covariance": broken}})
        assert randomize.covariance(other) is None
    with_it, without = (ArticulationEnv(a).reset(seed=3, options={"randomize": ["axis"]})[1] for a in (stated, door))
    assert not np.array_equal(with_it["randomized"]["axis"], without["randomized"]["axis"])
