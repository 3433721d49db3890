"""The liveliness tokens that a session knows now."""

from __future__ import annotations

from zstate.net.queryable import query_tokens
from zstate.net.session import Session


def current_tokens(session: Session, expression: str, timeout_s: float) -> frozenset[str]:
    """The tokens known to the routers or peers of ``session``; after ``timeout_s`` [s] those that arrived."""
    return query_tokens(session.zenoh, expression, timeout_s).keys
