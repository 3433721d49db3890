"""Exclusive ownership of child frames: one writer of edges for each.

A writer of some joints of a robot claims the edges that these move, and excludes a writer of all joints.

``claim_edges`` owns new edges: static ones while they are published, because then their value shows them,
moving ones as long as their writer is open.
"""

from __future__ import annotations

import time
from collections.abc import Container, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from typing import NamedTuple

from zstate.buffer.edge_rules import loop_refusal
from zstate.errors import InsertRefused, InvalidInput, MessageError, SecondWriter
from zstate.net.latched import cached_values
from zstate.net.ownership import (
    ROUND_S,
    TOKEN_EXPIRY_S,
    moving_streams,
    seniority,
    wait_for_discovery,
    writer_text,
)
from zstate.net.presence import ANSWER_WITHIN_S, announce, confirmed_tokens
from zstate.net.queryable import query
from zstate.net.session import Session
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
from zstate.wire.messages import Edges, RobotDescription, StaticTransforms
from zstate.wire.native import NativeWire

_WIRE = NativeWire()


@cache
def _all_histories_of_edges() -> tuple[str, ...]:
    """Queries that each writer of moving edges or of some joints receives, and to which none has samples."""
    return tuple(f"{stream_expression(ANY, stream)}?session=0" for stream in moving_streams())


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
