"""Requests to a running odometry node: to restart, or to place the base.

A request is a query of ``zstate/<robot>/@odometry/<writer>`` with the parameter ``do``: ``reset`` or
``set_pose``. ``pose``, which ``set_pose`` needs, is odom_from_base: x y z [m] and qx qy qz qw, separated by
commas. The reply has no payload; an error reply has its text.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Literal

from zstate.errors import InvalidInput, Unreachable
from zstate.net.queryable import check_timeout, query
from zstate.net.session import Session
from zstate.odometry.estimator import BaseEstimator
from zstate.transform import Transform
from zstate.wire.keys import ODOMETRY_REQUEST, shortened

_RETRY_S = 0.02

Action = Literal["reset", "set_pose"]


def request_odometry(
    session: Session,
    robot: str,
    action: Action,
    odom_from_base: Transform | None = None,
    *,
    writer: str = "odometry",
    timeout_s: float = 2.0,
) -> None:
    """Have the odometry of ``robot``, as ``writer``, reset or placed, as the methods of ``BaseEstimator``.

    ``action`` is "reset" or "set_pose"; the latter needs ``odom_from_base``, the pose from now on. Its frames
    are those of the node, whatever the transform calls them. Raises InvalidInput with the reason if the node
    refuses, and Unreachable without a reply within ``timeout_s`` [s].
    """
    check_timeout(timeout_s)
    key = ODOMETRY_REQUEST.key(robot, writer)
    selector = f"{key}?do={action}"
    if odom_from_base is not None:
        selector += f";pose={','.join(map(repr, odom_from_base.pose7.tolist()))}"
    deadline_s = time.monotonic() + timeout_s
    while (left_s := deadline_s - time.monotonic()) > 0.0:
        for reply in query(session.zenoh, selector, left_s):
            if reply.ok is not None:
                return
            if reply.err is not None and str(reply.err.encoding).startswith("text/plain"):
                raise InvalidInput(f"the odometry of {robot!r} refused: {reply.err.payload.to_string()}")
        # A query that ends before its timeout had no receiver: a session that has just been opened does not
        # know all of them yet.
        time.sleep(_RETRY_S)
    raise Unreachable(
        f"no reply at {key!r} within {timeout_s:g} s: is `zstate odometry {robot}` running, and may this "
        "program change it (`zstate acl`)?",
        endpoints=(key,),
    )


def apply_request(base: BaseEstimator, parameters: Mapping[str, str]) -> None:
    """Do what a request asks. Raises InvalidInput and NoData with the reason."""
    action, text = parameters.get("do", ""), parameters.get("pose")
    place = None if text is None else _parse_pose(base, text)
    if action == "reset":
        base.reset(place)
    elif action == "set_pose" and place is not None:
        base.set_pose(place)
    else:
        raise InvalidInput(f"a request is do=reset, or do=set_pose with a pose; got {shortened(action)!r}")


def _parse_pose(base: BaseEstimator, text: str) -> Transform:
    try:
        numbers = [float(number) for number in text.split(",")[:8]]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
        raise InvalidInput(f"a pose is seven finite numbers, x,y,z,qx,qy,qz,qw; got {shortened(text)!r}")
    return Transform.from_pose7(base.odom, base.base, numbers)
