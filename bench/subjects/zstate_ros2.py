"""zstate on the ROS 2 wire: the messages and keys of rmw_zenoh_cpp."""

from __future__ import annotations

from collections.abc import Sequence

from bench.job import Job
from bench.subjects.subject import Roles, Service, Subject
from bench.subjects.zstate_common import INSTALL, ROLE_SETTINGS, router, this_python, zstate_versions


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires
    from zstate import connect  # noqa: PLC0415

    return roles(lambda job, role: connect(endpoints=f"tcp/127.0.0.1:{job.ports[0]}"), "ros2")


def _services(job: Job) -> Sequence[Service]:
    return (router(job, "--ros2"),)


SUBJECT = Subject(
    name="zstate_ros2",
    title="zstate, ROS 2 wire",
    settings=(
        "CDR on the keys of rmw_zenoh_cpp: /joint_states and /robot_description are read, as a zstate reader "
        "does by default, and /tf is not published because it has no subscriber",
        "peers that find each other through `zstate router --ros2`, as ROS nodes do; data goes directly",
        *ROLE_SETTINGS,
    ),
    install=INSTALL,
    python=this_python,
    versions=zstate_versions,
    load=_load,
    services=_services,
)
