"""zstate on ROS 2's wire: what a node with rmw_zenoh_cpp writes and reads."""

from __future__ import annotations

from collections.abc import Sequence

from bench.job import Job
from bench.subjects.ours import HOW_READ, INSTALL, here, our_versions, router
from bench.subjects.subject import Roles, Service, Subject


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - as late as the protocol asks
    from zstate import connect  # noqa: PLC0415

    return roles(lambda job, role: connect(endpoints=f"tcp/127.0.0.1:{job.ports[0]}"), "ros2")


def _services(job: Job) -> Sequence[Service]:
    return (router(job, "--ros2"),)


SUBJECT = Subject(
    name="zstate_ros2",
    title="zstate, ROS 2 wire",
    settings=(
        "CDR on the keys of rmw_zenoh_cpp: /joint_states and /robot_description are read, as a zstate reader "
        "does by default, and /tf stays unwritten because nobody subscribes to it",
        "peers that find each other through `zstate router --ros2`, as ROS nodes do; data goes directly",
        *HOW_READ,
    ),
    install=INSTALL,
    python=here,
    versions=our_versions,
    load=_load,
    services=_services,
)
