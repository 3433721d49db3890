"""Who writes what: a liveliness token for every writer, which says who it is and vanishes with it.

RouterLosses: whether what has just vanished went with a router of ours.

Connections: whom a session has links to.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import math
import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput
from zstate.net.queryable import MAX_REPLIES, query_tokens
from zstate.net.session import Session
from zstate.net.streams import Receiver, Ring, call_for_each
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, MOST_CHARACTERS, READERS, Stream, parse_reader_key, shortened
from zstate.wire.protocol import Wire
from zstate.wire.registry import get_wire

_JUST_NOW_S = 0.1
_TOLD_WITHIN_S = 0.02
_ROUND_S = 0.002


class RouterLossDetector(Closeable):
    """The routers that a session is connected to, as they come and go. Has no thread: is asked."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._known: set[str] = set()
        self._lost_at = -math.inf
        self._lock = fork_safe_lock()
        channel: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(256)
        self._events = session.zenoh.info.declare_transport_events_listener(channel, history=True)

    def lost_recently(self) -> bool:
        """Whether a router was lost within the last tenth of a second.

        What a router told us of is gone up to a millisecond before we are told that the router is:
        waits for that, up to 20 ms, where there is a router at all.
        """
        deadline = time.monotonic() + _TOLD_WITHIN_S
        while True:
            self._follow()
            if time.monotonic() - self._lost_at < _JUST_NOW_S:
                return True
            if not self._known or time.monotonic() > deadline:
                return False
            time.sleep(_ROUND_S)

    def _follow(self) -> None:
        # Closing may come between: a listener that is undeclared has nothing more to tell.
        with self._lock, suppress(zenoh.ZError):
            while (event := self._events.try_recv()) is not None:
                zid, is_router = str(event.transport.zid), event.transport.whatami == zenoh.WhatAmI.ROUTER
                if event.kind == zenoh.SampleKind.PUT and is_router:
                    self._known.add(zid)
                elif event.kind == zenoh.SampleKind.DELETE and zid in self._known:
                    self._known.discard(zid)
                    self._lost_at = time.monotonic()

    def close(self) -> None:
        """Follow them no more. A second call does nothing."""
        self._session.release(self._events)


CAPACITY = 16_384
"""So many changes of tokens wait. When more come, the tokens are queried instead: see ``WriterWatch``."""

ANSWER_WITHIN_S = 0.5
ROUND_S = 0.1


def local_writer(session: int, program: str = "") -> WriterId:
    """A writer in this process, starting now; ``program`` is the script's name unless given.

    Raises InvalidInput for a name of more than 255 characters, which readers would not accept.
    """
    if len(program) > MOST_CHARACTERS:
        text = f"the program name {shortened(program)!r} has {len(program)} characters"
        raise InvalidInput(f"{text}, more than {MOST_CHARACTERS}")
    script = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] not in ("", "-c") else "python"
    return WriterId(program or script, socket.gethostname(), os.getpid(), time.time_ns(), session)


@dataclass(frozen=True, order=True, slots=True)
class RobotInfo:
    """A robot that somebody writes for: its writers as (stream, writer), sorted.

    ``static_names`` are (name, writer) for the names under which static edges are written.
    """

    name: str
    writers: tuple[tuple[Stream, WriterId], ...]
    static_names: tuple[tuple[str, WriterId], ...] = ()

    def __repr__(self) -> str:
        streams: dict[str, list[str]] = {}
        for stream, writer in self.writers:
            streams.setdefault(str(writer), []).append(stream)
        written = "; ".join(f"{writer} writes {', '.join(what)}" for writer, what in streams.items())
        return f"<robot {self.name!r}: {written or 'no writer'}>"

    def names_of(self, writer: WriterId) -> tuple[str, ...]:
        """The names under which ``writer`` writes static edges, sorted."""
        return tuple(name for name, said_by in self.static_names if said_by == writer)


class LivelinessToken(Closeable):
    """The token of one writer, there until closed or until its process ends."""

    def __init__(self, session: Session, token: zenoh.LivelinessToken) -> None:
        self._session = session
        self._token = token

    def close(self) -> None:
        """Say that this writer is gone. A second call does nothing."""
        self._session.release(self._token)


