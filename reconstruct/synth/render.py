"""Clips to pixels: MuJoCo renders colour, depth and which link each pixel shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruct.errors import TaaError
from reconstruct.synth.animation import Motion
from reconstruct.synth.hand_model import HandMesh, build_hand
from reconstruct.synth.objects import Box, Solid
from reconstruct.synth.staging import Clip

LINK_CODE = {"none": 0, "room": 1, "static": 2, "moving": 3, "hand": 4}
FACES = [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)]


@dataclass(frozen=True)
class Rendered:
    """Pixels of a clip.

    Attributes:
        image (T, H, W, 3) uint8 RGB; depth (T, H, W) float16 m along the optical axis, inf where nothing is;
        link (T, H, W) uint8, see LINK_CODE; K (3, 3) px.
    """

    image: np.ndarray
    depth: np.ndarray
    link: np.ndarray
    K: np.ndarray


def intrinsics(focal: float, size: tuple[int, int]) -> np.ndarray:
    """(3, 3) of an ideal camera; the centre of the top-left pixel is (0, 0)."""
    w, h = size
    return np.array([[focal * w, 0, (w - 1) / 2], [0, focal * w, (h - 1) / 2], [0, 0, 1]])


def _box_mesh(box: Box, seed: int, detail: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, normals, triangles, texture coordinates (one a vertex) and atlas of a finely divided box.

    ``detail`` scales the texture's resolution: small pictures need no more.
    """
    rng, density = np.random.default_rng(seed), box.density * detail
    pictures, faces = [], []
    for axis, sign in FACES:
        # u runs right and v up when looking at the face from outside, v along z wherever there is one.
        v_axis = 2 if axis != 2 else 1
        u_axis = 3 - axis - v_axis
        h, w = (max(4, round(box.size[m] * density)) for m in (v_axis, u_axis))
        pictures.append(box.paint(h, w, density, rng))
        faces.append((axis, sign, u_axis, v_axis))
    height = sum(p.shape[0] + 2 for p in pictures)
    width = max(p.shape[1] for p in pictures) + 2
    atlas = np.zeros((height, width, 3), np.uint8)
    top = 0
    V: list[np.ndarray] = []
    N: list[np.ndarray] = []
    F: list[np.ndarray] = []
    U: list[np.ndarray] = []
    for picture, (axis, sign, ua, va) in zip(pictures, faces, strict=True):
        h, w = picture.shape[:2]
        atlas[top : top + h + 2, : w + 2] = np.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
        nu, nv = (int(np.clip(np.ceil(box.size[m] / 0.05), 1, 12)) for m in (ua, va))  # lighting is by vertex
        a, b = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1))
        p = np.zeros((a.size, 3))
        p[:, axis] = 0.5 * sign * box.size[axis]
        right = -sign if axis == 1 else sign
        p[:, ua] = (a.ravel() - 0.5) * right * box.size[ua]
        p[:, va] = (b.ravel() - 0.5) * box.size[va]
        normal = np.zeros(3)
        normal[axis] = sign
        base = sum(len(x) for x in V)
        i = base + (np.arange(nv)[:, None] * (nu + 1) + np.arange(nu)[None]).ravel()
        quad = np.stack([i, i + 1, i + nu + 2, i + nu + 1], axis=1)
        e1, e2 = p[quad[0, 1] - base] - p[quad[0, 0] - base], p[quad[0, 3] - base] - p[quad[0, 0] - base]
        if np.cross(e1, e2) @ normal < 0:
            quad = quad[:, ::-1]
        V.append(p)
        N.append(np.tile(normal, (len(p), 1)))
        F.append(np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]))
        rows = top + 1 + (1 - b.ravel()) * h
        U.append(np.stack([(1 + a.ravel() * w) / width, rows / height], axis=1))
        top += h + 2
    vertices, normals = np.concatenate(V) @ box.rotation.T, np.concatenate(N) @ box.rotation.T
    return vertices, normals, np.concatenate(F), np.concatenate(U), atlas


