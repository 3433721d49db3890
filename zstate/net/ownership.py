"""Exclusive ownership (DDS): one writer for each stream of a robot.

``WriterClaim`` owns streams, and the edges under one name. Conflicting writers are found by their liveliness
tokens and raise SecondWriter. Each child frame has one writer, too: ``zstate.net.edge_ownership``.
"""

from __future__ import annotations

import math
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import islice
from typing import TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import MessageError, SecondWriter, format_duration
from zstate.net.presence import confirmed_tokens
from zstate.net.session import Session
from zstate.net.streams import BULK_CAPACITY, Ring, to_serialized
from zstate.stream_registry import edge_streams, is_bulk, is_measured, is_named
from zstate.streams import BULK_BYTES, StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, stream_expression, stream_key
from zstate.wire.messages import session_of
from zstate.wire.native import NativeWire

CAPACITY = 1024
TOKEN_EXPIRY_S = 0.5
"""The token of a killed writer may be visible for this long; measured: 2 to 33 ms."""

ROUND_S = 0.005

_DISCOVERY_S = 0.03
"""Peers that have just connected discover the others one by one; on a quiet loopback that took up to 6 ms."""

_PROPAGATION_S = 0.02
"""The longest time until a token has reached all peers; on a loopback that took some milliseconds."""

CHECK_PERIOD_S = 0.05
"""Between two checks of a writer that is not the only one."""

_STARTUP_S = 1.0
"""Each sample checks for this long: by then the tokens of writers that opened at the same time are here."""


def moving_streams() -> tuple[StreamName, ...]:
    """The streams whose writers each own the edges that they move."""
    return (*edge_streams(), "partial_joint_states")


_Handler: TypeAlias = "zenoh.handlers.Handler[zenoh.Sample]"

_WIRE = NativeWire()
_CLAIMS: weakref.WeakKeyDictionary[Session, set[WriterClaim]] = weakref.WeakKeyDictionary()
_CLAIMS_LOCK = fork_safe_lock()


