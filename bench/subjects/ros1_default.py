"""ROS 1 with default settings of robot_state_publisher, publisher and listener."""

from __future__ import annotations

from functools import partial

from bench.subjects import ros1_master
from bench.subjects.ros1 import CHAIN, READER
from bench.subjects.subject import Roles, Subject


def _load() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    writer = partial(roles.Writer, nodelay=False, queue_size=10)
    return writer, partial(roles.Reader, nodelay=False)


SUBJECT = Subject(
    name="ros1_default",
    title="ROS 1, Python reader, default settings",
    settings=(
        CHAIN,
        "robot_state_publisher: publish_frequency 50, ignore_timestamp false: it drops joint states "
        "above that rate, by design; they count as lost here",
        "without tcpNoDelay, except in robot_state_publisher's subscription, which requests it; the writer "
        "publishes with queue_size=10, as the tutorials do",
        READER,
    ),
    install=ros1_master.INSTALL,
    python=ros1_master.python,
    versions=ros1_master.versions,
    load=_load,
    services=ros1_master.services(),
    environment=ros1_master.environment,
)
