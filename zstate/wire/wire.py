"""The seam between what publishers and listeners do and how it is said on the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from msgspec import Struct

from zstate.wire.keys import Stream
from zstate.wire.messages import Message
from zstate.wire.sample_names import SampleNames
from zstate.wire.writer import Announced, Writer


class Arrival(Struct, frozen=True, gc=False):
    """One payload as it came from the network, with what came beside it.

    Of a payload that is too large for its stream only the ``size`` is kept, and one byte, so that it is not
    taken for a withdrawn value; decoding it raises MessageError.
    """

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None = None
    size: int = 0


class Place(NamedTuple):
    """Where a writer is on the network: its Zenoh session, and its number among that session's writers."""

    zid: str
    number: int


class Outlet(Protocol):
    """How one writer says one stream: where, in which bytes, and what goes beside them."""

    @property
    def key(self) -> str:
        """The key to put it on."""
        ...

    @property
    def encoding(self) -> str:
        """The Zenoh encoding under which it travels; empty for none."""
        ...

    @property
    def token(self) -> str | None:
        """The liveliness token that announces this writer of this stream, where there is one."""
        ...

    @property
    def can_withdraw(self) -> bool:
        """Whether readers understand that a latched value is taken back."""
        ...

    def encode(self, message: Message) -> bytes:
        """The bytes of ``message``. Raises InvalidInput for what this wire cannot say."""
        ...

    def attachment(self, now: int) -> bytes | None:
        """What goes beside the next payload, which is put at ``now`` [ns]."""
        ...


class Voice(Protocol):
    """One writer of one robot on a wire: what makes its outlets."""

    @property
    def token(self) -> str | None:
        """A liveliness token of the writer itself, where the wire has that."""
        ...

    def outlet(self, stream: Stream, number: int, name: str = "") -> Outlet:
        """How it says ``stream``; ``number`` tells its outlets apart, ``name`` its static edges."""
        ...


class Wire(Protocol):
    """One way of saying the streams of a robot: keys, encodings and bytes.

    What a stream carries is the same on every wire: JointState on ``joint_states``, TransformSample
    on ``tf``, StaticTransforms on ``tf_static``, RobotDescription on ``robot_description``, Clock on
    ``clock``. A wire may remember what it has decoded: each reader has its own.
    """

    @property
    def name(self) -> str:
        """What a user calls it: "native", ..."""
        ...

    @property
    def shared(self) -> frozenset[Stream]:
        """The streams of a robot that many writers say together, each a part."""
        ...

    def voice(self, robot: str, writer: Writer, place: Place, sample_names: SampleNames) -> Voice:
        """How ``writer`` says the streams of ``robot``. InvalidInput for names that cannot be in a key."""
        ...

    def reader_tokens(
        self, robot: str, streams: Sequence[Stream], reader: Writer, zid: str, number: Callable[[], int]
    ) -> tuple[str, ...]:
        """The liveliness tokens by which ``reader`` is known to read ``streams`` of ``robot``, or of all.

        ``number()`` gives each thing of a session another number.
        """
        ...

    def expression(self, robot: str, stream: Stream) -> str:
        """The key expression that hears ``stream`` from every writer; robot ``"*"`` means all."""
        ...

    def robot_of(self, key: str) -> str:
        """The robot that a key speaks of, for whoever listens to all. InvalidInput for a key of no robot."""
        ...

    def decode(self, stream: Stream, arrival: Arrival, robot: str) -> Sequence[Message]:
        """The messages that arrived on ``stream`` of ``robot``. Raises MessageError."""
        ...

    def statics_writer(self, key: str) -> str | None:
        """The name under which the static edges on ``key`` are written, if the key tells; as ``robot_of``."""
        ...

    def writers_expression(self, robot: str) -> str:
        """The key expression of the tokens of all writers of ``robot``, or of all robots for ``"*"``."""
        ...

    def announced(self, token: str, robot: str) -> Announced | None:
        """What a token under that expression says, or None if it speaks of something else."""
        ...