class WriterClaim(Closeable):
    """Exclusive ownership of ``claimed``: streams of one robot, or static edges under one name.

    Raises SecondWriter if a live writer is announced with one of them, or claims it in the same session. Two
    writers that open at the same time may not see each other's tokens yet: ``check`` raises for the later one
    (sticky), and ``confirm`` at once.

    A second after the first ``check`` this writer is established. A token alone does not displace it any
    more, whatever start time it carries: the other writer must also publish one of the streams. So if two
    writers publish on networks that are joined later, the later one ends.
    """

    def __init__(self, session: Session, claimed: Sequence[Announcement]) -> None:
        self._session = session
        self._claimed = claimed
        self._rivals: set[Announcement] = set()
        self._changes: deque[tuple[str, zenoh.SampleKind]] = deque(maxlen=CAPACITY)
        """Tokens that came and went since the last ``check``."""
        self.on_change: Callable[[], None] | None = None
        """Called in a thread of Zenoh when a token has ended ``is_settled``."""
        self._received: dict[tuple[StreamName, str], zenoh.ext.AdvancedSubscriber[_Handler]] = {}
        self._publishing: set[int] = set()
        self._first: Announcement | None = None
        self._next_check_s = 0.0
        """Until then [s, ``time.monotonic``], or until a token changes, ``check`` has nothing to do."""
        self._established_at = 0.0
        self._expression = _WIRE.writers_expression(claimed[0].robot)
        # Not before the first ``check``: a router's replies leave out some of the tokens that are subscribed.
        self._tokens: zenoh.Subscriber[None] | None = None
        # Conflicts within one session are known at once, without a query.
        with _CLAIMS_LOCK:
            claims = _CLAIMS.setdefault(self._session, set())
            rivals = self._conflicting(other for claim in claims for other in claim._claimed)
            if rivals:
                raise self._second_writer(self._oldest(rivals))
            claims.add(self)
        try:
            wait_for_discovery(self._session)
            self._wait_for_expiry(raises_early=False)
        except BaseException:
            self.close()
            raise

    def confirm(self) -> None:
        """Check, once this writer is announced, that no writer opened at the same time and stays.

        For writers that publish once and then rarely. Raises SecondWriter.
        """
        if not self._session.zenoh.info.routers_zid():  # a router's replies include every token sent to it
            time.sleep(_PROPAGATION_S)
        self._wait_for_expiry(raises_early=True)

    def check(self) -> None:
        """Raise SecondWriter if an older writer of the same stream exists (sticky). Raises Closed.

        A second after the first call, checks at most 20 times per second while there is another writer, and
        otherwise when a token has appeared or disappeared.
        """
        if self._first is None:
            now = time.monotonic()
            if now < self._next_check_s:
                return
            self._session.check()
            if self._tokens is None:
                self._established_at = now + _STARTUP_S
            elif now > self._established_at:
                self._next_check_s = math.inf  # before the changes are read: a later one sets it again
            self._update_rivals()
            if not self._rivals:
                return
            if now > self._established_at:
                self._next_check_s = now + CHECK_PERIOD_S
                if self._changes:  # a token that came just now: its own 0 may be overwritten
                    self._next_check_s = 0.0
            older = {rival for rival in self._rivals if self._is_older(rival)}
            if now > self._established_at:
                older = {rival for rival in older if self._publishes(rival)}
            # zenoh 1.10, a closed token is sometimes reported on in a subscribed session: delete when fixed
            alive = older.intersection(self._current_rivals()) if older else older
            self._rivals -= older - alive
            if not alive:
                return
            self._first = self._oldest(alive)
        raise self._second_writer(self._first)

    @property
    def is_settled(self) -> bool:
        """Whether ``check`` has nothing to do until a token changes."""
        return self._next_check_s == math.inf

    def close(self) -> None:
        """Release the ownership. A second call does nothing."""
        with _CLAIMS_LOCK:
            _CLAIMS[self._session].discard(self)
        if self._tokens is not None:
            self._session.release(self._tokens)
        while self._received:
            self._session.release(self._received.popitem()[1])

    def _wait_for_expiry(self, *, raises_early: bool) -> None:
        """Wait until there is no rival, for ``TOKEN_EXPIRY_S``. ``raises_early``: not if one is older."""
        deadline = time.monotonic() + TOKEN_EXPIRY_S
        while rivals := self._current_rivals():
            older = [rival for rival in rivals if raises_early and self._is_older(rival)]
            if older or time.monotonic() > deadline:
                raise self._second_writer(self._oldest(older or rivals))
            time.sleep(ROUND_S)

    def _update_rivals(self) -> None:
        """Apply token changes. Runs in the publishing thread: a claim has no thread of its own."""
        if self._tokens is None:
            # Called on Zenoh's thread, which must not wait.
            handler = zenoh.handlers.Callback(self._on_token, indirect=False)
            liveliness = self._session.zenoh.liveliness()
            self._tokens = liveliness.declare_subscriber(self._expression, handler, history=True)
        are_complete = len(self._changes) < CAPACITY
        while self._changes:
            token, kind = self._changes.popleft()
            rivals = self._rivals_in([token])
            if kind == zenoh.SampleKind.PUT:
                self._rivals.update(rivals)
            else:
                self._rivals.difference_update(rivals)
        if not are_complete:
            self._rivals = set(self._current_rivals())

    def _on_token(self, sample: zenoh.Sample) -> None:
        self._changes.append((str(sample.key_expr), sample.kind))
        self._next_check_s = 0.0
        if self.on_change is not None:
            self.on_change()

    def _publishes(self, rival: Announcement) -> bool:
        """Whether a sample or a latched value of ``rival`` has been received since the first call."""
        stream = (rival.stream, rival.name)
        if stream not in self._received:
            ring: Ring = zenoh.handlers.RingChannel(BULK_CAPACITY if is_bulk(rival.stream) else CAPACITY)
            has_key = bool(rival.name) or not is_named(rival.stream)
            self._received[stream] = zenoh.ext.declare_advanced_subscriber(
                self._session.zenoh,
                stream_key(rival.robot, *stream) if has_key else stream_expression(rival.robot, rival.stream),
                ring,
                history=zenoh.ext.HistoryConfig(max_samples=1),
            )
        for sample in islice(iter(self._received[stream].handler.try_recv, None), CAPACITY):
            with suppress(MessageError):  # withdrawn, or not of zstate
                received = to_serialized(sample, "", BULK_BYTES)
                for message in _WIRE.decode(rival.stream, received, rival.robot):
                    self._publishing.add(session_of(message))
        self._publishing &= {one.writer.session for one in self._rivals}
        return rival.writer.session in self._publishing

    def _current_rivals(self) -> list[Announcement]:
        return self._rivals_in(confirmed_tokens(self._session, self._expression))

    def _rivals_in(self, tokens: Iterable[str]) -> list[Announcement]:
        return self._conflicting(one for token in tokens for one in _WIRE.parse_token(token, ANY))

    def _conflicting(self, others: Iterable[Announcement]) -> list[Announcement]:
        return [one for one in others if any(one.conflicts_with(claimed) for claimed in self._claimed)]

    def _oldest(self, rivals: Iterable[Announcement]) -> Announcement:
        streams = [claimed.stream for claimed in self._claimed]

        def place(rival: Announcement) -> int:
            return streams.index(rival.stream) if rival.stream in streams else len(streams)

        return min(rivals, key=lambda rival: (seniority(rival), place(rival)))

    def _is_older(self, rival: Announcement) -> bool:
        return seniority(rival) < seniority(self._claimed[0])

    def _second_writer(self, first: Announcement) -> SecondWriter:
        what = f"{first.stream} of {first.robot!r}"
        if is_named(first.stream):
            kind = "static edges" if first.stream == "tf_static" else first.stream.replace("_", " ")
            what = f"{kind} of {first.robot!r} under the name {first.name!r}"
        claimed = {claimed.stream for claimed in self._claimed}
        if "partial_joint_states" in {first.stream, *claimed} and first.stream not in claimed:
            advice = "stop it first, for it and this writer would publish the same joints"
        elif first.stream in moving_streams() or is_measured(first.stream):
            advice = "stop it first, or give this writer another name"
        elif first.stream == "joint_commands":
            advice = "a robot has one commander at a time: close the first"
        else:
            advice = (
                "stop it first, or publish as well with takeover=True (--takeover): "
                "readers use the newest writer"
            )
        text = f"{writer_text(first.writer)} already writes {what}; {advice}"
        return SecondWriter(text, robot=first.robot, stream=first.stream, first=first.writer)


def wait_for_discovery(session: Session) -> None:
    """Return when a session that has just connected has discovered the others."""
    if not session.zenoh.info.routers_zid():  # a router has discovered all
        time.sleep(max(0.0, session.opened_at + _DISCOVERY_S - time.monotonic()))


def seniority(announced: Announcement) -> tuple[int, int]:
    """Sort key of writers: the oldest first."""
    return announced.writer.since, announced.writer.session


def writer_text(writer: WriterId) -> str:
    """The writer and its start, for errors."""
    if not writer.since:
        return repr(str(writer))
    start = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    age = format_duration(time.time_ns() - writer.since)
    return f"{str(writer)!r}, started {start:%Y-%m-%d %H:%M:%S} ({age} ago),"
