"""zstate ros1: a robot in zstate and in ROS 1."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

import click

from zstate.cli.options import session_options
from zstate.cli.output.console import count_text, print_result, print_status
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.bridges.ros1.bridge import Ros1Bridge
    from zstate.bridges.ros1.node import Node
    from zstate.model.robot import RobotModel

_CHECK_HZ = 2.0


@click.command("ros1")
@click.argument("robot")
@click.option("--to-ros", is_flag=True, help="From zstate to ROS.")
@click.option("--from-ros", is_flag=True, help="From ROS to zstate.")
@click.option(
    "--model",
    "source",
    metavar="MODEL",
    help="What comes from ROS, a name or a URDF file; default: the parameter robot_description.",
)
@click.option("--frame-prefix", default="", metavar="P", help="Put before the robot's frames in ROS.")
@click.option("--no-description", is_flag=True, help="Do not set the parameter robot_description.")
@session_options
def ros1_command(
    *,
    robot: str,
    to_ros: bool,
    from_ros: bool,
    source: str | None,
    frame_prefix: str,
    no_description: bool,
    network: SessionOptions,
) -> None:
    """Carry the joint states and transforms of ROBOT between zstate and ROS 1.

    To ROS go joint_states, /tf and /tf_static (no robot_state_publisher is needed there), and the parameter
    robot_description if nobody has set it. From ROS come joint_states and the edges of /tf_static that are
    not the model's; zstate does the kinematics. Other edges on /tf, such as odom -> base_link, are not
    carried, only named. Every sample keeps its stamp; a JointState without one is refused.

    Say which way, or both; what was carried does not come back. One bridge for each robot. ROS_MASTER_URI,
    ROS_IP and ROS_NAMESPACE count as for every ROS program. Needs rospy: on Debian 12,

    \b
    apt-get install python3-rospy python3-sensor-msgs python3-tf2-msgs
    /usr/bin/python3 -m venv --system-site-packages .venv
    .venv/bin/pip install zstate
    """
    from zstate.bridges.ros1.bridge import Ros1Bridge
    from zstate.bridges.ros1.node import Node
    from zstate.wire.keys import check_robot

    if not (to_ros or from_ros):
        raise click.UsageError("say which way: --to-ros, --from-ros, or both")
    check_robot(robot)
    model = _model(source, from_ros=from_ros)
    with (
        Node() as node,
        open_session(network) as session,
        Ros1Bridge(
            session,
            node,
            robot,
            to_ros=to_ros,
            from_ros=from_ros,
            model=model,
            frame_prefix=frame_prefix,
            with_description=not no_description,
        ) as bridge,
    ):
        _introduce(node, robot, to_ros=to_ros, from_ros=from_ros)
        try:
            _look_after(bridge)
        finally:
            gone, come = bridge.carried
            print_result(f"{count_text(gone, 'sample')} to ROS, {come} from there{_refused_text(bridge)}")


def _model(source: str | None, *, from_ros: bool) -> RobotModel | None:
    from zstate.model.load import load_model

    if source is not None and not from_ros:
        raise click.UsageError("--model is the robot that comes --from-ros; zstate's own is known in zstate")
    return None if source is None else load_model(source)


def _introduce(node: Node, robot: str, *, to_ros: bool, from_ros: bool) -> None:
    arrow = f"{'<' * from_ros}-{'>' * to_ros}"
    topics = f"{{{node.resolved('joint_states')},/tf,/tf_static}}"
    print_result(f"bridging {robot!r}: zstate {arrow} ROS 1 {topics} at {node.master.uri} as {node.name}")


def _look_after(bridge: Ros1Bridge) -> None:
    """Say what is waited for, and its end. Never returns."""
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    said = ""
    for _ in Rate(_CHECK_HZ, SystemClock(), Event()):
        bridge.check()
        reason = bridge.waits_for()
        if reason != said:
            print_status(f"waiting for {reason} ..." if reason else f"heard joint_states of {bridge.robot!r}")
            said = reason


def _refused_text(bridge: Ros1Bridge) -> str:
    refused = ", ".join(f"{reason} {count}" for reason, count in bridge.refused.items())
    return f"; refused: {refused}" if refused else ""
