"""zstate with default settings: peers of one host, native wire."""

from __future__ import annotations

from collections.abc import Mapping

from bench.job import Job
from bench.subjects.subject import Roles, Subject
from bench.subjects.zstate_common import INSTALL, ROLE_SETTINGS, this_python, zstate_versions


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires
    from zstate import connect  # noqa: PLC0415

    return roles(lambda job, role: connect())


def _environment(job: Job) -> Mapping[str, str]:
    # A rendezvous address of this run alone, so that no other zstate takes part.
    return {"ZSTATE_RENDEZVOUS": f"127.0.0.1:{job.ports[0]}"}


SUBJECT = Subject(
    name="zstate_peer",
    title="zstate",
    settings=("all defaults: peers of one host, native wire, no router", *ROLE_SETTINGS),
    install=INSTALL,
    python=this_python,
    versions=zstate_versions,
    load=_load,
    environment=_environment,
)
