"""Hands that replay a demonstration, by name.

One file a hand: a :class:`Hand` adds itself to a scene, and a :class:`Controller` drives it in the compiled model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from taa_envs.errors import UnknownHand

if TYPE_CHECKING:
    import mujoco

HANDS = ("points", "human", "shadow", "allegro", "leap")


class Controller(Protocol):
    """Drives a hand in a compiled scene. ``lead``: s by which its targets are to run ahead of the demonstration."""

    lead: float

    def place(self, data: mujoco.MjData, joints: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Put the hand at landmarks (21, 3) m, moving at velocity (21, 3) m/s; only at the start of an episode."""

    def control(self, data: mujoco.MjData, joints: np.ndarray) -> None:
        """Aim the actuators at landmarks (21, 3) m."""

    def landmarks(self, data: mujoco.MjData) -> np.ndarray:
        """(21, 3) where the landmarks are, m; a copy."""


class Hand(Protocol):
    """A hand before it is compiled."""

    @property
    def name(self) -> str:
        """Its registered name."""

    def attach(self, spec: mujoco.MjSpec) -> None:
        """Add bodies and actuators to a scene; nothing else in it may change."""

    def bind(self, model: mujoco.MjModel) -> Controller:
        """A controller for the compiled scene."""


def make_hand(name: str, side: str = "right", **kwargs: Any) -> Hand:
    """The hand of that name; side "right" or "left" matters to those with joints.

    Raises:
        UnknownHand: there is none; the message lists the names.
        HandUnavailable: its model is not on this machine and cannot be fetched.
    """
    if name == "points":
        from taa_envs.hands.points import PointsHand

        return PointsHand(**kwargs)
    if name == "human":
        from taa_envs.hands.human import human

        return human(side)
    if name in HANDS:
        from taa_envs.hands.menagerie import robot_hand

        return robot_hand(name, side)
    raise UnknownHand(f"no hand is named {name!r}; known: {', '.join(HANDS)}")
