"""NodeSamples: who says what on a topic that many ROS nodes may share."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field

from zstate.cli.doctor.samples import Ranges
from zstate.closing import Closing
from zstate.errors import MessageError
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import Stream
from zstate.wire.messages import JointState, TransformSample
from zstate.wire.protocol import SerializedSample, Wire


@dataclass
class NodeHeard:
    """What one node has said: how many messages, when [ns], and of which joints or child frames."""

    first: int
    count: int = 0
    last: int = 0
    names: dict[str, None] = field(default_factory=dict[str, None])
    ranges: Ranges = field(default_factory=Ranges)

    @property
    def rate_hz(self) -> float | None:
        """Messages a second, as they come; None for fewer than two."""
        return (self.count - 1) * 1e9 / (self.last - self.first) if self.last > self.first else None


class NodeSamples(Closing):
    """Hears ``stream`` of ``robot``; ``heard`` has what each node said, by the number it puts beside it."""

    def __init__(self, session: Session, robot: str, stream: Stream, wire: Wire) -> None:
        self.heard: dict[int, NodeHeard] = {}
        self._robot, self._wire = robot, wire
        self._stream: Stream = stream
        self._subscriber = StreamSubscriber(session, wire.expression(robot, stream), self._take)

    def close(self) -> None:
        self._subscriber.close()

    def _take(self, arrivals: list[SerializedSample]) -> None:
        for arrival in arrivals:
            with suppress(MessageError):  # the listener beside this counts and names those of tf
                for said in self._wire.decode(self._stream, arrival, self._robot):
                    if isinstance(said, JointState):
                        self._note(said.session, said.names or ()).ranges.add(said)
                    elif isinstance(said, TransformSample):
                        self._note(said.session, [child for _, child in said.edges or ()])

    def _note(self, session: int, names: list[str] | tuple[str, ...]) -> NodeHeard:
        now = time.monotonic_ns()
        node = self.heard.setdefault(session, NodeHeard(now))
        node.count, node.last = node.count + 1, now
        node.names.update(dict.fromkeys(names))
        return node
