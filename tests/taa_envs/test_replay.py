"""Open-loop replay through contact, and the controls that must not succeed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from taa_envs.asset import Asset, save_asset
from taa_envs.controls import CONTROLS, HOLD, control_path, mirror_plane
from taa_envs.replay import ReplayResult, render_frames, replay, simulate
from taa_envs.scene import build_scene
from taa_envs.simulation import HandPath, Simulation, Step
from tests.taa_envs.made import door_arguments, drawer_arguments, min_jerk

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
        reference = asset.reference
        driven = np.flatnonzero(reference.contact)
        for frame in driven[[0, len(driven) // 2, -1]]:
            hand = reference.hand_joints[frame]
            reflected = hand - 2 * ((hand - point) @ normal)[:, None] * normal
            np.testing.assert_allclose(path.at(float(reference.time[frame])), reflected, atol=1e-9)


def turning(asset: Asset, path: HandPath, times: np.ndarray) -> np.ndarray:
    """Mean of the joint's motion (rad or m) that the hand's own motion between the times amounts to."""
    axis = np.array(asset.joint["axis"], float)
    joints = np.stack([path.at(float(t)) for t in times])
    step = np.diff(joints, axis=0)
    if asset.joint_type == "prismatic":
        return (step @ axis).mean(1)
    arm = joints[:-1] - asset.joint["point"]
    along = np.cross(axis, arm)
    return ((step * along).sum(-1) / (along**2).sum(-1)).mean(1)


def test_a_mirrored_hand_moves_against_the_demonstration_all_the_time(door: Asset, drawer: Asset) -> None:
    for asset in (door, drawer):
        scene = build_scene(asset)
        path = control_path(scene, "mirrored_hand")
        times = np.arange(path.time[0], asset.end_time, 0.01)
        moved = turning(asset, path, times)
        assert moved.max() < 1e-9 and moved.sum() < -abs(asset.demo["q_demo_end"])
        sim = Simulation(scene)
        sim.reset(asset.demo["q_start"], path.joints[0])
        assert sim.data.ncon == 0, "it begins clear of the link"


def pressed_shut(folder: Path) -> Asset:
    """The door, whose hand first rests on it and presses it shut, lets go, and then pulls the handle."""
    arguments = door_arguments()
    reference = arguments["reference"]
    flat = reference["hand_joints"][18] * [1, 0, 1] + [-0.1, 0.002, 0.0]
    steps = min_jerk(np.linspace(0, 1, 10))[:, None, None]
    leaving = flat + steps * [0.0, 0.15, 0.0]
    over = leaving[-1] + steps * (reference["hand_joints"][0] - leaving[-1])
    before = np.concatenate([np.repeat(flat[None], 20, 0), leaving, over])
    n = len(before)
    reference["hand_joints"] = np.concatenate([before, reference["hand_joints"]])
    for name in ("q", "hand_valid", "contact"):
        old = reference[name]
        reference[name] = np.concatenate([np.full(n, name == "hand_valid", old.dtype), old])
    reference["time"] = np.arange(len(reference["q"])) / 30.0
    return save_asset(folder, "pressed-shut", **arguments)


def test_a_hand_that_rests_on_the_link_before_its_stroke_spoils_no_control(tmp_path: Path) -> None:
    """Reflected as a whole it pushes the door open from behind, by honest contact; that says nothing of the replay."""
    made = pressed_shut(tmp_path)
    for shift in (-0.003, 0.0, 0.003):
        joints = made.reference.hand_joints + [0.0, shift, 0.0]
        asset = replace(made, reference=replace(made.reference, hand_joints=joints))
        scene = build_scene(asset)
        point, normal = mirror_plane(scene)
        whole = HandPath(asset.reference.time, joints - 2 * ((joints - point) @ normal)[..., None] * normal)
        assert asset.stroke_fraction(simulate(scene, whole).q).max() > 0.01
        run = simulate(scene, control_path(scene, "mirrored_hand"))
        assert asset.stroke_fraction(run.q).max() < 0.005
    assert simulate(scene, HandPath(asset.reference.time, joints)).q[-1] >= 0.9 * asset.demo["q_demo_end"]


def test_the_mirrored_control_finds_a_joint_that_answers_to_presence(door: Asset, monkeypatch: pytest.MonkeyPatch
                                                                     ) -> None:  # fmt: skip
    """A joint that runs on whenever a hand touches it, however it pushes, is what the control is for."""
    step = Simulation.step

    def eager(self: Simulation, joints: np.ndarray | None) -> Step:
        made = step(self, joints)
        self.data.qfrc_applied[self.scene.dof] = 40.0 if made.contact else 0.0
        return made

    monkeypatch.setattr(Simulation, "step", eager)
    controls = replay(door).controls
    assert controls["mirrored_hand"] > 0.3 and controls["no_hand"] < 1e-3


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
