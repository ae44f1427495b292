"""Scenes: asset + hand + floor + lights + cameras, compiled. The only place that builds one.

Who touches whom: the hand touches the moving link (and an object's further moving links, which are as passive as the
first; only the first's joint is the task, and only what touches that link counts as contact) and nothing else. Not
itself (its spheres are free of each other), not the floor, and by default not the static link: much of a static link is
assumed (nobody saw its back), a monocular hand is off by centimetres, and a hand that catches on a surface nobody saw
would fail for a reason that is not in the video. ``touch_static=True`` lets it touch. The links do not touch each
other: the joint's range is the stop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taa_envs.asset import Asset
from taa_envs.checks import numbered
from taa_envs.errors import AssetError
from taa_envs.hands import Controller, Hand, make_hand
from taa_envs.hands.landmarks import SIDES, side_of
from taa_envs.registry import CONTROL_PERIOD

if TYPE_CHECKING:
    import mujoco

TIMESTEP = 0.002  # s
SUBSTEPS = round(CONTROL_PERIOD / TIMESTEP)  # in one environment step
MOVING_BIT, STATIC_BIT = 1 << 1, 1 << 2
FLOOR_GAP = 0.01  # m between the lowest point of either link, or of the hand that drives it, and the floor


@dataclass(frozen=True)
class Scene:
    """A compiled scene and where things are in it.

    Attributes:
        asset: what it shows.  model: ``mujoco.MjModel``.
        hand: controller bound to the model, None in a scene without a hand.
        qpos, dof: addresses of the object's joint.
        advance: of a screw, the address in ``qpos`` of the slide that follows the joint, and metres a radian.
        further: addresses in ``qpos`` of ``joint_2`` and so on, and of the slides that follow those that are screws.
        hand_geoms, moving_geoms: (ngeom,) bool.
        surface: (P, 3) points of the moving link's collision surface in its own frame, m.
        centre: (3,) and size: m, of the bounding box of both links at q = 0.
    """

    asset: Asset
    model: mujoco.MjModel
    hand: Controller | None
    qpos: int
    dof: int
    hand_geoms: np.ndarray
    moving_geoms: np.ndarray
    surface: np.ndarray
    centre: np.ndarray
    size: float
    advance: tuple[int, float] | None = None
    further: tuple[tuple[int, tuple[int, float] | None], ...] = ()

    def put(self, qpos: np.ndarray, q: float | np.ndarray) -> None:
        """Write the object's joint at q into states (..., nq), the slide that follows a screw with it."""
        qpos[..., self.qpos] = q
        if self.advance is not None:
            qpos[..., self.advance[0]] = self.advance[1] * np.asarray(q)

    def put_further(self, qpos: np.ndarray, time: float) -> None:
        """Write the further joints as the demonstration has them at a time, s, into states (..., nq)."""
        reference = self.asset.reference
        for (column, advance), states in zip(self.further, reference.further, strict=True):
            q = float(np.interp(time, reference.time, states))
            qpos[..., column] = q
            if advance is not None:
                qpos[..., advance[0]] = advance[1] * q


def _mesh_points(model: mujoco.MjModel, data: mujoco.MjData, geom: int | np.integer) -> np.ndarray:
    mesh = int(model.geom_dataid[geom])
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[start:start + count].astype(float)
    return points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def _bounds(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """(2, 3) box at q = 0, and (2, 3) box over the joints' ranges, of all mesh geoms."""
    import mujoco

    data = mujoco.MjData(model)
    boxes = []
    free = model.jnt_limited.astype(bool)
    # All joints together: each link's own box is what counts, and no link is carried by another.
    for q in (np.zeros(model.njnt), *np.linspace(model.jnt_range[:, 0], model.jnt_range[:, 1], 7)):
        data.qpos[free] = q[free]
        follow_screws(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        points = np.concatenate([_mesh_points(model, data, g) for g in range(model.ngeom) if model.geom_dataid[g] >= 0])
        boxes.append([points.min(0), points.max(0)])
    boxes = np.array(boxes)
    return boxes[0], np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])


def follow_screws(model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Write the slides that follow screws into states (..., nq) of an object's own model."""
    for e in range(model.neq):
        slide, turn = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        pitch = model.eq_data[e, 1]
        qpos[..., model.jnt_qposadr[slide]] = pitch * qpos[..., model.jnt_qposadr[turn]]


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """(3, 3) rotation of a MuJoCo camera (right, up, backward as columns) at position that looks at target."""
    back = np.asarray(position, float) - target
    back /= np.linalg.norm(back)
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, float)
    if abs(back @ up) > 0.99:
        up = np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    return quat


