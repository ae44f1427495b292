"""The joint from whole faces: what is found in rendered plates of faint paint, and what is left alone."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruct.cues import ProviderInfo, Tracks
from reconstruct.joint.faces import WORTH_DEG, belonging, by_faces
from reconstruct.joint.finish import Finished
from reconstruct.joint.fit import fit_joint
from reconstruct.joint.photometric import Adjustment, Pictures, Reader, Surface, spread_of
from reconstruct.joint.polish import Bundle, Sightings, polish
from reconstruct.joint.twist import Twist
from reconstruct.joint.uncertainty import spread
from reconstruct.joint.view import View
from reconstruct.video import Video

W, H, FOCAL, T = 320, 240, 300.0, 30
CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])
FRAME = T // 4
SIDE = 0.4
"""Of the plate, which is 1 away."""
NOISE = 1.8
"""Grey values of sensor noise."""


@dataclass(frozen=True)
class Plate:
    """A painted plate that turns about one of its edges before a painted wall, and the truth."""

    pictures: Pictures
    axis: np.ndarray
    point: np.ndarray
    q: np.ndarray
    normal: np.ndarray
    across: tuple[np.ndarray, np.ndarray]

    def pose(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation about the point, and the plate's middle."""
        R = Rotation.from_rotvec(self.q[t] * self.axis).as_matrix()
        return R, R @ (np.array([0, 0, 1.0]) - self.point) + self.point

    def surface(self, off_deg: float = 0.0) -> Surface:
        """The truth, or the same with the axis turned in the plate and what moves in the middle kept."""
        axis = Rotation.from_rotvec(np.radians(off_deg) * self.normal).as_matrix() @ self.axis
        middle = np.array([0, 0, 1.0])
        velocity = np.cross(self.axis, middle - self.point)
        speed = float(np.linalg.norm(velocity))
        d = velocity / speed
        w = (axis - (axis @ d) * d) / speed
        R, there = self.pose(FRAME)
        n = R @ self.normal
        a, b, c = n[2] / (n @ there), n[0] / (n @ there), n[1] / (n @ there)
        return Surface("revolute", Twist(middle, d, w), self.q * speed, 0.0, np.array([[a, b, c]]), FRAME)

    def on(self, t: int) -> np.ndarray:
        """(H, W) bool, pixels that show the plate."""
        x, y = _places(self, t)
        return (np.abs(x) < SIDE / 2) & (np.abs(y) < SIDE / 2)


def _places(plate: Plate, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Where on the plate every pixel's ray meets it."""
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    rays = np.stack([(u - CENTRE[0]) / FOCAL, (v - CENTRE[1]) / FOCAL, np.ones_like(u)], axis=-1)
    R, there = plate.pose(t)
    n = R @ plate.normal
    X = rays * ((n @ there) / (rays @ n))[..., None]
    back = (X - plate.point) @ R + plate.point - np.array([0, 0, 1.0])
    return back @ plate.across[0], back @ plate.across[1]


def paint(rng: np.random.Generator, size: int, fine: float, soft: float) -> np.ndarray:
    """(size, size) grey values: grain of some pixels and broad blotches, by their standard deviations."""
    out = np.zeros((size, size), np.float32)
    for width, level in ((2.0, fine), (14.0, soft)):
        g = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), width)
        out += level * g / g.std()
    return out


def film(seed: int, turn_deg: float = 10.0, fine: float = 3.0, light: float = 0.3) -> Plate:
    """A plate that goes out and back, lit from the side: it darkens, loses contrast, and more so at one end."""
    rng = np.random.default_rng(seed)
    n = np.append(0.5 * rng.normal(size=2), -1.0)
    n /= np.linalg.norm(n)
    u = np.cross(n, [0, 1.0, 0])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    q = np.radians(turn_deg) * np.sin(np.linspace(0, np.pi, T)) ** 2
    plate = Plate(None, u, -SIDE / 2 * v + [0, 0, 1.0], q, n, (u, v))
    density = 900.0
    face, wall = paint(rng, round(1.2 * SIDE * density), fine, 4.0), 170 + paint(rng, 700, 2.0, 4.0)[:H, :W]
    frames = []
    for t in range(T):
        x, y = _places(plate, t)
        at = [(k * density + len(face) / 2).astype(np.float32) for k in (x, y)]
        dim = 1 - light * q[t] * (1 + x / SIDE)
        shown = 120 * dim + (1 - light * q[t]) * cv2.remap(face, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        image = np.where(plate.on(t), shown, wall) + rng.normal(scale=NOISE, size=(H, W))
        frames.append(np.clip(image + 0.5, 0, 255).astype(np.uint8))
    return replace(plate, pictures=Pictures(np.stack(frames), np.zeros((T, H, W), bool), CENTRE))


def off_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b))))


