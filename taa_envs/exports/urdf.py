"""URDF: links and joints. https://wiki.ros.org/urdf/XML"""

from __future__ import annotations

import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from taa_envs.asset import Asset
from taa_envs.exports.body import Body, Inertial, Joint, Shape, read_body

EFFORT, VELOCITY = 1000.0, 100.0
"""URDF demands these two bounds; nothing in a video measures them, so they are out of the way."""


def _numbers(values: np.ndarray | list[float]) -> str:
    return " ".join(f"{float(v) + 0.0:.9g}" for v in values)


def write_urdf(asset: Asset, folder: Path) -> Path:
    """``<id>.urdf`` and ``meshes/``; moving links' frames are on their joints: URDF's joint origins are the points."""
    body = read_body(asset.model_path)
    (folder / "meshes").mkdir()
    robot = ET.Element("robot", name=asset.id)
    robot.append(ET.Comment(f"static and moving link of the asset {asset.id}; limits, damping and friction as in its "
                            "asset.json, effort and velocity limits are placeholders"))
    # For MuJoCo's importer only; others skip it.
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", meshdir="meshes", strippath="true", discardvisual="false",
                  balanceinertia="false", fusestatic="true")
    for shape in body.shapes:
        if shape.texture is not None and not shape.collides:
            material = ET.SubElement(robot, "material", name=shape.name)
            ET.SubElement(material, "texture", filename=f"meshes/{shape.texture.name}")
    _add_link(robot, "static", None, None, body, folder)
    for link, joint, inertial in zip(body.links, body.joints, body.inertials, strict=True):
        _add_link(robot, link, joint, inertial, body, folder)
        element = ET.SubElement(robot, "joint", name=link.replace("moving", "joint"), type=joint.kind)
        ET.SubElement(element, "origin", xyz=_numbers(joint.point), rpy="0 0 0")
        ET.SubElement(element, "parent", link="static")
        ET.SubElement(element, "child", link=link)
        ET.SubElement(element, "axis", xyz=_numbers(joint.axis))
        ET.SubElement(element, "limit", lower=f"{joint.limits[0]:.9g}", upper=f"{joint.limits[1]:.9g}",
                      effort=f"{EFFORT:g}", velocity=f"{VELOCITY:g}")
        ET.SubElement(element, "dynamics", damping=f"{joint.damping:.9g}", friction=f"{joint.friction:.9g}")
    ET.indent(robot)
    path = folder / f"{asset.id}.urdf"
    path.write_text('<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _add_link(robot: ET.Element, name: str, joint: Joint | None, mass: Inertial | None, body: Body,
              folder: Path) -> None:
    frame = joint.point if joint is not None else np.zeros(3)
    link = ET.SubElement(robot, "link", name=name)
    if mass is not None:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_numbers(mass.centre - frame), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=f"{mass.mass:.9g}")
        t = mass.tensor
        ET.SubElement(inertial, "inertia", ixx=f"{t[0, 0]:.9g}", ixy=f"{t[0, 1]:.9g}", ixz=f"{t[0, 2]:.9g}",
                      iyy=f"{t[1, 1]:.9g}", iyz=f"{t[1, 2]:.9g}", izz=f"{t[2, 2]:.9g}")
    for collides, tag in ((False, "visual"), (True, "collision")):
        for shape in body.of(name, collides):
            element = ET.SubElement(link, tag, name=shape.name)
            ET.SubElement(element, "origin", xyz=_numbers(-frame), rpy="0 0 0")
            ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=f"meshes/{shape.file.name}")
            if not collides and shape.texture is not None:
                ET.SubElement(element, "material", name=shape.name)
            _copy_mesh(shape, folder / "meshes")


def _copy_mesh(shape: Shape, folder: Path) -> None:
    """The mesh, with an OBJ material that names its picture: most programs look there, not into the URDF."""
    if shape.texture is None or shape.file.suffix != ".obj":
        shutil.copyfile(shape.file, folder / shape.file.name)
        return
    shutil.copyfile(shape.texture, folder / shape.texture.name)
    stem = shape.file.stem
    (folder / f"{stem}.mtl").write_text(f"newmtl {stem}\nKd 1 1 1\nmap_Kd {shape.texture.name}\n", encoding="ascii")
    text = shape.file.read_text(encoding="ascii")
    (folder / shape.file.name).write_text(f"mtllib {stem}.mtl\nusemtl {stem}\n{text}", encoding="ascii")
