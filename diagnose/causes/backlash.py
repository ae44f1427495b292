"""Lost motion between the part and what is read: a gear, a loose coupling, a handle on a worn pin."""

import mujoco
import numpy as np

from diagnose.causes.base import Cause, Parameter, angle

LIGHT = 1e-6  # inertia of the pointer over the part's


def add_pointer(spec, joint, play, plant):
    """A pointer that the part carries along with play, as plain MJCF; its reading is the tendon ``<joint>_reading``.

    Dry friction acts on the sum of both joints, that is on the pointer's absolute position: it stays where it is until
    an end of the play pushes it. The pointer is so light that the part does not feel it. A fault of the reading only:
    the motion of the part is what it was.
    """
    first = spec.joint(joint)
    pointer = first.parent.add_body(name=f"{joint}_pointer")
    small = LIGHT * plant.inertia
    pointer.mass, pointer.inertia, pointer.explicitinertial = small, [small] * 3, True
    pointer.ipos = first.pos  # its centre of mass is on the axis: no weight turns it
    mine = pointer.add_joint(name=f"{joint}_play", type=first.type, axis=first.axis, pos=first.pos)
    half = angle(spec, plant, 0.5 * play)
    mine.range, mine.limited = [-half, half], 1
    mine.solref_limit, mine.solimp_limit = [2 * plant.timestep, 1.0], [0.99, 0.999, 0.001, 0.5, 2.0]
    if not plant.hinge:
        pointer.gravcomp = 1.0
    tendon = spec.add_tendon(name=f"{joint}_reading", frictionloss=100 * small)
    tendon.wrap_joint(joint, 1.0)
    tendon.wrap_joint(f"{joint}_play", 1.0)
    tendon.solref_friction, tendon.solimp_friction = [2 * plant.timestep, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]
    spec.add_sensor(name=f"{joint}_reading", type=mujoco.mjtSensor.mjSENS_TENDONPOS,
                    objtype=mujoco.mjtObj.mjOBJ_TENDON, objname=f"{joint}_reading")  # fmt: skip

CAUSE = Cause(
    "backlash", "At each reversal the reading stands still until the part has crossed the play.",
    (Parameter("play", "play", "{q}", lambda m: (0.0, 0.5 * m.span), lambda m: 0.02 * m.span,
               "gears 0.002 to 0.05 rad"),), ("play",),
    measurement=True, reading=lambda m, _: {"play": -0.5 * np.sign(m.v)},
    experiment="move it to and fro by hand and log the position of the part itself as well",
)  # fmt: skip