def _solid_mesh(solid: Solid, seed: int, detail: float) -> tuple[np.ndarray, ...]:
    """Vertices, normals and texture coordinates, three a face, triangles and image of a solid of any shape."""
    from reconstruct.geometry.atlas import make_atlas

    rng, density = np.random.default_rng(seed), solid.density * detail
    atlas = make_atlas(solid.vertices, solid.faces, density)
    low, high = solid.vertices.min(0), solid.vertices.max(0)
    side = np.abs(atlas.directions).argmax(1) * 2 + (atlas.directions[np.arange(len(atlas.points)),
                                                     np.abs(atlas.directions).argmax(1)] > 0)  # fmt: skip
    colours = np.zeros((len(atlas.points), 3), np.uint8)
    for k in range(6):
        axis, v_axis = k // 2, 2 if k // 2 != 2 else 1
        u_axis = 3 - axis - v_axis
        h, w = (max(4, round((high - low)[m] * density)) for m in (v_axis, u_axis))
        picture = solid.paint(h, w, density, rng)
        here = side == k
        u, v = (((atlas.points[here] - low) / np.maximum(high - low, 1e-9))[:, m] for m in (u_axis, v_axis))
        right = (k % 2 == 0) == (axis == 1)  # text runs the right way round when seen from outside
        column = ((u if right else 1 - u) * (w - 1)).round().clip(0, w - 1).astype(int)
        colours[here] = picture[((1 - v) * (h - 1)).round().clip(0, h - 1).astype(int), column]
    skin = atlas.skin(colours)
    index = np.arange(3 * len(solid.faces)).reshape(-1, 3)
    uv = skin.uv.reshape(-1, 2) * [1, -1] + [0, 1]
    return solid.vertices[solid.faces].reshape(-1, 3), skin.normals.reshape(-1, 3), index, uv, skin.image


def _add_mesh(spec, body, name: str, V, N, F, U, FU, picture: np.ndarray, shine: float) -> None:
    import mujoco

    mesh = spec.add_mesh(name=name)
    mesh.uservert, mesh.usernormal = V.astype(np.float32).ravel(), N.astype(np.float32).ravel()
    mesh.userface = F.astype(np.int32).ravel()
    mesh.usertexcoord, mesh.userfacetexcoord = U.astype(np.float32).ravel(), FU.astype(np.int32).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    texture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=picture.shape[1], height=picture.shape[0], nchannel=3
    )
    texture.data = np.ascontiguousarray(picture).tobytes()
    material = spec.add_material(name=name, specular=shine, shininess=0.25 + 0.4 * shine)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, contype=0, conaffinity=0)


