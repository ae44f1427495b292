"""Open-loop replay through contact, and the controls that must not succeed."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from taa_envs.asset import Asset, save_asset
from taa_envs.replay import CONTROLS, HOLD, ReplayResult, control_path, mirror_plane, render_frames, replay, simulate
from taa_envs.scene import build_scene
from taa_envs.simulation import HandPath, Simulation
from tests.taa_envs.made import door_arguments, drawer_arguments

NAMES = ("door", "pushed_door", "drawer")


@pytest.fixture(scope="session")
def results(door: Asset, pushed_door: Asset, drawer: Asset) -> dict[str, ReplayResult]:
    return {name: replay(asset) for name, asset in zip(NAMES, (door, pushed_door, drawer), strict=True)}


@pytest.mark.parametrize("name", NAMES)
def test_demonstrated_hand_moves_the_joint_and_controls_do_not(results: dict, name: str) -> None:
    result = results[name]
    assert result.joint_progress >= 0.9 and result.final_q_error <= 0.1
    assert result.contact_fraction >= 0.9
    assert set(result.controls) == set(CONTROLS)
    assert max(result.controls.values()) < 0.1
    assert result.controls["no_hand"] < 1e-3
    assert result.max_penetration_m < 0.01 and result.wrong_way < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_contact_made_the_motion(results: dict, name: str) -> None:
    run = results[name].trajectory
    assert run.driven >= 0.8 * abs(run.q[-1] - run.q[0])


def test_result_has_exactly_the_contracts_fields(results: dict) -> None:
    assert set(results["door"].as_dict()) == {"joint_progress", "final_q_error", "max_progress", "contact_fraction",
                                              "max_penetration_m", "wrong_way", "controls"}


def test_replay_is_deterministic(door: Asset, results: dict) -> None:
    np.testing.assert_array_equal(replay(door, controls=False).trajectory.q, results["door"].trajectory.q)


def test_samples_lie_on_the_references_frames(door: Asset, results: dict) -> None:
    run = results["door"].trajectory
    np.testing.assert_array_equal(run.time[:-1], door.reference.time)
    np.testing.assert_array_equal(run.q_demo[:-1], door.reference.q)
    assert run.q[0] == door.demo["q_start"] and run.qpos.shape[0] == len(run.time)


def test_hand_that_stays_away_does_nothing(door: Asset) -> None:
    scene = build_scene(door)
    run = simulate(scene, HandPath(door.reference.time, door.reference.hand_joints + [2.0, 0, 0]))
    assert abs(run.q[-1]) < 1e-6 and not run.contact.any()


def test_joint_is_moved_by_contact_alone(door: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same hand in a scene where it passes through the link moves nothing."""
    scene = build_scene(door)
    scene.model.geom_conaffinity[scene.hand_geoms] = 0
    run = simulate(scene, HandPath(door.reference.time, door.reference.hand_joints))
    assert abs(run.q[-1]) < 1e-6


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sign_of_the_contacts_generalized_force(door: Asset, sign: float) -> None:
    """A hand pressed against the panel from either side pushes the joint that way."""
    scene = build_scene(door)
    sim = Simulation(scene)
    hand = door.reference.hand_joints[0] * 0 + [0.2, 0.0, 0.3] + np.linspace(-0.08, 0.08, 21)[:, None] * [0, 0, 1]
    sim.reset(0.5, hand + 3.0)
    body = scene.model.body("moving").id
    turn = sim.data.xmat[body].reshape(3, 3)
    inside = 0.5 * 0.02 + sign * 0.005  # shallow from one face or the other of the panel's y in [-0.02, 0]
    point = sim.data.xpos[body] + (hand - [0, inside, 0]) @ turn.T
    start = point - sign * 0.03 * turn[:, 1]
    sim.reset(0.5, start)
    impulse = 0.0
    for _ in range(60):
        impulse += sim.step(point).impulse
    assert impulse * sign > 0 and (sim.q - 0.5) * sign > 0


