"""Ear: everything that one robot says for a moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack

from zstate._util.closeable import Closeable
from zstate.cli.doctor.samples import StreamSamples
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import MessageError
from zstate.ingest.events import WriterEvent
from zstate.net.clock_offset import MeasuredOffset
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import RobotInfo
from zstate.net.queryable import query
from zstate.net.session import Session
from zstate.net.status import watch_status
from zstate.nodes.listener import Follow, TransformListener
from zstate.wire.identity import WriterId
from zstate.wire.keys import Stream, clock_key
from zstate.wire.messages import RobotDescription, Status
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

AT_LEAST_S = 1.2
"""Writers say once a second how they do."""

_OF_NODES: tuple[Stream, ...] = ("joint_states", "tf")
_ANSWERS_WITHIN_S = 0.4


class Ear(Closeable):
    """Hears the robot ``info``, and how its writers do."""

    def __init__(
        self,
        session: Session,
        info: RobotInfo,
        wire: str,
        neighbours: Iterable[RobotInfo] = (),
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        self.info = info
        self.neighbours = tuple(neighbours)
        """All robots that are announced."""
        self.streams = frozenset(stream for stream, _ in info.writers)
        is_native = wire == "native"
        moves_by_joints = "joint_states" in self.streams or "tf" not in self.streams
        self.followed: Follow = "joint_states" if is_native and moves_by_joints else "tf"
        self.description: RobotDescription | None = None
        self.statuses: dict[int, Status] = {}
        self.events: list[WriterEvent] = []
        self.offsets: tuple[MeasuredOffset, ...] = ()
        self.stuck: set[WriterId] = set()
        self._session, self._wire = session, get_wire(wire)
        self._on_change = on_change
        with ExitStack() as opening:
            key = self._wire.expression(info.name, "robot_description")
            opening.enter_context(LatchedSubscriber(session, key, self._take_description))
            samples = StreamSamples(session, info.name, self.followed, self._wire, on_change)
            self.samples = opening.enter_context(samples)
            self.nodes: dict[Stream, StreamSamples] = {}
            """By stream, what each node says, on ROS's side."""
            if is_native:
                opening.enter_context(watch_status(session, info.name, self._take_status))
            else:
                for stream in _OF_NODES:
                    nodes = StreamSamples(session, info.name, stream, self._wire)
                    self.nodes[stream] = opening.enter_context(nodes)
            self.listener = opening.enter_context(
                TransformListener(
                    session,
                    info.name,
                    wire=wire,
                    follow=self.followed,
                    on_event=self.events.append,
                )
            )
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _take_description(self, arrival: SerializedSample) -> None:
        try:
            for said in self._wire.decode("robot_description", arrival, self.info.name):
                if isinstance(said, RobotDescription):
                    self.description = said
                    self._on_change()
        except MessageError:
            pass  # withdrawn; or broken, which the listener counts and names

    def _take_status(self, _: str, status: Status) -> None:
        self.statuses[status.session] = status

    def writers(self, stream: Stream) -> list[WriterId]:
        """Who is announced to write ``stream``, the newest last."""
        found = [writer for said, writer in self.info.writers if said == stream]
        return sorted(found, key=lambda writer: writer.since)

    @property
    def samples_writer(self) -> str:
        """Who writes the samples that come."""
        writers = {writer.session: str(writer) for _, writer in self.info.writers}
        return writers.get(self.samples.statistics.session or 0, "somebody who is not announced")

    @property
    def lacks(self) -> bool:
        """Whether something that is announced has not come yet."""
        lacks_model = "robot_description" in self.streams and self.description is None
        return lacks_model or (self.followed in self.streams and self.samples.statistics.count < 2)

    @property
    def is_mute(self) -> bool:
        """Whether nothing at all has come but that somebody is there."""
        frames = any(frame.kind == "static" for frame in self.listener.buffer.frames())
        return not (
            self.description or self.samples.statistics.count or self.statuses or self.offsets or frames
        )

    def ask(self) -> None:
        """Find out which writers are stuck, of those that have not told the time.

        Questions reach such a one, and it does not answer; who is kept from asking by a router is told at
        once that there is no answer.
        """
        known = {offset.writer.session for offset in self.offsets}
        for writer in {writer for _, writer in self.info.writers if writer.session not in known}:
            asked = time.monotonic()
            key = clock_key(self.info.name, writer.identity)
            answers = list(query(self._session.zenoh, key, _ANSWERS_WITHIN_S))
            is_answered = any(answer.ok is not None for answer in answers)
            if not is_answered and time.monotonic() - asked > 0.9 * _ANSWERS_WITHIN_S:
                self.stuck.add(writer)


def listen(ears: Sequence[Ear], waiter: ConditionWaiter, timeout_s: float) -> None:
    """Wait until everything announced has arrived, at least 1.2 s, at most ``timeout_s``.

    ``waiter`` is notified by the ears.
    """
    time.sleep(min(AT_LEAST_S, timeout_s))
    waiter.wait_for(lambda: not any(ear.lacks for ear in ears), timeout_s - AT_LEAST_S)
