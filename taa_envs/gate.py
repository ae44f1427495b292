"""What every asset passes before it is written: does the body behave, and does it survive leaving home.

Four questions, each asked of the model as it stands on disk, none of them costly:

- **compiles**: MuJoCo builds it, alone and in the environment's scene.
- **sweep**: over the joint's range, with the exclusion between the links lifted, MuJoCo finds no contact between them;
  and a generalized force that just beats the joint's friction carries the link from either stop to the other.
- **settles**: let go from random states, the link comes to rest within half a minute and stays, its energy never grows.
- **exports**: the folder copied elsewhere, and its URDF, load again with the same joint, axis, limits and mass.
"""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.errors import AssetError

if TYPE_CHECKING:
    import mujoco

    from taa_envs.asset import Asset

SWEEP_STATES = 81
SETTLE_SECONDS = 30.0
SETTLE_STATES = 8
DRIFT_SHARE = 1e-3
"""Of the range: what a link at rest may creep in the last third of the half minute."""
ENERGY_SLACK = 1e-3
"""Of the first energy: what integration may add without being growth."""
PENETRATION = 1e-5
"""m: MuJoCo reports touching faces with the sign of rounding."""


@dataclass(frozen=True)
class Findings:
    """What the gate found; ``asset.json`` carries it under "gate".

    Attributes:
        passed: nothing is wrong.
        failures: one line each: what is wrong; what to do.
        sweep_states, contacts, penetration_m: states looked at, contacts between the links in them, the deepest.
        swept: share of the range that a force just above the joint's friction carries the link over.
        settle_seconds: (8,) s until each random state rests, None where it does not.
        drift: largest creep of a resting link in the last third, as a share of the range.
        energy_growth: largest rise above the first energy, as a share of it.
        exports: formats that came back unchanged.
    """

    passed: bool
    failures: tuple[str, ...]
    sweep_states: int
    contacts: int
    penetration_m: float
    swept: float
    settle_seconds: tuple[float | None, ...]
    drift: float
    energy_growth: float
    exports: tuple[str, ...]

    def as_dict(self) -> dict:
        """JSON-ready."""
        return asdict(self)


def examine(asset: Asset, seed: int = 0) -> Findings:
    """All questions, asked of an asset folder (about a second).

    Args:
        asset: loaded from the folder that is to be judged.
        seed: of the random states.
    """
    check_compiles(asset)
    failures: list[str] = []
    contacts, depth = sweep_contacts(asset)
    if contacts:
        failures.append(f"the links overlap by up to {1e3 * depth:.1f} mm in {contacts} contacts over the joint's "
                        "range; cut the static link's parts back or narrow the range")
    swept = sweep_by_force(asset)
    if swept < 0.999:
        failures.append(f"a force just above friction moves the joint over {swept:.0%} of its range; clear what holds "
                        "it")
    times, drift, growth = settle(asset, seed)
    if any(t is None for t in times):
        failures.append(f"{sum(t is None for t in times)} of {len(times)} random states do not come to rest in "
                        f"{SETTLE_SECONDS:.0f} s; give the joint damping or friction")
    if drift > DRIFT_SHARE:
        failures.append(f"at rest the link creeps over {drift:.2%} of its range in 10 s; give the joint more friction")
    if growth > ENERGY_SLACK:
        failures.append(f"energy grows by {growth:.1%} while nothing acts; check masses, inertia and limits")
    exports, words = round_trips(asset)
    failures += words
    return Findings(not failures, tuple(failures), SWEEP_STATES, contacts, depth, swept, times, drift, growth, exports)


def check_compiles(asset: Asset) -> None:
    """Build the model alone and in the environment's scene.

    Raises:
        AssetError: one of the two does not compile.
    """
    import mujoco

    from taa_envs.scene import build_scene

    try:
        build_scene(asset)
        mujoco.MjModel.from_xml_path(str(asset.model_path))
    except ValueError as error:
        raise AssetError(f"the model does not compile: {str(error)[:200]}; check its meshes and masses") from None


def _meeting_model(asset: Asset) -> mujoco.MjModel:
    """The model with the links free to collide with each other."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(asset.model_path))
    for pair in list(spec.excludes):
        spec.delete(pair)
    return spec.compile()


def sweep_contacts(asset: Asset, states: int = SWEEP_STATES) -> tuple[int, float]:
    """Contacts between the links over the joint's range, and the deepest penetration, m."""
    import mujoco

    from taa_envs.scene import follow_screws

    model = _meeting_model(asset)
    data = mujoco.MjData(model)
    count, depth = 0, 0.0
    free = np.flatnonzero(model.jnt_limited)
    for joint in free:
        # Each joint alone with the others at rest, and with each of the others at its stops.
        beside = [None, *((k, end) for k in free if k != joint for end in model.jnt_range[k])]
        for other in beside:
            for q in np.linspace(*model.jnt_range[joint], states):
                data.qpos[:] = 0.0
                data.qpos[joint] = q
                if other is not None:
                    data.qpos[other[0]] = other[1]
                follow_screws(model, data.qpos)
                mujoco.mj_fwdPosition(model, data)
                deep = -np.asarray(data.contact.dist[:data.ncon])
                deep = deep[deep > PENETRATION]
                count += len(deep)
                depth = max(depth, float(deep.max(initial=0.0)))
    return count, depth


