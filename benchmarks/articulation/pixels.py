"""Rows 4 and 5: the benchmark's objects as pixels, and the tracks that the project's own tracker makes of them.

The procedural objects are painted, set before a papered wall, lit, rendered, and a hand that holds the link is rendered
with them; hand detection and point tracking see nothing but the pictures. What is true of a track is read off the
surface under the pixel in which it was seeded. In row 5 the camera is held in a hand, and the pictures are compensated
first, as the pipeline does.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from benchmarks.articulation.motions import FOCAL, RATE, SIZE, Shot, in_a_hand, pixel_rays, shoot
from benchmarks.articulation.noise import Given
from benchmarks.articulation.objects import Model
from benchmarks.articulation.scenes import Hidden, Scene, project, rng_of
from reconstruct.cues import Tracks
from reconstruct.joint.handheld import filmed
from reconstruct.motion import stabilise
from reconstruct.video import Video

if TYPE_CHECKING:
    from reconstruct.synth.hand_model import HandPose

TEXTURES = ("plain", "wood", "rich")
FRAMES = 48
DIAGONAL = 0.55
"""m, of the rendered object: everything is brought to a size that a hand can hold."""
WALL, WALL_FRONT = 1.1, 0.03
"""Of DIAGONAL, and m more, from the object's middle to the wall behind it."""
STRAY_PX = 3.0
APPROACHES = (0, 40, -40, 80, -80, 120, -120, 160, -160)
"""deg in the picture, of the direction that the hand comes from against that from below: the first that is free."""
FLESH = 0.01
"""m, that skin and sleeve give way."""
PALM_JOINTS = (0, 1, 2, 5, 6, 9, 10, 13, 14, 17, 18)


def film(model: Model, motion: str, texture: str, small: bool = False, seed: int = 0, frames: int = FRAMES,
         held: bool = False) -> Given:  # fmt: skip
    """Tracks of one rendered clip, as an estimator is given them, with the truth about each.

    Args:
        model: a procedural one (boxes only).  motion, small: as in the other rows.  texture: one of TEXTURES.
        held: the camera is held in a hand; all else is as before one at rest.

    Raises:
        Hidden: the hand or the object itself hides the link, or nothing was tracked.
    """
    from reconstruct.providers.lk_tracks import track_points
    from reconstruct.providers.mediapipe_hand import detect_hands

    rng = rng_of(seed, model.name, motion, texture, "small" if small else "full")
    shot = shoot(model, motion, False, small, frames, rng)
    if held:
        shot = in_a_hand(shot, _scale(model, shot), rng_of(seed, model.name, motion, texture, "in a hand"))
    images = pictures(model, shot, texture, rng)
    video = video_of(np.ascontiguousarray(images[..., ::-1]))
    if held:
        video = _stabilised(video)
    hands = detect_hands(video)
    tracks = track_points(video, hands)
    if not len(tracks.uv):
        raise Hidden(f"{model.name}: nothing was tracked")
    known = _known(model, motion, small, shot, tracks, video.warp)
    if (count := int(known.scene.moving.sum())) < 8:
        raise Hidden(f"{model.name}: {count} tracks were seeded on the moving link")
    return replace(known, row=5 if held else 4, hands=hands, slip=tracks.slip, shade=tracks.shade, cast=tracks.cast,
                   frames=video.frames)  # fmt: skip


def _stabilised(video: Video) -> Video:
    with TemporaryDirectory() as folder:
        stable, _ = stabilise(video, Path(folder))
        return replace(stable, frames=np.array(stable.frames))


