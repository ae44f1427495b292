"""Robot hands of the MuJoCo Menagerie: ``shadow``, ``allegro``, ``leap``.

The package ``mujoco-menagerie`` (extra ``hands``) fetches a model on first use and keeps it in its cache;
``MENAGERIE_ROOT`` names a local copy of the collection instead. Nothing of a model is changed but what
:mod:`taa_envs.hands.rig` adds: a free base, gravity compensation, sites.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from taa_envs.errors import HandUnavailable
from taa_envs.hands.rig import JointedHand, Skeleton

if TYPE_CHECKING:
    import mujoco

Offset = tuple[float, float, float]


@dataclass(frozen=True)
class Robot:
    """A model of the collection and where its fingers are.

    Attributes:
        model: its name there; its entries are ``right_hand`` and ``left_hand``.
        root, palm: bodies; ``{p}`` is the side's prefix.
        prefix: of the right and the left hand's names.
        fingers: finger -> bodies of its knuckle, the two joints after it, and of its tip.
        tip, thumb_tip: (3,) m of the tip's centre in the tip's body.
    """

    model: str
    root: str
    palm: str
    prefix: tuple[str, str]
    fingers: dict[str, tuple[str, str, str, str]]
    tip: Offset
    thumb_tip: Offset


ROBOTS = {
    "shadow": Robot(
        "shadow_hand", "{p}forearm", "{p}palm", ("rh_", "lh_"),
        {**{f: tuple(f"{{p}}{s}{part}" for part in ("knuckle", "middle", "distal", "distal"))
            for f, s in (("index", "ff"), ("middle", "mf"), ("ring", "rf"), ("little", "lf"))},
         "thumb": ("{p}thproximal", "{p}thmiddle", "{p}thdistal", "{p}thdistal")},
        (0.0, 0.0, 0.018), (0.0, 0.0, 0.022)),
    "allegro": Robot(
        "wonik_allegro", "palm", "palm", ("", ""),
        {**{f: tuple(f"{s}_{part}" for part in ("base", "medial", "distal", "tip"))
            for f, s in (("index", "ff"), ("middle", "mf"), ("ring", "rf"))},
         "thumb": ("th_proximal", "th_medial", "th_distal", "th_tip")},
        (0.0, 0.0, 0.027), (0.0, 0.0, 0.042)),
    "leap": Robot(
        "leap_hand", "palm", "palm", ("", ""),
        {**{f: tuple(f"{s}_{part}" for part in ("bs", "md", "ds", "ds"))
            for f, s in (("index", "if"), ("middle", "mf"), ("ring", "rf"))},
         "thumb": ("th_bs", "th_px", "th_ds", "th_ds")},
        (0.0, -0.04, 0.0145), (0.0, -0.043, -0.0145)),
}  # fmt: skip


def model_file(name: str, side: str) -> Path:
    """The MJCF file of a robot hand, fetched if it is not in the cache.

    Raises:
        HandUnavailable: the package is not installed, or the model can neither be found nor fetched.
    """
    robot = ROBOTS[name]
    try:
        import mujoco_menagerie
    except ImportError:
        raise HandUnavailable(f"the hand {name} needs the package mujoco-menagerie; install it with: "
                              "pip install 'taa-envs[hands]'") from None
    try:
        return mujoco_menagerie.get(robot.model).xml(f"{side}_hand")
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        reason = " ".join(str(error).split())[:160]
        raise HandUnavailable(f"the model {robot.model} of the hand {name} is not on this machine and could not be "
                              f"fetched ({reason}); connect once to the internet, or set MENAGERIE_ROOT to a copy of "
                              "the MuJoCo Menagerie") from None


def robot_hand(name: str, side: str = "right") -> JointedHand:
    """The robot hand ``shadow``, ``allegro`` or ``leap``.

    Raises:
        HandUnavailable: see :func:`model_file`.
    """
    robot, file = ROBOTS[name], model_file(name, side)
    prefix = robot.prefix[0 if side == "right" else 1]

    def load() -> mujoco.MjSpec:
        import mujoco

        try:
            return mujoco.MjSpec.from_file(str(file))
        except ValueError as error:
            raise HandUnavailable(f"{file} does not load in MuJoCo ({str(error)[:160]}); remove it from the cache so "
                                  "that it is fetched again") from None

    bodies = {f: tuple(b.format(p=prefix) for b in names) for f, names in robot.fingers.items()}
    skeleton = Skeleton(
        root=robot.root.format(p=prefix), side=side, palm=robot.palm.format(p=prefix),
        knuckles={f: b[0] for f, b in bodies.items()}, chain={f: (b[1], b[2]) for f, b in bodies.items()},
        tips={f: (b[3], robot.thumb_tip if f == "thumb" else robot.tip) for f, b in bodies.items()})
    return JointedHand(name, load, skeleton)