def adjustment(plate: Plate, count: int = 3000, focal: float = FOCAL, focal_std: float = 0.0) -> Adjustment:
    """Of pixels well within the plate."""
    inner = cv2.erode(plate.on(FRAME).astype(np.uint8), np.ones((9, 9), np.uint8))
    y, x = np.nonzero(inner)
    pick = np.random.default_rng(0).permutation(len(x))[:count]
    xy = np.stack([x, y], axis=1)[pick] - CENTRE
    reader = Reader(plate.pictures, np.arange(T), focal)
    return Adjustment(reader, xy, np.zeros(len(xy), int), len(xy) / len(x), focal_std, np.full(T, 0.1))


@pytest.mark.slow
def test_faint_paint_holds_an_axis_within_what_is_stated():
    off, stated = [], []
    for seed in range(6):
        plate = film(seed)
        a = adjustment(plate)
        s, noise = a.solve(plate.surface(off_deg=12.0))
        assert noise < NOISE / 2  # smoothed
        off.append(off_deg(s.twist.axis, plate.axis))
        stated.append(spread_of(a, s).axis_deg)
    assert max(off) < 2.0
    z = np.array(off) / stated
    # Twice of what noise explains is stated (MODEL), and these plates are plane.
    assert np.all(z < 1.96) and np.sqrt(np.mean(z**2)) > 0.15


def test_an_unknown_focal_length_is_stated_no_wider_than_it_was_known_to_be():
    plate = film(1)
    a = adjustment(plate, focal=1.08 * FOCAL, focal_std=0.12)
    s, _ = a.solve(plate.surface())
    stated = spread_of(a, s)
    assert 0.01 < stated.log_focal <= 0.121
    assert abs(np.log(1.08) + s.log_focal) < 1.96 * 0.12
    assert off_deg(s.twist.axis, plate.axis) < 1.96 * stated.axis_deg


def test_what_light_does_to_a_face_is_no_motion():
    """With the truth as the start, a plate that darkens, loses contrast and does so unevenly stays where it is."""
    plate = film(1, light=1.5)
    a = adjustment(plate)
    s, _ = a.solve(plate.surface())
    rate = float(np.linalg.norm(s.twist.curvature))
    assert np.degrees(np.abs((s.q - s.q[0]) * rate - plate.q)).max() < 0.5
    assert off_deg(s.twist.axis, plate.axis) < 2.0


def test_the_plate_is_found_and_the_wall_that_it_covers_is_not():
    plate = film(2)
    reader = Reader(plate.pictures, np.arange(T), FOCAL)
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    grid = np.stack([u, v], axis=-1) - CENTRE
    face = belonging(plate.surface(), reader, grid, np.ones((H, W), bool))
    on = plate.on(FRAME)
    assert np.mean(on[face == 0]) > 0.97
    # Near the hinge it hardly moves, and is not asked.
    far = on & (np.linalg.norm(_went(plate), axis=-1) > 3)
    assert np.mean(face[far] == 0) > 0.7