def _add_cameras(spec: mujoco.MjSpec, asset: Asset, swept: np.ndarray) -> None:
    """``video`` where the asset knows it; ``overview`` from that side, of all that the links sweep (2, 3)."""
    import mujoco

    centre, view = swept.mean(0), np.array([1.0, -1.0, 0.7])
    if asset.camera is not None:
        camera = asset.camera
        K, T = np.array(camera["K"], float), np.array(camera["T_camera_world"], float)
        width, height = camera["width"], camera["height"]
        position = -T[:3, :3].T @ T[:3, 3]
        rotation = T[:3, :3].T @ np.diag([1.0, -1.0, -1.0])  # right, down, forward -> right, up, backward
        # Pixel (0, 0) is the centre of a pixel, so the image's middle is ((w - 1) / 2, (h - 1) / 2).
        spec.worldbody.add_camera(
            name="video", pos=position, quat=_quaternion(rotation), resolution=[width, height],
            sensor_size=[width * 1e-5, height * 1e-5], focal_pixel=[K[0, 0], K[1, 1]],
            principal_pixel=[(width - 1) / 2 - K[0, 2], (height - 1) / 2 - K[1, 2]])
        view = position - centre
    view = view / np.linalg.norm(view)
    view[2] = max(view[2], 0.4)  # never along the floor, from where one sees edges only
    position = centre + view / np.linalg.norm(view) * 1.5 * np.linalg.norm(swept[1] - swept[0])
    spec.worldbody.add_camera(name="overview", pos=position, quat=_quaternion(look_at(position, centre)), fovy=45,
                              proj=mujoco.mjtProjection.mjPROJ_PERSPECTIVE)


def _add_touch(spec: mujoco.MjSpec) -> None:
    """Sensors of what touches the moving link: ``touch`` the net wrench, ``touch_depth`` the deepest contact.

    Only a hand can touch it, see the module's text. A sensor costs a fraction of reading contacts in Python. MuJoCo
    keeps what ``touch`` said in each of the last :data:`SUBSTEPS` steps (:func:`touch_history`), so that many steps can
    be made in one call without losing what touched in between.
    """
    import mujoco

    field = mujoco.mjtConDataField
    net = (field.mjCONDATA_FOUND, field.mjCONDATA_FORCE, field.mjCONDATA_TORQUE, field.mjCONDATA_POS)
    for name, data, reduce in (("touch", net, 3), ("touch_depth", (field.mjCONDATA_DIST,), 1)):  # net force; least dist
        sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_BODY,
                                 objname="moving")
        sensor.intprm[:3] = [sum(1 << int(d) for d in data), reduce, 1]
        if name == "touch":
            sensor.nsample = SUBSTEPS


def touch_columns(scene: Scene) -> tuple[int, int]:
    """Where the two sensors' numbers begin in ``sensordata``."""
    return int(scene.model.sensor("touch").adr[0]), int(scene.model.sensor("touch_depth").adr[0])


def touch_history(scene: Scene) -> slice:
    """Where in ``MjData.history`` the last :data:`SUBSTEPS` readings of ``touch`` are, in no order: 10 numbers each."""
    sensor, model = scene.model.sensor("touch").id, scene.model
    count, size = int(model.sensor_history[sensor, 0]), int(model.sensor_dim[sensor])
    first = int(model.sensor_historyadr[sensor]) + 2 + count  # after the buffer's own two numbers and its times
    return slice(first, first + count * size)


