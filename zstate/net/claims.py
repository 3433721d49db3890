"""Claim: what one writer alone may say, and who else says it."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time
import weakref
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import TypeAlias

import zenoh

from zstate.closing import Closing
from zstate.errors import MessageError, SecondWriter, duration_text
from zstate.locks import new_lock
from zstate.net.presence import tokens_there
from zstate.net.receiver import Ring
from zstate.net.session import Session
from zstate.net.streams import arrival_of
from zstate.wire.keys import ANY, Stream, stream_key
from zstate.wire.messages import RobotDescription, Sample, StaticTransforms
from zstate.wire.native import NativeWire
from zstate.wire.writer import Announced, Writer

CAPACITY = 1024
GONE_WITHIN_S = 0.5
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
_CLAIMS: weakref.WeakKeyDictionary[Session, set[Claim]] = weakref.WeakKeyDictionary()
_CLAIMS_LOCK = new_lock()


class Claim(Closing):
    """That one writer alone says ``wanted``: streams of one robot, or static edges under one name.

    Raises SecondWriter when somebody else who lives is announced with one of them, or claims it in the
    same session. Two that open at the same time may not see each other yet: ``check`` tells the later
    one, ever after, and ``settle`` at once.

    From a second after the first ``check`` this writer is established. A token alone does not end it any
    more, whatever start it claims: the other writer must also publish one of the streams. So of two that
    publish on networks which are joined later, the later one ends.
    """

    def __init__(self, session: Session, wanted: Sequence[Announced]) -> None:
        self._session = session
        self._wanted = wanted
        self._rivals: set[Announced] = set()
        self._received: dict[tuple[Stream, str], zenoh.ext.AdvancedSubscriber[_Handler]] = {}
        self._publishing: set[int] = set()
        self._first: Announced | None = None
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

    def settle(self) -> None:
        """Make sure, once ours is announced, that nobody has opened at the same time and stays.

        For those who say something once and are silent then. Raises SecondWriter.
        """
        _await_the_word(self._session)
        deadline = time.monotonic() + GONE_WITHIN_S
        while rivals := self._rivals_now():
            earlier = [rival for rival in rivals if self._is_before_us(rival)]
            if earlier or time.monotonic() > deadline:
                raise _second_writer(self._foremost(earlier or rivals))
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
            self._first = self._foremost(there)
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
                raise _second_writer(self._foremost(rivals))
            claims.add(self)

    def _leave(self) -> None:
        with _CLAIMS_LOCK:
            _CLAIMS[self._session].discard(self)

    def _await_the_leaving(self) -> None:
        await_the_meeting(self._session)
        deadline = time.monotonic() + GONE_WITHIN_S
        while rivals := self._rivals_now():
            if time.monotonic() > deadline:
                raise _second_writer(self._foremost(rivals))
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

    def _publishes(self, rival: Announced) -> bool:
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
                for message in _WIRE.decode(rival.stream, arrival_of(sample), rival.robot):
                    if isinstance(message, Sample | StaticTransforms | RobotDescription):
                        self._publishing.add(message.session)
        self._publishing &= {one.writer.session for one in self._rivals}
        return rival.writer.session in self._publishing

    def _followed(self) -> zenoh.Subscriber[_Handler]:
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        return self._session.zenoh.liveliness().declare_subscriber(self._expression, ring, history=True)

    def _rivals_now(self) -> list[Announced]:
        return self._rivals_of(tokens_there(self._session, self._expression))

    def _rivals_of(self, tokens: Iterable[str]) -> list[Announced]:
        said = (_WIRE.announced(token, ANY) for token in tokens)
        return self._excluded_by(one for one in said if one is not None)

    def _excluded_by(self, others: Iterable[Announced]) -> list[Announced]:
        return [one for one in others if any(one.excludes(ours) for ours in self._wanted)]

    def _foremost(self, rivals: Iterable[Announced]) -> Announced:
        streams = [ours.stream for ours in self._wanted]
        return min(rivals, key=lambda rival: (age_of(rival), streams.index(rival.stream)))

    def _is_before_us(self, rival: Announced) -> bool:
        return age_of(rival) < age_of(self._wanted[0])


def _subscribed(session: Session, rival: Announced) -> zenoh.ext.AdvancedSubscriber[_Handler]:
    ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
    return zenoh.ext.declare_advanced_subscriber(
        session.zenoh,
        stream_key(rival.robot, rival.stream, rival.name),
        ring,
        history=zenoh.ext.HistoryConfig(max_samples=1),
    )


def await_the_meeting(session: Session) -> None:
    """Return when a session that has just connected has met the others."""
    if not session.zenoh.info.routers_zid():  # a router knows everybody
        time.sleep(max(0.0, session.opened_at + _MET_WITHIN_S - time.monotonic()))


def age_of(announced: Announced) -> tuple[int, int]:
    """Smaller for who came first."""
    return announced.writer.since, announced.writer.session


def _await_the_word(session: Session) -> None:
    """Return when the others have heard of the token that was just declared."""
    if not session.zenoh.info.routers_zid():  # what a router was told, it knows when it is asked
        time.sleep(_HEARD_WITHIN_S)


def _second_writer(first: Announced) -> SecondWriter:
    if first.stream == "tf_static":
        what = f"static edges of {first.robot!r} under the name {first.name!r}"
    else:
        what = f"{first.stream} of {first.robot!r}"
    text = (
        f"{who_text(first.writer)} writes {what} already; end that first, or say takeover=True (--takeover) "
        "to write beside it: readers follow the newest"
    )
    return SecondWriter(text, robot=first.robot, stream=first.stream, first=first.writer)


def who_text(writer: Writer) -> str:
    """Who that is, and since when, for errors."""
    if not writer.since:
        return repr(str(writer))
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    ago = duration_text(time.time_ns() - writer.since)
    return f"{str(writer)!r}, there since {began:%Y-%m-%d %H:%M:%S} ({ago} ago),"
