"""Queryables (Zenoh), and queries that never block a thread of Zenoh.

Zenoh delivers its own replies, and all local liveliness tokens, inside ``get`` and under the lock of its
session, before the caller can read anything. A channel that is full at that moment blocks the session for
ever; the default one holds 256 replies. A callback in Python would need the interpreter lock for each reply
while Zenoh holds its own: next to a computing thread, 8000 replies then take more than 5 s. So the replies go
into a channel that is never full, and the limit is applied where they are read.
"""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import NamedTuple, TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput
from zstate.net.query_workers import QueryWorkers, leave_workers, use_workers
from zstate.net.service_thread import JOIN_WITHIN_S
from zstate.net.session import Session
from zstate.net.streams import call_for_each

MAX_REPLIES = 100_000
"""Limit of the replies to one query that are used. More are counted, and logged as a warning."""

# zenoh 1.10, a channel that is full of a session's own replies blocks it for ever: delete when fixed
_NEVER_FULL = 2**24
"""Zenoh itself would need more than 10 GB for as many tokens. The channel allocates only what it holds."""

CAPACITY = 64
"""Waiting queries. If more arrive the oldest are lost, and end for their senders without a reply."""

MAX_PAUSE_S = 0.2

# zenoh 1.10, longer timeouts and infinity are refused as negative: delete when fixed
_LONGEST_TIMEOUT_S = 1e9

_LOG = logging.getLogger("zstate")

_Channel: TypeAlias = "zenoh.handlers.FifoChannel[zenoh.Reply]"


def check_timeout(timeout_s: float) -> float:
    """``timeout_s``. Raises InvalidInput unless it is above 0 and below 1e9 [s]."""
    if not 0.0 < timeout_s < _LONGEST_TIMEOUT_S:
        limits = f"give a positive number of seconds below {_LONGEST_TIMEOUT_S:g}"
        raise InvalidInput(f"timeout_s is {timeout_s}; {limits}")
    return timeout_s


def query(
    session: zenoh.Session,
    selector: str,
    timeout_s: float,
    *,
    target: zenoh.QueryTarget | None = None,
    consolidation: zenoh.ConsolidationMode | None = None,
    accept_replies: zenoh.ReplyKeyExpr | None = None,
    payload: bytes | None = None,
    encoding: str | None = None,
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
        payload=payload,
        encoding=encoding,
    )
    return _bounded(replies, selector)


class Tokens(NamedTuple):
    """Keys of liveliness tokens; not all of them if the query timed out (``is_complete`` is False)."""

    keys: frozenset[str]
    is_complete: bool


def query_tokens(session: zenoh.Session, expression: str, timeout_s: float) -> Tokens:
    """The keys of the liveliness tokens that match ``expression``; waits up to ``timeout_s`` [s].

    Raises ZError if the session is closed.
    """
    channel: _Channel = zenoh.handlers.FifoChannel(_NEVER_FULL)
    keys: set[str] = set()
    is_complete = True
    for reply in _bounded(session.liveliness().get(expression, channel, timeout=timeout_s), expression):
        if reply.ok is not None:
            keys.add(str(reply.ok.key_expr))
        else:  # Zenoh's own reply at the timeout
            is_complete = False
    return Tokens(frozenset(keys), is_complete)


def _bounded(replies: Iterable[zenoh.Reply], selector: str) -> Iterator[zenoh.Reply]:
    count = 0
    for count, reply in enumerate(replies, 1):
        if count <= MAX_REPLIES:
            yield reply
    if count > MAX_REPLIES:
        facts = {"event": "too many replies", "selector": selector, "replies": count}
        text = "%r has %d replies; only the first %d are used"
        _LOG.warning(text, selector, count, MAX_REPLIES, extra=facts)


class Reply(NamedTuple):
    """A payload and its Zenoh encoding; an error is sent as Zenoh's own error reply.

    ``key`` is that of the queryable by default. Attachment and timestamp are those of a cached sample.
    """

    payload: bytes
    encoding: str
    is_error: bool = False
    key: str = ""
    attachment: bytes | None = None
    timestamp: zenoh.Timestamp | None = None


class _Declared:
    """A declared queryable, for ``Session.release``."""

    def __init__(self, session: Session, key: str, queryable: zenoh.Queryable[None]) -> None:
        self._session, self._key, self._queryable = session, key, queryable

    def undeclare(self) -> None:
        self._queryable.undeclare()
        self._session.on_queryable_end(self._key)