def _to_wall(model: Model, shot: Shot, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(n,) distance along rays (n, 3) to the papered wall behind the object, in the model's unit."""
    normal = shot.T_world_camera[0, :3, 2]
    behind = _corners(model, shot).mean(0) + (WALL * DIAGONAL + WALL_FRONT) / _scale(model, shot) * normal
    return ((behind - eye) @ normal) / (rays @ normal)


def _corners(model: Model, shot: Shot) -> np.ndarray:
    """(n, 3) of the object's boxes at the first state."""
    q0 = float(shot.q[0])
    return np.concatenate([model.corners(q0, True), model.corners(q0, False)])


def _scale(model: Model, shot: Shot) -> float:
    """m per unit of the model, which is brought to DIAGONAL."""
    return DIAGONAL / float(np.linalg.norm(np.ptp(_corners(model, shot), axis=0)))


def video_of(frames: np.ndarray, warp: np.ndarray | None = None) -> Video:
    """A rendered clip's frames (T, h, w, 3) uint8 BGR as a video; warp: (T, 3, 3) where they are compensated."""
    T = len(frames)
    return Video(Path("rendered.mp4"), "0" * 64, SIZE, np.arange(T) / RATE, np.arange(T), T, frames, 1.0, warp=warp)


def with_tracks(given: Given, tracks: Tracks) -> Given:
    """The clip by other tracks of its pixels."""
    s = given.scene
    known = _known(s.model, s.motion, s.small, s.shot, tracks, given.warp)
    return replace(given, scene=known.scene, uv=known.uv, visible=known.visible, wrong=known.wrong, slip=tracks.slip,
                   shade=tracks.shade, cast=tracks.cast)  # fmt: skip


def _known(model: Model, motion: str, small: bool, shot: Shot, tracks: Tracks, warp: np.ndarray | None) -> Given:
    """Tracks with the surface point that each was seeded on; warp: of the pictures that they are tracks of."""
    visible, reference = tracks.visible, tracks.reference
    given_uv = np.where(visible[..., None], tracks.uv.astype(float), np.nan)
    uv = tracks.uv.astype(float) if warp is None else filmed(tracks.uv.astype(float), warp)
    N, T = visible.shape
    points, moving = np.zeros((N, 3)), np.zeros(N, bool)
    for f in np.unique(reference):
        rows = np.flatnonzero(reference == f)
        camera = shot.T_world_camera[f]
        rays = pixel_rays(uv[rows, f], shot.K, camera)
        distance, geom = model.cast(float(shot.q[f]), camera[:3, 3], rays)
        met = geom >= 0
        on = met & model.moving_geoms[geom]
        world = camera[:3, 3] + rays * np.where(met, distance, _to_wall(model, shot, camera[:3, 3], rays))[:, None]
        back = model.link_pose(float(shot.q[0]), float(shot.q[f]))
        world[on] = world[on] @ back[:3, :3].T + back[:3, 3]
        points[rows], moving[rows] = world, on
    world = np.repeat(points[:, None], T, axis=1)
    poses = model.link_pose(shot.q, float(shot.q[0]))
    world[moving] = np.einsum("tij,nj->nti", poses[:, :3, :3], points[moving]) + poses[:, :3, 3]
    true, depth = project(world, shot)
    both = np.concatenate([model.corners(float(shot.q[0]), True), model.corners(float(shot.q[0]), False)])
    scene = Scene(model, motion, False, small, shot, points, moving, reference, true, depth, visible,
                  float(np.linalg.norm(np.ptp(both, axis=0))), np.zeros(N))  # fmt: skip
    wrong = visible & (np.linalg.norm(np.nan_to_num(uv - true), axis=-1) > STRAY_PX)
    return Given(scene, 4, given_uv, visible, None, None, wrong, 0.0, 0.0, 0.0, warp=warp)


def pictures(model: Model, shot: Shot, texture: str, rng: np.random.Generator) -> np.ndarray:
    """(T, H, W, 3) uint8 RGB."""
    from scipy.spatial.transform import Rotation

    from reconstruct.synth import textures as tx
    from reconstruct.synth.animation import Motion
    from reconstruct.synth.hand_model import HandPose
    from reconstruct.synth.objects import Box
    from reconstruct.synth.objects import Model as Shown
    from reconstruct.synth.render import render
    from reconstruct.synth.staging import Clip

    q0, corners, scale = float(shot.q[0]), _corners(model, shot), _scale(model, shot)
    camera = shot.T_world_camera[0]
    # The lamps stand at low y: the whole scene is turned so that the camera does too.
    heading = np.arctan2(camera[1, 2], camera[0, 2])
    turn = Rotation.from_euler("z", np.pi / 2 - heading).as_matrix()
    there = lambda X: scale * np.asarray(X) @ turn.T  # noqa: E731
    boxes = []
    colours = {True: rng.uniform(0.35, 0.8, 3), False: rng.uniform(0.35, 0.8, 3)}
    model.pose(q0)
    for g in range(model.mj.ngeom):
        if int(model.mj.geom_type[g]) != int(mujoco.mjtGeom.mjGEOM_BOX):
            raise ValueError(f"{model.name}: rows 4 and 5 render boxes only")
        on = bool(model.moving_geoms[g])
        boxes.append(Box("moving" if on else "static", there(model._data.geom_xpos[g]),
                         2 * scale * model.mj.geom_size[g], _paint(texture, colours[on]),
                         turn @ model._data.geom_xmat[g].reshape(3, 3)))  # fmt: skip
    view = turn @ camera[:3, :3]  # camera to world
    eye, middle = there(camera[:3, 3]), there(corners.mean(0))
    wall = middle + WALL * DIAGONAL * view[:, 2]
    paper = tx.with_stickers(tx.plaster((0.80, 0.77, 0.70)), 30, 0.18)
    boxes.append(Box("room", wall + (WALL_FRONT + 0.02) * view[:, 2], np.array([4.0, 3.0, 0.04]), paper, view, 300.0))
    # A hand on the link's part that moves most, between the camera and the object: from below, or from where else the
    # arm goes through nothing.
    pose = HandPose()
    grip = _grip(model, shot, rng)
    poses = model.link_pose(shot.q, q0)
    link = np.tile(np.eye(4), (len(shot.q), 1, 1))
    link[:, :3, :3] = turn @ poses[:, :3, :3] @ turn.T
    link[:, :3, 3] = there(poses[:, :3, 3])
    touched = there(poses[:, :3, :3] @ grip + poses[:, :3, 3])
    held = [_hold(pose, touched, view @ Rotation.from_euler("z", a, degrees=True).as_matrix()) for a in APPROACHES]
    clear = [_clearance(pose, T, link, boxes) for T in held]
    hand = held[next((k for k, c in enumerate(clear) if c >= -FLESH), int(np.argmax(clear)))]
    T = len(shot.q)
    look = np.tile(np.eye(4), (T, 1, 1))
    look[:, :3, :3] = np.swapaxes(turn @ shot.T_world_camera[:, :3, :3], 1, 2)
    look[:, :3, 3] = -np.einsum("tij,tj->ti", look[:, :3, :3], there(shot.T_world_camera[:, :3, 3]))
    shown = Shown(tuple(boxes), None, None, None, 0.0, (0.0, 0.0))
    clip = Clip("row 4", "", shown, pose, "right", hand[0], np.zeros(3), np.zeros(3), eye, middle, FOCAL / SIZE[0])
    motion = Motion(np.arange(T) / RATE, shot.q, np.ones(T, bool), link, hand, look)
    return render(clip, motion, SIZE, int(rng.integers(1 << 30))).image


def _hold(pose: HandPose, touched: np.ndarray, view: np.ndarray) -> np.ndarray:
    """(T, 4, 4) of a hand whose middle finger's tip stays before the points ``touched`` (T, 3).

    Args:
        view: (3, 3) columns right, down and forward of the picture, turned by the direction that it comes from.
    """
    from reconstruct.synth.hand_model import landmarks

    fingers = view @ (np.array([-0.3, -0.7, 0.5]) / np.linalg.norm([-0.3, -0.7, 0.5]))
    palm = view[:, 2] - (view[:, 2] @ fingers) * fingers
    palm /= np.linalg.norm(palm)
    R = np.stack([np.cross(fingers, palm), fingers, palm], axis=1)
    out = np.tile(np.eye(4), (len(touched), 1, 1))
    out[:, :3, :3] = R
    out[:, :3, 3] = touched - R @ landmarks(pose)[12] - 0.012 * view[:, 2]
    return out


def _clearance(pose: HandPose, hand: np.ndarray, link: np.ndarray, boxes: list) -> float:
    """m, between the object and the palm, the fingers' first joints and the arm; negative where they go through it."""
    from reconstruct.synth.hand_model import forearm_direction, landmarks

    arm = np.linspace(0.02, pose.arm, 24)[:, None] * forearm_direction(pose)
    points = np.concatenate([landmarks(pose)[list(PALM_JOINTS)], arm])
    thick = np.r_[np.full(len(PALM_JOINTS), 0.008), np.full(len(arm), 0.03)]
    least = np.inf
    for T, moved in zip(hand[::4], link[::4], strict=True):
        X = points @ T[:3, :3].T + T[:3, 3]
        for box in boxes:
            if box.link == "room":
                continue
            x = (X - moved[:3, 3]) @ moved[:3, :3] if box.link == "moving" else X
            out = np.abs((x - box.centre) @ box.rotation) - np.asarray(box.size) / 2
            away = np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(1), 0)
            least = min(least, float((away - thick).min()))
    return least


