"""Queryables of requests, which change a node: of one key alone, or with a message."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from typing import TypeAlias

import zenoh

from zstate.net.queryable import Queryable, Reply
from zstate.net.session import Session
from zstate.wire.keys import shortened

RequestAnswer: TypeAlias = "Reply | Future[Reply | None] | None"


class ExactQueryable(Queryable):
    """As ``Queryable``, but queries of another key expression, as with a wildcard, get an error reply.

    So one request never changes several nodes.
    """

    def _reply_to(self, received: zenoh.Query) -> Reply | None:
        if str(received.key_expr) != self._key:
            asked = shortened(str(received.key_expr))
            text = f"a request is for one key, such as {self._key!r}, not for {asked!r}"
            return Reply(text.encode(), "text/plain", is_error=True)
        return super()._reply_to(received)


class RequestQueryable(Queryable):
    """Replies to queries that carry a message: ``answer(payload, encoding)``, as in ``Queryable``.

    Other queries are answered while the future of an answer is not done.
    """

    def __init__(self, session: Session, key: str, answer: Callable[[bytes, str], RequestAnswer]) -> None:
        self._answer_request = answer
        super().__init__(session, key, lambda _: None)

    def _on_query(self, received: zenoh.Query) -> None:
        payload = b"" if received.payload is None else received.payload.to_bytes()
        with ExitStack() as ending:
            ending.enter_context(received)
            answer = self._answer_request(payload, str(received.encoding or ""))
            if isinstance(answer, Future):
                ending.pop_all()
                answer.add_done_callback(partial(self._on_done, received))
            else:
                self._send(received, answer)

    def _on_done(self, received: zenoh.Query, answer: Future[Reply | None]) -> None:
        with received:
            if not answer.cancelled():
                self._send(received, answer.result())
