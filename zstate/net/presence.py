"""Presence (Zenoh liveliness): a token for every writer and reader, which disappears with its process.

``WriterWatch`` follows the changes of tokens; ``zstate.net.discovery`` queries all of them.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import InvalidInput, ZStateError
from zstate.net.queryable import MAX_REPLIES, Tokens, query_tokens
from zstate.net.session import Session
from zstate.net.streams import Receiver, call_for_each
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, MAX_NAME_LENGTH, shortened
from zstate.wire.protocol import GraphNode, Wire, WriterTokens
from zstate.wire.registry import get_wire

CAPACITY = 16_384
"""Waiting changes of tokens. If more arrive, the tokens are queried instead: see ``WriterWatch``."""

ANSWER_WITHIN_S = 0.5
ALL_TOKENS_WITHIN_S = 5.0
"""Routers take a time that grows with the square of the number of tokens: half a second for 1000 robots."""


def local_writer(session: int, program: str = "") -> WriterId:
    """A writer in this process that starts now; ``program`` is the script's name by default.

    Raises InvalidInput for a name of more than 255 characters, which readers would refuse.
    """
    if len(program) > MAX_NAME_LENGTH:
        text = f"the program name {shortened(program)!r} has {len(program)} characters"
        raise InvalidInput(f"{text}, more than {MAX_NAME_LENGTH}")
    script = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] not in ("", "-c") else "python"
    return WriterId(program or script, socket.gethostname(), os.getpid(), time.time_ns(), session)


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
    reader = local_writer(0, program)
    node = GraphNode(robot, reader, session.zid, session.node_number(robot, reader.program))
    tokens = wire.reader_tokens(node, streams, session.next_number)
    return [announce(session, token) for token in tokens]


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


class WriterWatch(Receiver):
    """Watches the writers of ``robot`` ("*": of all robots; or of several), beginning with the current ones.

    ``callback(announced, alive)`` is called from one thread, and ``before_losses()`` before those for writers
    that disappeared together: the loss of a router removes every writer behind it. ``foreign`` counts tokens
    that announce no stream of a robot, ``ignored`` those beyond the 100,000 that are kept. An exception of a
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
        before_losses: Callable[[], object] = lambda: None,
    ) -> None:
        self.foreign = 0
        self.ignored = 0
        self._known: dict[str, tuple[Announcement, ...]] = {}
        self._tokens_of: Counter[Announcement] = Counter()
        """A writer may announce a stream by more than one token."""
        self._callback = callback
        self._before_losses = before_losses
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
        try:
            if not all(alive for _, alive in changes):
                self._before_losses()
        finally:
            call_for_each(changes, lambda change: self._on_change(*change))

    def _current_tokens(self) -> set[str]:
        """All tokens, queried until the replies are complete: a token that a reply lacks may be alive."""
        current: set[str] = set()
        for expression in self._expressions:
            is_complete = False
            while not (is_complete or self._closed):
                tokens, is_complete = _confirmed(self._session, expression, ALL_TOKENS_WITHIN_S)
                current |= tokens
        return current

    def _on_change(self, token: str, alive: bool) -> None:
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
        call_for_each(changed, lambda one: self._callback(one, alive))
