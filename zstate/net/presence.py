"""Presence (Zenoh liveliness): a token for every writer and reader, which disappears with its process.

Discovery queries the tokens; ``WriterWatch`` follows their changes. ``connections`` counts links.
"""

from __future__ import annotations

import math
import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput, Unreachable, ZStateError
from zstate.net.queryable import MAX_REPLIES, Tokens, check_timeout, query_tokens
from zstate.net.session import Session
from zstate.net.streams import Receiver, call_for_each
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, MAX_NAME_LENGTH, READER_TOKEN, shortened
from zstate.wire.protocol import Wire, WriterTokens
from zstate.wire.registry import get_wire

CAPACITY = 16_384
"""Waiting changes of tokens. If more arrive, the tokens are queried instead: see ``WriterWatch``."""

ANSWER_WITHIN_S = 0.5
ROUND_S = 0.1
_ALL_TOKENS_WITHIN_S = 5.0
"""Routers take a time that grows with the square of the number of tokens: half a second for 1000 robots."""

_RECENT_S = 0.1
_ROUTER_EVENT_S = 0.02
_POLL_S = 0.002  # zenoh 1.10, channels have no receive with a timeout: delete when they have


def local_writer(session: int, program: str = "") -> WriterId:
    """A writer in this process that starts now; ``program`` is the script's name by default.

    Raises InvalidInput for a name of more than 255 characters, which readers would refuse.
    """
    if len(program) > MAX_NAME_LENGTH:
        text = f"the program name {shortened(program)!r} has {len(program)} characters"
        raise InvalidInput(f"{text}, more than {MAX_NAME_LENGTH}")
    script = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] not in ("", "-c") else "python"
    return WriterId(program or script, socket.gethostname(), os.getpid(), time.time_ns(), session)


@dataclass(frozen=True, order=True, slots=True)
class RobotInfo:
    """A robot with its writers as (stream, writer), sorted.

    ``names`` are (stream, name, writer), sorted, of the streams whose writers have names: sensors, maps,
    drivers of some joints, writers of edges.
    """

    name: str
    writers: tuple[tuple[StreamName, WriterId], ...]
    names: tuple[tuple[StreamName, str, WriterId], ...] = ()

    def __repr__(self) -> str:
        streams: dict[str, list[str]] = {}
        for stream, writer in self.writers:
            streams.setdefault(str(writer), []).append(stream)
        written = "; ".join(f"{writer} writes {', '.join(names)}" for writer, names in streams.items())
        return f"<robot {self.name!r}: {written or 'no writer'}>"

    def names_of(self, writer: WriterId, stream: StreamName) -> tuple[str, ...]:
        """The names under which ``writer`` writes on ``stream``, sorted; empty for streams without names."""
        return tuple(name for name, owner in self.named(stream) if owner == writer)

    def named(self, stream: StreamName) -> tuple[tuple[str, WriterId], ...]:
        """The names of the writers of ``stream``, sorted: (name, writer)."""
        return tuple((name, writer) for one, name, writer in self.names if one == stream)


class LivelinessToken(Closeable):
    """Liveliness token of one writer, until closed or until its process ends."""

    def __init__(self, session: Session, token: zenoh.LivelinessToken) -> None:
        self._session = session
        self._token = token

    def close(self) -> None:
        self._session.release(self._token)


def announce(session: Session, token: str) -> LivelinessToken:
    """Declare a liveliness token, visible on the whole network until it is closed."""
    return LivelinessToken(session, session.zenoh.liveliness().declare_token(token))


def announce_reader(
    session: Session, wire: Wire, robot: str, streams: Sequence[StreamName], program: str = ""
) -> list[LivelinessToken]:
    """Announce this program as a reader of ``streams`` of ``robot``, if ``wire`` announces readers.

    ``program`` is its name for others; default: the script's name.
    """
    tokens = wire.reader_tokens(robot, streams, local_writer(0, program), session.zid, session.next_number)
    return [announce(session, token) for token in tokens]


