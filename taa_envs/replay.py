"""Open-loop replay: the demonstrated hand, on its actuators, against the passive joint; and its negative controls.

The hand's targets follow the reference; nobody looks at the object and nobody writes its state. Scores are those of the
contract, at the end of the replay:

``joint_progress``      clip((q - q_start) / (q_demo_end - q_start), 0, 1)
``final_q_error``       |q - q_demo_end| / (max q_demo - min q_demo)
``max_progress``        the largest progress on the way
``contact_fraction``    of the reference's ``contact`` frames up to the demonstration's end, the fraction during which
                        (from that frame to the next) the hand pushed on the moving link; 0 where the reference has none
``max_penetration_m``   deepest overlap of hand and moving link
``wrong_way``           largest motion against the demonstration's direction, as a fraction of its stroke
``controls``            ``joint_progress`` of three replays that must not succeed: without a hand, with
                        a mirrored one, with a late one; see :mod:`taa_envs.controls`
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from taa_envs.asset import Asset
from taa_envs.controls import CONTROLS, HOLD, control_path
from taa_envs.hands import Hand, make_hand
from taa_envs.hands.rig import JointedController
from taa_envs.scene import Scene, build_scene
from taa_envs.simulation import Diverged, HandPath, Simulation, Step


@dataclass(frozen=True)
class Trajectory:
    """One replay, sampled at the reference's frames up to the demonstration's end and once more after the hold.

    A sample is the state of the first simulation step at or after its frame's time, at most a timestep later.

    Attributes:
        time: (N,) s of the reference.  q: (N,) simulated.  q_demo: (N,) demonstrated.
        contact: (N,) bool, whether the hand pushed on the link between this frame and the next.
        penetration: (N,) m, deepest in that time.
        qpos: (N, nq) full state, for rendering.
        joints: (N, 21, 3) m, where the hand's targets were.
        driven: change of q made while contact did work, rad or m.
    """

    time: np.ndarray
    q: np.ndarray
    q_demo: np.ndarray
    contact: np.ndarray
    penetration: np.ndarray
    qpos: np.ndarray
    joints: np.ndarray
    driven: float
    q_extremes: tuple[float, float]


@dataclass(frozen=True)
class ReplayResult:
    """Scores of a replay, the fields of the contract; trajectory and notes beside them."""

    joint_progress: float
    final_q_error: float
    max_progress: float
    contact_fraction: float
    max_penetration_m: float
    wrong_way: float
    controls: dict[str, float]
    trajectory: Trajectory = field(repr=False)
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict:
        """The contract's object, JSON-ready."""
        return {"joint_progress": self.joint_progress, "final_q_error": self.final_q_error,
                "max_progress": self.max_progress, "contact_fraction": self.contact_fraction,
                "max_penetration_m": self.max_penetration_m, "wrong_way": self.wrong_way,
                "controls": dict(self.controls)}


def simulate(scene: Scene, path: HandPath | None) -> Trajectory:
    """Run the hand along path from the reference's first frame to the demonstration's end plus :data:`HOLD`.

    Raises:
        Diverged: the simulation became unstable.
    """
    asset, reference = scene.asset, scene.asset.reference
    end = asset.demo["demo_end_frame"]
    start = float(reference.time[0])
    stop = asset.end_time + HOLD
    sim = Simulation(scene)
    lead = scene.hand.lead if scene.hand is not None else 0.0
    sim.reset(asset.demo["q_start"], path.at(start) if path is not None else np.zeros((21, 3)))
    steps = int(np.ceil((stop - start) / scene.model.opt.timestep))
    edges = np.append(reference.time[:end + 1], stop)
    rows: list[tuple] = []
    window, driven, frame = Step(), 0.0, 0
    least = most = sim.q

    def sample(t: float, k: int) -> tuple:
        joints = path.at(t) if path is not None else np.full((21, 3), np.nan)
        return t, sim.q, reference.q[min(k, end)], sim.data.qpos.copy(), joints

    opened = sample(start, 0)
    for i in range(steps):
        t = start + i * scene.model.opt.timestep
        while t >= edges[frame + 1] and frame < end:
            rows.append((*opened, window.contact, window.penetration))
            frame += 1
            window, opened = Step(), sample(float(reference.time[frame]), frame)
        window.add(step := sim.step(path.at(t + lead) if path is not None else None))
        driven += step.driven
        least, most = min(least, sim.q), max(most, sim.q)
    rows.append((*opened, window.contact, window.penetration))
    rows.append((*sample(stop, end), step.contact, step.penetration))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Trajectory(time=columns[0], q=columns[1], q_demo=columns[2], qpos=columns[3], joints=columns[4],
                      contact=columns[5], penetration=columns[6], driven=driven, q_extremes=(least, most))