def sweep_by_force(asset: Asset) -> float:
    """Share of the range that a generalized force 1.5 times the friction, and damping at a slow pace, can cover.

    Pushed from each stop to the other with the links free to collide; the least of all joints and ways is returned.
    """
    model = _meeting_model(asset)
    return min(_pushed(model, int(joint)) for joint in np.flatnonzero(model.jnt_limited))


def _pushed(model: mujoco.MjModel, joint: int) -> float:
    import mujoco

    from taa_envs.scene import follow_screws

    low, high = model.jnt_range[joint]
    seconds = 8.0
    pace = 2.0 * (high - low) / seconds
    data = mujoco.MjData(model)
    covered = 1.0
    full = np.zeros((model.nv, model.nv))
    for start, sign in ((low, 1.0), (high, -1.0)):
        mujoco.mj_resetData(model, data)
        data.qpos[joint] = start
        follow_screws(model, data.qpos)
        mujoco.mj_forward(model, data)
        # Gravity is what the joint carries besides friction where the link is not balanced.
        held = float(np.abs(data.qfrc_bias[joint] - data.qfrc_gravcomp[joint]))
        mujoco.mj_fullM(model, data, full)
        # With a screw's advance: what moves when this joint moves by one.
        along = np.zeros(model.nv)
        along[joint] = 1.0
        follow_screws(model, along)
        inertia = float(along @ full @ along)
        force = (1.5 * model.dof_frictionloss[joint] + np.ravel(model.dof_damping[joint])[0] * pace
                 + 2.0 * inertia * pace + 2.0 * held)
        data.qfrc_applied[joint] = sign * force
        best = 0.0
        for _ in range(int(seconds / model.opt.timestep)):
            mujoco.mj_step(model, data)
            best = max(best, sign * (data.qpos[joint] - start) / (high - low))
            if best >= 0.999:
                break
        covered = min(covered, best)
    return float(covered)


def settle(asset: Asset, seed: int = 0) -> tuple[tuple[float | None, ...], float, float]:
    """Let go from random states; half of them at rest, half moving at up to one range a second.

    Returns:
        Seconds until each rests (None: never), the largest drift in the last third and the largest energy growth,
        as shares (see :class:`Findings`).
    """
    import mujoco
    from mujoco import rollout

    from taa_envs.scene import follow_screws

    spec = mujoco.MjSpec.from_file(str(asset.model_path))
    spec.add_sensor(name="potential", type=mujoco.mjtSensor.mjSENS_E_POTENTIAL)
    spec.add_sensor(name="kinetic", type=mujoco.mjtSensor.mjSENS_E_KINETIC)
    model = spec.compile()
    free = np.flatnonzero(model.jnt_limited)  # all but the slides that follow screws
    low, span = model.jnt_range[free, 0], np.ptp(model.jnt_range[free], axis=1)
    rng = np.random.default_rng(seed)
    # time, q, velocity: MuJoCo's full physics state of a model that has nothing but hinges and slides
    first = np.zeros((SETTLE_STATES, 1 + 2 * model.njnt))
    q, velocity = first[:, 1:1 + model.njnt], first[:, 1 + model.njnt:]
    q[:, free] = low + span * rng.uniform(size=(SETTLE_STATES, len(free)))
    velocity[1::2, free] = span * rng.uniform(-1, 1, (SETTLE_STATES // 2, len(free)))
    follow_screws(model, q)
    follow_screws(model, velocity)
    steps = int(SETTLE_SECONDS / model.opt.timestep)
    states, energies = rollout.rollout(model, mujoco.MjData(model), first, nstep=steps)
    if not (np.isfinite(states).all() and np.isfinite(energies).all()):
        return (None,) * SETTLE_STATES, float("inf"), float("inf")
    late = steps * 2 // 3
    moving = (np.abs(states[:, :, 1 + model.njnt + free]) > DRIFT_SHARE * span).any(-1)
    last = np.where(moving.any(1), steps - moving[:, ::-1].argmax(1), 0)
    times = tuple(round(float(i * model.opt.timestep), 3) if i < late else None for i in last)
    drift = float((np.ptp(states[:, late:, 1 + free], axis=1) / span).max())
    # MuJoCo's potential energy is gravity's; gravcomp carries its share of it.
    carried = 1.0 - float(model.body_gravcomp[model.jnt_bodyid[0]])
    energy = energies[:, :, 1] + carried * energies[:, :, 0]
    # A stationary start has no energy of its own to compare with: what a slow motion over the range has, serves.
    slow = float(np.min(0.5 / model.dof_invweight0[free] * (0.1 * span) ** 2))
    start = energy[:, :1]
    growth = float(((energy - start) / np.maximum(np.abs(energies[:, :1, 1]), slow)).max())
    return times, drift, max(growth, 0.0)


def round_trips(asset: Asset) -> tuple[tuple[str, ...], list[str]]:
    """Formats that came back with the same joint, axis, limits and mass; and what is wrong with the others.

    A format that cannot hold the object's joints is in neither.
    """
    from taa_envs.exports import cannot_hold, export_asset
    from taa_envs.exports.check import check_export

    good, words = [], []
    for kind in ("mjcf", "urdf"):
        if cannot_hold(asset, kind):
            continue
        with tempfile.TemporaryDirectory(prefix="taa-gate-") as folder:
            target = export_asset(asset, kind, Path(folder) / kind)
            wrong = check_export(asset, kind, target)
        if wrong:
            words.append(f"the {kind.upper()} export comes back changed: {wrong[0]}; report this as a bug")
        else:
            good.append(kind)
    return tuple(good), words
