"""ROS 1 from Debian: robot_state_publisher and tf2_ros in Python, with the best known settings."""

from __future__ import annotations

from bench.subjects import ros1_master
from bench.subjects.subject import Roles, Subject

CHAIN = (
    "Debian's ROS 1 (Noetic): a rospy node publishes sensor_msgs/JointState, robot_state_publisher (C++) "
    "turns it into /tf; rosmaster alone, without rosout. That state publisher asks the master for tf_prefix "
    "at each joint state: the master's CPU belongs to the chain"
)
BEST = (
    "robot_state_publisher: publish_frequency 1000, ignore_timestamp true; it keeps one joint state waiting",
    "tcpNoDelay everywhere; the writer publishes in its own thread (queue_size None), with one message "
    "object for all samples",
)
READER = (
    "reader: tf2_ros.Buffer and TransformListener, which queues without limit; a second subscriber of /tf, "
    "called right after the listener's, calls lookup_transform_core(base, tip, stamp): no polling"
)


def _load() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles.Writer, roles.Reader


SUBJECT = Subject(
    name="ros1",
    title="ROS 1, Python reader",
    settings=(CHAIN, *BEST, READER),
    install=ros1_master.INSTALL,
    python=ros1_master.python,
    versions=ros1_master.versions,
    load=_load,
    services=ros1_master.services(*ros1_master.BEST),
    environment=ros1_master.environment,
)
