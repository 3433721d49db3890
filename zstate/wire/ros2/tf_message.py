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
    """A decoded TFMessage: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``.

    ``poses`` is a block of x y z [m], qx qy qz qw. ``stamps`` [ns] has one for each edge; ``stamp`` is
    their common value, or None if they differ or there are none. Payloads that differ only in numbers have
    the same ``edges`` object.
    """

    stamp: int | None
    stamps: tuple[int, ...]
    edges: Edges
    poses: bytes


class TfMessageEncoder:
    """Encodes the poses of ``edges`` at one instant.

    Raises InvalidInput for a frame name that is no text for ROS 2.
    """

    def __init__(self, edges: Edges) -> None:
        self._count = len(edges)
        writer = CdrWriter()
        writer.count(len(edges))
        for parent, child in edges:
            writer.stamp(0)
            writer.text(parent)
            writer.text(child)
            writer.numbers(bytes(POSE_BYTES))
        reader = CdrReader(writer.payload(), TF_MESSAGE.name)
        _read(reader)
        self._template = CdrTemplate(reader)
        self._fixed, _ = self._template.split(reader.payload)

    def encode(self, stamp: int, poses: bytes) -> bytes:
        """The payload of one instant; ``poses`` is a block of ``parent_from_child``, pose7 for each edge.

        Raises InvalidInput for a block without one pose for each edge, and for a ``stamp`` [ns] outside the
        years 1901 to 2038.
        """
        count = self._count
        if len(poses) != POSE_BYTES * count:
            raise InvalidInput(
                f"{count} edges need a block of {POSE_BYTES * count} bytes, {POSE_BYTES} for each pose, "
                f"not {len(poses)}"
            )
        return self._template.join(self._fixed, pack_stamp(stamp) * count + poses)


class TfMessageDecoder:
    """Decodes payloads of any number of writers; after the first of its template, in one step."""

    def __init__(self) -> None:
        self._templates: TemplateCache[Edges] = TemplateCache()

    def decode(self, payload: bytes) -> RosTransforms:
        """The message in ``payload``.

        Raises MessageError with the reason "truncated" or "malformed". Does not check that numbers are
        finite, quaternions have length 1 and frames form a tree.
        """
        found = self._templates.find(payload)
        if found is None:
            reader = CdrReader(payload, TF_MESSAGE.name)
            transforms = _read(reader)
            self._templates.add(reader, transforms.edges)
            return transforms
        edges, numbers = found
        count = len(edges)
        times, poses = numbers[: STAMP_BYTES * count], numbers[STAMP_BYTES * count :]
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
