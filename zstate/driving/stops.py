"""Stops of a driver: sent by any program that may, obeyed until they are released, also after a restart.

A stop travels by a key of its own, reliably and before all samples. It is no safety-rated channel: an
emergency stop is wired to the power of the hardware.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import NamedTuple

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.driving.driver import StopMode
from zstate.driving.stops_file import ActiveStop, HostLock, read_stops, stops_file, write_stops
from zstate.errors import ConfigError, InvalidInput, MessageError, Unreachable, printable
from zstate.net.latched import LatchedPublisher, LatchedSubscriber, cached_values
from zstate.net.ownership import wait_for_discovery
from zstate.net.presence import local_writer
from zstate.net.queryable import check_timeout
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, call_for_each
from zstate.wire.identity import WriterId
from zstate.wire.keys import (
    check_robot,
    driver_key,
    parse_stop_key,
    release_expression,
    stop_expression,
    stop_key,
)
from zstate.wire.messages import DriverState, Release, Stop
from zstate.wire.native import ENCODINGS, decode, encode
from zstate.wire.protocol import SerializedSample

_LOG = logging.getLogger("zstate")

_CACHES_WITHIN_S = 0.5
_MOST_STOPS = 256

_STANDING = ("stopped", "off", "fault")
"""States in which a driver writes nothing, and has been stopped."""

_STOPPERS: weakref.WeakKeyDictionary[Session, dict[str, _Stopper]] = weakref.WeakKeyDictionary()
_STOPPERS_LOCK = fork_safe_lock()


def stop(
    session: Session, robot: str, reason: str = "", *, how: StopMode = "hold", timeout_s: float = 1.0
) -> DriverState:
    """Stop the driver of ``robot``, and return its state once it has stopped.

    The driver stays stopped, also if it or this program restarts, until ``Commander.release``. "hold" leaves
    the joints where they are, "relax" without torque. ``reason`` is shown to users. No claim is needed. Not a
    safety-rated channel.

    Raises Unreachable if no driver has confirmed the stop within ``timeout_s`` [s]. The stop stays latched in
    ``session`` then: a driver that can be reached later obeys it.
    """
    check_timeout(timeout_s)
    with _STOPPERS_LOCK:
        stoppers = _STOPPERS.setdefault(session, {})
        stopper = stoppers.get(robot)
        if stopper is None:
            stopper = stoppers[robot] = _Stopper(session, check_robot(robot))
    return stopper.stop(how, reason, timeout_s)


class _Stopper:
    """The stops of one robot that one session has sent; latched while the session is open."""

    def __init__(self, session: Session, robot: str) -> None:
        self._robot = robot
        # Not the session itself: the stoppers of a session must not keep it alive.
        self._session = weakref.ref(session)
        self._writer = local_writer(secrets.randbits(32))
        self._seq = 0
        self._lock = fork_safe_lock()
        key = stop_key(robot, self._writer.identity)
        self._latched = LatchedPublisher(session, key, ENCODINGS[Stop], urgent=True)

    def stop(self, how: StopMode, reason: str, timeout_s: float) -> DriverState:
        with self._lock:
            number, self._seq = self._seq, self._seq + 1
            message = Stop(time.time_ns(), number, self._writer.session, how, reason)
            self._latched.set(encode(message))  # before anything that takes time
        session = self._session()
        assert session is not None, "the caller has it"
        confirmed = wait_for_state(
            session, self._robot, lambda state: self._is_obeyed(state, number), timeout_s
        )
        if confirmed is None:
            raise Unreachable(
                f"no driver of {self._robot!r} has confirmed the stop within {timeout_s:g} s. Is it running, "
                "and may this program stop it (`zstate acl`)? The stop stays latched while this session is "
                "open",
                endpoints=(),
            )
        return confirmed

    def _is_obeyed(self, state: DriverState, number: int) -> bool:
        """Whether the driver has stopped for the stop ``number`` or a later one, which replaces it."""
        mine = self._writer.session
        return state.state in _STANDING and any(
            session == mine and seq >= number for session, seq in state.stops
        )


def wait_for_state(
    session: Session, robot: str, condition: Callable[[DriverState], bool], timeout_s: float
) -> DriverState | None:
    """The first state of the driver of ``robot`` with ``condition``, else None after ``timeout_s``."""
    found: list[DriverState] = []
    has_found = threading.Event()

    def on_value(sample: SerializedSample) -> None:
        with suppress(MessageError):
            state = decode(sample.payload, sample.encoding, DriverState)
            if not found and condition(state):
                found.append(state)
                has_found.set()

    with LatchedSubscriber(session, driver_key(robot), on_value):
        has_found.wait(timeout_s)
    return found[0] if found else None


class LatchedStops(NamedTuple):
    """The ``stops`` that are not released, and how many have ``arrived`` until now, the ``newest`` last.

    A stop that is released before the next tick is known by these two.
    """

    stops: tuple[ActiveStop, ...] = ()
    arrived: int = 0
    newest: ActiveStop | None = None


class StopRegister:
    """The stops of a driver that are not released. Safe from any thread."""

    def __init__(self) -> None:
        self._lock = fork_safe_lock()
        self._by_session: dict[int, ActiveStop] = {}
        self._released: dict[int, int] = {}
        """The last released stop of each session, which its program may still cache."""
        self.current = LatchedStops()
        """Another object after each change."""
        self.released_by = (0, 0)
        """Session and ``seq`` of the last release of a stop."""

    def latch(self, reason: str, writer: WriterId, how: StopMode = "hold") -> None:
        """Latch a stop of this host itself, after those that it has latched before."""
        with self._lock:
            session = writer.session
            known = self._by_session.get(session)
            seq = 1 + (self._released.get(session, -1) if known is None else known.seq)
            self._add(ActiveStop(session, seq, how, reason, str(writer)))

    def add(self, one: ActiveStop) -> None:
        """Latch ``one``, unless it is older than the last stop of its session, or released."""
        with self._lock:
            known = self._by_session.get(one.session)
            is_old = known is not None and known.seq >= one.seq
            if not is_old and self._released.get(one.session, -1) < one.seq:
                self._add(one)

    def release(self, release: Release) -> None:
        """End the stops of ``release``, and older ones of their sessions."""
        with self._lock:
            ended = [
                session
                for session, seq in release.stops
                if session in self._by_session and self._by_session[session].seq <= seq
            ]
            for session in ended:
                # Newest last, so that the oldest is forgotten first.
                self._released.pop(session, None)
                self._released[session] = self._by_session.pop(session).seq
            while len(self._released) > _MOST_STOPS:
                del self._released[next(iter(self._released))]
            if ended:
                self.released_by = (release.session, release.seq)
                self._save()  # first: a release that is confirmed holds for the next host as well
                self.current = self.current._replace(stops=tuple(self._by_session.values()))

    def _add(self, one: ActiveStop) -> None:
        """Latch ``one`` in place of the last stop of its session, or of the oldest one of too many.

        If that has switched the torque off, it stays off.
        """
        replaced = [self._by_session.pop(one.session, None)]
        if len(self._by_session) == _MOST_STOPS:
            replaced.append(self._by_session.pop(next(iter(self._by_session))))
        if any(old is not None and old.how == "relax" for old in replaced):
            one = replace(one, how="relax")
        self._by_session[one.session] = one
        self.current = LatchedStops(tuple(self._by_session.values()), self.current.arrived + 1, one)
        self._save()

    def _save(self) -> None:
        """Called with the lock, after a stop is latched, and before its release holds."""


class StopLatch(StopRegister, Closeable):
    """The stops of the driver of ``robot`` that are not released, from the network.

    They are kept in ``stops_file``, which a restarted host reads, and are read from the caches of programs
    that have sent them. A file that cannot be read counts as a stop; one that cannot be written raises
    ConfigError here, and is logged later. While it is open, it has the ``HostLock`` of the robot; raises
    SecondWriter if another host has that. ``refusals`` counts invalid messages.
    """

    def __init__(self, session: Session, robot: str, refusals: Refusals) -> None:
        super().__init__()
        self._robot = robot
        self._path = stops_file(robot)
        self._refusals = refusals
        with ExitStack() as opening:
            opening.enter_context(HostLock(robot))
            self._read_file()
            self._write_file(is_opening=True)
            wait_for_discovery(session)
            call_for_each(cached_values(session, stop_expression(robot), _CACHES_WITHIN_S), self._on_stop)
            opening.enter_context(LatchedSubscriber(session, stop_expression(robot), self._on_stop))
            releases = StreamSubscriber(session, release_expression(robot), self._on_releases)
            opening.enter_context(releases)
            self._opened = opening.pop_all()

    @property
    def latched(self) -> tuple[ActiveStop, ...]:
        """The stops that are not released."""
        return self.current.stops

    def close(self) -> None:
        """Follow no further stops. Those that are latched stay in the file."""
        self._opened.close()

    def _on_stop(self, sample: SerializedSample) -> None:
        if not sample.payload:
            return  # the program has ended; its stop has not
        try:
            _, identity = parse_stop_key(sample.key)
            writer = WriterId.parse(identity)
            message = decode(sample.payload, sample.encoding, Stop)
        except (MessageError, InvalidInput) as error:
            self._refusals.count(getattr(error, "reason", "foreign"), error)
            return
        if message.session != writer.session:
            self._refusals.count("foreign", f"the Stop of another program on {sample.key!r}")
            return
        reason = printable(message.reason)
        self.add(ActiveStop(message.session, message.seq, message.how, reason, str(writer)))

    def _on_releases(self, samples: list[SerializedSample]) -> None:
        for sample in samples:
            try:
                release = decode(sample.payload, sample.encoding, Release)
            except MessageError as error:
                self._refusals.count(error.reason, error)
                continue
            self.release(release)

    def _read_file(self) -> None:
        try:
            stops, self._released = read_stops(self._path)
        except (OSError, ValueError) as error:
            stops = [ActiveStop(0, 0, "hold", f"{self._path} cannot be read: {error}", "this host")]
        self._by_session = {one.session: one for one in stops}
        self.current = LatchedStops(tuple(stops), len(stops), stops[-1] if stops else None)

    def _save(self) -> None:
        self._write_file()

    def _write_file(self, *, is_opening: bool = False) -> None:
        try:
            write_stops(self._path, tuple(self._by_session.values()), self._released)
        except OSError as error:
            text = (
                f"stops of {self._robot!r} cannot be kept in {self._path}: {error}; a restarted host would "
                "not obey them: set XDG_STATE_HOME to a folder that can be written"
            )
            if is_opening:
                raise ConfigError(text, path=str(self._path)) from None
            _LOG.error("%s", text)
