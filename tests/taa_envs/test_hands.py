"""Hands with joints: retargeting within limits, side, loading, replays. The robots' models are stand-ins of the same
layout (:mod:`tests.taa_envs.robot_models`): the published ones are fetched from the internet."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from taa_envs.asset import Asset
from taa_envs.corrections import NAMES, Corrections
from taa_envs.errors import HandUnavailable, UnknownHand
from taa_envs.hands import HANDS, make_hand
from taa_envs.hands.human import human
from taa_envs.hands.landmarks import TIPS, palm_frame, side_of
from taa_envs.hands.retarget import JOINT_SPEED, Retargeting
from taa_envs.hands.rig import BASE_FORCE, PERIOD, JointedController
from taa_envs.replay import replay, simulate
from taa_envs.rollouts import Rollouts
from taa_envs.scene import build_scene
from taa_envs.simulation import HandPath, Simulation
from tests.taa_envs.made import hooked_hand
from tests.taa_envs.robot_models import write_models

JOINTED = tuple(name for name in HANDS if name != "points")


@pytest.fixture(scope="module", autouse=True)
def menagerie(tmp_path_factory: pytest.TempPathFactory):
    pytest.importorskip("mujoco_menagerie", reason="the extra `hands` is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MENAGERIE_ROOT", str(write_models(tmp_path_factory.mktemp("menagerie"))))
        yield


def controller(name: str, asset: Asset) -> JointedController:
    made = build_scene(asset, name).hand
    assert isinstance(made, JointedController)
    return made


def test_human_hand_has_26_degrees_of_freedom() -> None:
    model = human().spec().compile()
    assert model.nv == 26 and model.nu == 20
    assert 0.3 < model.body_subtreemass[1] < 0.6


@pytest.mark.parametrize("side", ["right", "left"])
def test_human_hand_is_of_average_size_and_of_its_side(side: str) -> None:
    model = human(side).spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert 0.17 < np.linalg.norm(data.site("tip_middle").xpos - data.body("palm").xpos) < 0.19
    data.qpos[7:] = [0.6 * b if "spread" not in model.joint(j + 1).name else 0.0
                     for j, b in enumerate(model.jnt_range[1:, 1])]
    mujoco.mj_kinematics(model, data)
    joints = np.zeros((21, 3))
    for finger, (start, *_) in {"thumb": (1,), "index": (5,), "middle": (9,), "ring": (13,), "little": (17,)}.items():
        for k in range(3):
            joints[start + k] = data.body(f"{finger}_{k + 1}").xpos
        joints[start + 3] = data.site(f"tip_{finger}").xpos
    assert side_of(joints[None]) == side  # fingers curl towards the palm


def test_side_of_a_mirrored_hand_is_the_other(pushed_door: Asset) -> None:
    joints = pushed_door.reference.hand_joints
    assert {side_of(joints), side_of(joints * [-1, 1, 1])} == {"right", "left"}


def test_palm_frame_is_a_rotation() -> None:
    for side in ("right", "left"):
        frame = palm_frame(hooked_hand() + [0.0, 0.01, 0.0] * np.arange(21)[:, None], side)
        np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("name", JOINTED)
def test_retargeting_reaches_the_finger_tips_within_limits(name: str, pushed_door: Asset) -> None:
    ik = controller(name, pushed_door).retargeting
    joints = pushed_door.reference.hand_joints
    q = ik.start(joints[0])
    errors, dt = [], 0.01
    for t in np.arange(pushed_door.reference.time[0], pushed_door.end_time, dt):
        before = q
        q = ik.step(q, HandPath(pushed_door.reference.time, joints).at(t), dt)
        assert (q[7:] >= ik.low - 1e-12).all() and (q[7:] <= ik.high + 1e-12).all()
        assert np.abs(q[7:] - before[7:]).max() <= JOINT_SPEED * dt + 1e-12
        wanted = HandPath(pushed_door.reference.time, joints).at(t)
        errors.append([np.linalg.norm(p - wanted[TIPS[f]]) for f, p in ik.tips(q).items()])
    assert np.median(errors) < 0.012


@pytest.mark.parametrize("name", JOINTED)
def test_a_left_hand_reaches_as_far_as_a_right_one(name: str, pushed_door: Asset) -> None:
    joints = pushed_door.reference.hand_joints[30]
    reached = []
    for side, mirror in (("right", 1), ("left", -1)):
        alone = make_hand(name, side)
        ik = Retargeting(alone.spec().compile(), side, tuple(alone.skeleton.tips))
        goal = joints * [mirror, 1, 1]
        tips = ik.tips(ik.start(goal, rounds=150))
        reached.append([np.linalg.norm(tips[f] - goal[TIPS[f]]) for f in tips])
    np.testing.assert_allclose(reached[0], reached[1], atol=2e-3)


@pytest.mark.parametrize("name", JOINTED)
def test_joints_stay_in_range_even_for_a_hand_nobody_has(name: str, pushed_door: Asset) -> None:
    ik = controller(name, pushed_door).retargeting
    rng = np.random.default_rng(0)
    q = ik.start(rng.normal(0, 0.5, (21, 3)))
    for _ in range(20):
        q = ik.step(q, rng.normal(0, 0.5, (21, 3)), 0.01)
        assert np.isfinite(q).all() and (q[7:] >= ik.low).all() and (q[7:] <= ik.high).all()
        assert np.linalg.norm(q[3:7]) == pytest.approx(1)


def test_a_step_without_solution_keeps_the_joints(pushed_door: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    import mink

    ik = controller("human", pushed_door).retargeting
    q = ik.start(pushed_door.reference.hand_joints[0])
    for answer in (None, np.full(26, np.nan)):
        monkeypatch.setattr(mink, "solve_ik", lambda *_, answer=answer, **__: answer)
        np.testing.assert_array_equal(ik.step(q, pushed_door.reference.hand_joints[5], 0.01), q)

    def fails(*_: object, **__: object) -> None:
        raise mink.NoSolutionFound("daqp")

    monkeypatch.setattr(mink, "solve_ik", fails)
    np.testing.assert_array_equal(ik.step(q, pushed_door.reference.hand_joints[5], 0.01), q)
    assert ik.unsolved == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", JOINTED)
def test_a_hand_with_joints_drives_a_door(name: str, pushed_door: Asset) -> None:
    result = replay(pushed_door, name)
    assert result.joint_progress >= 0.8 and result.contact_fraction > 0.8
    assert result.controls["no_hand"] < 1e-3 and result.controls["late_hand"] < 0.05
    run = result.trajectory
    assert run.driven >= 0.7 * abs(run.q[-1] - run.q[0])


@pytest.mark.parametrize("name", JOINTED)
def test_object_stays_passive_and_the_base_weak(name: str, pushed_door: Asset) -> None:
    scene = build_scene(pushed_door, name)
    model = scene.model
    assert model.neq == 0
    joint = model.joint("joint").id
    for i in range(model.nu):
        assert int(model.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_JOINT) or model.actuator_trnid[i, 0] != joint
    base = [model.actuator(f"hand_base_{a}").id for a in "xyz"]
    assert (model.actuator_forcerange[base] == [-BASE_FORCE, BASE_FORCE]).all()
    # What is only there to be seen does not touch.
    shell = [g for g in range(model.ngeom) if int(model.geom_group[g]) == 2 and model.geom(g).name == ""]
    assert not model.geom_conaffinity[shell].any()


def test_rollouts_of_a_hand_with_joints_are_replays(pushed_door: Asset) -> None:
    scene = build_scene(pushed_door, "human")
    z = np.zeros(len(NAMES))
    z[0] = 0.5
    paths = [Corrections.of(pushed_door).path(v) for v in (np.zeros(len(NAMES)), z)]
    for path, made in zip(paths, Rollouts(scene, n=2).run(paths), strict=True):
        np.testing.assert_allclose(made.q, simulate(scene, path).q, atol=1e-6)


def test_targets_are_in_the_simulations_state(pushed_door: Asset) -> None:
    """A controller that has just been made goes on where another one was."""
    scene = build_scene(pushed_door, "human")
    sim = Simulation(scene)
    path = HandPath(pushed_door.reference.time, pushed_door.reference.hand_joints)
    sim.reset(0.0, path.at(0.0))
    for i in range(4 * PERIOD):
        sim.step(path.at(0.002 * i))
    fresh = build_scene(pushed_door, "human").hand
    np.testing.assert_allclose(fresh.target(sim.data), scene.hand.target(sim.data), atol=1e-12)
    marks = scene.hand.landmarks(sim.data)
    wanted = path.at(sim.data.time)
    assert np.linalg.norm(marks - wanted, axis=1)[list(TIPS.values())].max() < 0.03


def test_environment_takes_a_hand_with_joints(pushed_door: Asset) -> None:
    gymnasium.register(id="TAA/jointed-trial", entry_point="taa_envs.env:ArticulationEnv",
                       kwargs={"asset": str(pushed_door.path)})
    with gymnasium.make("TAA/jointed-trial", hand="human") as env:
        observation, _ = env.reset(seed=0)
        assert env.observation_space.contains(observation)
        for _ in range(3):
            observation, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert env.observation_space.contains(observation) and np.isfinite(reward)


def test_unknown_hand_and_missing_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownHand, match="known: points, human, shadow, allegro, leap"):
        make_hand("claw")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(HandUnavailable, match="model leap_hand of the hand leap.*MENAGERIE_ROOT"):
        make_hand("leap")
    monkeypatch.delenv("MENAGERIE_ROOT")
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nowhere").as_uri())
    with pytest.raises(HandUnavailable, match="could not be fetched"):
        make_hand("shadow")
    (tmp_path / "leap_hand").mkdir()
    (tmp_path / "leap_hand" / "right_hand.xml").write_text("<mujoco><worldbody><body/></worldbody>")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(HandUnavailable, match="does not load"):
        make_hand("leap").spec()


def test_names_of_hands_are_all_made() -> None:
    for name in HANDS:
        assert make_hand(name).name == name
