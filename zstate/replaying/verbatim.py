"""Verbatim: what a robot said, said again as it is, by one new writer."""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack

from zstate.clock import SIMULATED
from zstate.closing import Closing
from zstate.net.outlets import LatchedOutlet, Outlets, StreamOutlet
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.wire.keys import Stream
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)


class Verbatim(Closing):
    """Publishes messages of ``robot`` on all ``wires``, with a session and sequence numbers of its own.

    ``streams`` are announced at once, latched values with the first of their name. A message that one of
    the wires cannot say raises InvalidInput, and is said on none.
    """

    def __init__(self, session: Session, wires: Sequence[str], robot: str, streams: Sequence[Stream]) -> None:
        self._session_id = secrets.randbits(32)
        self._seqs: Counter[Stream] = Counter()
        self._latched: dict[tuple[Stream, str], list[LatchedOutlet]] = {}
        writer = writer_here(self._session_id)
        with ExitStack() as opening:
            self._outlets = [
                opening.enter_context(Outlets(session, wire_named(wire), robot, writer)) for wire in wires
            ]
            self._streams: dict[Stream, list[StreamOutlet]] = {
                stream: [outlets.stream(stream) for outlets in self._outlets] for stream in streams
            }
            self._opened = opening.pop_all()

    def say(self, message: JointState | TransformSample) -> None:
        """One sample."""
        stream: Stream = "joint_states" if isinstance(message, JointState) else "tf"
        head = (message.stamp, self._seqs[stream], self._session_id, message.order)
        if isinstance(message, JointState):
            numbers = (message.positions, message.velocities, message.efforts)
            again = JointState(*head, *numbers, message.names)
        else:
            again = TransformSample(*head, message.poses, message.edges)
        said = [(outlet, outlet.encode(again)) for outlet in self._streams[stream]]
        self._seqs[stream] += 1
        for outlet, payload in said:
            outlet.put(payload)

    def describe(self, description: RobotDescription, writer: str) -> None:
        """What the robot is, for late joiners too."""
        said = description
        again = RobotDescription(
            self._session_id, said.urdf, said.digest, said.joint_names, said.moving_edges, SIMULATED
        )
        for outlet in self._latch("robot_description", writer):
            outlet.set(again)

    def fix(self, statics: StaticTransforms, writer: str) -> None:
        """All static edges of one ``writer``; none at all take back what it said before."""
        key: tuple[Stream, str] = ("tf_static", writer)
        if statics.edges:
            for outlet in self._latch(*key):
                outlet.set(StaticTransforms(self._session_id, statics.edges, statics.poses))
        else:
            for outlet in self._latched.get(key, ()):
                outlet.withdraw()

    def _latch(self, stream: Stream, writer: str) -> list[LatchedOutlet]:
        if (stream, writer) not in self._latched:
            opened = [outlets.latched(stream, writer) for outlets in self._outlets]
            self._latched[stream, writer] = opened
        return self._latched[stream, writer]

    def close(self) -> None:
        """Stop; who has the latched values keeps them. A second call does nothing."""
        self._opened.close()
