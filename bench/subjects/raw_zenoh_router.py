"""The floor through a router: two clients of eclipse-zenoh, and ``zstate router`` between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from bench.job import Job
from bench.subjects import raw_zenoh
from bench.subjects.subject import Answered, Roles, Service
from bench.subjects.zstate_common import router_row


def _load() -> Roles:
    from bench.subjects import raw_zenoh_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    def reader(job: Job, answered: Answered) -> roles.Reader:
        return roles.Reader(job, answered, roles.through_router(job, "reader"))

    return lambda job: roles.Writer(job, roles.through_router(job, "writer")), reader


def _services(job: Job) -> Sequence[Service]:
    return router_row(job)


SUBJECT = replace(
    raw_zenoh.SUBJECT,
    name="raw_zenoh_router",
    title="raw Zenoh, router (floor)",
    settings=(
        "two clients of the routers that zstate uses, over TCP on loopback",
        *raw_zenoh.SUBJECT.settings[1:],
    ),
    load=_load,
    services=_services,
    fleet=True,
)
