"""USD with UsdPhysics: rigid bodies, a passive joint, convex colliders. https://openusd.org/release/api/usd_physics_page_front.html"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from taa_envs.asset import Asset
from taa_envs.errors import TaaEnvsError
from taa_envs.exports.body import Body, Shape, read_body


def write_usd(asset: Asset, folder: Path) -> Path:
    """``<id>.usda`` and ``textures/``: metres, kilograms, z up; /<id>/static, /<id>/moving, /<id>/joint.

    Raises:
        TaaEnvsError: usd-core is not installed.
    """
    try:
        from pxr import Gf, Usd, UsdGeom, UsdPhysics
    except ImportError:
        raise TaaEnvsError("writing USD needs the package usd-core; install it with: pip install 'taa-envs[usd]'"
                           ) from None

    body = read_body(asset.model_path)
    path = folder / f"{asset.id}.usda"
    stage: Any = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/" + prim_name(asset.id))
    stage.SetDefaultPrim(root.GetPrim())
    base = str(root.GetPath())
    UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    links = {}
    for name in ("static", "moving"):
        link = UsdGeom.Xform.Define(stage, f"{base}/{name}")
        UsdPhysics.RigidBodyAPI.Apply(link.GetPrim())
        links[name] = link
        for collides in (False, True):
            for shape in body.of(name, collides):
                _add_mesh(stage, f"{base}/{name}/{prim_name(shape.name)}", shape, folder)
    _add_mass(links["moving"].GetPrim(), body)
    anchor = UsdPhysics.FixedJoint.Define(stage, f"{base}/anchor")
    anchor.CreateBody1Rel().SetTargets([links["static"].GetPath()])
    _add_joint(stage, f"{base}/joint", body, {name: link.GetPath() for name, link in links.items()})
    root.GetPrim().SetCustomDataByKey("taa:asset", asset.id)
    stage.SetMetadata("comment", f"asset {asset.id}; the numbers' origins are in its asset.json")
    # MuJoCo's friction has no place in UsdPhysics; it is kept as an attribute for whoever knows what to do with it.
    from pxr import Sdf

    attribute = stage.GetPrimAtPath(f"{base}/joint").CreateAttribute("taa:frictionloss", Sdf.ValueTypeNames.Float)
    attribute.Set(body.joint.friction)
    del Gf
    stage.GetRootLayer().Save()
    return path


def prim_name(name: str) -> str:
    """A name that USD accepts: letters, digits and underscores, no digit first."""
    clean = "".join(c if c.isalnum() and c.isascii() else "_" for c in name)
    return clean if not clean[:1].isdigit() else f"_{clean}"


def _add_mass(prim: Any, body: Body) -> None:
    from pxr import Gf, UsdPhysics
    from scipy.spatial.transform import Rotation

    moments, axes = np.linalg.eigh(body.inertial.tensor)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    w, x, y, z = Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]].tolist()
    api = UsdPhysics.MassAPI.Apply(prim)
    api.CreateMassAttr(body.inertial.mass)
    api.CreateCenterOfMassAttr(Gf.Vec3f(*body.inertial.centre.tolist()))
    api.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    api.CreatePrincipalAxesAttr(Gf.Quatf(w, x, y, z))


def _add_joint(stage: Any, path: str, body: Body, links: dict[str, Any]) -> None:
    """UsdPhysics joints turn about a frame's x axis: both local frames turn x onto the joint's axis."""
    from pxr import Gf, UsdPhysics
    from scipy.spatial.transform import Rotation

    joint = body.joint
    hinge = joint.kind == "revolute"
    made = (UsdPhysics.RevoluteJoint if hinge else UsdPhysics.PrismaticJoint).Define(stage, path)
    made.CreateBody0Rel().SetTargets([links["static"]])
    made.CreateBody1Rel().SetTargets([links["moving"]])
    made.CreateAxisAttr(UsdPhysics.Tokens.x)
    turn, _ = Rotation.align_vectors(joint.axis[None], np.array([[1.0, 0, 0]]))
    w, x, y, z = turn.as_quat()[[3, 0, 1, 2]].tolist()
    for create in (made.CreateLocalPos0Attr, made.CreateLocalPos1Attr):
        create(Gf.Vec3f(*joint.point.tolist()))
    for create in (made.CreateLocalRot0Attr, made.CreateLocalRot1Attr):
        create(Gf.Quatf(w, x, y, z))
    unit = 180.0 / np.pi if hinge else 1.0  # UsdPhysics counts angles in degrees
    made.CreateLowerLimitAttr(joint.limits[0] * unit)
    made.CreateUpperLimitAttr(joint.limits[1] * unit)
    # A drive without stiffness whose target is rest is viscous damping.
    drive = UsdPhysics.DriveAPI.Apply(made.GetPrim(), UsdPhysics.Tokens.angular if hinge else UsdPhysics.Tokens.linear)
    drive.CreateTypeAttr(UsdPhysics.Tokens.force)
    drive.CreateStiffnessAttr(0.0)
    drive.CreateDampingAttr(joint.damping / unit)
    drive.CreateTargetVelocityAttr(0.0)


def _add_mesh(stage: Any, path: str, shape: Shape, folder: Path) -> None:
    """A mesh; colliders are guides that their hull stands for, visual meshes carry their picture."""
    from pxr import Gf, Sdf, UsdGeom, UsdPhysics, UsdShade, Vt

    vertices, faces, uv = read_obj(shape.file)
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr([Gf.Vec3f(*vertices.min(0).tolist()), Gf.Vec3f(*vertices.max(0).tolist())])
    if shape.collides:
        mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        return
    if shape.texture is None or uv is None:
        return
    (folder / "textures").mkdir(exist_ok=True)
    shutil.copyfile(shape.texture, folder / "textures" / shape.texture.name)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32).reshape(-1, 2)))
    material = UsdShade.Material.Define(stage, f"{path}_material")
    surface = UsdShade.Shader.Define(stage, f"{path}_material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    reader = UsdShade.Shader.Define(stage, f"{path}_material/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    picture = UsdShade.Shader.Define(stage, f"{path}_material/picture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./textures/{shape.texture.name}")
    picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices (V, 3), triangles (F, 3) and texture coordinates of their corners (F, 3, 2) or None, of an OBJ file.

    Reads what this package writes: v, vt and triangular f lines.
    """
    v, vt, f, ft = [], [], [], []
    for line in path.read_text(encoding="ascii").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            v.append([float(x) for x in words[:3]])
        elif kind == "vt":
            vt.append([float(x) for x in words[:2]])
        elif kind == "f":
            corners = [w.split("/") for w in words]
            f.append([int(c[0]) - 1 for c in corners])
            ft.append([int(c[1]) - 1 if len(c) > 1 and c[1] else -1 for c in corners])
    faces = np.asarray(f, int).reshape(-1, 3)
    coordinates = np.asarray(vt, float)[np.asarray(ft)] if vt else None
    return np.asarray(v, float).reshape(-1, 3), faces, coordinates