def announce(session: Session, token: str) -> LivelinessToken:
    """Keep a liveliness token, for everybody to see, until closed."""
    return LivelinessToken(session, session.zenoh.liveliness().declare_token(token))


def announce_reader(
    session: Session, wire: Wire, robot: str, streams: Sequence[Stream]
) -> list[LivelinessToken]:
    """Tell everybody that this program reads ``streams`` of ``robot``, on wires that tell such things."""
    tokens = wire.reader_tokens(robot, streams, local_writer(0), session.zid, session.next_number)
    return [announce(session, token) for token in tokens]


def discover(session: Session, timeout_s: float = 1.0, *, wire: str = "native") -> tuple[RobotInfo, ...]:
    """Every robot that is announced, with its writers, sorted by name.

    A session that has just connected has not met everybody yet: asks until two answers in a row, a
    tenth of a second apart, name the same writers; for nobody at all it waits ``timeout_s`` [s].
    """
    spoken = get_wire(wire)
    tokens = discover_tokens(session, spoken.writers_expression(ANY), timeout_s)
    announced = (spoken.announced(token, ANY) for token in tokens)
    return by_robot({one for one in announced if one is not None})


def discover_readers(session: Session, timeout_s: float = 1.0) -> tuple[Announcement, ...]:
    """Every reader that is announced on the native wire, sorted; the robot "*" stands for all robots.

    Asks as ``discover`` does. Programs that subscribe to keys by themselves are not announced.
    """
    tokens = discover_tokens(session, READERS, timeout_s)
    found = {one for one in map(_reader, tokens) if one is not None}
    return tuple(sorted(found, key=lambda one: (one.robot, one.stream, one.writer)))


def _reader(token: str) -> Announcement | None:
    try:
        return Announcement.parse(*parse_reader_key(token))
    except InvalidInput:
        return None


def discover_tokens(session: Session, expression: str, timeout_s: float = 1.0) -> frozenset[str]:
    """The liveliness tokens there are, asked for as ``discover`` does."""
    if not timeout_s > 0.0:
        raise InvalidInput(f"timeout_s is {timeout_s}; give a positive number of seconds")
    deadline = time.monotonic() + timeout_s
    found = last = frozenset[str]()
    while (remaining_s := deadline - time.monotonic()) > 0.0:
        # Thousands of tokens take a moment: what is asked for last is not cut short.
        within_s, asked_s = max(remaining_s, ANSWER_WITHIN_S), time.monotonic()
        answer = current_tokens(session, expression, within_s)
        if answer and answer == found:
            break
        if time.monotonic() - asked_s >= within_s:
            found |= answer
        elif answer or not last:  # an answer without tokens may be wrong; two are not
            found = answer
        last = answer
        time.sleep(min(ROUND_S, max(0.0, deadline - time.monotonic())))
    return found


def current_tokens(session: Session, expression: str, timeout_s: float) -> frozenset[str]:
    """The liveliness tokens that are known where this session is connected, within ``timeout_s`` [s]."""
    return frozenset(query_tokens(session.zenoh, expression, timeout_s))


def confirmed_tokens(session: Session, expression: str) -> frozenset[str]:
    """The liveliness tokens there are, asked for twice before there are said to be none."""
    # Of a router's answers to a session that follows the same tokens, one in 1500 was empty.
    found = current_tokens(session, expression, ANSWER_WITHIN_S)
    return found or current_tokens(session, expression, ANSWER_WITHIN_S)


def by_robot(found: Iterable[Announcement]) -> tuple[RobotInfo, ...]:
    """What was announced, robot by robot, sorted."""
    robots: dict[str, list[Announcement]] = {}
    for token in found:
        robots.setdefault(token.robot, []).append(token)
    return tuple(_info(name, tokens) for name, tokens in sorted(robots.items()))


def _info(robot: str, tokens: Iterable[Announcement]) -> RobotInfo:
    writers: set[tuple[Stream, WriterId]] = {(token.stream, token.writer) for token in tokens}
    names = {(token.name, token.writer) for token in tokens if token.name}
    return RobotInfo(robot, tuple(sorted(writers)), tuple(sorted(names)))


