"""The seam between what publishers and listeners do and how it is said on the network."""

from __future__ import annotations

from typing import Protocol

from zstate.wire.keys import Stream
from zstate.wire.messages import Message


class Wire(Protocol):
    """One way of saying the streams of a robot: keys, encodings and bytes.

    What a stream carries is the same on every wire: JointState on ``joint_states``, TransformSample
    on ``tf``, StaticTransforms on ``tf_static``, RobotDescription on ``robot_description``.
    """

    @property
    def name(self) -> str:
        """What a user calls it: "native", ..."""
        ...

    def key(self, robot: str, stream: Stream, writer: str = "") -> str:
        """The key to put ``stream`` on. InvalidInput for names that cannot be a chunk of it."""
        ...

    def expression(self, robot: str, stream: Stream) -> str:
        """The key expression that hears ``stream`` from every writer; robot ``"*"`` means all."""
        ...

    def encoding(self, stream: Stream) -> str:
        """The Zenoh encoding under which ``stream`` travels."""
        ...

    def encode(self, message: Message) -> bytes:
        """The bytes of ``message``."""
        ...

    def decode(self, stream: Stream, payload: bytes, encoding: str) -> Message:
        """The message that arrived on ``stream``. Raises MessageError."""
        ...
