"""Frame poses for tests of the scene, and the messages sent to viser."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import viser
from helpers.processes import until

from zstate import se3
from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.view.scene.scene import Scene

Pose = Sequence[float]
HERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Pose:
    return (x, y, z, *se3.quaternion_from_rpy(0.0, 0.0, yaw))


def tree(parents: Mapping[str, str | None]) -> FrameTable:
    """Frames by name with their parents, parents first."""
    names = tuple(parents)
    rows = [-1 if parent is None else names.index(parent) for parent in parents.values()]
    kinds = tuple("root" if parent is None else "joint" for parent in parents.values())
    return FrameTable(names, np.array(rows, dtype=np.intp), kinds, (None,) * len(names))


def moment(
    of: FrameTable, poses: Mapping[str, Pose], stamp: int = 0, unknown: Sequence[str] = ()
) -> FramePoses:
    """Poses of all frames; unnamed frames coincide with their parents."""
    rows = np.array([poses.get(name, HERE) for name in of.names])
    known = np.array([name not in unknown for name in of.names])
    return FramePoses(stamp, of, rows, known)


def drawn(scene: Scene, shown) -> None:
    """Shows poses until the picture is complete."""

    def complete() -> bool:
        scene.show(shown, "map")
        return not scene.busy

    until(complete)
    scene.show(shown, "map")


def handles(server: viser.ViserServer, kind: type[Any]) -> dict[str, Any]:
    """All scene nodes of a kind, by path."""
    every = server.scene._handle_from_node_name
    return {path: handle for path, handle in every.items() if isinstance(handle, kind)}


def in_fixed(server: viser.ViserServer, path: str) -> tuple[float, ...]:
    """The pose of a node in the fixed frame: the product of the poses of all nodes above it."""
    pose = se3.IDENTITY
    parts = path.split("/")
    for k in range(2, len(parts) + 1):
        handle = server.scene.get_handle_by_name("/".join(parts[:k]))
        assert handle is not None
        qw, qx, qy, qz = handle.wxyz.tolist()
        pose = se3.compose(pose, (*handle.position.tolist(), qx, qy, qz, qw))
    return pose


def is_seen(server: viser.ViserServer, path: str) -> bool:
    """Whether a node and all above it are visible."""
    parts = path.split("/")
    above = [server.scene.get_handle_by_name("/".join(parts[:k])) for k in range(2, len(parts) + 1)]
    return all(handle is not None and handle.visible for handle in above)


@contextmanager
def sent_messages(server: viser.ViserServer) -> Iterator[list[Any]]:
    """Collects the messages sent to viser inside the block."""
    messages: list[Any] = []
    scene = server.scene
    queue = scene._queue_scene_message

    def queued(message: Any) -> None:
        messages.append(message)
        queue(message)

    scene._queue_scene_message = queued
    try:
        yield messages
    finally:
        scene._queue_scene_message = queue
