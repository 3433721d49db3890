"""Replies: the replies to a Zenoh query, received without blocking a thread of Zenoh.

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
from collections.abc import Iterable, Iterator
from typing import TypeAlias

import zenoh

MOST_REPLIES = 100_000
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
        if count <= MOST_REPLIES:
            yield reply
    if count > MOST_REPLIES:
        facts = {"event": "too many replies", "selector": selector, "replies": count}
        text = "%r has %d replies; only the first %d are used"
        _LOG.warning(text, selector, count, MOST_REPLIES, extra=facts)
