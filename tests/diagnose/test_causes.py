"""Every cause's edit of the MJCF does in MuJoCo what the fit's own integrator assumes."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from diagnose.causes import CAUSES, PLACES, UNNAMED, backlash, free_torques
from diagnose.kernel import KNOTS
from diagnose.kernel import TERMS as KERNEL_TERMS
from diagnose.log import JointLog
from diagnose.plant import isolated, load_plant
from diagnose.simulate import Frame, mujoco_rollouts, prepare, readings, row_of, shown

XML = """<mujoco><compiler angle="{angle}"/><option timestep="0.001" integrator="implicitfast"/><worldbody>
<body pos="0 0 1"><joint name="j" type="hinge" axis="0 1 0.5" stiffness=".1" springref="{ref}" damping=".01"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.4" mass="1"/></body></worldbody></mujoco>"""
TERMS = [
    ("viscous_damping", dict(damping=0.05), 1e-3), ("quadratic_drag", dict(drag=0.03), 1e-3),
    ("coulomb_friction", dict(coulomb=0.1), 1e-3),
    ("stribeck_friction", dict(coulomb=0.05, stiction=0.1, stribeck_velocity=0.3), 0.05),
    ("spring", dict(stiffness=0.5, spring_torque=0.2), 1e-3), ("constant_torque", dict(torque=0.3), 1e-3),
    ("gravity_torque", dict(gravity_sin=0.3, gravity_cos=-0.2), 1e-3), ("inertia", dict(inertia=0.01), 1e-3),
    ("inertia", dict(inertia=-0.01), 1e-3),
    ("end_stop", dict(stop_place=0.5, stop_stiffness=30.0, stop_damping=0.1), 5e-3),
    ("detent", dict(detent_place=0.2, detent_strength=0.4, detent_width=0.1), 0.01),
]  # fmt: skip
FRAME = Frame((-1.0, 1.0), (-5.0, 5.0))


def episode(plant):
    t = np.arange(0, 3, 0.01)
    return prepare(plant, JointLog("a", t, np.sin(t), np.where(t < 1.0, 0.8, 0.0)), most=1e-3)


@pytest.mark.parametrize("angle, ref", [("radian", 0.2), ("degree", np.degrees(0.2))])
@pytest.mark.parametrize("name, terms, tolerance", TERMS)
def test_edit_agrees_with_the_fit(tmp_path, name, terms, tolerance, angle, ref):
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle=angle, ref=ref))
    plant = load_plant(path, "j")
    spec = mujoco.MjSpec.from_file(str(path))
    CAUSES[name].edit(spec, "j", terms, plant, FRAME)
    spec.compile()
    again = mujoco.MjSpec.from_string(spec.to_xml())  # what a user will load
    model = isolated(again, "j")
    assert model.nu == 0
    ep = episode(plant)
    start = np.array([0.1, 0.0])
    Q, V = mujoco_rollouts(model, ep, [start])
    real = shown(plant, FRAME, {}, Q[0], V[0], ep.t, model.opt.timestep)
    ours, nominal = readings(plant, FRAME, ep, np.stack([row_of(terms), row_of({})]), np.tile(start, (2, 1)))
    effect = np.abs(ours - nominal).max()
    assert effect > 0.02
    assert np.abs(real - ours).max() < max(tolerance, 2e-3)


def test_free_torques_are_plain_mjcf(tmp_path):
    """A torque over position and one over velocity, as knots, are what passive elements make of them."""
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle="radian", ref=0.2))
    plant = load_plant(path, "j")
    ep = episode(plant)
    start = np.array([0.1, 0.0])
    nominal = readings(plant, FRAME, ep, row_of({}), start)[0]
    frame = Frame((float(nominal.min()), float(nominal.max())), (-5.0, 5.0))
    over_q = 0.3 * np.cos(np.linspace(0, 4, KNOTS))
    spline = np.concatenate([over_q, -0.02 * np.linspace(*frame.v, KNOTS)])
    spec = mujoco.MjSpec.from_file(str(path))
    free_torques.edit(spec, "j", spline, plant, frame)
    model = isolated(mujoco.MjSpec.from_string(spec.to_xml()), "j")
    assert model.nu == 0
    Q, V = mujoco_rollouts(model, ep, [start])
    real = shown(plant, frame, {}, Q[0], V[0], ep.t, model.opt.timestep)
    ours = readings(plant, frame, ep, row_of({}), start, spline[None])[0]
    inside = np.maximum.accumulate((ours < frame.q[0]) | (ours > frame.q[1])) == 0
    assert inside.sum() > 50 and np.abs(ours - nominal)[inside].max() > 0.1
    assert np.abs(real - ours)[inside].max() < 0.1 * np.abs(ours - nominal)[inside].max()


def test_names_are_those_of_the_contract():
    contract = {"viscous_damping", "quadratic_drag", "coulomb_friction", "stribeck_friction", "spring",
                "constant_torque", "gravity_torque", "inertia", "backlash", "end_stop", "detent", "time_delay",
                "sensor_bias", "sensor_gain", "axis_misalignment", "pivot_offset", "second_joint"}  # fmt: skip
    assert {*CAUSES, *PLACES} - set(UNNAMED) == contract
    terms = [p.term for c in CAUSES.values() for p in c.parameters]
    assert set(terms) <= set(KERNEL_TERMS)


