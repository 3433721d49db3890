"""Helpers for tests of the scene: snapshots from given poses, and the nodes and messages of viser."""

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
    """A table of frames with their parents, which come before them."""
    names = tuple(parents)
    rows = [-1 if parent is None else names.index(parent) for parent in parents.values()]
    kinds = tuple("root" if parent is None else "joint" for parent in parents.values())
    return FrameTable(names, np.array(rows, dtype=np.intp), kinds, (None,) * len(names))


def snapshot(
    frames: FrameTable, poses: Mapping[str, Pose], stamp: int = 0, unknown: Sequence[str] = ()
) -> FramePoses:
    """A snapshot; frames that are not in ``poses`` have the pose of their parent."""
    rows = np.array([poses.get(name, HERE) for name in frames.names])
    known = np.array([name not in unknown for name in frames.names])
    return FramePoses(stamp, frames, rows, known)


def drawn(scene: Scene, shown) -> None:
    """Show a snapshot until all its meshes are loaded."""

    def complete() -> bool:
        scene.show(shown, "map")
        return not scene.busy

    until(complete)
    scene.show(shown, "map")


def handles(server: viser.ViserServer, kind: type[Any]) -> dict[str, Any]:
    """The nodes of a type in the scene, by path."""
    every = server.scene._handle_from_node_name
    return {path: handle for path, handle in every.items() if isinstance(handle, kind)}


def pose_in_fixed(server: viser.ViserServer, path: str) -> tuple[float, ...]:
    """The pose of a viser node in the fixed frame: the product of its own and its ancestors' poses."""
    pose = se3.IDENTITY
    parts = path.split("/")
    for k in range(2, len(parts) + 1):
        handle = server.scene.get_handle_by_name("/".join(parts[:k]))
        assert handle is not None
        qw, qx, qy, qz = handle.wxyz.tolist()
        pose = se3.compose(pose, (*handle.position.tolist(), qx, qy, qz, qw))
    return pose


def is_visible(server: viser.ViserServer, path: str) -> bool:
    """Whether a node and all its ancestors are visible."""
    parts = path.split("/")
    above = [server.scene.get_handle_by_name("/".join(parts[:k])) for k in range(2, len(parts) + 1)]
    return all(handle is not None and handle.visible for handle in above)


@contextmanager
def sent_messages(server: viser.ViserServer) -> Iterator[list[Any]]:
    """The messages that viser sends inside."""
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
