"""A human-looking right or left hand: skeleton, closed skin and skin colour, all from a few joint angles.

The hand frame of a right hand has its origin at the wrist, y along the middle metacarpal, x to the thumb's side
and z out of the palm. A left hand is its mirror image in x.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from reconstruct.synth.surface import Noise, gradient, smooth_min, smooth_union, surface_quads, tapered_capsule

FINGERS = ("index", "middle", "ring", "little")
KNUCKLES = np.array([[0.026, 0.091, 0.000], [0.003, 0.094, 0.001], [-0.018, 0.087, 0.000], [-0.037, 0.075, -0.002]])
"""(4, 3) metacarpal-phalangeal joints in the hand frame, m."""
PHALANGES = np.array([[0.042, 0.025, 0.020], [0.046, 0.029, 0.021], [0.042, 0.028, 0.021], [0.033, 0.020, 0.019]])
"""(4, 3) lengths from each knuckle to the finger's tip landmark, m."""
RADII = np.array(
    [
        [0.0112, 0.0093, 0.0083, 0.0072],
        [0.0115, 0.0096, 0.0085, 0.0073],
        [0.0108, 0.0090, 0.0080, 0.0070],
        [0.0096, 0.0080, 0.0070, 0.0062],
    ]
)
"""(4, 4) skin radius at knuckle, two finger joints and tip, m."""
THUMB_BASE = np.array([0.024, 0.020, 0.010])
THUMB_LENGTHS = np.array([0.044, 0.034, 0.026])
THUMB_RADII = np.array([0.0165, 0.0120, 0.0105, 0.0086])
BONES = [
    (0, 1),
    (1, 2),
    (2, 3),
    (3, 4),
    (0, 5),
    (5, 6),
    (6, 7),
    (7, 8),
    (0, 9),
    (9, 10),
    (10, 11),
    (11, 12),
    (0, 13),
    (13, 14),
    (14, 15),
    (15, 16),
    (0, 17),
    (17, 18),
    (18, 19),
    (19, 20),
]


@dataclass(frozen=True)
class HandPose:
    """Joint angles in degrees.

    Attributes:
        flex: (4, 3) flexion of the knuckle and the two joints of index, middle, ring and little finger.
        spread: (4,) of each finger in the palm's plane, positive to the thumb's side.
        thumb: (spread from the y axis, rise out of the palm's plane, flexion of two joints).
        wrist: (extension, deviation to the little finger's side): where the forearm leaves the hand.
        arm: length of the arm, m, long enough to leave the picture.
    """

    flex: tuple[tuple[float, float, float], ...] = ((8, 10, 6),) * 4
    spread: tuple[float, ...] = (11, 1, -8, -19)
    thumb: tuple[float, float, float, float] = (48, 12, 12, 10)
    wrist: tuple[float, float] = (0, 0)
    arm: float = 0.64


FLAT = HandPose()
PUSH = HandPose(flex=((12, 14, 8), (12, 14, 8), (12, 14, 8), (14, 16, 8)), wrist=(35, 0))
HOOK = HandPose(
    flex=((42, 52, 28), (44, 54, 28), (46, 54, 28), (48, 52, 28)),
    spread=(8, 1, -6, -14),
    thumb=(40, 18, 10, 15),
    wrist=(10, 0),
)
GRIP = HandPose(
    flex=((48, 26, 14), (50, 26, 14), (50, 26, 14), (48, 28, 14)),
    spread=(10, 1, -8, -18),
    thumb=(38, 52, -10, 8),
    wrist=(10, 0),
)


def landmarks(pose: HandPose, side: str = "right") -> np.ndarray:
    """(21, 3) landmarks in the hand frame, m, in MediaPipe's order."""
    out = np.zeros((21, 3))
    a, e, *bend = np.radians(pose.thumb)
    out[1] = THUMB_BASE
    for j, length in enumerate(THUMB_LENGTHS):
        direction = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
        out[2 + j] = out[1 + j] + length * direction
        if j < 2:
            a -= bend[j]
    for i in range(4):
        s = np.radians(pose.spread[i])
        ahead = np.array([np.sin(s), np.cos(s), 0.0])
        out[5 + 4 * i] = KNUCKLES[i]
        f = 0.0
        for j in range(3):
            f += np.radians(pose.flex[i][j])
            step = np.cos(f) * ahead + np.array([0.0, 0.0, np.sin(f)])
            out[6 + 4 * i + j] = out[5 + 4 * i + j] + PHALANGES[i, j] * step
    if side == "left":
        out[:, 0] *= -1
    return out