@pytest.mark.parametrize("kind", ["hinge", "slide"])
def test_a_pointer_with_play_is_plain_mjcf(tmp_path, kind):
    """The extended model's own sensor shows what the reading with play is taken to be."""
    path = tmp_path / "m.xml"
    path.write_text(f"""<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body pos="0 0 1">
        <joint name="j" type="{kind}" axis="0 1 0" stiffness="3" damping=".02"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.4" mass="1"/></body></worldbody></mujoco>""")
    plant = load_plant(path, "j")
    spec = mujoco.MjSpec.from_file(str(path))
    backlash.add_pointer(spec, "j", 0.1, plant)
    model = mujoco.MjModel.from_xml_string(spec.to_xml())
    assert model.nu == 0
    data = mujoco.MjData(model)
    data.qpos[0] = 0.8
    data.qpos[1] = -0.05  # at rest behind the part: it goes inwards first
    q, read = [], []
    for _ in range(3000):
        mujoco.mj_step1(model, data)
        q.append(data.qpos[0])
        read.append(data.sensordata[0])
        mujoco.mj_step2(model, data)
    q, read = np.array(q), np.array(read)
    want = np.empty_like(q)
    held = read[0]
    for k, x in enumerate(q):
        held = min(max(held, x - 0.05), x + 0.05)
        want[k] = held
    assert np.ptp(q) > 0.8 and np.abs(read - want).max() < 0.005
    plain = mujoco.MjModel.from_xml_path(str(path))
    other = mujoco.MjData(plain)
    other.qpos[0] = 0.8
    for _ in range(2999):
        mujoco.mj_step(plain, other)
    mujoco.mj_step1(plain, other)
    assert abs(other.qpos[0] - q[-1]) < 2e-3  # the part does not feel its pointer


def test_hand_force_is_a_torque_about_the_axis(tmp_path):
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle="radian", ref=0.2).replace("0 1 0.5", "0 0 1"))
    plant = load_plant(path, "j")
    t = np.arange(50) * 0.01
    force, point = np.tile([0.0, 2.0, 5.0], (50, 1)), np.tile([0.3, 0.1, 7.0], (50, 1))
    log = JointLog("f", t, 0 * t, force=force, point=point)
    assert plant.input_torque(log) == pytest.approx(np.full(50, 0.6))


def test_step_input_is_aligned_to_a_fraction_of_a_step(tmp_path):
    """A torque step between even samples gives a parabola from its own time on."""
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle="radian", ref=0.0).replace('stiffness=".1"', "").replace('damping=".01"', "")
                    .replace("0 1 0.5", "0 0 1"))  # fmt: skip
    plant = load_plant(path, "j")
    t = np.arange(0, 1, 0.01)
    log = JointLog("s", t, np.sin(t), np.where(t >= 0.3 - 1e-9, 0.01, 0.0))
    ep = prepare(plant, log)
    got = readings(plant, FRAME, ep, row_of({}), np.zeros(2))[0]
    exact = 0.5 * 0.01 / plant.inertia * np.maximum(t - 0.3, 0) ** 2
    assert np.abs(got - exact).max() < 1e-3 * exact.max()


def test_weight_swings_in_its_own_time_with_long_steps(tmp_path):
    """Fourth order for smooth torques: 5 ms steps keep the phase of a pendulum to the noise of a good encoder."""
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle="radian", ref=0.0).replace('stiffness=".1"', "").replace('damping=".01"', ""))
    plant = load_plant(path, "j")
    t = np.arange(0, 6, 0.01)
    log = JointLog("s", t, np.sin(t))
    start = np.array([1.0, 0.0])
    shapes = []
    for most in (5e-3, 2e-4):
        ep = prepare(plant, log, most)
        first = start.copy()
        first[1] = -0.5 * ep.step * plant.static(np.array([1.0]))[0] / plant.inertia  # half a step before
        shapes.append(readings(plant, FRAME, ep, row_of({}), first)[0])
    assert np.abs(shapes[0] - shapes[1]).max() < 2e-4


def test_reading_with_play_stands_still_at_a_reversal(tmp_path):
    path = tmp_path / "m.xml"
    path.write_text(XML.format(angle="radian", ref=0.0))
    plant = load_plant(path, "j")
    t = np.arange(0, 3, 0.01)
    ep = prepare(plant, JointLog("s", t, np.sin(t)))
    rows = np.stack([row_of({}), row_of({"play": 0.1})])
    true, read = readings(plant, FRAME, ep, rows, np.tile([0.8, 0.0], (2, 1)))
    assert np.abs(read - true).max() == pytest.approx(0.05, abs=1e-6)
    moving = np.abs(np.diff(true)) > 2e-3
    assert (np.diff(read)[moving] == 0).any() and np.ptp(read) < np.ptp(true)
