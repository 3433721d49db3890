"""The same ROS 1 as it comes: robot_state_publisher, publisher and listener with their default settings."""

from __future__ import annotations

from functools import partial

from bench.subjects import ros1_world
from bench.subjects.ros1 import CHAIN, READER
from bench.subjects.subject import Roles, Subject


def _load() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - as late as the protocol asks

    writer = partial(roles.Writer, nodelay=False, queue_size=10)
    return writer, partial(roles.Reader, nodelay=False)


SUBJECT = Subject(
    name="ros1_default",
    title="ROS 1, Python reader, default settings",
    settings=(
        CHAIN,
        "robot_state_publisher: publish_frequency 50, ignore_timestamp false: it leaves out joint states "
        "that come sooner than that, by design; they count as lost here",
        "without tcpNoDelay, but for robot_state_publisher's subscription, which asks for it; the writer "
        "publishes with queue_size=10, as the tutorials do",
        READER,
    ),
    install=ros1_world.INSTALL,
    python=ros1_world.python,
    versions=ros1_world.versions,
    load=_load,
    services=ros1_world.services(),
    environment=ros1_world.environment,
)
