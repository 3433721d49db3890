"""What a session knows now: liveliness tokens, and other sessions."""

from __future__ import annotations

from zstate.net.queryable import query_tokens
from zstate.net.session import Session


def current_tokens(session: Session, expression: str, timeout_s: float) -> frozenset[str]:
    """The tokens known to the routers or peers of ``session``; after ``timeout_s`` [s] those that arrived."""
    return query_tokens(session.zenoh, expression, timeout_s).keys


def have_met(one: Session, other: Session) -> bool:
    """Whether ``one`` has a link to ``other``."""
    return other.zid in [str(zid) for zid in one.zenoh.info.peers_zid()]