def discover(session: Session, timeout_s: float = 1.0, *, wire: str = "native") -> tuple[RobotInfo, ...]:
    """Every announced robot with its writers, sorted by name.

    A session that has just connected has not discovered all others yet: queries until two replies in a row,
    a tenth of a second apart, have the same writers; without any writer for ``timeout_s`` [s].

    Raises Unreachable if Zenoh has not received the whole reply within 5 s, or ``timeout_s`` if that is more.
    """
    format_ = get_wire(wire)
    tokens = discover_tokens(session, format_.writers_expression(ANY), timeout_s)
    return by_robot({one for token in tokens for one in format_.parse_token(token, ANY)})


def discover_readers(session: Session, timeout_s: float = 1.0) -> tuple[Announcement, ...]:
    """Every announced reader of the native wire, sorted; the robot "*" stands for all robots.

    Queries like ``discover``. Programs that subscribe to keys without zstate are not announced.
    """
    found: set[Announcement] = set()
    for token in discover_tokens(session, READER_TOKEN.expression(), timeout_s):
        with suppress(InvalidInput):
            found.update(Announcement.parse_all(*READER_TOKEN.parse(token)))
    return tuple(sorted(found, key=lambda one: (one.robot, one.stream, one.writer)))


def discover_tokens(session: Session, expression: str, timeout_s: float = 1.0) -> frozenset[str]:
    """The liveliness tokens that match ``expression``, queried like ``discover``. Raises Unreachable."""
    deadline = time.monotonic() + check_timeout(timeout_s)
    found = last = frozenset[str]()
    is_complete = True
    while (remaining_s := deadline - time.monotonic()) > 0.0:
        # Thousands of tokens take a moment: no query is cut short.
        within_s, start_s = max(remaining_s, _ALL_TOKENS_WITHIN_S), time.monotonic()
        tokens, is_complete = query_tokens(session.zenoh, expression, within_s)
        if tokens and tokens == found:
            break
        if not is_complete:
            found |= tokens
        elif tokens or not last:  # one reply without tokens may be wrong; two are not
            found = tokens
        last = tokens
        now_s = time.monotonic()
        time.sleep(max(0.0, min(start_s + ROUND_S, deadline) - now_s))
    if not is_complete:
        waited_s = max(timeout_s, _ALL_TOKENS_WITHIN_S)
        raise Unreachable(
            f"discovery is incomplete: {len(found)} announcements in {waited_s:g} s, and then no end of the "
            "reply; this host, its router or the link between them is overloaded: try again",
            endpoints=(),
        )
    return found


def confirmed_tokens(session: Session, expression: str) -> frozenset[str]:
    """The current liveliness tokens, queried a second time if the first reply has none."""
    return _confirmed(session, expression, ANSWER_WITHIN_S).keys


def announced_robots(session: Session, wire: Wire) -> list[str]:
    """The robots with announced writers, sorted; empty if the session is closed. Takes up to a second."""
    with suppress(ZStateError, zenoh.ZError):
        tokens = confirmed_tokens(session, wire.writers_expression(ANY))
        return sorted({one.robot for token in tokens for one in wire.parse_token(token, ANY)})
    return []


def _confirmed(session: Session, expression: str, timeout_s: float) -> Tokens:
    # zenoh 1.10, of a router's replies to a session that subscribes to the same tokens, one in 1500 is empty:
    # delete when fixed
    found = query_tokens(session.zenoh, expression, timeout_s)
    return found if found.keys else query_tokens(session.zenoh, expression, timeout_s)