def test_mirror_reverses_the_hands_motion(door: Asset, drawer: Asset) -> None:
    for asset in (door, drawer):
        scene = build_scene(asset)
        point, normal = mirror_plane(scene)
        assert np.linalg.norm(normal) == pytest.approx(1)
        if asset.joint_type == "revolute":
            assert abs(normal @ np.array(asset.joint["axis"])) < 1e-9
        path = control_path(scene, "mirrored_hand")
        moved = asset.reference.hand_joints[-1].mean(0) - asset.reference.hand_joints[20].mean(0)
        mirrored = path.joints[-1].mean(0) - path.joints[20].mean(0)
        assert (moved @ normal) == pytest.approx(-(mirrored @ normal)) and abs(moved @ normal) > 0.1


def test_late_hand_has_not_begun_when_time_is_up(door: Asset) -> None:
    path = control_path(build_scene(door), "late_hand")
    for time in (door.reference.time[0], door.end_time + HOLD):
        np.testing.assert_allclose(path.at(time), door.reference.hand_joints[0], atol=1e-9)
    np.testing.assert_allclose(path.at(2 * door.end_time + HOLD), door.reference.hand_joints[-1], atol=1e-9)


def test_unknown_control(door: Asset) -> None:
    with pytest.raises(ValueError, match="known: no_hand"):
        control_path(build_scene(door), "upside_down")


@pytest.mark.parametrize("seed", range(3))
def test_centimetre_noise_does_not_break_it(tmp_path: Path, seed: int) -> None:
    asset = save_asset(tmp_path, "door", **door_arguments(noise=0.007, seed=seed))
    result = replay(asset, controls=False)
    assert result.joint_progress > 0.7 and result.max_penetration_m < 0.03


def test_start_deep_inside_neither_explodes_nor_jams(drawer: Asset) -> None:
    """All of the hand inside the drawer's front at once: it slips out and the drawer hardly moves."""
    scene = build_scene(drawer)
    sim = Simulation(scene)
    hand = np.random.default_rng(0).uniform([-0.1, 0.0, 0.13], [0.1, 0.02, 0.27], (21, 3))
    sim.reset(0.1, hand + [0, -0.1, 0])
    fastest = 0.0
    for _ in range(300):
        sim.step(hand + [0, -0.1, 0])
        fastest = max(fastest, abs(sim.qvel), float(np.abs(sim.data.qvel).max()))
    assert fastest < 5.0 and abs(sim.q - 0.1) < 0.05


def test_demonstration_that_comes_back_is_scored_at_its_far_point(tmp_path: Path) -> None:
    arguments = drawer_arguments()
    reference = arguments["reference"]
    n = len(reference["time"])
    for name in ("q", "hand_joints", "hand_valid", "contact"):
        reference[name] = np.concatenate([reference[name], reference[name][::-1]])
    reference["time"] = np.arange(2 * n) / 30.0
    asset = save_asset(tmp_path, "drawer", **arguments)
    assert asset.demo["demo_end_frame"] < n
    result = replay(asset, controls=False)
    assert result.joint_progress > 0.9 and "comes back" in result.notes[0]
    assert result.trajectory.time[-1] < n / 30.0 + 0.3


def test_frames_beside_the_videos(door: Asset, results: dict) -> None:
    run = results["door"].trajectory
    frames = [f for _, f in zip(range(2), render_frames(door, run, height=121), strict=False)]
    assert frames[0].shape == (122, 162, 3) and frames[0].dtype == np.uint8 and frames[0].std() > 5
    assert frames[0] is not frames[1]


def test_object_state_is_never_written_in_an_episode(door: Asset) -> None:
    """Between steps q only changes by the integrator: q' = q + dt qvel', to rounding."""
    scene = build_scene(door)
    sim = Simulation(scene)
    path = HandPath(door.reference.time, door.reference.hand_joints)
    sim.reset(0.0, path.at(0.0))
    for i in range(900):
        before = sim.q
        sim.step(path.at(i * 0.002))
        assert sim.q - before == pytest.approx(0.002 * sim.qvel, abs=1e-12)
    assert sim.q > 0.1
    assert int(scene.model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
