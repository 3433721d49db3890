"""Claim: what one writer alone may say, and who else says it."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime

import zenoh

from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError, SecondWriter, duration_text
from zstate.net.presence import tokens_now
from zstate.net.receiver import Ring
from zstate.net.session import Session
from zstate.net.streams import arrival_of
from zstate.wire.keys import ANY, full_name
from zstate.wire.messages import StaticTransforms
from zstate.wire.native import NativeWire
from zstate.wire.writer import Announced, Writer

CAPACITY = 1024
GONE_WITHIN_S = 0.5
"""So long after a writer was killed its token may still be seen; measured: 2 to 33 ms."""

_ROUND_S = 0.005
_ANSWER_WITHIN_S = 0.5
_MET_WITHIN_S = 0.01
"""Peers that have just connected meet the others one by one; on a loopback that took up to 6 ms."""

_WIRE = NativeWire()


class Claim(Closing):
    """That one writer alone says ``wanted``: streams of one robot, or static edges under one name.

    Raises SecondWriter when somebody else who lives is announced with one of them. Two that open at
    the same time may not see each other yet: ``check`` tells the later one, ever after.
    """

    def __init__(self, session: Session, wanted: Sequence[Announced]) -> None:
        self._session = session
        self._wanted = wanted
        self._rivals: set[Announced] = set()
        self._first: Announced | None = None
        self._expression = _WIRE.writers_expression(wanted[0].robot)
        # Before it is subscribed: then a router would not be asked, but what it has told so far.
        self._await_the_leaving()
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        liveliness = session.zenoh.liveliness()
        self._tokens = liveliness.declare_subscriber(self._expression, ring, history=True)

    def check(self) -> None:
        """Raise SecondWriter if there is somebody who came before; then always. Raises Closed."""
        if self._first is None:
            self._session.check()
            self._follow()
            earlier = [rival for rival in self._rivals if self._is_before_us(rival)]
            if not earlier:
                return
            self._first = self._foremost(earlier)
        raise _second_writer(self._first)

    def close(self) -> None:
        """Claim no more. A second call does nothing."""
        self._session.release(self._tokens)

    def _await_the_leaving(self) -> None:
        _await_the_meeting(self._session)
        deadline = time.monotonic() + GONE_WITHIN_S
        while rivals := self._rivals_now():
            if time.monotonic() > deadline:
                raise _second_writer(self._foremost(rivals))
            time.sleep(_ROUND_S)

    def _follow(self) -> None:
        """No thread for this: whoever publishes looks whether somebody has come or gone."""
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

    def _rivals_now(self) -> list[Announced]:
        return self._rivals_of(tokens_now(self._session, self._expression, _ANSWER_WITHIN_S))

    def _rivals_of(self, tokens: Iterable[str]) -> list[Announced]:
        said = [_WIRE.announced(token, ANY) for token in tokens]
        return [one for one in said if one is not None and any(one.excludes(ours) for ours in self._wanted)]

    def _foremost(self, rivals: Sequence[Announced]) -> Announced:
        streams = [ours.stream for ours in self._wanted]
        return min(rivals, key=lambda rival: (_age(rival), streams.index(rival.stream)))

    def _is_before_us(self, rival: Announced) -> bool:
        return _age(rival) < _age(self._wanted[0])


def check_edge(session: Session, writer: Announced, edge: tuple[str, str]) -> None:
    """Raise SecondWriter if a static writer of any robot that lives already places the child of ``edge``.

    Frames are named in full; ``writer`` is who asks. Takes as long as the network: one round trip.
    """
    _await_the_meeting(session)
    for robot, name, said in _statics_now(session):
        if (robot, name) != (writer.robot, writer.name):
            for parent, child in _named(robot, said):
                if child == edge[1]:
                    first = _writer_of(session, Announced(robot, "tf_static", _unknown(name, said), name))
                    raise _placed_already(first, (parent, child))


def _await_the_meeting(session: Session) -> None:
    if not session.zenoh.info.routers_zid():  # a router knows everybody
        time.sleep(max(0.0, session.opened_at + _MET_WITHIN_S - time.monotonic()))


def _statics_now(session: Session) -> Iterator[tuple[str, str, StaticTransforms]]:
    """What static writers keep for late joiners, whose key tells robot and name."""
    kept = session.zenoh.get(
        f"{_WIRE.expression(ANY, 'tf_static')}/@adv/**",
        timeout=_ANSWER_WITHIN_S,
        accept_replies=zenoh.ReplyKeyExpr.ANY,
    )
    for reply in kept:
        if reply.ok is not None:
            arrival = arrival_of(reply.ok)
            with suppress(MessageError, InvalidInput):  # withdrawn, or not ours
                robot = _WIRE.robot_of(arrival.key)
                (said,) = _WIRE.decode("tf_static", arrival, robot)
                assert isinstance(said, StaticTransforms)
                yield robot, _WIRE.statics_writer(arrival.key), said


def _named(robot: str, said: StaticTransforms) -> Iterator[tuple[str, str]]:
    for parent, child in said.edges:
        with suppress(InvalidInput):  # no reader takes it either
            yield full_name(robot, parent), full_name(robot, child)


def _unknown(name: str, said: StaticTransforms) -> Writer:
    return Writer(name, "", 0, 0, said.session)


def _writer_of(session: Session, placed: Announced) -> Announced:
    """The same with who it is, if that is announced."""
    for token in tokens_now(session, _WIRE.writers_expression(placed.robot), _ANSWER_WITHIN_S):
        said = _WIRE.announced(token, placed.robot)
        if said is not None and said.stream == "tf_static" and said.writer.session == placed.writer.session:
            return Announced(placed.robot, "tf_static", said.writer, placed.name)
    return placed


def _age(announced: Announced) -> tuple[int, int]:
    return announced.writer.since, announced.writer.session


def _second_writer(first: Announced) -> SecondWriter:
    if first.stream == "tf_static":
        what = f"static edges of {first.robot!r} under the name {first.name!r}"
    else:
        what = f"{first.stream} of {first.robot!r}"
    text = (
        f"{_who(first.writer)} writes {what} already; end that first, or say takeover=True (--takeover) to "
        "write beside it: readers follow the newest"
    )
    return SecondWriter(text, robot=first.robot, stream=first.stream, first=first.writer)


def _placed_already(first: Announced, edge: tuple[str, str]) -> SecondWriter:
    parent, child = edge
    text = (
        f"{_who(first.writer)} places {child!r} on {parent!r} already, as {first.name!r} of {first.robot!r}; "
        "end or withdraw that first, or say takeover=True (--takeover)"
    )
    return SecondWriter(text, robot=first.robot, stream="tf_static", first=first.writer, edge=edge)


def _who(writer: Writer) -> str:
    if not writer.since:
        return repr(str(writer))
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    ago = duration_text(time.time_ns() - writer.since)
    return f"{str(writer)!r}, there since {began:%Y-%m-%d %H:%M:%S} ({ago} ago),"
