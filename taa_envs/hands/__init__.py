"""Hands that replay a demonstration, by name.

A hand is an object with

``name``
    its registered name;
``attach(spec)``
    adds its bodies and actuators to a scene's ``mujoco.MjSpec``;
``bind(model)``
    a controller for the compiled model, see :class:`taa_envs.hands.points.PointsController`.
"""

from __future__ import annotations

from taa_envs.errors import UnknownHand

HANDS = ("points",)


def make_hand(name: str, **kwargs: object) -> object:
    """The hand of that name.

    Raises:
        UnknownHand: there is none; the message lists the names.
    """
    if name == "points":
        from taa_envs.hands.points import PointsHand

        return PointsHand(**kwargs)
    raise UnknownHand(f"no hand is named {name!r}; known: {', '.join(HANDS)}")
