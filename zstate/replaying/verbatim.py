"""Republishes recorded messages of a robot unchanged, as one new writer."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager

from zstate.clock import SIMULATED
from zstate.closing import Closing
from zstate.net.claims import Claim
from zstate.net.placing import Edge, named_edges, placing
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.net.writer import LatchedWriter, SampleWriter, WireWriter, write_all
from zstate.wire.keys import Stream
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)
from zstate.wire.writer import Announced


class Verbatim(Closing):
    """Publishes messages of ``robot`` on all ``wires``, with a session and sequence numbers of its own.

    ``streams`` are announced at once, latched values with the first of their name. A message that one of
    the wires cannot represent raises InvalidInput, and is sent on none. Raises SecondWriter if another
    writer of the same is active on the native wire; not with ``takeover``. Writers whose sessions are in
    ``cast``, this one among them, may place the same frame, as they did in the recording.
    """

    def __init__(
        self,
        session: Session,
        wires: Sequence[str],
        robot: str,
        streams: Sequence[Stream],
        *,
        cast: set[int],
        takeover: bool = False,
    ) -> None:
        self._session = session
        self._session_id = secrets.randbits(32)
        self._robot = robot
        self._cast = cast
        self._is_alone = "native" in wires and not takeover
        self._seqs: Counter[Stream] = Counter()
        self._latched: dict[tuple[Stream, str], list[LatchedWriter]] = {}
        self._placed: dict[str, set[Edge]] = {}
        self._writer = writer = writer_here(self._session_id)
        cast.add(self._session_id)
        with ExitStack() as opening:
            self._claim = self._claimed(opening, [Announced(robot, stream, writer) for stream in streams])
            self._wire_writers = [
                opening.enter_context(WireWriter(session, wire_named(wire), robot, writer)) for wire in wires
            ]
            self._streams: dict[Stream, list[SampleWriter]] = {
                stream: [one.open_stream(stream) for one in self._wire_writers] for stream in streams
            }
            self._opened = opening.pop_all()

    def say(self, message: JointState | TransformSample) -> None:
        """Publish one sample."""
        if self._claim is not None:
            self._claim.check()
        stream: Stream = "joint_states" if isinstance(message, JointState) else "tf"
        head = (message.stamp, self._seqs[stream], self._session_id, message.order)
        if isinstance(message, JointState):
            numbers = (message.positions, message.velocities, message.efforts)
            again = JointState(*head, *numbers, message.names)
        else:
            again = TransformSample(*head, message.poses, message.edges)
        write_all(self._streams[stream], again)
        self._seqs[stream] += 1

    def describe(self, description: RobotDescription, writer: str) -> None:
        """Publish the robot description, latched."""
        again = RobotDescription(
            self._session_id,
            description.urdf,
            description.digest,
            description.joint_names,
            description.moving_edges,
            SIMULATED,
        )
        write_all(self._latch("robot_description", writer), again)

    def fix(self, statics: StaticTransforms, writer: str) -> None:
        """Publish all static edges of one ``writer``, latched; if there are none, withdraw them."""
        key: tuple[Stream, str] = ("tf_static", writer)
        if statics.edges:
            writers = self._latch(*key)
            with self._placing(statics, writer):
                write_all(writers, StaticTransforms(self._session_id, statics.edges, statics.poses))
        else:
            for latched in self._latched.get(key, ()):
                latched.withdraw()
            self._placed.pop(writer, None)

    def _latch(self, stream: Stream, writer: str) -> list[LatchedWriter]:
        if (stream, writer) not in self._latched:
            announced = self._announced(stream, writer)
            with ExitStack() as opening:
                claim = self._claimed(opening, [announced])
                opened = [one.open_latched(stream, writer) for one in self._wire_writers]
                if claim is not None:
                    claim.settle()
                self._opened.push(opening.pop_all())
            self._latched[stream, writer] = opened
        return self._latched[stream, writer]

    def _announced(self, stream: Stream, writer: str) -> Announced:
        return Announced(self._robot, stream, self._writer, writer if stream == "tf_static" else "")

    def _claimed(self, opening: ExitStack, wanted: Sequence[Announced]) -> Claim | None:
        return opening.enter_context(Claim(self._session, wanted)) if self._is_alone and wanted else None

    @contextmanager
    def _placing(self, statics: StaticTransforms, writer: str) -> Generator[None]:
        """Announce the new ones of the edges of ``writer`` while they are sent."""
        edges = set(named_edges(self._robot, statics.edges))
        new = sorted(edges - self._placed.get(writer, set())) if self._is_alone else []
        with ExitStack() as placed:
            if new:
                announced = self._announced("tf_static", writer)
                placed.enter_context(placing(self._session, announced, new, beside=self._cast))
            yield
        self._placed[writer] = edges

    def close(self) -> None:
        """Stop publishing; listeners keep the latched values. A second call does nothing."""
        self._opened.close()
