"""The one program that commands a robot's driver."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.driving.commands import check_named_positions
from zstate.errors import Closed, InvalidInput, MessageError, Unreachable, format_duration
from zstate.net.latched import LatchedSubscriber
from zstate.net.ownership import WriterClaim
from zstate.net.presence import local_writer
from zstate.net.queryable import check_timeout
from zstate.net.session import Session
from zstate.net.streams import StreamPublisher
from zstate.net.writer import WireWriter
from zstate.wire.identity import Announcement
from zstate.wire.keys import check_robot, driver_key, release_key
from zstate.wire.messages import DriverState, JointCommand, Release, order_digest, to_block
from zstate.wire.native import ENCODINGS, decode, encode
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

_SILENT_S = 0.5
"""A driver publishes its state ten times a second; one that is silent for so long is gone or frozen."""

_RELEASE_PERIOD_S = 0.1


class Commander(Closeable):
    """Sends setpoints to the driver of ``robot``; a robot has one commander at a time.

    SecondWriter, which names the first, is raised if another commander is active, and by ``send`` if both
    opened at once. ``program`` is this commander's name for others; default: the script's name. A context
    manager; safe from any thread. Not a safety-rated channel.
    """

    def __init__(self, session: Session, robot: str, *, program: str = "") -> None:
        self.robot = check_robot(robot)
        identity = local_writer(secrets.randbits(32), program)
        self._session_id = identity.session
        self._seq = 0
        self._closed = False
        self._lock = fork_safe_lock()
        self._state: tuple[DriverState, float] | None = None
        self._has_changed = fork_safe(threading.Condition())
        with ExitStack() as opening:
            announced = Announcement(self.robot, "joint_commands", identity)
            self._claim = opening.enter_context(WriterClaim(session, [announced]))
            writer = opening.enter_context(WireWriter(session, get_wire("native"), self.robot, identity))
            self._writer = writer.open_stream("joint_commands")
            self._claim.confirm()
            key = release_key(self.robot, identity.identity)
            self._releases = opening.enter_context(StreamPublisher(session, key, ENCODINGS[Release]))
            opening.enter_context(LatchedSubscriber(session, driver_key(self.robot), self._on_state))
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._closed else ""
        return f"<Commander of {self.robot!r}: {self._seq} commands{closed}>"

    @property
    def driver(self) -> DriverState | None:
        """The newest state of the driver; None if none has arrived for half a second."""
        newest = self._state
        if newest is None or time.monotonic() - newest[1] > _SILENT_S:
            return None
        return newest[0]

    def wait_for_driver(self, timeout_s: float = 2.0) -> DriverState:
        """The state of the driver, once it is known. Raises Unreachable after ``timeout_s`` [s]."""
        check_timeout(timeout_s)
        with self._has_changed:
            if not self._has_changed.wait_for(lambda: self.driver is not None, timeout_s):
                raise Unreachable(
                    f"no driver of {self.robot!r} has published its state within {timeout_s:g} s; start the "
                    "program with its DriverHost first",
                    endpoints=(),
                )
            state = self.driver
        assert state is not None
        return state

    def send(self, positions: Mapping[str, float], ttl_s: float | None = None) -> None:
        """Send positions [rad] or [m] by joint; returns at once.

        They are valid for ``ttl_s`` [s] after their arrival, by default and at most for the driver's own
        limit: then the driver holds the joints. Send again before. The driver refuses positions outside
        limits, and moves no faster than these allow: ``driver`` has the counts and the newest reason.

        Raises InvalidInput for no joints, for numbers that are not finite, for an unknown joint and a ttl
        that is too long if the driver's state is known; SecondWriter; and Closed. If it raises, nothing was
        sent.
        """
        numbers = {name: float(value) for name, value in positions.items()}
        check_named_positions(numbers)
        if ttl_s is not None:
            check_timeout(ttl_s)
        ttl = 0 if ttl_s is None else max(1, round(ttl_s * 1e9))
        self._check_against_driver(numbers, ttl)
        names = tuple(numbers)
        block = to_block(list(numbers.values()))
        with self._lock:
            if self._closed:
                raise Closed(f"the commander of {self.robot!r} is closed")
            self._claim.check()
            head = (time.time_ns(), self._seq, self._session_id, order_digest(names))
            self._writer.write(encode(JointCommand(*head, block, names=names, ttl=ttl)))
            self._seq += 1

    def release(self, timeout_s: float = 2.0) -> DriverState:
        """Release the stops of the driver that are known here, and return its state after that.

        The driver moves again with the next ``send`` of this commander, from where the joints are then. A
        stop that arrives at the same time stays. Raises Unreachable if the driver has not confirmed it within
        ``timeout_s`` [s]; SecondWriter; and Closed.
        """
        deadline = time.monotonic() + check_timeout(timeout_s)
        known = self.wait_for_driver(timeout_s)
        while True:
            state = self.wait_for_driver(timeout_s)
            left = set(known.stops).intersection(state.stops)
            if not left and (state.stops or state.state != "stopped"):  # not between the two
                return state
            if time.monotonic() > deadline:
                raise Unreachable(
                    f"the driver of {self.robot!r} has not confirmed the release within {timeout_s:g} s; may "
                    "this program command it (`zstate acl --commander`)?",
                    endpoints=(),
                )
            with self._lock:
                if self._closed:
                    raise Closed(f"the commander of {self.robot!r} is closed")
                self._claim.check()
                message = Release(time.time_ns(), self._seq, self._session_id, tuple(left))
                self._releases.put(encode(message))
            with self._has_changed:
                self._has_changed.wait(_RELEASE_PERIOD_S)

    def close(self) -> None:
        """Send no more; the driver holds once the last command has expired. A second call does nothing."""
        with self._lock:
            self._closed = True
        self._opened.close()

    def _check_against_driver(self, positions: Mapping[str, float], ttl: int) -> None:
        state = self.driver
        if state is None:
            return
        unknown = [name for name in positions if name not in state.joint_names]
        if unknown:
            raise InvalidInput(
                f"the driver of {self.robot!r} has no joint {', '.join(map(repr, unknown))}; it has "
                f"{', '.join(state.joint_names)}"
            )
        if ttl > state.ttl:
            raise InvalidInput(
                f"a ttl of {format_duration(ttl)} is longer than {format_duration(state.ttl)}, which the "
                f"driver of {self.robot!r} grants at most; send again before it ends"
            )

    def _on_state(self, sample: SerializedSample) -> None:
        with suppress(MessageError):
            state = decode(sample.payload, sample.encoding, DriverState)
            with self._has_changed:
                self._state = (state, time.monotonic())
                self._has_changed.notify_all()
