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
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache
from typing import NamedTuple

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.driving.driver import StopMode
from zstate.driving.messages import DriverState, Release, Stop, stop_text
from zstate.driving.stops_file import (
    ActiveStop,
    HostLock,
    StopId,
    copy_aside,
    read_stops,
    stops_file,
    write_stops,
)
from zstate.errors import ConfigError, InvalidInput, MessageError, Unreachable, printable
from zstate.net.latched import LatchedPublisher, LatchedSubscriber, cached_values
from zstate.net.ownership import wait_for_discovery
from zstate.net.presence import local_writer
from zstate.net.queryable import check_timeout
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, call_for_each
from zstate.wire.identity import WriterId
from zstate.wire.keys import (
    RELAX,
    RELEASE,
    STOP,
    check_robot,
    stream_from_key,
    stream_key,
)
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample

_LOG = logging.getLogger("zstate")

_CACHES_WITHIN_S = 0.5
_MOST_STOPS = 256
_MOST_OF_SESSION = 8
_MOST_DISPLACED = 256
_MOST_RELEASED = 32
_MOST_SENT = 64
_MOST_WAITING = 1024
"""The most stops that wait; in a flood the newest one waits for as many others."""

_STEP_BITS = 32
_REPEAT_S = 0.25
"""A stop that is not confirmed within that is sent again, as it was; then after twice that, ..."""

STAYS_LATCHED = "The stop stays latched while this session is open"

_STANDING = ("stopped", "off", "fault")
"""States in which a driver writes nothing, and has been stopped."""

_STOPPERS: weakref.WeakKeyDictionary[Session, dict[str, _Stopper]] = weakref.WeakKeyDictionary()
_STOPPERS_LOCK = fork_safe_lock()


def stop(
    session: Session, robot: str, reason: str = "", *, how: StopMode = "hold", timeout_s: float = 1.0
) -> DriverState:
    """Stop the driver of ``robot``, and return its state once it has stopped.

    The driver stays stopped, also if it or this program restarts, until ``Commander.release``. ``how`` "hold"
    (the default) leaves the joints where they are, "relax" without torque: behind a router with access
    control only commanders and operators switch it off, and the joints hold for others. ``reason`` is shown
    to users; it is cut after 1000 characters, and no text makes a stop fail. No claim is needed. Not a
    safety-rated channel.

    It is repeated until a driver has confirmed it. Raises Unreachable if none has within ``timeout_s`` [s].
    The stop stays latched in ``session`` then: a driver that can be reached later obeys it.
    """
    check_timeout(timeout_s)
    with _STOPPERS_LOCK:
        stoppers = _STOPPERS.setdefault(session, {})
        stopper = stoppers.get(robot)
        if stopper is None:
            stopper = stoppers[robot] = _Stopper(session, check_robot(robot))
    return stopper.stop(how, stop_text(str(reason)), timeout_s)


