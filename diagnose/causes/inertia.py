"""The part is heavier, or lighter, to turn than modelled."""

import mujoco

from diagnose.causes.base import Cause, Parameter, add_constant, add_wave


def edit(spec, joint, terms, plant, frame):
    added = terms["inertia"]
    j = spec.joint(joint)
    if added >= 0:
        j.armature = float(j.armature) + added
        return
    spared = min(float(j.armature), -added)
    j.armature = float(j.armature) - spared
    ratio = 1.0 + (added + spared) / (plant.inertia - spared)
    # Scale what moves about the axis, then give back the weight that this took away.
    model = spec.compile()
    todo = [j.parent]
    while todo:
        body = todo.pop()
        todo += list(body.bodies)
        b = model.body(body.name) if body.name else model.body(body.id)
        mass = float(b.mass[0])
        if mass == 0:
            continue
        body.mass, body.ipos, body.iquat = mass * ratio, b.ipos, b.iquat
        body.inertia = b.inertia * ratio
        body.fullinertia = [float("nan")] * 6
        body.explicitinertial = True
    spec.compiler.inertiafromgeom = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO)
    sine, cosine, constant = ((1.0 - ratio) * g for g in plant.gravity)
    if plant.hinge:
        add_wave(spec, joint, f"{joint}_weight", sine, cosine, 1.0)
    elif constant:
        add_constant(spec, joint, plant, frame, constant)


CAUSE = Cause(
    "inertia", "More, or less, to accelerate than the model has; gravity's torque stays.",
    (Parameter("inertia", "added_inertia", "{i}", lambda m: (-0.9 * m.plant.inertia, 30 * m.plant.inertia),
               lambda m: 0.3 * m.plant.inertia, "a mass known to 10 % gives an inertia known to 20 %"),),
    ("inertia",), features=lambda m, _: {"inertia": m.a}, edit=edit,
    experiment="push with a known torque (or hang a known mass on it): free motion gives only ratios to the inertia",
)  # fmt: skip