def _paint(texture: str, colour: np.ndarray):
    from reconstruct.synth import textures as tx

    c = (float(colour[0]), float(colour[1]), float(colour[2]))
    if texture == "plain":
        return tx.paint(c, 0.03)
    return tx.wood(c, 0.2) if texture == "wood" else tx.with_stickers(tx.wood(c, 0.2), 5, 0.06)


def _grip(model: Model, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """(3,) a point of the link at frame 0 that is seen there and moves much."""
    u, v = np.meshgrid(np.arange(4, SIZE[0], 8.0), np.arange(4, SIZE[1], 8.0))
    camera = shot.T_world_camera[0]
    rays = pixel_rays(np.stack([u, v], axis=-1), shot.K, camera).reshape(-1, 3)
    distance, geom = model.cast(float(shot.q[0]), camera[:3, 3], rays)
    on = (geom >= 0) & model.moving_geoms[geom]
    if on.sum() < 5:
        raise Hidden(f"{model.name}: the moving link is not seen in the first frame")
    X = camera[:3, 3] + rays[on] * distance[on, None]
    far = model.link_pose(float(shot.q[np.argmax(np.abs(shot.q - shot.q[0]))]), float(shot.q[0]))
    moved = np.linalg.norm(X @ far[:3, :3].T + far[:3, 3] - X, axis=1)
    best = np.flatnonzero(moved >= np.quantile(moved, 0.8))
    return X[rng.choice(best)]
