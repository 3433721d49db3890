"""Exclusive ownership (DDS): one writer for each stream of a robot, one writer of edges for each child frame.

A writer of some joints of a robot claims the edges that these move, and excludes a writer of all joints.

``WriterClaim`` owns streams, and the edges under one name; ``claim_edges`` owns new edges: static ones while
they are published, because then their value shows them, moving ones as long as their writer is open.
Conflicting writers are found by their liveliness tokens and raise SecondWriter.
"""

from __future__ import annotations

import math
import time
import weakref
from collections import deque
from collections.abc import Callable, Container, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from functools import cache
from itertools import islice
from typing import NamedTuple, TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.edge_rules import loop_refusal
from zstate.errors import InsertRefused, InvalidInput, MessageError, SecondWriter, format_duration
from zstate.net.latched import cached_values
from zstate.net.presence import ANSWER_WITHIN_S, announce, confirmed_tokens
from zstate.net.queryable import query
from zstate.net.session import Session
from zstate.net.streams import BULK_CAPACITY, Ring, to_serialized
from zstate.plugins import edge_streams, is_bulk, is_measured, is_named
from zstate.streams import BULK_BYTES, StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import (
    ANY,
    EDGE_TOKEN,
    FOREIGN_FRAME,
    MODEL_WRITER,
    foreign_edge_problem,
    frame_owner,
    full_name,
    stream_expression,
    stream_key,
)
from zstate.wire.messages import Edges, RobotDescription, StaticTransforms, session_of
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


@cache
def _all_histories_of_edges() -> tuple[str, ...]:
    """Queries that each writer of moving edges or of some joints receives, and to which none has samples."""
    return tuple(f"{stream_expression(ANY, stream)}?session=0" for stream in moving_streams())


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


Edge = tuple[str, str]
"""Parent and child, as full names."""


@contextmanager
def claim_edges(
    session: Session, writer: Announcement, edges: Sequence[Edge], allowed: Container[int] = ()
) -> Generator[None]:
    """Exclusive ownership of the children of ``edges``, for ``writer``.

    Raises SecondWriter if a live writer of edges of any robot places one of them; of two that claim one
    at the same time the later one gets it. Writers whose sessions are in ``allowed`` do not conflict. Takes
    some round trips.
    """
    with ExitStack() as claims:
        for parent, child in edges:
            token = EDGE_TOKEN.key(writer.robot, child, parent, writer.identity)
            claims.enter_context(announce(session, token))
        # Each writer announces its claim before it checks, so that at least one of two sees the other. Peers
        # check received tokens: a peer that has replied has received ours, and we have received its tokens.
        if not session.zenoh.info.routers_zid():
            check_edges(session, writer, edges, allowed)
            for histories in _all_histories_of_edges():
                for _ in query(session.zenoh, histories, ANSWER_WITHIN_S):
                    pass
        for edge in edges:
            _wait_for_rival_claims(session, writer, edge[1], allowed)
        check_edges(session, writer, edges, allowed)
        yield


def _wait_for_rival_claims(
    session: Session, writer: Announcement, child: str, allowed: Container[int]
) -> None:
    """Wait until no other writer claims ``child``; SecondWriter if an older one does, or after 0.5 s."""
    deadline = time.monotonic() + TOKEN_EXPIRY_S
    while True:
        claims: list[tuple[Announcement, Edge]] = []
        for token in confirmed_tokens(session, EDGE_TOKEN.expression(child=child)):
            with suppress(InvalidInput):  # not a token of zstate
                robot, _, parent, identity = EDGE_TOKEN.parse(token)
                other = Announcement.parse(robot, "tf_static", identity)
                is_other = other.writer.session != writer.writer.session
                if is_other and other.writer.session not in allowed and not _outranks(writer, robot, child):
                    claims.append((other, (parent, child)))
        if not claims:
            return
        first, edge = min(claims, key=lambda claim: seniority(claim[0]))
        if seniority(first) < seniority(writer) or time.monotonic() > deadline:
            raise frame_conflict(_announced(session, first), edge, "is placing")
        time.sleep(ROUND_S)


def check_edges(
    session: Session, writer: Announcement, edges: Sequence[Edge], allowed: Container[int] = ()
) -> None:
    """Raise SecondWriter if a static writer of any robot places a child of ``edges`` already.

    Frames are full names; ``writer`` publishes ``edges``. Takes one round trip.
    """
    wait_for_discovery(session)
    children = {child for _, child in edges}
    for robot, name, statics in _current_statics(session):
        is_own = writer.stream == "tf_static" and (robot, name) == (writer.robot, writer.name)
        if is_own or statics.session in allowed:
            continue
        for parent, child in named_edges(robot, statics.edges):
            if child in children and not _outranks(writer, robot, child):
                first = Announcement(robot, "tf_static", WriterId(name, "", 0, 0, statics.session), name)
                raise frame_conflict(_announced(session, first), (parent, child), "places")


def _announced(session: Session, writer: Announcement) -> Announcement:
    """The announcement of a writer of edges, of which only robot, name and session are known for certain."""
    for token in confirmed_tokens(session, _WIRE.writers_expression(writer.robot)):
        for known in _WIRE.parse_token(token, writer.robot):
            if known.name == writer.name and known.writer.session == writer.writer.session:
                return known
    return writer


