"""Posing: where nodes are, told to viser by the shortest way.

The one place that goes around viser's own setters: they compare each pose with numpy's ``allclose``, which
costs more than all the rest of telling it, and our callers have compared already. For talos at 30 Hz that
is a third of the drawing. They also look through Python's types for each array.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray
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


def place(
    handle: viser.BatchedAxesHandle | viser.BatchedGlbHandle,
    positions: NDArray[np.float32],
    wxyzs: NDArray[np.float32],
) -> None:
    """Put the instances of a node at places (N, 3) [m], turned by (N, 4); both are viser's to keep."""
    node = handle._impl
    node.props.batched_positions, node.props.batched_wxyzs = positions, wxyzs
    moved = {"batched_positions": positions, "batched_wxyzs": wxyzs}
    node.api._queue_scene_message(messages.SceneNodeUpdateMessage(node.name, moved))