def _scene(clip: Clip, hand: HandMesh, size: tuple[int, int], seed: int):
    """Compiled model whose geoms are named <link>_<number>; `moving` and `hand` are mocap bodies."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.visual.global_.offwidth, spec.visual.global_.offheight = size
    spec.visual.quality.shadowsize = 2048
    spec.visual.quality.offsamples = 4
    spec.visual.map.znear, spec.visual.map.zfar = 0.02, 12.0
    spec.visual.headlight.ambient = [0.34, 0.34, 0.35]
    spec.visual.headlight.diffuse = [0.20, 0.20, 0.20]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    spec.stat.extent, spec.stat.center = 1.0, clip.target
    # Each light with a shadow costs a pass over the scene: one lamp throws it, the others fill.
    at = clip.target + np.array([-0.55, -0.9, 1.6])
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        pos=at,
        dir=clip.target - at,
        cutoff=60,
        exponent=2,
        diffuse=[0.52, 0.51, 0.47],
        specular=[0.3, 0.3, 0.3],
        castshadow=True,
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=clip.target + [1.0, -1.0, 0.8],
        dir=[-0.7, 0.6, -0.4],
        diffuse=[0.14, 0.15, 0.17],
        specular=[0, 0, 0],
        castshadow=False,
    )
    bodies = {"room": spec.worldbody, "static": spec.worldbody}
    for name in ("moving", "hand"):
        bodies[name] = spec.worldbody.add_body(name=name, mocap=True)
    for i, box in enumerate(clip.model.boxes):
        detail = min(1.0, size[0] / 960)
        if isinstance(box, Solid):
            V, N, F, U, atlas = _solid_mesh(box, seed * 1000 + i, detail)
        else:
            V, N, F, U, atlas = _box_mesh(box, seed * 1000 + i, detail)
            V = V + box.centre
        _add_mesh(spec, bodies[box.link], f"{box.link}_{i}", V, N, F, U, F, atlas, box.shine)
    quads, index = hand.quads, np.arange(4 * len(hand.quads)).reshape(-1, 4)
    F, FU = (np.concatenate([x[:, [0, 1, 2]], x[:, [0, 2, 3]]]) for x in (quads, index))
    _add_mesh(spec, bodies["hand"], "hand_0", hand.vertices, hand.normals, F, hand.texcoord, FU, hand.texture, 0.12)
    # MuJoCo cameras look along -z with y up.
    spec.worldbody.add_camera(
        name="camera", fovy=float(np.degrees(2 * np.arctan(0.5 * size[1] / (clip.focal * size[0]))))
    )
    return spec.compile()


def render(clip: Clip, motion: Motion, size: tuple[int, int], seed: int) -> Rendered:
    """Render every frame.

    Args:
        size: (width, height) px.
        seed: textures, skin and sensor noise.

    Raises:
        TaaError: no OpenGL without a display here.
    """
    import mujoco

    # No finer than pixels show.
    hand = build_hand(clip.pose, clip.side, seed, cell=float(np.clip(2.7 / size[0], 0.0028, 0.006)))
    model = _scene(clip, hand, size, seed)
    data = mujoco.MjData(model)
    code = np.zeros(model.ngeom + 1, np.uint8)
    for g in range(model.ngeom):
        code[g] = LINK_CODE[model.geom(g).name.split("_")[0]]
    try:
        renderer = mujoco.Renderer(model, size[1], size[0])
    except Exception as error:  # MuJoCo raises whatever the GL loader happens to raise
        raise TaaError(
            "cannot render without a display: no EGL; install libegl1 and libgl1-mesa-dri and set "
            f"MUJOCO_GL=egl ({error})"
        ) from error
    n = len(motion.time)
    out = Rendered(
        np.empty((n, size[1], size[0], 3), np.uint8),
        np.empty((n, size[1], size[0]), np.float16),
        np.empty((n, size[1], size[0]), np.uint8),
        intrinsics(clip.focal, size),
    )
    rng = np.random.default_rng(seed + 7)
    mocap = {name: model.body(name).mocapid[0] for name in ("moving", "hand")}
    with renderer:
        for t in range(n):
            for name, T in (("moving", motion.T_world_moving[t]), ("hand", motion.T_world_hand[t])):
                data.mocap_pos[mocap[name]] = T[:3, 3]
                data.mocap_quat[mocap[name]] = Rotation.from_matrix(T[:3, :3]).as_quat()[[3, 0, 1, 2]]
            T = motion.T_camera_world[t]
            model.cam_pos[0] = -T[:3, :3].T @ T[:3, 3]
            to_world = T[:3, :3].T @ np.diag([1.0, -1, -1])
            model.cam_quat[0] = Rotation.from_matrix(to_world).as_quat()[[3, 0, 1, 2]]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "camera")
            out.image[t] = _expose(renderer.render(), rng)
            renderer.enable_depth_rendering()
            depth = renderer.render()
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            ids = renderer.render()
            renderer.disable_segmentation_rendering()
            geom = np.where(ids[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM), ids[..., 0], -1)
            out.link[t] = code[geom]
            out.depth[t] = np.where(geom >= 0, depth, np.inf)
    return out


def _expose(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A camera's response: gain and sensor noise that grows with brightness."""
    x = image.astype(np.float32) * 1.04
    noise = rng.standard_normal(image.shape[:2], np.float32)
    return np.clip(x + noise[..., None] * (0.9 + 0.006 * x) + 0.5, 0, 255).astype(np.uint8)