class _Stopper:
    """The stops of one robot that one session has sent; latched while the session is open."""

    def __init__(self, session: Session, robot: str) -> None:
        self._robot = robot
        # Not the session itself: the stoppers of a session must not keep it alive.
        self._session = weakref.ref(session)
        self._writer = local_writer(secrets.randbits(32))
        self._seq = secrets.randbits(_STEP_BITS)
        self._sent: tuple[tuple[int, StopMode], ...] = ()
        """Numbers of the last stops, and how."""
        self._lock = fork_safe_lock()
        self._publishers: dict[StopMode, LatchedPublisher] = {}
        self._publisher(session, "hold")

    def stop(self, how: StopMode, reason: str, timeout_s: float) -> DriverState:
        deadline = time.monotonic() + timeout_s
        session = self._session()
        assert session is not None, "the caller has it"
        is_held, pause_s = False, _REPEAT_S
        with self._lock:
            messages = self._messages(how, reason)

        def is_obeyed(state: DriverState) -> bool:
            nonlocal is_held
            is_held = self._is_obeyed(state, messages[0].seq, "hold")
            return is_held and self._is_obeyed(state, messages[0].seq, how)

        while True:
            # With the same numbers, which a release ends once and for all, however late the last one arrives.
            with self._lock:
                for message in messages:
                    self._publisher(session, message.how).set(encode(message))
            left_s = deadline - time.monotonic()
            confirmed = wait_for_state(session, self._robot, is_obeyed, max(0.0, min(left_s, pause_s)))
            if confirmed is not None:
                return confirmed
            if left_s <= pause_s:
                raise self._unconfirmed(timeout_s, is_held=is_held)
            pause_s *= 2.0

    def _messages(self, how: StopMode, reason: str) -> list[Stop]:
        """Those of a new stop; with the lock. A program that may not relax a driver stops it all the same."""
        hows: tuple[StopMode, ...] = ("relax", "hold") if how == "relax" else ("hold",)
        messages: list[Stop] = []
        for one in hows:
            # Others that may write this key cannot send a stop with the next number before this program does.
            self._seq += 1 + secrets.randbits(_STEP_BITS)
            messages.append(Stop(time.time_ns(), self._seq, self._writer.session, one, reason))
            self._sent = (*self._sent[1 - _MOST_SENT :], (self._seq, one))
        return messages

    def _publisher(self, session: Session, how: StopMode) -> LatchedPublisher:
        if how not in self._publishers:
            key = (STOP if how == "hold" else RELAX).key(self._robot, self._writer.identity)
            self._publishers[how] = LatchedPublisher(session, key, encoding_of(Stop), urgent=True)
        return self._publishers[how]

    def _is_obeyed(self, state: DriverState, first: int, how: StopMode) -> bool:
        """Whether the driver has stopped for the stop ``first`` or a later one, without torque to "relax"."""
        latched = {seq for session, seq in state.stops if session == self._writer.session}
        return state.state in _STANDING and any(
            seq >= first and seq in latched and how in ("hold", sent) for seq, sent in self._sent
        )

    def _unconfirmed(self, timeout_s: float, *, is_held: bool) -> Unreachable:
        text = (
            f"no driver of {self._robot!r} has confirmed the stop within {timeout_s:g} s. Is it running, "
            f"and may this program stop it (`zstate acl`)? {STAYS_LATCHED}"
        )
        if is_held:
            text = (
                f"the driver of {self._robot!r} has stopped and holds its joints, but has not confirmed "
                f"within {timeout_s:g} s that their torque is off: behind a router with access control only "
                "commanders and operators switch it off (`zstate acl --commander`)"
            )
        return Unreachable(text, endpoints=())


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

    with LatchedSubscriber(session, stream_key(robot, "driver"), on_value):
        has_found.wait(timeout_s)
    return found[0] if found else None


@lru_cache(4096)  # called for each stop of a flood
def _parse_key(key: str) -> tuple[WriterId, str]:
    """The writer of a stop, and whether its key is that of a "stop" or "relax"."""
    stream = stream_from_key(key)
    _, identity = (RELAX if stream == "relax" else STOP).parse(key)
    return WriterId.parse(identity), stream


class LatchedStops(NamedTuple):
    """The ``stops`` that are not released, and how many have ``arrived`` until now, the ``newest`` last.

    A stop that is released before the next tick is known by these two. ``displaced`` are the last stops for
    which the substitute stands. ``ids`` are those that a driver reports as obeyed: each of ``stops`` and
    ``displaced`` once it is kept, so that a stop that is confirmed holds for the next host as well.
    """

    stops: tuple[ActiveStop, ...] = ()
    arrived: int = 0
    newest: ActiveStop | None = None
    displaced: tuple[StopId, ...] = ()
    ids: tuple[StopId, ...] = ()

    def kept(self) -> LatchedStops:
        """The same once the stops are in the file."""
        return self._replace(ids=(*(one.id for one in self.stops), *self.displaced))