def _outranks(writer: Announcement, other_robot: str, child: str) -> bool:
    """Whether ``child`` is a frame of the writer's robot, whose edges override those of another robot."""
    return frame_owner(child) == writer.robot != other_robot


def check_readers(session: Session, writer: Announcement, edges: Sequence[Edge]) -> None:
    """Raise InsertRefused for an edge that readers refuse, by what is announced now.

    That is an edge that places another robot's frames, see ``foreign_edge_problem``, or that excludes an edge
    of a robot's model. Takes some round trips.
    """
    wait_for_discovery(session)
    for edge in edges:
        robots: set[str] = set()
        for robot in {frame_owner(frame) for frame in edge} - {writer.robot}:
            with suppress(InvalidInput):  # not a robot's name
                if confirmed_tokens(session, _WIRE.writers_expression(robot)):
                    robots.add(robot)
        objection = foreign_edge_problem(writer.robot, edge, robots)
        if objection:
            raise InsertRefused(objection, reason=FOREIGN_FRAME, edge=edge)
    placements = _Placements(session, writer.robot)
    for edge in edges:
        placements.check(edge)


class _Placement(NamedTuple):
    """The parent of a frame, and what places it there."""

    parent: str
    writer: str
    is_model: bool


class _Placements:
    """The static edges of the writers of ``robot``, and the edges of all models needed for a check."""

    def __init__(self, session: Session, robot: str) -> None:
        self._session = session
        self._fetched: set[str] = set()
        self._by_child: dict[str, _Placement] = {}
        for owner, name, statics in _current_statics(session):
            if owner == robot or name == MODEL_WRITER:
                is_model = name == MODEL_WRITER
                writer = f"the model of {owner!r}" if is_model else f"{name!r} of {owner!r}"
                for parent, child in named_edges(owner, statics.edges):
                    self._by_child[child] = _Placement(parent, writer, is_model)

    def check(self, edge: Edge) -> None:
        """Raise InsertRefused if a model places the child, or if the edge closes a loop."""
        parent, child = edge
        placement = self._get(child)
        if placement is not None and placement.is_model:
            raise InsertRefused(
                f"{parent!r} -> {child!r}: {child!r} is a link, placed on {placement.parent!r} by "
                f"{placement.writer}, and readers refuse another edge for it; publish a frame that the model "
                "does not place",
                reason="second writer" if placement.parent == parent else "second parent",
                edge=edge,
            )
        loop = loop_refusal(parent, child, None, self._get)
        if loop is not None and parent != child:  # the writer's own buffer refuses that
            raise InsertRefused(
                f"{loop}; readers refuse it: the second frame is the one that is placed, and {child!r} is "
                f"above {parent!r} already: turn the edge round, or place another frame",
                reason="loop",
                edge=edge,
            )

    def _get(self, frame: str) -> _Placement | None:
        """The placement of a frame; fetches the models of its robot at the first call."""
        robot = frame_owner(frame)
        if robot not in self._fetched:
            self._fetched.add(robot)
            for description in _current_descriptions(self._session, robot):
                for parent, child in named_edges(robot, description.moving_edges):
                    self._by_child[child] = _Placement(parent, f"the model of {robot!r}", is_model=True)
        return self._by_child.get(frame)


def _current_descriptions(session: Session, robot: str) -> Iterator[RobotDescription]:
    try:
        key = _WIRE.expression(robot, "robot_description")
    except InvalidInput:  # not a robot's name
        return
    for value in cached_values(session, key, ANSWER_WITHIN_S):
        if value.key == key:
            with suppress(MessageError):
                (description,) = _WIRE.decode("robot_description", value, robot)
                assert isinstance(description, RobotDescription)
                yield description


def _current_statics(session: Session) -> Iterator[tuple[str, str, StaticTransforms]]:
    """Robot, writer name and edges of each static writer."""
    for value in cached_values(session, _WIRE.expression(ANY, "tf_static"), ANSWER_WITHIN_S):
        with suppress(MessageError, InvalidInput):  # withdrawn, or not of zstate
            robot, name = _WIRE.robot_from_key(value.key), _WIRE.edge_writer_name(value.key)
            if value.key == stream_key(robot, "tf_static", name):
                (statics,) = _WIRE.decode("tf_static", value, robot)
                assert isinstance(statics, StaticTransforms)
                yield robot, name, statics


def named_edges(robot: str, edges: Edges) -> Iterator[Edge]:
    """The edges of ``robot`` by full names, without edges whose names cannot be frames."""
    for parent, child in edges:
        with suppress(InvalidInput):  # readers refuse it, too
            yield full_name(robot, parent), full_name(robot, child)


def frame_conflict(first: Announcement, edge: Edge, verb: str) -> SecondWriter:
    """The error of a writer whose edge excludes ``edge`` of the writer ``first``."""
    parent, child = edge
    advice = "stop or withdraw that first, or use takeover=True (--takeover)"
    if first.stream in moving_streams():
        verb, advice = "places", "stop that first"
    text = (
        f"{writer_text(first.writer)} {verb} {child!r} on {parent!r} already, as {first.name!r} of "
        f"{first.robot!r}; {advice}"
    )
    return SecondWriter(text, robot=first.robot, stream=first.stream, first=first.writer, edge=edge)
