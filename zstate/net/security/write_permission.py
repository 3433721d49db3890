"""Detects writes that the router's access control drops. Zenoh gives no error for them."""

from __future__ import annotations

import time

import zenoh

from zstate.errors import AccessDenied
from zstate.net.queryable import query_tokens
from zstate.net.session import Session

TIMEOUT_S = 1.0
ROUND_S = 0.02


def check_may_write(session: Session, robot: str, token: str) -> None:
    """Raise AccessDenied if the router of ``session`` drops what it writes of ``robot``.

    ``token`` is a liveliness token that the session keeps among the robot's keys. A second session of
    the same identity, open for milliseconds, queries the router for it. Without credentials, in modes other
    than client, and while the router changes, nothing is checked.
    """
    probe = session.probe
    if probe is None or not _routers(session.zenoh):
        return
    try:
        other = probe.open()
    except zenoh.ZError:
        return
    with other:
        if _routers(other) != _routers(session.zenoh):
            return
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            if any(query_tokens(other, token, TIMEOUT_S)):
                return
            time.sleep(ROUND_S)
    raise AccessDenied(
        f"the router does not let {probe.identity} write as robot {robot!r}: it drops {token!r}, and would "
        "drop samples without an error. Is this the identity of that robot? If so, the "
        f"access control of the router lacks the rules '{robot} writes' and '{robot} reads', which "
        f"`zstate acl --robot {robot}` prints, with --wire for those of ROS; routers read it when they start",
        reason="not allowed to write",
        endpoint=token,
    )


def _routers(session: zenoh.Session) -> set[str]:
    return {str(zid) for zid in session.info.routers_zid()}