class StopRegister:
    """The stops of the driver of ``host`` that are not released. Safe from any thread.

    Each ends by its own release only. If there are too many, the oldest are replaced by one stop of the host,
    with another number for each, so that no release of it ends a stop that came later.
    """

    def __init__(self, host: WriterId) -> None:
        self._host = host
        self._lock = fork_safe_lock()
        self._active: dict[StopId, ActiveStop] = {}
        """The oldest first."""
        self._released: dict[int, list[int]] = {}
        """The numbers of the last stops of each session that are over, which its program may still send."""
        self._is_unsaved = False
        self._own_seq = -1
        self._substitute: ActiveStop | None = None
        """The stop in place of those that were displaced."""
        self._displaced = 0
        """How many these are."""
        self._displaced_ids: deque[StopId] = deque(maxlen=_MOST_DISPLACED)
        self.current = LatchedStops()
        """Another object after each change."""
        self.released_by = (0, 0)
        """Session and ``seq`` of the last release of a stop, or of one that named none."""

    def latch(self, reason: str, how: StopMode = "hold") -> None:
        """Latch a stop of this host itself, and save it."""
        with self._lock:
            self._add(self._own_stop(reason, how))
        self.save()

    def add(self, one: ActiveStop) -> None:
        """Latch ``one``, unless it is latched or released already. ``save`` follows."""
        with self._lock:
            if one.id not in self._active and one.seq not in self._released.get(one.session, ()):
                self._add(one)

    def save(self) -> None:
        """Save the stops that were added."""
        with self._lock:
            if self._is_unsaved:
                self._save()
                self.current = self.current.kept()

    def release(self, *releases: Release) -> None:
        """End the stops of ``releases``. One that names none counts once there is none."""
        with self._lock:
            has_ended = False
            for release in releases:
                ended = [one for stop_id in release.stops if (one := self._active.pop(stop_id, None))]
                has_ended |= bool(ended) or not set(release.stops).isdisjoint(self._displaced_ids)
                self._keep_released(ended, release.stops)
                if ended or not (release.stops or self._active):
                    self.released_by = (release.session, release.seq)
            if has_ended:
                self._save()  # first: a release that is confirmed holds for the next host as well
                stops = tuple(self._active.values())
                left = self.current._replace(stops=stops, displaced=tuple(self._displaced_ids))
                self.current = left.kept()

    def _keep_released(self, ended: Sequence[ActiveStop], named: Sequence[StopId]) -> None:
        """Keep that ``ended`` are released. A cached stop whose release is forgotten stops once more.

        Displaced stops that are ``named`` are no longer reported, also if the substitute stays for others.
        """
        for one in ended:
            self._ignore(one)
        if self._substitute in ended:
            self._substitute, self._displaced = None, 0
            self._displaced_ids.clear()
        elif self._displaced_ids:
            released = set(named)
            kept = (stop_id for stop_id in self._displaced_ids if stop_id not in released)
            self._displaced_ids = deque(kept, _MOST_DISPLACED)

    def _ignore(self, one: ActiveStop) -> None:
        """Ignore further messages of ``one``."""
        seqs = self._released.pop(one.session, [])
        self._released[one.session] = [*seqs[1 - _MOST_RELEASED :], one.seq]  # newest last
        while len(self._released) > _MOST_STOPS:
            del self._released[next(iter(self._released))]

    def _own_stop(self, reason: str, how: StopMode) -> ActiveStop:
        self._own_seq += 1
        return ActiveStop(self._host.session, self._own_seq, how, stop_text(reason), str(self._host))

    def _add(self, one: ActiveStop) -> None:
        """Latch ``one``. It replaces one that reads alike, or, of too many, the oldest."""
        same = [kept for kept in self._active.values() if kept.session == one.session]
        alike = [kept for kept in same if (kept.how, str(kept)) == (one.how, str(one))]
        if alike:  # a program that stops again; a release from before does not end that
            del self._active[alike[0].id]
            self._ignore(alike[0])  # one that is still under way; the newer one stands for it
        elif len(same) >= _MOST_OF_SESSION:
            self._displace(same)
        elif len(self._active) >= _MOST_STOPS - 1:
            self._displace(self._active.values())
        self._active[one.id] = one
        self._is_unsaved = True
        stops, displaced = tuple(self._active.values()), tuple(self._displaced_ids)
        arrived, confirmed = self.current.arrived + 1, self.current.ids
        self.current = LatchedStops(stops, arrived, one, displaced, confirmed)

    def _displace(self, stops: Iterable[ActiveStop]) -> None:
        """Let the substitute stand for the oldest of ``stops``. If it keeps the torque off, so does that."""
        oldest = next(one for one in stops if one is not self._substitute)
        ended = [self._active.pop(one.id) for one in (oldest, self._substitute) if one is not None]
        how: StopMode = "relax" if any(one.how == "relax" for one in ended) else "hold"
        self._displaced += 1
        self._displaced_ids.append(oldest.id)
        reason = f"further stops ({self._displaced}), the last one {oldest}"
        self._substitute = self._own_stop(reason, how)
        self._active[self._substitute.id] = self._substitute

    def _save(self) -> None:
        """Called with the lock, after stops are latched, and before their release holds."""
        self._is_unsaved = False


