"""The base classes of messages, and the types of their first fields."""

from __future__ import annotations

from typing import Annotated, ClassVar, TypeAlias

from msgspec import Meta, Struct

Stamp: TypeAlias = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
SessionId: TypeAlias = Annotated[int, Meta(ge=0)]
"""Below 2^64, as MessagePack has no larger integers."""
Count: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""One more than it can still be encoded: readers echo numbers, and count on from them."""


class Message(Struct, frozen=True, array_like=True, gc=False):
    """Base of the messages of the native wire format."""

    type_name: ClassVar[str] = ""
    """The name in its Zenoh encoding, which is part of the protocol; empty for that of the class."""
    max_bytes: ClassVar[int] = 0
    """Larger payloads are refused, on whatever key; 0 for the limit of the largest stream."""

    @staticmethod
    def pack(payload: bytes) -> bytes:
        """The bytes on the wire for the MessagePack array ``payload``."""
        return payload

    @staticmethod
    def unpack(payload: bytes) -> bytes:
        """The MessagePack array in the bytes from the wire. Raises MessageError."""
        return payload


class StampedMessage(Message, frozen=True, array_like=True, gc=False):
    """A message of a stream at the instant ``stamp`` [ns].

    ``seq`` grows by one with each message of a ``session``, a random number drawn when a writer starts.
    """

    stamp: Stamp
    seq: Count
    session: SessionId
