"""zstate through a router process."""

from __future__ import annotations

from collections.abc import Sequence

from bench.job import Job
from bench.subjects.subject import Roles, Service, Subject
from bench.subjects.zstate_common import INSTALL, ROLE_SETTINGS, router, this_python, zstate_versions


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires
    from zstate import connect  # noqa: PLC0415

    return roles(lambda job, role: connect(mode="client", endpoints=f"tcp/127.0.0.1:{job.ports[0]}"))


def _services(job: Job) -> Sequence[Service]:
    return (router(job),)


SUBJECT = Subject(
    name="zstate_router",
    title="zstate, router",
    settings=(
        "writer and reader are clients of one `zstate router` on loopback; native wire",
        *ROLE_SETTINGS,
    ),
    install=INSTALL,
    python=this_python,
    versions=zstate_versions,
    load=_load,
    services=_services,
    fleet=True,
)
