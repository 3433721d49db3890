"""zstate bridge: whole robots between zstate and ROS 2."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from zstate.cli.metrics import bridge_collector, serve_metrics
from zstate.cli.options import metrics_option, session_options
from zstate.cli.output.console import fail, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import Unreachable

if TYPE_CHECKING:
    from zstate.bridges.ros2 import Way
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session

# The router of rmw_zenoh, on this host.
_ROS_ROUTER = "tcp/127.0.0.1:7447"


@click.command("bridge")
@click.argument("robot", required=False)
@click.option(
    "--wire",
    default="ros2",
    show_default=True,
    metavar="SPEC",
    help="What ROS speaks, with options: ros2:domain=5, or ros2:namespace=* for many robots.",
)
@click.option(
    "--ros",
    default=_ROS_ROUTER,
    show_default=True,
    metavar="ENDPOINT",
    help="The router of the ROS nodes. The session options below are those of the other side.",
)
@metrics_option
@session_options
def bridge_command(
    *, network: SessionOptions, robot: str | None, wire: str, ros: str, metrics: BindAddress | None
) -> None:
    """Carry ROBOT between zstate's native wire and ROS 2 nodes that run rmw_zenoh, both ways.

    Whoever writes it, on either side, is heard on the other: model, joint states with their stamps,
    static edges. /tf is derived again there; what else stands in it, such as odom -> base_link, is not
    carried. What a bridge has written is never carried back.

    In ROS the robot stands in the root namespace, or in the one that the wire names. ROBOT may be left
    out while one robot alone is announced natively, and with namespace=*, where each robot has a
    namespace of its name.
    """
    from zstate.bridges.ros2 import Bridge
    from zstate.clock import wait_interruptible

    has_room = _has_room_for_all(wire)
    with open_session(network) as native, _ros_session(ros) as session:
        robots = [robot] if robot else None if has_room else _announced(native)
        with (
            Bridge(native, session, wire, robots, on_change=_tell) as bridge,
            serve_metrics(metrics, bridge_collector(bridge)),
        ):
            named = " and ".join(map(repr, robots)) if robots else "every robot"
            print_wrapped(f"bridging {named} between native and {wire} at {ros}")
            print_status("a robot is carried as soon as its robot_description is heard")
            wait_interruptible(threading.Event())


def _has_room_for_all(wire: str) -> bool:
    from zstate.wire.keys import ANY
    from zstate.wire.registry import get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    spoken = get_wire(wire)
    return isinstance(spoken, Ros2Wire) and spoken.options.namespace == ANY


def _announced(session: Session) -> Sequence[str] | None:
    from zstate.net.presence import discover

    return [info.name for info in discover(session)] or None


def _ros_session(endpoint: str) -> Session:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.session import connect

    try:
        # In a thread of its own: a signal ends the wait for it.
        return BackgroundCall("zstate connect", lambda: connect(mode="client", endpoints=endpoint)).result()
    except Unreachable:
        fail(
            f"nothing answers at {endpoint!r}, where the router of the ROS 2 nodes should be; start one "
            "(`ros2 run rmw_zenoh_cpp rmw_zenohd`, or `zstate router --ros2`), or say where it is: "
            "--ros tcp/HOST:7447"
        )


def _tell(robot: str, way: Way | None) -> None:
    print_wrapped(f"{robot!r} is carried no more" if way is None else f"carrying {robot!r}: {way}")
