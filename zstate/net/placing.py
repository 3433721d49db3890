"""Placing: that one static writer alone says where a frame is."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time
from collections.abc import Container, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import NamedTuple

import zenoh

from zstate.errors import InsertRefused, InvalidInput, MessageError, SecondWriter
from zstate.net.claims import (
    GONE_WITHIN_S,
    ROUND_S,
    age_of,
    await_the_meeting,
    who_text,
)
from zstate.net.presence import ANSWER_WITHIN_S, announce, tokens_there
from zstate.net.replies import query
from zstate.net.session import Session
from zstate.net.streams import arrival_of
from zstate.wire.keys import (
    ANY,
    FOREIGN,
    MODEL_WRITER,
    edge_expression,
    edge_key,
    foreign_objection,
    full_name,
    parse_edge_key,
    robot_in,
    stream_key,
)
from zstate.wire.messages import Edges, RobotDescription, StaticTransforms
from zstate.wire.native import NativeWire
from zstate.wire.protocol import SerializedSample
from zstate.wire.writer import Announced, Writer

Edge = tuple[str, str]
"""Parent and child, named in full."""

_WIRE = NativeWire()


@contextmanager
def placing(
    session: Session, writer: Announced, edges: Sequence[Edge], beside: Container[int] = ()
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


def _await_the_later(session: Session, writer: Announced, edge: Edge, beside: Container[int]) -> None:
    deadline = time.monotonic() + GONE_WITHIN_S
    while rivals := list(_about_to_place(session, writer, edge[1], beside)):
        first, theirs = min(rivals, key=lambda rival: age_of(rival[0]))
        if age_of(first) < age_of(writer) or time.monotonic() > deadline:
            raise _placed(first, theirs, "is placing")
        time.sleep(ROUND_S)


def _about_to_place(
    session: Session, writer: Announced, child: str, beside: Container[int]
) -> Iterator[tuple[Announced, Edge]]:
    for token in tokens_there(session, edge_expression(child)):
        with suppress(InvalidInput):  # not ours
            robot, edge, identity = parse_edge_key(token)
            said = Announced.parse(robot, "tf_static", identity)
            if _gives_way(robot, edge[1], writer):
                continue
            if said.writer.session != writer.writer.session and said.writer.session not in beside:
                yield said, edge


def check_edges(
    session: Session, writer: Announced, edges: Sequence[Edge], beside: Container[int] = ()
) -> None:
    """Raise SecondWriter if a static writer of any robot that lives already places a child of ``edges``.

    Frames are named in full; ``writer`` is who asks. Takes as long as the network: one round trip.
    """
    await_the_meeting(session)
    children = {child for _, child in edges}
    for robot, name, said in _statics_now(session):
        if (robot, name) != (writer.robot, writer.name) and said.session not in beside:
            for parent, child in named_edges(robot, said.edges):
                if child in children and not _gives_way(robot, child, writer):
                    first = Announced(robot, "tf_static", _unknown(name, said), name)
                    raise _placed(_told_in_full(session, first), (parent, child), "places")


def _gives_way(robot: str, child: str, writer: Announced) -> bool:
    """Whether ``child`` is a frame of the writer's robot, which counts more than what others say of it."""
    return robot_in(child) == writer.robot != robot


def check_readers(session: Session, writer: Announced, edges: Sequence[Edge]) -> None:
    """Raise InsertRefused for an edge that readers refuse, as far as what is announced now tells.

    That is an edge that places another robot's frames, see ``foreign_objection``, or that excludes an edge
    of a robot's model. Takes as long as the network: some round trips.
    """
    await_the_meeting(session)
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
        return bool(tokens_there(session, _WIRE.writers_expression(robot)))
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
            yield arrival_of(reply.ok)


def named_edges(robot: str, edges: Edges) -> Iterator[Edge]:
    """The edges of ``robot`` by their full names, without those whose names cannot be frames."""
    for parent, child in edges:
        with suppress(InvalidInput):  # no reader takes it either
            yield full_name(robot, parent), full_name(robot, child)


def _unknown(name: str, said: StaticTransforms) -> Writer:
    return Writer(name, "", 0, 0, said.session)


def _told_in_full(session: Session, placed: Announced) -> Announced:
    """The same with who it is, if that is announced."""
    for token in tokens_there(session, _WIRE.writers_expression(placed.robot)):
        said = _WIRE.announced(token, placed.robot)
        if said is not None and said.stream == "tf_static" and said.writer.session == placed.writer.session:
            return Announced(placed.robot, "tf_static", said.writer, placed.name)
    return placed


def _placed(first: Announced, edge: Edge, does: str) -> SecondWriter:
    parent, child = edge
    text = (
        f"{who_text(first.writer)} {does} {child!r} on {parent!r} already, as {first.name!r} of "
        f"{first.robot!r}; end or withdraw that first, or say takeover=True (--takeover)"
    )
    return SecondWriter(text, robot=first.robot, stream="tf_static", first=first.writer, edge=edge)