class StopLatch(StopRegister, Closeable):
    """The stops of the driver of ``robot`` that are not released, from the network.

    They are kept in ``stops_file``, which a restarted host reads, and are read from the caches of programs
    that have sent them. A file that cannot be read counts as a stop, and a damaged one is kept next to it;
    one that cannot be written raises ConfigError here, and is logged later. While it is open, it has the
    ``HostLock`` of the robot; raises SecondWriter if another host has that. ``host`` is the program of this
    host, ``refusals`` counts invalid messages.
    """

    def __init__(self, session: Session, robot: str, host: WriterId, refusals: Refusals) -> None:
        super().__init__(host)
        self._robot = robot
        self._path = stops_file(robot)
        self._refusals = refusals
        with ExitStack() as opening:
            opening.enter_context(HostLock(robot))
            self._read_file()
            self._write_file(is_opening=True)
            wait_for_discovery(session)
            expressions = STOP.expression(robot), RELAX.expression(robot)
            for keyexpr in expressions:
                call_for_each(cached_values(session, keyexpr, _CACHES_WITHIN_S), self._on_stop)
            self.save()
            stops = LatchedSubscriber(
                session, expressions, self._on_stop, on_batch_end=self.save, capacity=_MOST_WAITING
            )
            opening.enter_context(stops)
            releases = StreamSubscriber(session, RELEASE.expression(robot), self._on_releases)
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
            writer, stream = _parse_key(sample.key)
            message = decode(sample.payload, sample.encoding, Stop)
        except (MessageError, InvalidInput) as error:
            self._refusals.count(getattr(error, "reason", "foreign"), error)
            return
        if message.session != writer.session or message.session == self._host.session:
            self._refusals.count("foreign", f"the Stop of another program on {printable(sample.key)!r}")
            return
        how = message.how
        if how == "relax" and stream != "relax":
            how = "hold"
            text = f"the stop of {writer} is not on the key that switches the torque off; the joints hold"
            self._refusals.count("relax", text)
        reason = stop_text(printable(message.reason))
        self.add(ActiveStop(message.session, message.seq, how, reason, str(writer)))

    def _on_releases(self, samples: list[SerializedSample]) -> None:
        releases: list[Release] = []
        for sample in samples:
            try:
                _, identity = RELEASE.parse(sample.key)
                session = WriterId.parse(identity).session
                release = decode(sample.payload, sample.encoding, Release)
            except (MessageError, InvalidInput) as error:
                self._refusals.count(getattr(error, "reason", "foreign"), error)
                continue
            if release.session == session:
                releases.append(release)
            else:
                text = f"the Release of another program on {printable(sample.key)!r}"
                self._refusals.count("foreign", text)
        self.release(*releases)

    def _read_file(self) -> None:
        try:
            stops, self._released = read_stops(self._path)
        except (OSError, ValueError) as error:
            kept = ""
            if isinstance(error, ValueError):
                with suppress(OSError):
                    kept = f"; it is kept as {copy_aside(self._path)}"
            reason = f"{self._path} cannot be read: {error}{kept}"
            _LOG.error(
                "the stops of %r are not known: %s; it is stopped until a release", self._robot, reason
            )
            stops = [self._own_stop(reason, "hold")]
        self._active = {one.id: one for one in stops}
        self.current = LatchedStops(tuple(stops), len(stops), stops[-1] if stops else None).kept()

    def _save(self) -> None:
        super()._save()
        self._write_file()

    def _write_file(self, *, is_opening: bool = False) -> None:
        try:
            write_stops(self._path, tuple(self._active.values()), self._released)
        except OSError as error:
            text = (
                f"stops of {self._robot!r} cannot be kept in {self._path}: {error}; a restarted host would "
                "not obey them: set XDG_STATE_HOME to a folder that can be written"
            )
            if is_opening:
                raise ConfigError(text, path=str(self._path)) from None
            _LOG.error("%s", text)