def by_robot(found: Iterable[Announcement]) -> tuple[RobotInfo, ...]:
    """The announced writers, grouped by robot, sorted."""
    writers: dict[str, set[tuple[StreamName, WriterId]]] = {}
    names: dict[str, set[tuple[StreamName, str, WriterId]]] = {}
    for one in found:
        writers.setdefault(one.robot, set()).add((one.stream, one.writer))
        if one.name:
            names.setdefault(one.robot, set()).add((one.stream, one.name, one.writer))
    return tuple(
        RobotInfo(robot, tuple(sorted(writers[robot])), tuple(sorted(names.get(robot, ()))))
        for robot in sorted(writers)
    )


# zenoh 1.10, tokens behind a lost router are undeclared like those of ended writers: delete when they differ
class RouterLossDetector(Closeable):
    """The routers that a session is connected to. Has no thread: reads events when it is asked."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._routers: set[str] = set()
        self._lost_at = -math.inf
        self._lock = fork_safe_lock()
        channel: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(256)
        self._events = session.zenoh.info.declare_transport_events_listener(channel, history=True)

    def lost_recently(self) -> bool:
        """Whether a router was lost within the last tenth of a second.

        Tokens behind a router disappear up to a millisecond before the event of its loss. Waits for that
        event, up to 20 ms, if there is a router at all.
        """
        deadline = time.monotonic() + _ROUTER_EVENT_S
        while True:
            # The listener may be undeclared at the same time: then it has no events.
            with self._lock, suppress(zenoh.ZError):
                while (event := self._events.try_recv()) is not None:
                    zid, is_router = str(event.transport.zid), event.transport.whatami == zenoh.WhatAmI.ROUTER
                    if event.kind == zenoh.SampleKind.PUT and is_router:
                        self._routers.add(zid)
                    elif event.kind == zenoh.SampleKind.DELETE and zid in self._routers:
                        self._routers.discard(zid)
                        self._lost_at = time.monotonic()
            if time.monotonic() - self._lost_at < _RECENT_S:
                return True
            if not self._routers or time.monotonic() > deadline:
                return False
            time.sleep(_POLL_S)

    def close(self) -> None:
        self._session.release(self._events)


class WriterWatch(Receiver):
    """Watches the writers of ``robot`` ("*": of all robots; or of several), beginning with the current ones.

    ``callback(announced, alive)`` is called from one thread. The loss of a router removes every writer behind
    it; for these ``on_cut_off(announced)`` is called instead, if it is given. ``foreign`` counts tokens that
    announce no stream of a robot, ``ignored`` those beyond the 100,000 that are kept. An exception of a
    callback is counted in ``failures``; the calls for other tokens still happen.

    A burst of tokens can overflow the ring between Zenoh and this thread. Nothing is lost by that: the
    current tokens are queried then, and compared with the previous ones.
    """

    def __init__(
        self,
        session: Session,
        robot: str | Sequence[str],
        callback: Callable[[Announcement, bool], None],
        wire: str | WriterTokens = "native",
        on_cut_off: Callable[[Announcement], None] | None = None,
    ) -> None:
        self.foreign = 0
        self.ignored = 0
        self._known: dict[str, tuple[Announcement, ...]] = {}
        self._tokens_of: Counter[Announcement] = Counter()
        """A writer may announce a stream by more than one token."""
        self._callback = callback
        self._on_cut_off = on_cut_off
        self._routers = None if on_cut_off is None else RouterLossDetector(session)
        robots = (robot,) if isinstance(robot, str) else robot
        self._robot = robots[0] if len(robots) == 1 else ANY
        self._wire = get_wire(wire) if isinstance(wire, str) else wire
        # In ROS robots share one expression.
        self._expressions = list(dict.fromkeys(self._wire.writers_expression(one) for one in robots))
        declare = partial(session.zenoh.liveliness().declare_subscriber, history=True)
        super().__init__(session, self._expressions, declare, CAPACITY)

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        if len(batch) < CAPACITY:
            puts = zenoh.SampleKind.PUT
            changes = [(str(sample.key_expr), sample.kind == puts) for sample in batch]
        else:
            # Differences since the last batch; later changes are still in the ring.
            current, known = self._current_tokens(), self._known.keys()
            if self._closed:
                return
            changes = [(token, False) for token in known - current]
            changes += [(token, True) for token in current - known]
        is_loss = any(not alive for _, alive in changes)
        cut_off = is_loss and self._routers is not None and self._routers.lost_recently()
        call_for_each(changes, lambda change: self._on_change(*change, cut_off=cut_off))

    def _current_tokens(self) -> set[str]:
        """All tokens, queried until the replies are complete: a token that a reply lacks may be alive."""
        current: set[str] = set()
        for expression in self._expressions:
            is_complete = False
            while not (is_complete or self._closed):
                tokens, is_complete = _confirmed(self._session, expression, _ALL_TOKENS_WITHIN_S)
                current |= tokens
        return current

    def _on_change(self, token: str, alive: bool, *, cut_off: bool) -> None:
        if alive == (token in self._known):
            return
        if alive and len(self._known) >= MAX_REPLIES:
            self.ignored += 1
            return
        announced = self._wire.parse_token(token, self._robot) if alive else self._known.pop(token)
        if alive:
            self._known[token] = announced
            self.foreign += not announced
            changed = [one for one in announced if one not in self._tokens_of]
            self._tokens_of.update(announced)
        else:
            self._tokens_of.subtract(announced)
            changed = [one for one in announced if not self._tokens_of[one]]
            for one in changed:
                del self._tokens_of[one]
        if cut_off and not alive and self._on_cut_off is not None:
            call_for_each(changed, self._on_cut_off)
        else:
            call_for_each(changed, lambda one: self._callback(one, alive))

    def close(self) -> None:
        super().close()  # first: its thread uses the detector
        if self._routers is not None:
            self._routers.close()


class OtherTfSubscription(Closeable):
    """A listener's subscription to /tf besides joint states, while others than state publishers write it.

    A state publisher writes there what its model and the joint states contain; zstate's own does not even
    compute it without a subscriber.
    """

    def __init__(self, subscribe: Callable[[], Closeable]) -> None:
        self._subscribe = subscribe
        self._writers: set[Announcement] = set()
        self._subscription: Closeable | None = None

    def on_writer(self, announced: Announcement, *, alive: bool) -> None:
        """Subscribe or unsubscribe, if this writer makes a difference."""
        (self._writers.add if alive else self._writers.discard)(announced)
        streams: dict[str, set[StreamName]] = {}
        for one in self._writers:
            streams.setdefault(one.node, set()).add(one.stream)
        if not any(one.stream == "tf" and not _is_state_publisher(one, streams) for one in self._writers):
            self.close()
        elif self._subscription is None:
            self._subscription = self._subscribe()

    def close(self) -> None:
        """Unsubscribe."""
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            subscription.close()


def _is_state_publisher(announced: Announcement, streams: Mapping[str, Collection[StreamName]]) -> bool:
    """Whether it is of a node with the model that writes joint states, or is named robot_state_publisher.

    ``streams`` are those of each node; the nodes behind a zenoh-plugin-ros2dds bridge are not known.
    """
    written = streams[announced.node]
    is_named_so = announced.writer.program.endswith("/robot_state_publisher")
    return (
        bool(announced.node) and "robot_description" in written and ("joint_states" in written or is_named_so)
    )


class Connections(NamedTuple):
    """Numbers of sessions by their mode, of all three, and of links by their protocol ("tcp", "tls", ...)."""

    sessions: dict[str, int]
    links: dict[str, int]


def connections(session: Session) -> Connections:
    """The current direct connections of ``session``. Raises Closed."""
    info = session.zenoh.info
    sessions = Counter(str(transport.whatami).lower() for transport in info.transports())
    links = Counter(str(link.dst).partition("/")[0] for link in info.links())
    return Connections({mode: sessions[mode] for mode in ("client", "peer", "router")}, dict(links))
