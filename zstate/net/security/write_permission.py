"""Whether a router takes what a session writes. One that denies it does not say so: it drops it."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import time

import zenoh

from zstate.errors import AccessDenied
from zstate.net.queryable import query_tokens
from zstate.net.security.connection_monitor import ProbeSession
from zstate.net.session import Session

HEARD_WITHIN_S = 1.0
ROUND_S = 0.02


def check_may_write(session: Session, robot: str, token: str) -> None:
    """Raise AccessDenied if the router of ``session`` drops what it writes of ``robot``.

    ``token`` is a liveliness token that the session keeps among the robot's keys. A second session of
    the same identity, there for milliseconds, asks the router for it. Silent where that tells
    nothing: without credentials, for other modes than client, and while routers come and go.
    """
    twin = session.probe
    if twin is None or not _routers(session.zenoh):
        return
    try:
        other = twin.open()
    except zenoh.ZError:
        return
    with other:
        is_same_router = _routers(other) == _routers(session.zenoh)
        if is_same_router and not _is_forwarded(other, token):
            raise _denied(twin, robot, token)


def _routers(session: zenoh.Session) -> set[str]:
    return {str(zid) for zid in session.info.routers_zid()}


def _is_forwarded(session: zenoh.Session, token: str) -> bool:
    deadline = time.monotonic() + HEARD_WITHIN_S
    while time.monotonic() < deadline:
        if any(query_tokens(session, token, HEARD_WITHIN_S)):
            return True
        time.sleep(ROUND_S)
    return False


def _denied(twin: ProbeSession, robot: str, token: str) -> AccessDenied:
    return AccessDenied(
        f"the router does not let {twin.identity} write as robot {robot!r}: {token!r} does not come through, "
        "and samples would be lost like it, without a word. Is this the identity of that robot? If so, the "
        f"access control of the router lacks the rules '{robot} writes' and '{robot} reads', which "
        f"`zstate acl --robot {robot}` prints, with --wire for those of ROS; routers read it when they start",
        reason="not allowed to write",
        endpoint=token,
    )
