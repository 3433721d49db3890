"""zstate bridge: bidirectional bridge of whole robots between zstate and ROS 2."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import click

from zstate.bridges.cli.metrics import bridge_rows
from zstate.cli import options
from zstate.cli.metrics import serve_metrics
from zstate.cli.output.console import fail, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import Unreachable

if TYPE_CHECKING:
    from zstate.bridges.ros2 import Way
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session


@click.command("bridge")
@click.argument("robot", required=False)
@click.option(
    "--wire",
    default="ros2",
    show_default=True,
    metavar="SPEC",
    help="Wire format of the ROS side: ros2:domain=5, or ros2:namespace=* for many robots.",
)
@click.option(
    "--ros",
    default="tcp/127.0.0.1:7447",
    show_default=True,
    metavar="ENDPOINT",
    help="Router of the ROS nodes. The session options below are for the zstate side.",
)
@options.metrics_option
@options.session_options
def bridge_command(
    *, network: SessionOptions, robot: str | None, wire: str, ros: str, metrics: BindAddress | None
) -> None:
    """Bridge ROBOT between zstate's native wire and ROS 2 nodes that run rmw_zenoh, in both directions.

    Carries the model, joint states with their stamps, and static edges, whichever side publishes them. The
    model's part of /tf is computed again on the other side. Other moving edges, such as odom -> base_link,
    are carried from either side; in zstate their writer has the name of the ROS node. Odometry keeps its
    velocity and covariances (nav_msgs/Odometry); other edges have none, as on /tf. Nothing that the bridge
    has published is carried back.

    On the ROS side the robot is in the root namespace, or in the one that --wire names. ROBOT may be left
    out if only one robot is announced natively, or with namespace=*, which gives each robot a namespace of
    its name.
    """
    from zstate.bridges.ros2 import Bridge
    from zstate.clock import wait_interruptible
    from zstate.net.discovery import discover
    from zstate.wire.keys import ANY
    from zstate.wire.registry import get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    def print_change(name: str, way: Way | None) -> None:
        print_wrapped(f"{name!r} is no longer carried" if way is None else f"carrying {name!r}: {way}")

    wire_format = get_wire(wire)
    is_for_all = isinstance(wire_format, Ros2Wire) and wire_format.options.namespace == ANY
    with open_session(network) as native, _open_ros_session(ros) as session:
        robots = [robot] if robot else None
        if not robots and not is_for_all:
            robots = [info.name for info in discover(native)] or None
        names = " and ".join(map(repr, robots)) if robots else "every robot"
        # Before the first robot is carried, which a thread of the bridge prints.
        print_wrapped(f"bridging {names} between native and {wire} at {ros}")
        with (
            Bridge(native, session, wire, robots, on_change=print_change) as bridge,
            serve_metrics(metrics, bridge_rows(bridge)),
        ):
            print_status("a robot is carried once its robot_description arrives")
            wait_interruptible(threading.Event())


def _open_ros_session(endpoint: str) -> Session:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.session import connect

    try:
        # In a thread of its own: a signal ends the wait for it.
        return BackgroundCall("zstate connect", lambda: connect(mode="client", endpoints=endpoint)).result()
    except Unreachable:
        fail(
            f"no router of ROS 2 nodes answers at {endpoint!r}; start one (`ros2 run rmw_zenoh_cpp "
            "rmw_zenohd`, or `zstate router --ros2`), or pass its address: --ros tcp/HOST:7447"
        )
