"""Claim: what one writer alone may say, and who else says it.

Placing: that one static writer alone says where a frame is.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time
import weakref
from collections.abc import Container, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from typing import NamedTuple, TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InsertRefused, InvalidInput, MessageError, SecondWriter, format_duration
from zstate.net.presence import ANSWER_WITHIN_S, announce, confirmed_tokens
from zstate.net.queryable import query
from zstate.net.session import Session
from zstate.net.streams import Ring, to_serialized
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import (
    ANY,
    FOREIGN,
    MODEL_WRITER,
    Stream,
    edge_expression,
    edge_key,
    foreign_objection,
    full_name,
    parse_edge_key,
    robot_in,
    stream_key,
)
from zstate.wire.messages import Edges, RobotDescription, Sample, StaticTransforms
from zstate.wire.native import NativeWire
from zstate.wire.protocol import SerializedSample

CAPACITY = 1024
TOKEN_EXPIRY_S = 0.5
"""So long after a writer was killed its token may still be seen; measured: 2 to 33 ms."""

ROUND_S = 0.005

_MET_WITHIN_S = 0.03
"""Peers that have just connected meet the others one by one; on a quiet loopback that took up to 6 ms."""

_HEARD_WITHIN_S = 0.02
"""So long a token is on its way to all peers, at most; on a loopback that took some milliseconds."""

_LOOK_EVERY_S = 0.05
"""Asking Zenoh who has come is a fifth of what a sample costs its writer."""

_AT_ONCE_S = 1.0
"""But so long each sample asks: who opened at the same time is heard of by then."""

_Handler: TypeAlias = "zenoh.handlers.Handler[zenoh.Sample]"

_WIRE = NativeWire()
_CLAIMS: weakref.WeakKeyDictionary[Session, set[WriterClaim]] = weakref.WeakKeyDictionary()
_CLAIMS_LOCK = fork_safe_lock()


class WriterClaim(Closeable):
    """That one writer alone says ``wanted``: streams of one robot, or static edges under one name.

    Raises SecondWriter when somebody else who lives is announced with one of them, or claims it in the
    same session. Two that open at the same time may not see each other yet: ``check`` tells the later
    one, ever after, and ``settle`` at once.

    From a second after the first ``check`` this writer is established. A token alone does not end it any
    more, whatever start it claims: the other writer must also publish one of the streams. So of two that
    publish on networks which are joined later, the later one ends.
    """

    def __init__(self, session: Session, wanted: Sequence[Announcement]) -> None:
        self._session = session
        self._wanted = wanted
        self._rivals: set[Announcement] = set()
        self._received: dict[tuple[Stream, str], zenoh.ext.AdvancedSubscriber[_Handler]] = {}
        self._publishing: set[int] = set()
        self._first: Announcement | None = None
        self._look_at = 0.0
        self._heard_of_all_at = 0.0
        self._expression = _WIRE.writers_expression(wanted[0].robot)
        # Not before the first ``check``: of the tokens that are followed, a router's answers leave some out.
        self._tokens: zenoh.Subscriber[_Handler] | None = None
        self._enter()
        try:
            self._await_the_leaving()
        except BaseException:
            self._leave()
            raise

    def confirm(self) -> None:
        """Make sure, once ours is announced, that nobody has opened at the same time and stays.

        For those who say something once and are silent then. Raises SecondWriter.
        """
        _wait_for_propagation(self._session)
        deadline = time.monotonic() + TOKEN_EXPIRY_S
        while rivals := self._rivals_now():
            earlier = [rival for rival in rivals if self._is_before_us(rival)]
            if earlier or time.monotonic() > deadline:
                raise _second_writer(self._oldest(earlier or rivals))
            time.sleep(ROUND_S)

    def check(self) -> None:
        """Raise SecondWriter if there is somebody who came before; then always. Raises Closed.

        A second after the first call it looks twenty times a second only, however often it is called.
        """
        if self._first is None:
            now = time.monotonic()
            if now < self._look_at:
                return
            self._session.check()
            if self._tokens is None:
                self._heard_of_all_at = now + _AT_ONCE_S
            elif now > self._heard_of_all_at:
                self._look_at = now + _LOOK_EVERY_S
            self._follow()
            if not self._rivals:
                return
            earlier = {rival for rival in self._rivals if self._is_before_us(rival)}
            if now > self._heard_of_all_at:
                earlier = {rival for rival in earlier if self._publishes(rival)}
            # Zenoh now and then goes on telling of a token that is gone, in the session that followed it.
            there = earlier.intersection(self._rivals_now()) if earlier else earlier
            self._rivals -= earlier - there
            if not there:
                return
            self._first = self._oldest(there)
        raise _second_writer(self._first)

    def close(self) -> None:
        """Claim no more. A second call does nothing."""
        self._leave()
        if self._tokens is not None:
            self._session.release(self._tokens)
        while self._received:
            self._session.release(self._received.popitem()[1])

    def _enter(self) -> None:
        """Of those in one session the first is known at once, and without asking the network."""
        with _CLAIMS_LOCK:
            claims = _CLAIMS.setdefault(self._session, set())
            rivals = self._excluded_by(theirs for claim in claims for theirs in claim._wanted)
            if rivals:
                raise _second_writer(self._oldest(rivals))
            claims.add(self)

    def _leave(self) -> None:
        with _CLAIMS_LOCK:
            _CLAIMS[self._session].discard(self)

    def _await_the_leaving(self) -> None:
        wait_for_discovery(self._session)
        deadline = time.monotonic() + TOKEN_EXPIRY_S
        while rivals := self._rivals_now():
            if time.monotonic() > deadline:
                raise _second_writer(self._oldest(rivals))
            time.sleep(ROUND_S)

    def _follow(self) -> None:
        """No thread for this: whoever publishes looks whether somebody has come or gone."""
        if self._tokens is None:
            self._tokens = self._followed()
        seen = 0
        while (sample := self._tokens.handler.try_recv()) is not None:
            seen += 1
            said = self._rivals_of([str(sample.key_expr)])
            if sample.kind == zenoh.SampleKind.PUT:
                self._rivals.update(said)
            else:
                self._rivals.difference_update(said)
        if seen >= CAPACITY:  # some may have been lost
            self._rivals = set(self._rivals_now())

    def _publishes(self, rival: Announcement) -> bool:
        """Whether a sample or a latched value of ``rival`` has been received, from the first call on."""
        place = (rival.stream, rival.name)
        if place not in self._received:
            self._received[place] = _subscribed(self._session, rival)
        handler = self._received[place].handler
        for _ in range(CAPACITY):
            sample = handler.try_recv()
            if sample is None:
                break
            with suppress(MessageError):  # not ours, or withdrawn
                for message in _WIRE.decode(rival.stream, to_serialized(sample), rival.robot):
                    if isinstance(message, Sample | StaticTransforms | RobotDescription):
                        self._publishing.add(message.session)
        self._publishing &= {one.writer.session for one in self._rivals}
        return rival.writer.session in self._publishing

    def _followed(self) -> zenoh.Subscriber[_Handler]:
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        return self._session.zenoh.liveliness().declare_subscriber(self._expression, ring, history=True)

    def _rivals_now(self) -> list[Announcement]:
        return self._rivals_of(confirmed_tokens(self._session, self._expression))

    def _rivals_of(self, tokens: Iterable[str]) -> list[Announcement]:
        said = (_WIRE.announced(token, ANY) for token in tokens)
        return self._excluded_by(one for one in said if one is not None)

    def _excluded_by(self, others: Iterable[Announcement]) -> list[Announcement]:
        return [one for one in others if any(one.conflicts_with(ours) for ours in self._wanted)]

    def _oldest(self, rivals: Iterable[Announcement]) -> Announcement:
        streams = [ours.stream for ours in self._wanted]
        return min(rivals, key=lambda rival: (seniority(rival), streams.index(rival.stream)))

    def _is_before_us(self, rival: Announcement) -> bool:
        return seniority(rival) < seniority(self._wanted[0])


def _subscribed(session: Session, rival: Announcement) -> zenoh.ext.AdvancedSubscriber[_Handler]:
    ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
    return zenoh.ext.declare_advanced_subscriber(
        session.zenoh,
        stream_key(rival.robot, rival.stream, rival.name),
        ring,
        history=zenoh.ext.HistoryConfig(max_samples=1),
    )


def wait_for_discovery(session: Session) -> None:
    """Return when a session that has just connected has met the others."""
    if not session.zenoh.info.routers_zid():  # a router knows everybody
        time.sleep(max(0.0, session.opened_at + _MET_WITHIN_S - time.monotonic()))


def seniority(announced: Announcement) -> tuple[int, int]:
    """Smaller for who came first."""
    return announced.writer.since, announced.writer.session


def _wait_for_propagation(session: Session) -> None:
    """Return when the others have heard of the token that was just declared."""
    if not session.zenoh.info.routers_zid():  # what a router was told, it knows when it is asked
        time.sleep(_HEARD_WITHIN_S)


def _second_writer(first: Announcement) -> SecondWriter:
    if first.stream == "tf_static":
        what = f"static edges of {first.robot!r} under the name {first.name!r}"
    else:
        what = f"{first.stream} of {first.robot!r}"
    text = (
        f"{writer_text(first.writer)} writes {what} already; end that first, or say takeover=True "
        "(--takeover) to write beside it: readers follow the newest"
    )
    return SecondWriter(text, robot=first.robot, stream=first.stream, first=first.writer)


def writer_text(writer: WriterId) -> str:
    """Who that is, and since when, for errors."""
    if not writer.since:
        return repr(str(writer))
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    ago = format_duration(time.time_ns() - writer.since)
    return f"{str(writer)!r}, there since {began:%Y-%m-%d %H:%M:%S} ({ago} ago),"


Edge = tuple[str, str]
"""Parent and child, named in full."""


@contextmanager
def claim_edges(
    session: Session, writer: Announcement, edges: Sequence[Edge], beside: Container[int] = ()
) -> Generator[None]:
    """While ``writer`` says ``edges`` for the first time: nobody else says where their children are.

    Raises SecondWriter if a static writer of any robot that lives places one of them already; of two who
    are about to, the later one gets it. Those whose sessions are ``beside`` may. Takes some round trips.
    """
    with ExitStack() as said:
        for edge in edges:
            said.enter_context(announce(session, edge_key(writer.robot, edge, writer.identity)))
        # Each says it before looking, so that at least one of two sees the other. Peers look at what they
        # have heard: whoever has answered has heard of ours, and what it said before we have heard.
        if not session.zenoh.info.routers_zid():
            check_edges(session, writer, edges, beside)
        for edge in edges:
            _await_the_later(session, writer, edge, beside)
        check_edges(session, writer, edges, beside)
        yield


def _await_the_later(session: Session, writer: Announcement, edge: Edge, beside: Container[int]) -> None:
    deadline = time.monotonic() + TOKEN_EXPIRY_S
    while rivals := list(_about_to_place(session, writer, edge[1], beside)):
        first, theirs = min(rivals, key=lambda rival: seniority(rival[0]))
        if seniority(first) < seniority(writer) or time.monotonic() > deadline:
            raise _placed(first, theirs, "is placing")
        time.sleep(ROUND_S)


def _about_to_place(
    session: Session, writer: Announcement, child: str, beside: Container[int]
) -> Iterator[tuple[Announcement, Edge]]:
    for token in confirmed_tokens(session, edge_expression(child)):
        with suppress(InvalidInput):  # not ours
            robot, edge, identity = parse_edge_key(token)
            said = Announcement.parse(robot, "tf_static", identity)
            if _is_own_frame(robot, edge[1], writer):
                continue
            if said.writer.session != writer.writer.session and said.writer.session not in beside:
                yield said, edge


def check_edges(
    session: Session, writer: Announcement, edges: Sequence[Edge], beside: Container[int] = ()
) -> None:
    """Raise SecondWriter if a static writer of any robot that lives already places a child of ``edges``.

    Frames are named in full; ``writer`` is who asks. Takes as long as the network: one round trip.
    """
    wait_for_discovery(session)
    children = {child for _, child in edges}
    for robot, name, said in _statics_now(session):
        if (robot, name) != (writer.robot, writer.name) and said.session not in beside:
            for parent, child in named_edges(robot, said.edges):
                if child in children and not _is_own_frame(robot, child, writer):
                    first = Announcement(robot, "tf_static", _unknown(name, said), name)
                    raise _placed(_with_identity(session, first), (parent, child), "places")


def _is_own_frame(robot: str, child: str, writer: Announcement) -> bool:
    """Whether ``child`` is a frame of the writer's robot, which counts more than what others say of it."""
    return robot_in(child) == writer.robot != robot


