"""Service: questions on one key, answered by one thread of ours.

Replies: the replies to a Zenoh query, received without blocking a thread of Zenoh.

Zenoh delivers what it knows of itself, and all local liveliness tokens, inside ``get`` and under the lock of
its session, before the caller can read anything. A channel that is full at that moment blocks the session
for ever; the default one holds 256 replies. A callback in Python would need the interpreter lock for each
reply, while Zenoh holds its own: beside a thread that computes, 8000 replies then take more than 5 s.
So the replies go into a channel that is never full, and the bound is applied where they are read.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import NamedTuple, TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import InvalidInput, Unreachable, ZStateError
from zstate.net.session import Session
from zstate.net.streams import Receiver, call_for_each
from zstate.transform import Transform
from zstate.wire.keys import lookup_key
from zstate.wire.lookup_request import LookupRequest, error_from_json, from_json

MAX_REPLIES = 100_000
"""At most so many replies to one query are kept. The rest are counted, and logged as a warning."""

_NEVER_FULL = 2**24
"""For so many tokens Zenoh itself would need more than 10 GB. The channel allocates what it holds."""

_LOG = logging.getLogger("zstate")

_Channel: TypeAlias = "zenoh.handlers.FifoChannel[zenoh.Reply]"


def query(
    session: zenoh.Session,
    selector: str,
    timeout_s: float,
    *,
    target: zenoh.QueryTarget | None = None,
    consolidation: zenoh.ConsolidationMode | None = None,
    accept_replies: zenoh.ReplyKeyExpr | None = None,
) -> Iterator[zenoh.Reply]:
    """The replies to ``selector`` as they arrive, until all queryables have finished or ``timeout_s`` passed.

    The query is sent at once. Raises ZError if the session is closed.
    """
    channel: _Channel = zenoh.handlers.FifoChannel(_NEVER_FULL)
    replies = session.get(
        selector,
        channel,
        timeout=timeout_s,
        target=target,
        consolidation=consolidation,
        accept_replies=accept_replies,
    )
    return _bounded(replies, selector)


def query_tokens(session: zenoh.Session, expression: str, timeout_s: float) -> Iterator[str]:
    """The keys of the liveliness tokens that match ``expression``. Sent at once, like ``query``."""
    channel: _Channel = zenoh.handlers.FifoChannel(_NEVER_FULL)
    replies = _bounded(session.liveliness().get(expression, channel, timeout=timeout_s), expression)
    return (str(reply.ok.key_expr) for reply in replies if reply.ok is not None)


def _bounded(replies: Iterable[zenoh.Reply], selector: str) -> Iterator[zenoh.Reply]:
    count = 0
    for count, reply in enumerate(replies, 1):
        if count <= MAX_REPLIES:
            yield reply
    if count > MAX_REPLIES:
        facts = {"event": "too many replies", "selector": selector, "replies": count}
        text = "%r has %d replies; only the first %d are used"
        _LOG.warning(text, selector, count, MAX_REPLIES, extra=facts)


CAPACITY = 64
"""So many questions wait. When more come the oldest are lost, and who asked is told that nobody answers."""

MAX_PAUSE_S = 0.2

Queries: TypeAlias = "zenoh.handlers.RingChannel[zenoh.Query]"


class Reply(NamedTuple):
    """What is answered, and under which Zenoh encoding; an error travels as Zenoh's own error reply."""

    payload: bytes
    encoding: str
    is_error: bool = False


class Queryable(Closeable):
    """Answers whoever asks on ``key``, until it is closed.

    ``answer(parameters)`` is called from one thread of this service, question after question; None is
    no answer. What it raises is counted in ``failures``, and the first is reported to
    ``threading.excepthook``. Neither a slow answer nor a flood of questions delays Zenoh or those who
    publish: what finds no room is lost, and ``overflows`` counts how often that may have been so. Then it
    rests, so that a flood takes no more than a quarter of one processor.
    """

    def __init__(
        self,
        session: Session,
        key: str,
        answer: Callable[[Mapping[str, str]], Reply | None],
        capacity: int = CAPACITY,
    ) -> None:
        self.answered = 0
        self._key = key
        self._answer = answer
        self._capacity = capacity
        ring: Queries = zenoh.handlers.RingChannel(capacity)
        queryable = session.zenoh.declare_queryable(key, ring)
        self._receiver = Receiver(session, queryable, self._answer_all, capacity)

    @property
    def overflows(self) -> int:
        """How often the room for questions was found full: some may have been lost there."""
        return self._receiver.full_batches

    @property
    def failures(self) -> int:
        """How often ``answer`` raised, batches of questions that came together counted once."""
        return self._receiver.failures

    def _answer_all(self, queries: list[zenoh.Query]) -> None:
        began = time.monotonic()
        try:
            call_for_each(queries, self._answer_one)
        finally:
            if len(queries) >= self._capacity:
                time.sleep(min(3.0 * (time.monotonic() - began), MAX_PAUSE_S))

    def _answer_one(self, asked: zenoh.Query) -> None:
        with asked:  # leaving tells the one who asks that this was all
            answer = self._answer(parse_parameters(str(asked.parameters)))
            if answer is None:
                return
            with suppress(zenoh.ZError):  # who asked, or the session, is gone
                if answer.is_error:
                    asked.reply_err(answer.payload, encoding=answer.encoding)
                else:
                    asked.reply(self._key, answer.payload, encoding=answer.encoding)
                self.answered += 1

    def close(self) -> None:
        """Answer no more, within a second. A second call does nothing."""
        self._receiver.close()


def parse_parameters(text: str) -> dict[str, str]:
    """The parameters of a selector, ``name=value;name=value``, as Zenoh writes them after the ``?``."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}


def query_lookup(
    session: Session, robot: str, target: str, source: str, at: int | None = None, *, timeout_s: float = 1.0
) -> Transform:
    """The pose of ``source`` in ``target`` at the stamp ``at`` [ns], or the newest there is.

    Asks whoever answers for ``robot``, for instance `zstate publish`; needs no buffer here. Raises what
    ``TransformBuffer.lookup`` raised there, and Unreachable when nobody answers within ``timeout_s``.
    """
    if not timeout_s > 0.0:
        raise InvalidInput(f"timeout_s is {timeout_s}; give a positive number of seconds")
    key = lookup_key(robot)
    selector = f"{key}?{LookupRequest(target, source, at).parameters()}"
    error: ZStateError = Unreachable(
        f"nobody answers at {key!r} within {timeout_s:g} s; run `zstate publish {robot}`, or a LookupService",
        endpoints=(key,),
    )
    for reply in query(session.zenoh, selector, timeout_s):
        # On another key, such as one with a wildcard, it is no answer of this robot.
        if reply.ok is not None and str(reply.ok.key_expr) == key:
            return from_json(reply.ok.payload.to_bytes())
        if reply.err is not None and str(reply.err.encoding) == "application/json":
            error = error_from_json(reply.err.payload.to_bytes())
    raise error