class WriterWatch(Closeable):
    """Follows the writers of ``robot`` ("*": of all robots), those already there included.

    ``callback(announced, alive)`` is called from one thread. Losing a router takes every writer behind it
    away as well: for those ``on_cut_off(announced)`` is called instead, if it is given. ``foreign`` counts
    tokens that announce no stream of a robot, ``ignored`` those beyond the 100,000 that are kept. An
    exception of a callback is counted in ``failures``, and costs no other token its call.

    A burst of tokens can overflow the ring between Zenoh and this thread. Nothing is lost by that: the
    tokens that are there are queried then, and compared with those known.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        callback: Callable[[Announcement, bool], None],
        wire: Wire,
        on_cut_off: Callable[[Announcement], None] | None = None,
    ) -> None:
        self.foreign = 0
        self.ignored = 0
        self._session = session
        self._known: dict[str, Announcement | None] = {}
        self._callback = callback
        self._on_cut_off = on_cut_off
        self._routers = None if on_cut_off is None else RouterLossDetector(session)
        self._robot = robot
        self._wire = wire
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        self._expression = wire.writers_expression(robot)
        tokens = session.zenoh.liveliness().declare_subscriber(self._expression, ring, history=True)
        self._receiver = Receiver(session, tokens, self._hand_over, CAPACITY)

    @property
    def failures(self) -> int:
        """How often a callback raised, tokens that came together counted once."""
        return self._receiver.failures

    def _hand_over(self, batch: list[zenoh.Sample]) -> None:
        if len(batch) < CAPACITY:
            puts = zenoh.SampleKind.PUT
            changes = [(str(sample.key_expr), sample.kind == puts) for sample in batch]
        else:
            changes = self._changes()
        gone = any(not alive for _, alive in changes)
        cut_off = gone and self._routers is not None and self._routers.lost_recently()
        call_for_each(changes, lambda change: self._on_change(*change, cut_off=cut_off))

    def _changes(self) -> list[tuple[str, bool]]:
        """What has come and gone since the last batch; later changes are still in the ring."""
        there = confirmed_tokens(self._session, self._expression)
        gone, come = self._known.keys() - there, there - self._known.keys()
        return [*((token, False) for token in gone), *((token, True) for token in come)]

    def _on_change(self, token: str, alive: bool, *, cut_off: bool) -> None:
        if alive == (token in self._known):
            return
        if alive and len(self._known) >= MAX_REPLIES:
            self.ignored += 1
            return
        announced = self._wire.announced(token, self._robot) if alive else self._known.pop(token)
        if alive:
            self._known[token] = announced
            self.foreign += announced is None
        if announced is None:
            return
        if cut_off and not alive and self._on_cut_off is not None:
            self._on_cut_off(announced)
        else:
            self._callback(announced, alive)

    def close(self) -> None:
        """Stop within a second. A second call does nothing."""
        self._receiver.close()  # its thread asks the other
        if self._routers is not None:
            self._routers.close()


def watch(
    session: Session,
    robot: str,
    callback: Callable[[Announcement, bool], None],
    wire: str = "native",
    on_cut_off: Callable[[Announcement], None] | None = None,
) -> WriterWatch:
    """Call ``callback(announced, alive)`` for each writer there is, comes or goes; see ``WriterWatch``."""
    return WriterWatch(session, robot, callback, get_wire(wire), on_cut_off)


_MODES = ("client", "peer", "router")


class Connections(NamedTuple):
    """How many: sessions by their mode, of all three; links by their protocol ("tcp", "tls", ...)."""

    sessions: dict[str, int]
    links: dict[str, int]


def connections(session: Session) -> Connections:
    """Who is connected to ``session`` directly, now. Raises Closed."""
    info = session.zenoh.info
    met = Counter(str(transport.whatami).lower() for transport in info.transports())
    links = Counter(str(link.dst).partition("/")[0] for link in info.links())
    return Connections({mode: met[mode] for mode in _MODES}, dict(links))
