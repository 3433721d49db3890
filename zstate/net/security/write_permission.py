"""Writes that the access control of a router drops."""

from __future__ import annotations

import time

import zenoh

from zstate.errors import AccessDenied
from zstate.net.queryable import query_tokens
from zstate.net.session import Session

_TIMEOUT_S = 1.0
_ROUND_S = 0.02


def check_may_write(session: Session, robot: str, token: str) -> None:
    """Raise AccessDenied if the router of ``session`` drops what it writes of ``robot``.

    Zenoh gives no error for that. ``token`` is a liveliness token that the session keeps among the robot's
    keys. A second session of the same identity, open for milliseconds, queries the router for it. Without
    credentials, in modes other than client, and while the router changes, nothing is checked.
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
        deadline = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < deadline:
            if query_tokens(other, token, _TIMEOUT_S).keys:
                return
            time.sleep(_ROUND_S)
    raise AccessDenied(
        f"the router does not let {probe.identity} write as robot {robot!r}: it drops {token!r}, and would "
        f"drop samples without an error. {_advice(robot, token)}; "
        "routers read it when they start",
        reason="not allowed to write",
        endpoint=token,
    )


def _advice(robot: str, token: str) -> str:
    """What lets an identity write what ``token`` announces."""
    if "joint_commands" in token:
        return (
            "Only commanders command a robot and release its stops: `zstate acl --robot "
            f"{robot} --commander NAME` prints the rules for the identity NAME"
        )
    return (
        "Is this the identity of that robot? If so, the access control of the router lacks the rules "
        f"'{robot} writes' and '{robot} reads', which `zstate acl --robot {robot}` prints, with --wire for "
        "those of ROS"
    )


def _routers(session: zenoh.Session) -> set[str]:
    return {str(zid) for zid in session.info.routers_zid()}