def replay(asset: Asset, hand: str | Hand = "points", *, controls: bool = True, touch_static: bool = False
           ) -> ReplayResult:
    """Replay the demonstration and its controls through contact.

    Args:
        asset: as loaded.
        hand: name of a hand, or a hand.
        controls: whether to run the three controls too (three more replays); their dict is empty otherwise.
        touch_static: see :mod:`taa_envs.scene`.

    Raises:
        AssetError, UnknownHand: the scene cannot be built.
        Diverged: the simulation became unstable.
    """
    reference = asset.reference
    scene = build_scene(asset, hand, touch_static=touch_static)
    run = simulate(scene, HandPath(reference.time, reference.hand_joints))
    notes = []
    end = asset.demo["demo_end_frame"]
    if end < len(reference.time) - 1:
        notes.append(f"the demonstration comes back; replayed and scored up to frame {end}, the end of its main stroke")
    wanted = reference.contact[:end + 1]
    if not wanted.any():
        notes.append("the reference marks no frame as driven by the hand; contact_fraction is 0 for want of any")
    progress = {}
    for name in CONTROLS if controls else ():
        control_scene = build_scene(asset, None) if name == "no_hand" else scene
        if name == "mirrored_hand" and isinstance(scene.hand, JointedController):
            # In a mirror a right hand is a left one, and only a left one can do what it does there.
            other = "left" if scene.hand.hand.skeleton.side == "right" else "right"
            control_scene = build_scene(asset, make_hand(scene.hand.hand.name, other), touch_static=touch_static)
        progress[name] = float(asset.progress(simulate(control_scene, control_path(control_scene, name)).q[-1]))
    fractions = asset.stroke_fraction(np.array(run.q_extremes))
    return ReplayResult(
        joint_progress=float(asset.progress(run.q[-1])), final_q_error=asset.final_q_error(run.q[-1]),
        max_progress=float(np.clip(fractions.max(), 0, 1)),
        contact_fraction=float(run.contact[:end + 1][wanted].mean()) if wanted.any() else 0.0,
        max_penetration_m=float(run.penetration.max()), wrong_way=float(max(0.0, -fractions.min())),
        controls=progress, trajectory=run, notes=tuple(notes))


def render_frames(asset: Asset, trajectory: Trajectory, *, hand: str | Hand | None = "points",
                  camera: str | None = None, width: int | None = None, height: int = 480) -> Iterator[np.ndarray]:
    """Pictures of a replay, one a sample of its trajectory, so that frame i goes beside the video's frame i.

    Args:
        camera: "video", "overview" or None for video where the asset has one.
        width: px; default keeps the camera's aspect (4:3 for the overview).

    Yields:
        (height, width, 3) uint8 RGB. Width and height are made even, as video encoders want them.
    """
    import mujoco

    scene = build_scene(asset, hand)
    if camera is None:
        camera = "video" if asset.camera is not None else "overview"
    aspect = asset.camera["width"] / asset.camera["height"] if camera == "video" and asset.camera else 4 / 3
    width = int(round(height * aspect)) if width is None else width
    width, height = width + width % 2, height + height % 2
    data = mujoco.MjData(scene.model)
    with mujoco.Renderer(scene.model, height=height, width=width) as renderer:
        for qpos in trajectory.qpos:
            data.qpos[:] = qpos
            mujoco.mj_forward(scene.model, data)
            renderer.update_scene(data, camera=camera)
            yield renderer.render().copy()


__all__ = ["CONTROLS", "Diverged", "ReplayResult", "Trajectory", "render_frames", "replay", "simulate"]
