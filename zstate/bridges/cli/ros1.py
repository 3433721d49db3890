"""zstate ros1: bidirectional bridge of one robot between zstate and ROS 1."""

from __future__ import annotations

from threading import Event

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, print_result, print_status
from zstate.cli.session import SessionOptions, open_session

_CHECK_HZ = 2.0


@click.command("ros1")
@click.argument("robot")
@click.option("--to-ros", is_flag=True, help="Carry from zstate to ROS.")
@click.option("--from-ros", is_flag=True, help="Carry from ROS to zstate.")
@click.option(
    "--model",
    "source",
    metavar="MODEL",
    help="Model of a robot --from-ros, a name or a URDF file; default: the parameter robot_description.",
)
@click.option("--frame-prefix", default="", metavar="P", help="Prefix of the robot's frames in ROS.")
@click.option("--no-description", is_flag=True, help="Do not set the parameter robot_description.")
@options.session_options
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

    To ROS: joint_states, /tf and /tf_static (no robot_state_publisher is needed there), and the parameter
    robot_description if it is not set. From ROS: joint_states, and the edges of /tf and /tf_static that are
    not in the model; zstate computes the kinematics. Edges such as odom -> base_link keep the name of their
    node in zstate, and lose their covariance in ROS. Every sample keeps its stamp; a JointState without one
    is refused.

    Give --to-ros, --from-ros or both; carried samples are not carried back. Run one bridge per robot.
    ROS_MASTER_URI, ROS_IP and ROS_NAMESPACE apply as for every ROS program. Needs rospy, on Debian 12:

    \b
    apt-get install python3-rospy python3-sensor-msgs python3-tf2-msgs
    /usr/bin/python3 -m venv --system-site-packages .venv
    .venv/bin/pip install zstate
    """
    from zstate.bridges.ros1.bridge import Ros1Bridge
    from zstate.bridges.ros1.node import Ros1Node
    from zstate.clock import SystemClock
    from zstate.model.load import load_model
    from zstate.rate import Rate
    from zstate.wire.keys import check_robot

    if not (to_ros or from_ros):
        raise click.UsageError("no direction is given: pass --to-ros, --from-ros, or both")
    check_robot(robot)
    if source is not None and not from_ros:
        raise click.UsageError("--model needs --from-ros; the model of a robot in zstate is already known")
    model = None if source is None else load_model(source)
    with (
        Ros1Node() as node,
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
        arrow = f"{'<' * from_ros}-{'>' * to_ros}"
        topics = f"{{{node.resolved('joint_states')},/tf,/tf_static}}"
        print_result(f"bridging {robot!r}: zstate {arrow} ROS 1 {topics} at {node.master.uri} as {node.name}")
        missing = ""
        try:
            for _ in Rate(_CHECK_HZ, SystemClock(), Event()):
                bridge.check()
                reason = bridge.waits_for()
                if reason != missing:
                    print_status(
                        f"waiting for {reason} ..."
                        if reason
                        else f"receiving joint_states of {bridge.robot!r}"
                    )
                    missing = reason
        finally:
            to_count, from_count = bridge.carried
            refused = ", ".join(f"{reason} {count}" for reason, count in bridge.refused.items())
            refused = f"; refused: {refused}" if refused else ""
            print_result(f"{count_text(to_count, 'sample')} to ROS, {from_count} from ROS{refused}")
