"""Stand-ins for the robot hands of the MuJoCo Menagerie, which tests cannot fetch.

Same layout, body, joint, tendon and actuator names, and joint axes, ranges and lengths as the published models (Shadow
E3M5, Allegro V3, LEAP); capsules and boxes in place of meshes, which carry no kinematics.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree


def _body(name: str, pos: str, inner: str, quat: str = "1 0 0 0") -> str:
    return f'<body name="{name}" pos="{pos}" quat="{quat}">{inner}</body>'


def _joint(name: str, axis: str, low: float, high: float, extra: str = "") -> str:
    return f'<joint name="{name}" axis="{axis}" range="{low} {high}" {extra}/>'


def _file(model: str, default: str, world: str, rest: str) -> str:
    return (f'<mujoco model="{model}"><compiler angle="radian" autolimits="true"/><default>{default}</default>'
            f"<worldbody>{world}</worldbody>{rest}</mujoco>")


def _capsule(radius: float, half: float, z: float) -> str:
    return f'<geom type="capsule" size="{radius} {half}" pos="0 0 {z}"/>'


def shadow() -> str:
    """Forearm, two wrist joints, four coupled fingers (the little one with a metacarpal), a thumb of five joints."""
    def finger(s: str, pos: str, side: str) -> str:
        s, up = f"rh_{s}", f"rh_{s.upper()}"
        light = '<inertial pos="0 0 0.01" mass="{}" diaginertia="{} {} {}"/>'
        distal = _body(f"{s}distal", "0 0 0.025", light.format(0.013, *["1.2e-6"] * 3)
                       + _joint(f"{up}J1", "1 0 0", 0, 1.5708) + _capsule(0.0085, 0.011, 0.012))
        middle = _body(f"{s}middle", "0 0 0.045", light.format(0.017, *["2.7e-6"] * 3)
                       + _joint(f"{up}J2", "1 0 0", 0, 1.5708) + _capsule(0.009, 0.0125, 0.0125) + distal)
        proximal = _body(f"{s}proximal", "0 0 0", light.format(0.03, *["1e-5"] * 3)
                         + _joint(f"{up}J3", "1 0 0", -0.261799, 1.5708) + _capsule(0.009, 0.02, 0.025) + middle)
        return _body(f"{s}knuckle", pos, light.format(0.008, *["3.2e-7"] * 3)
                     + _joint(f"{up}J4", side, -0.349066, 0.349066) + proximal)

    thumb_distal = _body("rh_thdistal", "0 0 0.032",
                         '<inertial pos="0 0 0.0145" mass="0.017" diaginertia="2.4e-6 2.3e-6 1e-6"/>'
                         + _joint("rh_THJ1", "1 0 0", -0.261799, 1.5708) + _capsule(0.0095, 0.013, 0.014), "1 0 0 -1")
    thumb_middle = _body("rh_thmiddle", "0 0 0",
                         '<inertial pos="0 0 0.016" mass="0.02" diaginertia="5e-6 5e-6 1.2e-6"/>'
                         + _joint("rh_THJ2", "0 -1 0", -0.698132, 0.698132) + _capsule(0.009, 0.009, 0.012)
                         + thumb_distal)
    hub = _body("rh_thhub", "0 0 0.038", '<inertial pos="0 0 0" mass="0.005" diaginertia="1e-6 1e-6 3e-7"/>'
                + _joint("rh_THJ3", "1 0 0", -0.20944, 0.20944) + thumb_middle)
    thumb_proximal = _body("rh_thproximal", "0 0 0",
                           '<inertial pos="0 0 0.019" mass="0.04" diaginertia="1.36e-5 1.36e-5 3.1e-6"/>'
                           + _joint("rh_THJ4", "1 0 0", 0, 1.22173) + _capsule(0.0105, 0.009, 0.02) + hub)
    thumb = _body("rh_thbase", "0.034 -0.00858 0.029",
                  '<inertial pos="0 0 0" mass="0.01" diaginertia="1.6e-7 1.6e-7 1.6e-7"/>'
                  + _joint("rh_THJ5", "0 0 -1", -1.0472, 1.0472) + thumb_proximal, "0.92388 0 0.382683 0")
    little = _body("rh_lfmetacarpal", "-0.033 0 0.02071",
                   '<inertial pos="0 0 0.04" mass="0.03" diaginertia="1.6e-5 1.5e-5 4.3e-6"/>'
                   + _joint("rh_LFJ5", "0.573576 0 0.819152", 0, 0.785398)
                   + '<geom type="box" size="0.011 0.012 0.025" pos="0.002 0 0.033"/>'
                   + finger("lf", "0 0 0.06579", "0 1 0"))
    palm = _body("rh_palm", "0 0 0.034", '<inertial pos="0 0 0.035" mass="0.3" diaginertia="5.3e-4 3.6e-4 1.9e-4"/>'
                 + _joint("rh_WRJ1", "1 0 0", -0.698132, 0.488692, 'damping="0.5"')
                 + '<geom type="box" size="0.031 0.0035 0.049" pos="0.011 0.0085 0.038"/>'
                 + finger("ff", "0.033 0 0.095", "0 -1 0") + finger("mf", "0.011 0 0.099", "0 -1 0")
                 + finger("rf", "-0.011 0 0.095", "0 1 0") + little + thumb)
    wrist = _body("rh_wrist", "0.01 0 0.21301", '<inertial pos="0 0 0.029" mass="0.1" diaginertia="6e-5 4e-5 4e-5"/>'
                  + _joint("rh_WRJ2", "0 1 0", -0.523599, 0.174533, 'damping="0.5"') + palm, "1 0 0 1")
    forearm = _body("rh_forearm", "0 0 0", '<inertial pos="0 0 0.09" mass="3" diaginertia="0.0138 0.0138 0.00744"/>'
                    '<geom type="mesh" mesh="shell" contype="0" conaffinity="0" group="2"/>' + wrist, "0 1 0 1")

    def drive(name: str, kp: float, low: float, high: float, limit: float, what: str = "joint", of: str = "") -> str:
        return (f'<position name="rh_A_{name}" {what}="rh_{of or name}" kp="{kp}" ctrlrange="{low} {high}" '
                f'forcerange="-{limit} {limit}"/>')

    acts = [drive("WRJ2", 10, -0.523599, 0.174533, 10), drive("WRJ1", 8, -0.698132, 0.488692, 5),
            drive("THJ5", 0.4, -1.0472, 1.0472, 3), drive("THJ4", 1, 0, 1.22173, 2),
            drive("THJ3", 0.5, -0.20944, 0.20944, 1), drive("THJ2", 1.5, -0.698132, 0.698132, 1),
            drive("THJ1", 1, -0.261799, 1.5708, 1)]
    tendons = ""
    for s in ("FF", "MF", "RF", "LF"):
        tendons += (f'<fixed name="rh_{s}J0"><joint joint="rh_{s}J2" coef="1"/><joint joint="rh_{s}J1" coef="1"/>'
                    "</fixed>")
        if s == "LF":
            acts.append(drive("LFJ5", 1, 0, 0.785398, 1))
        acts += [drive(f"{s}J4", 1, -0.349066, 0.349066, 1), drive(f"{s}J3", 1, -0.261799, 1.5708, 1),
                 drive(f"{s}J0", 0.5, 0, 3.1415, 1, "tendon")]
    rest = ('<asset><mesh name="shell" vertex="0 0 0  0.03 0 0  0 0.03 0  0 0 0.2"/></asset>'
            f"<tendon>{tendons}</tendon><actuator>{''.join(acts)}</actuator>"
            '<keyframe><key name="open"/></keyframe>')
    default = '<joint damping="0.05" armature="0.0002" frictionloss="0.01"/>'
    return _file("right_shadow_hand", default, forearm, rest)


def allegro() -> str:
    """Three fingers and a thumb of four joints each, boxes, round tips."""
    def box(size: str, pos: str) -> str:
        return f'<geom type="box" size="{size}" pos="{pos}" density="800"/>'

    def finger(s: str, pos: str, quat: str) -> str:
        tip = _body(f"{s}_tip", "0 0 0", _capsule(0.012, 0.01, 0.019))
        distal = _body(f"{s}_distal", "0 0 0.0384", _joint(f"{s}j3", "0 1 0", -0.227, 1.618)
                       + box("0.0098 0.01375 0.008", "0 0 0.008") + tip)
        medial = _body(f"{s}_medial", "0 0 0.054", _joint(f"{s}j2", "0 1 0", -0.174, 1.709)
                       + box("0.0098 0.01375 0.0192", "0 0 0.0192") + distal)
        proximal = _body(f"{s}_proximal", "0 0 0.0164", _joint(f"{s}j1", "0 1 0", -0.196, 1.61)
                         + box("0.0098 0.01375 0.027", "0 0 0.027") + medial)
        return _body(f"{s}_base", pos, _joint(f"{s}j0", "0 0 1", -0.47, 0.47)
                     + box("0.0098 0.01375 0.0082", "0 0 0.0082") + proximal, quat)

    tip = _body("th_tip", "0 0 0", _capsule(0.012, 0.008, 0.035))
    distal = _body("th_distal", "0 0 0.0514", _joint("thj3", "0 1 0", -0.162, 1.719)
                   + box("0.0098 0.01375 0.0157", "0 0 0.0157") + tip)
    medial = _body("th_medial", "0 0 0.0177", _joint("thj2", "0 1 0", -0.189, 1.644)
                   + box("0.0098 0.01375 0.0257", "0 0 0.0257") + distal)
    proximal = _body("th_proximal", "-0.027 0.005 0.0399", _joint("thj1", "0 0 1", -0.105, 1.163)
                     + box("0.0098 0.01375 0.00885", "0 0 0.00885") + medial)
    thumb = _body("th_base", "-0.0182 0.019333 -0.045987", _joint("thj0", "-1 0 0", 0.263, 1.396)
                  + box("0.0179 0.017 0.02275", "-0.0179 0.009 0.0145") + proximal,
                  "0.477714 -0.521334 -0.521334 -0.477714")
    palm = _body("palm", "0 0 0", box("0.0204 0.0565 0.0475", "-0.0093 0 -0.0475")
                 + finger("ff", "0 0.0435 -0.001542", "0.999048 -0.0436194 0 0") + finger("mf", "0 0 0.0007", "1 0 0 0")
                 + finger("rf", "0 -0.0435 -0.001542", "0.999048 0.0436194 0 0") + thumb, "0 1 0 1")
    ranges = ((-0.47, 0.47), (-0.196, 1.61), (-0.174, 1.709), (-0.227, 1.618))
    thumb_ranges = ((0.263, 1.396), (-0.105, 1.163), (-0.189, 1.644), (-0.162, 1.719))
    acts = "".join(f'<position name="{s}a{k}" joint="{s}j{k}" kp="10" ctrlrange="{a} {b}"/>'
                   for s in ("ff", "mf", "rf", "th")
                   for k, (a, b) in enumerate(thumb_ranges if s == "th" else ranges))
    return _file("allegro_right", '<joint damping="1"/>', palm, f"<actuator>{acts}</actuator>")


def leap() -> str:
    """Three fingers and a thumb of four joints each; every joint turns about -z of its body."""
    axis = "0 0 -1"

    def finger(s: str, y: float) -> str:
        distal = _body(f"{s}_ds", "0 -0.0361 0.0002", '<inertial pos="0 -0.027 0.0146" mass="0.016" '
                       'diaginertia="3.7e-6 3e-6 1.6e-6"/>' + _joint(f"{s}_dip", axis, -0.366, 2.042)
                       + '<geom type="capsule" size="0.011" fromto="0 -0.015 0.0145 0 -0.037 0.0145"/>')
        middle = _body(f"{s}_md", "0.015 0.0143 -0.013", '<inertial pos="0.005 -0.029 0.015" mass="0.037" '
                       'diaginertia="8e-6 8e-6 5e-6"/>' + _joint(f"{s}_pip", axis, -0.506, 1.885)
                       + '<geom type="box" size="0.008 0.011 0.013" pos="0 -0.02 0.015"/>' + distal,
                       "0.500003 0.5 -0.5 0.499997")
        proximal = _body(f"{s}_px", "-0.0122 0.0381 0.0145", '<inertial pos="0.0075 0 -0.011" mass="0.032" '
                         'diaginertia="4.9e-6 4.4e-6 3.1e-6"/>' + _joint(f"{s}_rot", axis, -1.047, 1.047)
                         + '<geom type="box" size="0.017 0.013 0.011" pos="0.0075 0 -0.011"/>' + middle,
                         "0.500003 -0.5 -0.499997 0.5")
        return _body(f"{s}_bs", f"-0.007 {y} -0.0187", '<inertial pos="-0.0225 0.034 0.016" mass="0.044" '
                     'diaginertia="1.7e-5 1.6e-5 7e-6"/>' + _joint(f"{s}_mcp", axis, -0.314, 2.23)
                     + '<geom type="box" size="0.014 0.02 0.01" pos="-0.027 0.042 0.015"/>' + proximal,
                     "0.500003 0.5 0.5 -0.499997")

    distal = _body("th_ds", "0 0.0466 0.0002", '<inertial pos="0 -0.024 -0.0144" mass="0.049" '
                   'diaginertia="2e-5 2e-5 4.7e-6"/>' + _joint("th_ipl", axis, -1.34, 1.88)
                   + '<geom type="capsule" size="0.011" fromto="0 -0.01 -0.0145 0 -0.042 -0.0145"/>', "0 0 0 1")
    middle = _body("th_px", "0 0.0145 -0.017", '<inertial pos="-0.002 0.016 -0.0137" mass="0.038" '
                   'diaginertia="9.9e-6 9.3e-6 4.4e-6"/>' + _joint("th_mcp", axis, -0.47, 2.443)
                   + '<geom type="box" size="0.01 0.02 0.012" pos="0 0.0105 -0.014"/>' + distal,
                   "0.707109 -0.707105 0 0")
    base = _body("th_bs", "0 0.0143 -0.013", '<inertial pos="0 0 -0.007" mass="0.003" diaginertia="6e-7 5e-7 2e-7"/>'
                 + _joint("th_axl", axis, -0.349, 2.094)
                 + '<geom type="box" size="0.009 0.0165 0.002" pos="0 0 -0.0015"/>' + middle,
                 "0.500003 0.5 -0.5 0.499997")
    thumb = _body("th_mp", "-0.0693 -0.0012 -0.0216", '<inertial pos="0.0075 -0.0002 -0.011" mass="0.032" '
                  'diaginertia="4.9e-6 4.4e-6 3.1e-6"/>' + _joint("th_cmc", axis, -0.349, 2.094)
                  + '<geom type="box" size="0.017 0.013 0.011" pos="-0.0075 -0.0002 -0.011"/>' + base,
                  "0.707109 0 0.707105 0")
    palm = _body("palm", "0 0 0.1", '<inertial pos="-0.05 -0.043 -0.01" mass="0.237" diaginertia="4e-4 3e-4 1.8e-4"/>'
                 '<geom type="box" size="0.042 0.06 0.02" pos="-0.055 -0.035 -0.0115"/>'
                 + finger("if", 0.023) + finger("mf", -0.0224) + finger("rf", -0.0678) + thumb, "0 1 0 0")
    ranges = {"mcp": (-0.314, 2.23), "rot": (-1.047, 1.047), "pip": (-0.506, 1.885), "dip": (-0.366, 2.042)}
    thumb_ranges = {"cmc": (-0.349, 2.094), "axl": (-0.349, 2.094), "mcp": (-0.47, 2.443), "ipl": (-1.34, 1.88)}
    acts = "".join(f'<position name="{s}_{j}_act" joint="{s}_{j}" kp="3" kv="0.01" ctrlrange="{a} {b}"/>'
                   for s in ("if", "mf", "rf", "th")
                   for j, (a, b) in (thumb_ranges if s == "th" else ranges).items())
    return _file("leap_rh", '<joint damping="0.03" frictionloss="0.001"/>', palm, f"<actuator>{acts}</actuator>")


FOLDERS = {"shadow": ("shadow_hand", shadow), "allegro": ("wonik_allegro", allegro), "leap": ("leap_hand", leap)}


def mirrored(text: str) -> str:
    """The left hand of a right one: every place, turn and joint axis reflected in x = 0."""
    root = ElementTree.fromstring(text)
    flips = {"pos": (-1, 1, 1), "fromto": (-1, 1, 1, -1, 1, 1), "axis": (1, -1, -1), "quat": (1, 1, -1, -1)}
    for element in root.iter():
        for key, signs in flips.items():
            if key in element.attrib:
                numbers = [s * float(v) for s, v in zip(signs, element.attrib[key].split(), strict=True)]
                element.set(key, " ".join(map(str, numbers)))
    return ElementTree.tostring(root, encoding="unicode").replace("rh_", "lh_")


def write_models(root: Path) -> Path:
    """A folder laid out as the collection (``MENAGERIE_ROOT``) with both hands of the three robots."""
    for folder, make in FOLDERS.values():
        (root / folder).mkdir(parents=True, exist_ok=True)
        (root / folder / "right_hand.xml").write_text(make(), encoding="utf-8")
        (root / folder / "left_hand.xml").write_text(mirrored(make()), encoding="utf-8")
    return root