def decode_touch(columns: tuple[int, int], sensordata: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What touched the moving link in the step that MuJoCo has just made.

    Args:
        columns: of :func:`touch_columns`.
        sensordata: (..., nsensordata).

    Returns:
        force (..., 3) N on the link, torque (..., 3) N m about position (..., 3) m, asset frame, and depth (...) m of
        the deepest overlap; zeros where nothing touched it.
    """
    a, b = columns
    # MuJoCo gives the wrench from the named body on the other; depth is a negative distance.
    return (-sensordata[..., a + 1:a + 4], -sensordata[..., a + 4:a + 7], sensordata[..., a + 7:a + 10],
            np.maximum(-sensordata[..., b], 0.0))


def build_spec(asset: Asset, hand: Hand | None, *, touch_static: bool = False) -> mujoco.MjSpec:
    """The scene as an uncompiled ``mujoco.MjSpec``; hand as from :func:`taa_envs.hands.make_hand`, None for none.

    Raises:
        AssetError: the asset's model does not compile.
    """
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(asset.model_path))
        spec.compiler.degree = False
        box, swept = _bounds(spec.compile())
    except ValueError as error:
        raise AssetError(f"{asset.model_path} does not compile: {str(error)[:200]}") from None
    centre, size = box.mean(0), float(np.linalg.norm(box[1] - box[0]))
    spec.modelname = f"TAA/{asset.id}"
    for name, bit in (("static", STATIC_BIT), *((name, MOVING_BIT) for name in asset.links)):
        for geom in spec.body(name).geoms:
            if geom.contype or geom.conaffinity:
                geom.contype, geom.conaffinity = bit, 0
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 5.0  # stiffer friction than normal force: a pinch holds instead of creeping

    lowest = swept[0, 2]
    if (driven := asset.reference.contact).any():  # what hangs on a wall is opened from below
        lowest = min(lowest, float(asset.reference.hand_joints[driven][..., 2].min()) - FLOOR_GAP)
    if asset.camera is not None:  # a floor above the video's camera would hide everything from it
        T = np.array(asset.camera["T_camera_world"], float)
        lowest = min(lowest, float((-T[:3, :3].T @ T[:3, 3])[2]) - 0.1 * size)
    spec.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
                     rgb1=[0.82, 0.83, 0.84], rgb2=[0.76, 0.77, 0.79], width=256, height=256)
    spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
                     rgb1=[0.93, 0.95, 0.97], rgb2=[0.75, 0.8, 0.86], width=128, height=128)
    material = spec.add_material(name="floor", texrepeat=[4 / size, 4 / size], texuniform=True, specular=0.0)
    textures = list(material.textures)
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "floor"
    material.textures = textures
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, size],
                            pos=[centre[0], centre[1], lowest - FLOOR_GAP], material="floor", contype=0, conaffinity=0)
    spec.worldbody.add_light(name="key", pos=centre + size * np.array([1.5, -2.0, 3.0]), dir=[-0.4, 0.55, -0.8],
                             type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=True, diffuse=[0.35] * 3)
    spec.worldbody.add_light(name="fill", pos=centre + size * np.array([-2.0, 1.0, 2.0]), dir=[0.7, -0.4, -0.6],
                             type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=False, diffuse=[0.15] * 3)
    # Mostly ambient: the colours come from a video and hold its light already.
    spec.visual.headlight.ambient = [0.6] * 3
    spec.visual.headlight.diffuse = [0.25] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 2560
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear = 0.005
    spec.visual.map.shadowclip = 10.0  # wide enough that the shadow map's rim, which flickers, is out of sight
    spec.stat.center, spec.stat.extent = centre, size
    _add_cameras(spec, asset, swept)
    if hand is not None:
        _add_touch(spec)
        hand.attach(spec)
        for geom in spec.geoms:
            solid = geom.contype or geom.conaffinity
            if solid and geom.parent.name not in ("static", *asset.links, "world"):
                geom.contype, geom.conaffinity = 0, MOVING_BIT | (STATIC_BIT if touch_static else 0)
    return spec


def _side(asset: Asset) -> str:
    """Whether a right or a left hand demonstrated."""
    side = (asset.provenance.get("hand.side") or {}).get("value")
    return side if side in SIDES else side_of(asset.reference.hand_joints)


def build_scene(asset: Asset, hand: str | Hand | None = "points", *, touch_static: bool = False) -> Scene:
    """Compile asset, hand, floor, lights and the cameras ``overview`` and (where it is known) ``video``.

    Args:
        asset: as loaded.
        hand: a hand's name, a hand, or None for a scene without one.
        touch_static: whether the hand can touch the static link, see the module's text.

    Raises:
        AssetError: the asset's model does not compile.
        UnknownHand: no hand has that name.
    """
    import mujoco

    made = make_hand(hand, side=_side(asset)) if isinstance(hand, str) else hand
    model = build_spec(asset, made, touch_static=touch_static).compile()
    moving = model.geom_bodyid == model.body("moving").id
    static = model.geom_bodyid == model.body("static").id
    touching = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    others = np.isin(model.geom_bodyid, [model.body(name).id for name in asset.links[1:]])
    points = np.concatenate([_mesh_points(model, data, g) for g in np.flatnonzero(moving | others | static)])
    box = np.stack([points.min(0), points.max(0)])
    surface = np.concatenate([_mesh_points(model, data, g) for g in np.flatnonzero(moving & touching)])
    if len(surface) > 500:
        surface = surface[np.linspace(0, len(surface) - 1, 500).astype(int)]
    return Scene(asset=asset, model=model, hand=None if made is None else made.bind(model),
                 qpos=int(model.joint("joint").qposadr[0]), dof=int(model.joint("joint").dofadr[0]),
                 hand_geoms=touching & ~moving & ~others & ~static, moving_geoms=touching & moving, surface=surface,
                 centre=box.mean(0), size=float(np.linalg.norm(box[1] - box[0])),
                 advance=_advance(model, 1, asset.joint),
                 further=tuple((int(model.joint(numbered("joint", k)).qposadr[0]), _advance(model, k, joint))
                               for k, joint in enumerate(asset.further, 2)))


def _advance(model: mujoco.MjModel, link: int, joint: dict) -> tuple[int, float] | None:
    if joint["type"] != "screw":
        return None
    return int(model.joint(numbered("advance", link)).qposadr[0]), float(joint["pitch"])
