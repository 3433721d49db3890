"""Placing: that one static writer alone says where a frame is."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time
from collections.abc import Container, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

import zenoh

from zstate.errors import InvalidInput, MessageError, SecondWriter
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
from zstate.wire.keys import ANY, edge_expression, edge_key, full_name, parse_edge_key
from zstate.wire.messages import StaticTransforms
from zstate.wire.native import NativeWire
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
            for parent, child in named_edges(robot, said):
                if child in children:
                    first = Announced(robot, "tf_static", _unknown(name, said), name)
                    raise _placed(_told_in_full(session, first), (parent, child), "places")


def _statics_now(session: Session) -> Iterator[tuple[str, str, StaticTransforms]]:
    """What static writers keep for late joiners, whose key tells robot and name."""
    kept = f"{_WIRE.expression(ANY, 'tf_static')}/@adv/**"
    for reply in query(session.zenoh, kept, ANSWER_WITHIN_S, accept_replies=zenoh.ReplyKeyExpr.ANY):
        if reply.ok is not None:
            arrival = arrival_of(reply.ok)
            with suppress(MessageError, InvalidInput):  # withdrawn, or not ours
                robot = _WIRE.robot_of(arrival.key)
                (said,) = _WIRE.decode("tf_static", arrival, robot)
                assert isinstance(said, StaticTransforms)
                yield robot, _WIRE.statics_writer(arrival.key), said


def named_edges(robot: str, said: StaticTransforms) -> Iterator[Edge]:
    """The edges that ``said`` of ``robot`` places, without those whose names cannot be frames."""
    for parent, child in said.edges:
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
