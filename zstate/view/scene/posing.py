"""Posing: where nodes are, told to viser by the shortest way.

The one place that goes around viser's own setters: they compare each pose with numpy's ``allclose``, which
costs more than all the rest of telling it, and ``Nodes`` has compared already. For talos at 30 Hz that is
a third of the drawing.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import viser
from viser import _messages as messages

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def move(handle: viser.SceneNodeHandle, position: Vector) -> None:
    """Put a node at a place [m] in that above it."""
    node = handle._impl
    node.position[:] = position
    node.api._queue_scene_message(messages.SetPositionMessage(node.name, position))


def turn(handle: viser.SceneNodeHandle, wxyz: Quaternion) -> None:
    """Turn a node in that above it."""
    node = handle._impl
    node.wxyz[:] = wxyz
    node.api._queue_scene_message(messages.SetOrientationMessage(node.name, wxyz))