def check_readers(session: Session, writer: Announcement, edges: Sequence[Edge]) -> None:
    """Raise InsertRefused for an edge that readers refuse, as far as what is announced now tells.

    That is an edge that places another robot's frames, see ``foreign_objection``, or that excludes an edge
    of a robot's model. Takes as long as the network: some round trips.
    """
    wait_for_discovery(session)
    for edge in edges:
        named = {robot_in(frame) for frame in edge} - {writer.robot}
        robots = {robot for robot in named if _is_announced(session, robot)}
        objection = foreign_objection(writer.robot, edge, robots)
        if objection:
            raise InsertRefused(objection, reason=FOREIGN, edge=edge)
    known = _Models(session, writer.robot)
    for edge in edges:
        known.check(edge)


def _is_announced(session: Session, robot: str) -> bool:
    try:
        return bool(confirmed_tokens(session, _WIRE.writers_expression(robot)))
    except InvalidInput:  # what cannot be a robot's name is that of none
        return False


class _Above(NamedTuple):
    """What places a frame: on which parent, and by whom."""

    parent: str
    by: str
    is_model: bool


class _Models:
    """The edges of the models that a question leads to, and the static edges of the writers of ``robot``."""

    def __init__(self, session: Session, robot: str) -> None:
        self._session = session
        self._fetched: set[str] = set()
        self._above: dict[str, _Above] = {}
        for owner, name, said in _statics_now(session):
            if owner == robot or name == MODEL_WRITER:
                is_model = name == MODEL_WRITER
                by = f"the model of {owner!r}" if is_model else f"{name!r} of {owner!r}"
                for parent, child in named_edges(owner, said.edges):
                    self._above[child] = _Above(parent, by, is_model)

    def check(self, edge: Edge) -> None:
        """Raise InsertRefused if a model places the child, or if the edge closes a loop."""
        parent, child = edge
        there = self._what_places(child)
        if there is not None and there.is_model:
            raise InsertRefused(
                f"{parent!r} -> {child!r}: {child!r} is a link, placed on {there.parent!r} by {there.by}, "
                "and readers refuse another edge for it; publish a frame that the model does not place",
                reason="second writer" if there.parent == parent else "second parent",
                edge=edge,
            )
        ring, others = [parent], list[str]()
        while ring[-1] != child:
            above = self._what_places(ring[-1])
            if above is None or above.parent in ring:
                return
            ring.append(above.parent)
            others.append(above.by)
        if others:
            way = " -> ".join(map(repr, reversed(ring)))
            raise InsertRefused(
                f"{parent!r} -> {child!r} would close the loop {way} -> {child!r} with edges of "
                f"{' and '.join(dict.fromkeys(others))}, and readers refuse it; the second frame is the one "
                f"that is placed, and {child!r} is above {parent!r} already: turn the edge round, or place "
                "another frame",
                reason="loop",
                edge=edge,
            )

    def _what_places(self, frame: str) -> _Above | None:
        robot = robot_in(frame)
        if robot not in self._fetched:
            self._fetched.add(robot)
            for description in _descriptions_now(self._session, robot):
                for parent, child in named_edges(robot, description.moving_edges):
                    self._above[child] = _Above(parent, f"the model of {robot!r}", is_model=True)
        return self._above.get(frame)


