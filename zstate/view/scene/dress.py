"""Dresses: in which ways the shapes of a robot are drawn."""

from __future__ import annotations

from typing import Literal

from zstate.model.shapes import Color, Role

Dress = Literal["visual", "collision", "grey"]

_COLLISION: Color = (0.98, 0.55, 0.12, 0.42)
_GREY: Color = (0.55, 0.57, 0.60, 0.38)

OVER: dict[Dress, Color | None] = {"visual": None, "collision": _COLLISION, "grey": _GREY}
"""The one colour of each dress; None for the colours that the shapes have."""


def role_of(dress: Dress) -> Role:
    """Which shapes are drawn in it: grey is for a silent robot, whose visuals are drawn so."""
    return "collision" if dress == "collision" else "visual"