def _went(plate: Plate) -> np.ndarray:
    s = plate.surface()
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    xy = np.stack([u, v], axis=-1).reshape(-1, 2) - CENTRE
    reader = Reader(plate.pictures, np.array([0, FRAME, T // 2]), FOCAL)
    few = replace(s, q=s.q[[0, FRAME, T // 2]], frame=1)
    at = reader.places(few, xy, np.maximum(s.inverse_depths(xy, np.zeros(len(xy), int), FOCAL), 0.1))
    return (at[2] - at[0]).reshape(H, W, 2)


def by_tracks(plate: Plate, seed: int) -> Finished:
    """A joint of tracks that err alike all over the plate, as windows on even paint do, by half a px at the most.

    Neither their covariance nor halves of them show it; what is stated is what it comes to in the end.
    """
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.45, 0.45, (2, 90)) * SIDE
    X = x[:, None] * plate.across[0] + y[:, None] * plate.across[1] + [0, 0, 1.0]
    world = np.stack([(X - plate.point) @ plate.pose(t)[0].T + plate.point for t in range(T)], axis=1)
    uv = FOCAL * world[..., :2] / world[..., 2:]
    shear = rng.normal(size=(2, 2)) / 60
    uv += 0.5 * (plate.q / plate.q.max())[:, None] * (uv[:, :1] @ shear.T) + rng.normal(scale=0.05, size=uv.shape)
    seen = np.ones(uv.shape[:2], bool)
    s = Sightings(uv, seen, np.ones(len(uv)), FOCAL, frames=np.arange(T))
    true = plate.surface()
    b = polish(Bundle("revolute", true.twist, true.q, X), s, iterations=40)
    sure = replace(spread(b, s), axis_deg=5.0)
    return Finished(b, s, np.arange(len(uv)), sure, {"revolute": 1.0}, View(FOCAL))


@pytest.mark.slow
def test_faces_mend_tracks_that_err_alike():
    before, after, place = [], [], []
    for seed in range(4):
        plate = film(seed, fine=5.0)
        done = by_tracks(plate, seed)
        mended = by_faces(done, plate.pictures)
        before.append(off_deg(done.bundle.twist.axis, plate.axis))
        after.append(off_deg(mended.bundle.twist.axis, plate.axis))
        assert after[-1] < 1.96 * mended.spread.axis_deg
        assert len(mended.members) == len(mended.bundle.X) == len(mended.sight.uv)
        if mended is not done:
            # Up to scale: distance of the hinge from the middle of the points, which lie all over the plate.
            X, tw = mended.bundle.X, mended.bundle.twist
            place.append(np.linalg.norm(np.cross(X.mean(0) - tw.point, tw.axis)) / X[:, 2].mean())
    assert np.median(before) > 3 and max(after) < 2
    assert len(place) == 4 and np.allclose(place, SIDE / 2, rtol=0.15)


@pytest.mark.slow
def test_faces_do_not_know_the_states_that_no_track_shows():
    plate = film(0, fine=5.0)
    done = by_tracks(plate, 0)
    seen = done.sight.seen.copy()
    seen[:, :4] = False
    b = done.bundle
    bent = replace(b, q=np.where(np.arange(T) < 4, b.q[4], b.q) - b.q[4])
    sight = replace(done.sight, seen=seen)
    vague = replace(done.spread, q=np.full(T, 0.5))
    hidden = replace(done, bundle=bent, sight=sight, spread=vague)
    mended = by_faces(hidden, plate.pictures)
    assert mended is not hidden
    # They are relative to the first frame, which is not shown.
    assert np.all(mended.spread.q >= 0.5)
    assert by_faces(done, plate.pictures).spread.q.max() < 0.1


@pytest.mark.slow
def test_faces_do_not_know_the_states_that_no_track_links_to_the_first():
    """Half of the tracks end where the others begin: by how far the link turns in between they do not say."""
    plate = film(0, fine=5.0)
    done = by_tracks(plate, 0)
    seen, cut = done.sight.seen.copy(), T // 2
    seen[::2, cut:] = False
    seen[1::2, :cut] = False
    sight = replace(done.sight, seen=seen)
    sure = replace(spread(done.bundle, sight), axis_deg=5.0)
    late, stroke = np.arange(T) >= cut, float(np.ptp(plate.q))
    assert sure.q[late].min() > 0.9 * stroke
    mended = by_faces(replace(done, sight=sight, spread=sure), plate.pictures)
    assert mended.bundle is not done.bundle
    assert mended.spread.q[late].min() > 0.9 * stroke
    assert mended.spread.q[~late].max() < 0.1


def test_pictures_that_show_nothing_change_nothing():
    plate = film(0)
    done = by_tracks(plate, 0)
    blank = replace(plate.pictures, grey=np.zeros_like(plate.pictures.grey))
    covered = replace(plate.pictures, covered=np.ones_like(plate.pictures.covered))
    still = replace(plate.pictures, grey=np.repeat(plate.pictures.grey[:1], T, axis=0))
    for pictures in (blank, covered, still):
        assert by_faces(done, pictures) is done


def test_tracks_that_hold_the_axis_are_believed():
    plate = film(0)
    done = by_tracks(plate, 0)
    sure = replace(done, spread=replace(done.spread, axis_deg=0.5 * WORTH_DEG))
    assert by_faces(sure, plate.pictures) is sure


@pytest.mark.slow
def test_the_fit_says_that_faces_hold_the_axis():
    plate = film(3, turn_deg=15.0, fine=5.0)
    rng = np.random.default_rng(0)
    uv = by_tracks(plate, 0).sight.uv + CENTRE + rng.normal(scale=0.3, size=(90, T, 2))
    rest = np.repeat(rng.uniform([5, 5], [W - 5, H - 5], (60, 2))[:, None], T, axis=1)
    uv = np.concatenate([uv, rest + rng.normal(scale=0.1, size=rest.shape)]).astype(np.float32)
    video = Video(Path("plate.mp4"), "0" * 64, (W, H), np.arange(T) / 30, np.arange(T), T,
                  np.repeat(plate.pictures.grey[..., None], 3, axis=-1), 1.0)  # fmt: skip
    tracks = Tracks(uv, np.ones(uv.shape[:2], bool), np.zeros(len(uv), int), ProviderInfo("test", "1", "Apache-2.0"))
    old, new = (fit_joint(video, tracks, FOCAL, camera_moving=False, pictures=p) for p in (None, plate.pictures))
    assert "pixels" in new.reason and "pixels" not in old.reason
    assert new.type == "revolute" and new.std["axis_deg"] < old.std["axis_deg"]
    off = off_deg(np.asarray(new.T_camera_world)[:3, :3] @ new.axis, plate.axis)
    assert off < 1.96 * new.std["axis_deg"] and off < 2.0