class Queryable(Closeable):
    """Replies to queries on ``key``, until it is closed.

    ``answer(parameters)`` is called in a thread of the session (``zstate.net.query_workers``), for one query
    after the other; None sends no reply. Neither a slow answer nor a flood of queries delays Zenoh,
    publishers or other queryables: queries beyond ``capacity`` are lost, and ``full_batches`` counts how
    often that may have happened. After a full batch the thread pauses, so that a flood takes no more than a
    quarter of one processor. An exception of ``answer`` is counted in ``failures``, once for queries that
    arrived together, and the first goes to ``threading.excepthook``.
    """

    def __init__(
        self,
        session: Session,
        key: str,
        answer: Callable[[Mapping[str, str]], Reply | None],
        capacity: int = CAPACITY,
    ) -> None:
        self.answered = self.full_batches = self.failures = 0
        self._session = session
        self._key = key
        self._answer = answer
        self._capacity = capacity
        self._lock = fork_safe_lock()
        self._queries: list[zenoh.Query] = []
        self._has_turn = False
        self._closed = False
        self._answering = fork_safe_lock()
        """Held by ``_thread``, which answers now."""
        self._thread: threading.Thread | None = None
        self._workers: QueryWorkers | None = use_workers(session)
        callback = zenoh.handlers.Callback(self._add, self._leave, indirect=False)
        try:
            declared = session.zenoh.declare_queryable(key, callback)
        except BaseException:
            self._leave()
            raise
        self._declared = _Declared(session, key, declared)

    def close(self) -> None:
        """Stop within a second, also from inside an answer, after which none is sent."""
        with self._lock:
            self._closed = True
        self._session.release(self._declared)
        self._leave()
        if threading.current_thread() is not self._thread and self._answering.acquire(timeout=JOIN_WITHIN_S):
            self._answering.release()

    def _add(self, received: zenoh.Query) -> None:
        """Runs in a thread of Zenoh, which must not wait."""
        lost: zenoh.Query | None = None  # a query that is freed ends for its sender
        with self._lock:
            workers = self._workers
            if self._closed or workers is None:
                return
            if len(self._queries) >= self._capacity:
                lost = self._queries.pop(0)
            self._queries.append(received)
            has_turn, self._has_turn = self._has_turn, True
        del lost
        if not has_turn:
            workers.submit(self._run)

    def _leave(self) -> None:
        """Answer no more. Also called by Zenoh at the end of the session."""
        with self._lock:
            workers, self._workers = self._workers, None
            queries, self._queries = self._queries, []
        queries.clear()
        if workers is not None:
            leave_workers(self._session, workers)

    def _run(self) -> None:
        """Answer the queries that wait now; later ones have the next turn, after other queryables."""
        with self._answering:
            self._thread = threading.current_thread()
            with self._lock:
                batch, self._queries = self._queries, []
            if len(batch) >= self._capacity:
                self.full_batches += 1
            try:
                if not self._closed:
                    self._on_batch(batch)
            except Exception:
                self.failures += 1
                if self.failures == 1:
                    threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
            batch.clear()
            self._thread = None
        with self._lock:
            workers = self._workers if self._queries else None
            self._has_turn = workers is not None
        if workers is not None:
            workers.submit(self._run)

    def _on_batch(self, batch: list[zenoh.Query]) -> None:
        start = time.monotonic()
        try:
            call_for_each(batch, self._on_query)
        finally:
            if len(batch) >= self._capacity:
                time.sleep(min(3.0 * (time.monotonic() - start), MAX_PAUSE_S))

    def _on_query(self, received: zenoh.Query) -> None:
        with received:  # the end of the block ends the query for its sender
            self._send(received, self._reply_to(received))

    def _send(self, received: zenoh.Query, reply: Reply | None) -> None:
        if reply is None:
            return
        with suppress(zenoh.ZError):  # the sender, or the session, is gone
            if reply.is_error:
                received.reply_err(reply.payload, encoding=reply.encoding)
            else:
                received.reply(
                    reply.key or self._key,
                    reply.payload,
                    encoding=reply.encoding,
                    attachment=reply.attachment,
                    timestamp=reply.timestamp,
                )
            self.answered += 1

    def _reply_to(self, received: zenoh.Query) -> Reply | None:
        return self._answer(parse_parameters(str(received.parameters)))


def parse_parameters(text: str) -> dict[str, str]:
    """The parameters of a selector, ``name=value;name=value``, as Zenoh writes them after the ``?``."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}