def forearm_direction(pose: HandPose, side: str = "right") -> np.ndarray:
    """(3,) unit direction from the wrist to the elbow in the hand frame."""
    x, d = np.radians(pose.wrist)
    out = np.array([-np.sin(d), -np.cos(x) * np.cos(d), -np.sin(x) * np.cos(d)])
    if side == "left":
        out[0] *= -1
    return out / np.linalg.norm(out)


@dataclass(frozen=True)
class HandMesh:
    """Skin, sleeve and colour of one posed hand, hand frame.

    Attributes:
        vertices (V, 3) m, normals (V, 3), quads (F, 4), joints (21, 3) m.
        texcoord (4 F, 2) and texture (S, S, 3) uint8 RGB: one square patch of texels a quad, in quad order.
    """

    vertices: np.ndarray
    normals: np.ndarray
    quads: np.ndarray
    joints: np.ndarray
    texcoord: np.ndarray
    texture: np.ndarray
    side: str
    pose: HandPose = field(default_factory=HandPose)


class _Skin:
    """Distance and colour of a right hand."""

    SLEEVE_START = 0.085

    def __init__(self, pose: HandPose, seed: int):
        self.pose = pose
        self.joints = landmarks(pose).astype(np.float32)
        self.noise = Noise(seed)
        rng = np.random.default_rng(seed)
        self.tone = rng.normal(0.0, 0.012, 3)
        self.cloth = np.array([[0.16, 0.22, 0.34], [0.30, 0.31, 0.33], [0.24, 0.30, 0.25]])[seed % 3]
        self.arm = forearm_direction(pose).astype(np.float32)
        self.wide = np.cross(self.arm, [0, 0, 1.0]).astype(np.float32)
        self.wide /= np.linalg.norm(self.wide)

    def finger(self, x: np.ndarray, i: int) -> np.ndarray:
        """Finger 0 to 3, or the thumb for 4; joints a little thicker than the bones between them."""
        if i == 4:
            p, r = self.joints[1:5], THUMB_RADII
        else:
            p, r = self.joints[5 + 4 * i : 9 + 4 * i], RADII[i]
        parts = []
        for j in range(3):
            mid, rm = 0.5 * (p[j] + p[j + 1]), 0.5 * (r[j] + r[j + 1]) * (0.99 if j < 2 else 1.05)
            lower, upper = tapered_capsule(x, p[j], mid, r[j], rm), tapered_capsule(x, mid, p[j + 1], rm, r[j + 1])
            parts.append(np.minimum(lower, upper))
        return smooth_union(parts, 0.002)

    def palm(self, x: np.ndarray) -> np.ndarray:
        p = self.joints
        wrist = [(0.014, 0.004, 0), (0.003, 0.004, 0), (-0.008, 0.004, 0), (-0.016, 0.006, 0)]
        ends = p[5::4] - np.array([0, 0.006, 0], np.float32)
        rays = [tapered_capsule(x, wrist[i], ends[i], 0.0165, RADII[i, 0] + 0.0012) for i in range(4)]
        thenar = tapered_capsule(x, (0.017, 0.020, 0.009), 0.6 * p[2] + 0.4 * p[1], 0.0165, 0.0135)
        web = tapered_capsule(x, 0.5 * (p[1] + p[2]) * 0.9 + 0.1 * p[5], 0.35 * p[2] + 0.65 * p[5], 0.0105, 0.0085)
        hypo = tapered_capsule(x, (-0.021, 0.020, 0.006), (-0.034, 0.058, 0.004), 0.0150, 0.0135)
        return smooth_union([smooth_union(rays, 0.012), thenar, web, hypo], 0.014)

    def forearm(self, x: np.ndarray) -> np.ndarray:
        pair = []
        for s in (-1, 1):
            a = s * 0.012 * self.wide
            b = s * 0.018 * self.wide + 0.24 * self.arm
            pair.append(tapered_capsule(x, a, b, 0.0195, 0.0300))
        return smooth_union(pair, 0.02)

    def sleeve(self, x: np.ndarray) -> np.ndarray:
        t = x @ self.arm
        fold = 0.0022 * self.noise(x, 0.035) + 0.0016 * np.sin(t * 140 + 3 * self.noise(x, 0.06))
        pair = []
        for s in (-1, 1):
            a = s * 0.016 * self.wide + self.SLEEVE_START * self.arm
            b = s * 0.019 * self.wide + self.pose.arm * self.arm
            pair.append(tapered_capsule(x, a, b, 0.0335, 0.0375 + 0.018 * self.pose.arm))
        return np.maximum(np.maximum(smooth_union(pair, 0.02) + fold, self.SLEEVE_START - t), t - self.pose.arm)

    def skin(self, x: np.ndarray) -> np.ndarray:
        palm = smooth_min(self.palm(x), self.forearm(x), 0.018)
        d = smooth_min(palm, self.finger(x, 4), 0.009)
        for i in range(4):
            d = np.minimum(d, smooth_min(palm, self.finger(x, i), 0.0075))
        return d

    def __call__(self, x: np.ndarray) -> np.ndarray:
        # Most of the volume holds nothing but sleeve: only one of the two is asked far from where they meet.
        t = x @ self.arm
        out = np.empty(len(x), np.float32)
        bare, covered = t < 0.045, t > 0.27
        both = ~(bare | covered)
        out[bare] = self.skin(x[bare])
        out[covered] = self.sleeve(x[covered])
        out[both] = np.minimum(self.skin(x[both]), self.sleeve(x[both]))
        return out

    def albedo(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(N, 3) sRGB in [0, 1] of surface points with outward normals: cloth or skin."""
        weave = 1 + 0.10 * self.noise(x, 0.004, 2) + 0.18 * self.noise(x, 0.03)
        colour = self.cloth * weave[:, None]
        near = np.flatnonzero(x @ self.arm < 0.27)
        bare = near[self.skin(x[near]) <= self.sleeve(x[near])]
        colour[bare] = self.skin_colour(x[bare], n[bare])
        return np.clip(colour, 0, 1)

    def skin_colour(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(N, 3) sRGB of bare skin: tone, mottling, creases, knuckles, nails, veins."""
        palmar = 1 / (1 + np.exp(-5 * n[:, 2]))
        p = self.joints
        dorsal_tone, palm_tone = np.array([0.79, 0.575, 0.465]), np.array([0.87, 0.665, 0.575])
        c = dorsal_tone + palmar[:, None] * (palm_tone - dorsal_tone) + self.tone
        red = np.zeros(len(x))
        dark = np.zeros(len(x))
        nail = np.zeros(len(x))
        for i in range(5):
            q = p[1:5] if i == 4 else p[5 + 4 * i : 9 + 4 * i]
            radius = THUMB_RADII if i == 4 else RADII[i]
            for j in range(1, 3) if i == 4 else range(3):
                along = q[j + 1] - q[j]
                along = along / np.linalg.norm(along)
                before = q[j] - (q[j - 1] if j else q[j] - np.array([0, 0.03, 0], np.float32))
                mean = along + before / np.linalg.norm(before)
                mean /= np.linalg.norm(mean)
                t = (x - q[j]) @ mean
                near = np.exp(-((np.linalg.norm(x - q[j], axis=1) / (1.5 * radius[j])) ** 4))
                red += near * (0.5 if j else 0.7)
                wrinkle = np.sin(t * 3000 + 4 * self.noise(x, 0.006)) * np.exp(-((t / 0.0035) ** 2))
                # The back of a joint is wrinkled; the palm side has one or two sharp creases.
                crease = np.exp(-(((t + 0.001) / 0.0008) ** 2)) + 0.6 * np.exp(-(((t - 0.0022) / 0.0007) ** 2))
                dark += near * ((1 - palmar) * 0.55 * wrinkle * (j > 0) + palmar * crease * 1.1)
            along = q[3] - q[2]
            along = along / np.linalg.norm(along)
            # The finger's own back: the bending plane's normal turned by 90 degrees.
            side = np.cross(q[2] - q[1], q[3] - q[2])
            if np.linalg.norm(side) < 1e-7:
                side = np.array([1.0, 0, 0])
            back = np.cross(along, side / np.linalg.norm(side))
            if i < 4 and back @ np.cross(np.array([1, 0, 0], np.float32), along) < 0:
                back = -back
            if i == 4 and back[2] > 0:
                back = -back
            across = np.cross(along, back)
            rel = x - q[3]
            u, v = rel @ along, rel @ across
            w = radius[3] * 0.78
            plate = 1 - np.clip(
                (np.maximum(np.abs(v) / w, 0) ** 4 + np.abs((u - 0.0005) / 0.0072) ** 4 - 0.8) / 0.35, 0, 1
            )
            top = np.clip((n @ back - 0.35) / 0.2, 0, 1) * (np.linalg.norm(rel, axis=1) < 0.016)
            nail = np.maximum(nail, plate * top)
            red += 0.5 * np.exp(-((np.linalg.norm(rel, axis=1) / 0.012) ** 2))
        # Three large creases of the palm.
        for a, b, bow in (
            (np.array([0.034, 0.066]), np.array([-0.030, 0.040]), 0.006),
            (np.array([0.022, 0.084]), np.array([-0.044, 0.056]), -0.010),
            (np.array([0.034, 0.064]), np.array([0.006, 0.010]), -0.016),
        ):
            h = np.clip((x[:, :2] - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            normal = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
            off = (x[:, :2] - a) @ normal - bow * 4 * h * (1 - h)
            dark += 0.8 * palmar * np.exp(-((off / 0.0011) ** 2)) * (x[:, 1] < 0.09) * (h > 0) * (h < 1)
        c = c + np.clip(red, 0, 1)[:, None] * np.array([0.02, -0.045, -0.04])
        c = c + self.noise(x, 0.016, 3)[:, None] * np.array([0.030, 0.034, 0.030])
        c = c + self.noise(x, 0.0022)[:, None] * 0.020
        # Veins and tendons on the back.
        ridge = np.exp(-(((self.noise(x, (0.012, 0.045, 0.012), 2)) / 0.10) ** 2)) * (x[:, 1] < 0.08)
        c = c + ((1 - palmar) * ridge)[:, None] * np.array([-0.030, -0.012, -0.005])
        c = c * (1 - 0.30 * np.clip(dark, -0.6, 1))[:, None]
        c = c + nail[:, None] * (np.array([0.90, 0.71, 0.66]) - c) * 0.8
        return np.clip(c, 0, 1)

    def occlusion(self, x: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(N,) how much of the surroundings a surface point sees, 1 for all."""
        out = np.ones(len(x))
        for reach, weight in ((0.004, 0.30), (0.009, 0.30), (0.018, 0.25)):
            out -= weight * np.clip(1 - self(x + reach * n) / reach, 0, 1)
        return np.clip(out, 0.25, 1)


def build_hand(pose: HandPose, side: str = "right", seed: int = 0, cell: float = 0.0028, texels: int = 4) -> HandMesh:
    """Mesh and colour one posed hand.

    Args:
        pose: joint angles.
        side: "right" or "left".
        seed: skin tone, cloth and mottling.
        cell: mesh size, m.
        texels: edge length of a quad's patch of texture.
    """
    skin = _Skin(pose, seed)
    reach = skin.arm * pose.arm
    lower = np.minimum(skin.joints.min(0), np.minimum(reach, 0)) - 0.052
    upper = np.maximum(skin.joints.max(0), np.maximum(reach, 0)) + 0.052
    vertices, quads = surface_quads(skin, lower, upper, cell)
    normals = gradient(skin, vertices, 6e-4)
    corner = vertices[quads]
    t = np.linspace(0, 1, texels, dtype=np.float32)
    # Corner order of a quad: (0,0) (1,0) (1,1) (0,1) in (column, row) of its patch.
    u, v = np.meshgrid(t, t)
    w = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1).reshape(-1, 4)
    x = np.einsum("pk,fkd->fpd", w, corner).reshape(-1, 3)
    n = np.einsum("pk,fkd->fpd", w, normals[quads]).reshape(-1, 3)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    colour = skin.albedo(x, n)
    shade = skin.occlusion(vertices, normals)
    colour = colour * (w @ shade[quads].T).T.reshape(-1)[:, None] ** 0.8
    across = int(np.ceil(np.sqrt(len(quads))))
    # A rim of repeated texels around each patch: filtering never reaches a neighbour's colour.
    patch = np.pad(colour.reshape(-1, texels, texels, 3), ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    size = texels + 2
    grid = np.zeros((across * across, size, size, 3), np.float32)
    grid[: len(quads)] = patch
    texture = grid.reshape(across, across, size, size, 3).transpose(0, 2, 1, 3, 4)
    texture = (texture.reshape(across * size, across * size, 3) * 255).round().astype(np.uint8)
    row, column = np.divmod(np.arange(len(quads)), across)
    at = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (texels - 1) + 1.5
    texcoord = (np.stack([column, row], axis=1)[:, None] * size + at) / (across * size)
    mesh = HandMesh(
        vertices, normals, quads, skin.joints.astype(float), texcoord.reshape(-1, 2), texture, "right", pose
    )
    if side == "left":
        flip = np.array([-1.0, 1, 1])
        order = [0, 3, 2, 1]
        mesh = replace(
            mesh,
            vertices=vertices * flip,
            normals=normals * flip,
            quads=quads[:, order],
            joints=mesh.joints * flip,
            side="left",
            texcoord=mesh.texcoord.reshape(-1, 4, 2)[:, order].reshape(-1, 2),
        )
    return mesh
