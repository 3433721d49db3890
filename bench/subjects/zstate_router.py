"""zstate through a router process."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from bench.job import Job
from bench.subjects.subject import Roles, Service, Subject
from bench.subjects.zstate_common import INSTALL, ROLE_SETTINGS, router_row, this_python, zstate_versions

if TYPE_CHECKING:
    from zstate.net.session import Session


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles(_connect)


def _connect(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above

    return connect(mode="client", endpoints=f"tcp/127.0.0.1:{job.router_port(role)}")


def _services(job: Job) -> Sequence[Service]:
    return router_row(job)


SUBJECT = Subject(
    name="zstate_router",
    title="zstate, router",
    settings=(
        "writer and reader are clients of one `zstate router` on loopback, or of two in a row; native wire",
        *ROLE_SETTINGS,
    ),
    install=INSTALL,
    python=this_python,
    versions=zstate_versions,
    load=_load,
    services=_services,
    fleet=True,
)