def _descriptions_now(session: Session, robot: str) -> Iterator[RobotDescription]:
    try:
        key = _WIRE.expression(robot, "robot_description")
    except InvalidInput:  # what cannot be a robot's name is that of none
        return
    for arrival in _kept_now(session, key):
        if arrival.key == key:
            with suppress(MessageError):
                (said,) = _WIRE.decode("robot_description", arrival, robot)
                assert isinstance(said, RobotDescription)
                yield said


def _statics_now(session: Session) -> Iterator[tuple[str, str, StaticTransforms]]:
    """What static writers keep for late joiners, whose key tells robot and name."""
    for arrival in _kept_now(session, _WIRE.expression(ANY, "tf_static")):
        with suppress(MessageError, InvalidInput):  # withdrawn, or not ours
            robot, name = _WIRE.robot_of(arrival.key), _WIRE.statics_writer(arrival.key)
            if arrival.key == stream_key(robot, "tf_static", name):
                (said,) = _WIRE.decode("tf_static", arrival, robot)
                assert isinstance(said, StaticTransforms)
                yield robot, name, said


def _kept_now(session: Session, expression: str) -> Iterator[SerializedSample]:
    """What latched publishers on these keys keep for late joiners."""
    kept = f"{expression}/@adv/**"
    for reply in query(session.zenoh, kept, ANSWER_WITHIN_S, accept_replies=zenoh.ReplyKeyExpr.ANY):
        if reply.ok is not None:
            yield to_serialized(reply.ok)


def named_edges(robot: str, edges: Edges) -> Iterator[Edge]:
    """The edges of ``robot`` by their full names, without those whose names cannot be frames."""
    for parent, child in edges:
        with suppress(InvalidInput):  # no reader takes it either
            yield full_name(robot, parent), full_name(robot, child)


def _unknown(name: str, said: StaticTransforms) -> WriterId:
    return WriterId(name, "", 0, 0, said.session)


def _with_identity(session: Session, placed: Announcement) -> Announcement:
    """The same with who it is, if that is announced."""
    for token in confirmed_tokens(session, _WIRE.writers_expression(placed.robot)):
        said = _WIRE.announced(token, placed.robot)
        if said is not None and said.stream == "tf_static" and said.writer.session == placed.writer.session:
            return Announcement(placed.robot, "tf_static", said.writer, placed.name)
    return placed


def _placed(first: Announcement, edge: Edge, does: str) -> SecondWriter:
    parent, child = edge
    text = (
        f"{writer_text(first.writer)} {does} {child!r} on {parent!r} already, as {first.name!r} of "
        f"{first.robot!r}; end or withdraw that first, or say takeover=True (--takeover)"
    )
    return SecondWriter(text, robot=first.robot, stream="tf_static", first=first.writer, edge=edge)
