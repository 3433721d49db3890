"""``tf2_msgs/msg/TFMessage``: transforms, each with its frames and its stamp."""

from __future__ import annotations

from typing import NamedTuple

from zstate.errors import InvalidInput
from zstate.wire.messages import POSE_BYTES, Edges
from zstate.wire.ros2.cdr import STAMP_BYTES, CdrReader, CdrWriter, pack_stamp, unpack_stamps
from zstate.wire.ros2.cdr_template import CdrTemplate, TemplateCache
from zstate.wire.ros2.types import TF_MESSAGE

_POSE_NUMBERS = 7


class RosTransforms(NamedTuple):
    """A TFMessage as received: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``.

    ``poses`` is a block of x y z [m], qx qy qz qw. ``stamps`` [ns] has one for each edge; ``stamp`` is
    the one they share, or None when they differ or there are none. Payloads that differ in numbers only
    come with the very same ``edges``.
    """

    stamp: int | None
    stamps: tuple[int, ...]
    edges: Edges
    poses: bytes


class TfMessageEncoder:
    """Says the poses of ``edges``, all of one instant, a block in their order each time.

    Raises InvalidInput for a frame name that is no text for ROS 2.
    """

    def __init__(self, edges: Edges) -> None:
        self._count = len(edges)
        payload = _write(edges)
        reader = CdrReader(payload, TF_MESSAGE.name)
        _read(reader)
        self._layout = CdrTemplate(reader)
        self._fixed, _ = self._layout.split(payload)

    def encode(self, stamp: int, poses: bytes) -> bytes:
        """The payload of one instant; ``poses`` is a block of ``parent_from_child``, pose7 for each edge.

        Raises InvalidInput for a block that has not one pose for each edge, and for a ``stamp`` [ns]
        outside the years 1901 to 2038.
        """
        count = self._count
        if len(poses) != POSE_BYTES * count:
            raise InvalidInput(
                f"{count} edges need a block of {POSE_BYTES * count} bytes, {POSE_BYTES} for each pose, "
                f"not {len(poses)}"
            )
        return self._layout.join(self._fixed, pack_stamp(stamp) * count + poses)


class TfMessageDecoder:
    """Reads the payloads of any number of writers; those it has seen the like of, in one step."""

    def __init__(self) -> None:
        self._layouts: TemplateCache[Edges] = TemplateCache()

    def decode(self, payload: bytes) -> RosTransforms:
        """The message in ``payload``.

        Raises MessageError with the reason "truncated" or "malformed". Whether numbers are finite,
        quaternions of length 1 and frames a tree is not looked at.
        """
        found = self._layouts.find(payload)
        if found is None:
            return self._decode_new(payload)
        edges, numbers = found
        end = STAMP_BYTES * len(edges)
        return _transforms(edges, numbers[:end], numbers[end:])

    def _decode_new(self, payload: bytes) -> RosTransforms:
        reader = CdrReader(payload, TF_MESSAGE.name)
        transforms = _read(reader)
        self._layouts.add(reader, transforms.edges)
        return transforms


def _transforms(edges: Edges, times: bytes, poses: bytes) -> RosTransforms:
    count = len(edges)
    first = times[:STAMP_BYTES]
    if not count or times != first * count:
        return RosTransforms(None, unpack_stamps(times), edges, poses)
    (stamp,) = unpack_stamps(first)
    return RosTransforms(stamp, (stamp,) * count, edges, poses)


def _read(reader: CdrReader) -> RosTransforms:
    stamps: list[int] = []
    edges: list[tuple[str, str]] = []
    poses: list[bytes] = []
    for _ in range(reader.count()):
        stamps.append(reader.stamp())
        edges.append((reader.text(), reader.text()))
        poses.append(reader.numbers(_POSE_NUMBERS))
    shared = stamps[0] if len(set(stamps)) == 1 else None
    return RosTransforms(shared, tuple(stamps), tuple(edges), b"".join(poses))


def _write(edges: Edges) -> bytes:
    writer = CdrWriter()
    writer.count(len(edges))
    for parent, child in edges:
        writer.stamp(0)
        writer.text(parent)
        writer.text(child)
        writer.numbers(bytes(POSE_BYTES))
    return writer.payload()
