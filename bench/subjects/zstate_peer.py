"""zstate as it is without any setting: peers of one host, the native wire."""

from __future__ import annotations

from collections.abc import Mapping

from bench.job import Job
from bench.subjects.ours import HOW_READ, INSTALL, here, our_versions
from bench.subjects.subject import Roles, Subject


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - as late as the protocol asks
    from zstate import connect  # noqa: PLC0415

    return roles(lambda job, role: connect())


def _environment(job: Job) -> Mapping[str, str]:
    # Where its processes meet: a place of this run's own, so that no other zstate takes part.
    return {"ZSTATE_RENDEZVOUS": f"127.0.0.1:{job.ports[0]}"}


SUBJECT = Subject(
    name="zstate_peer",
    title="zstate",
    settings=("all defaults: peers of one host, native wire, no router", *HOW_READ),
    install=INSTALL,
    python=here,
    versions=our_versions,
    load=_load,
    environment=_environment,
)
