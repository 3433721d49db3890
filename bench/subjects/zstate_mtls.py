"""zstate through a router with mutual TLS."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING

from bench.job import Job
from bench.subjects.subject import Roles, Service, Subject
from bench.subjects.zstate_common import ROLE_SETTINGS, router, this_python, zstate_versions

if TYPE_CHECKING:
    from zstate.net.session import Session

LIBRARY = "cryptography"


def _load() -> Roles:
    from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles(_connect)


def _connect(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above
    from zstate.net.security.credentials import Credentials  # noqa: PLC0415

    credentials = Credentials.from_folder(job.folder, role)
    return connect(mode="client", endpoints=f"tls/127.0.0.1:{job.ports[0]}", credentials=credentials)


def _services(job: Job) -> Sequence[Service]:
    from zstate.fleet.certificates import issue_identities  # noqa: PLC0415 - as above

    issue_identities(job.folder, ("router", "writer", "reader"))
    return (router(job, "--certs", job.folder, "--identity", "router", protocol="tls"),)


SUBJECT = Subject(
    name="zstate_mtls",
    title="zstate, mutual TLS",
    settings=(
        "writer and reader are clients of one `zstate router` on loopback over TLS 1.3; each presents a "
        "certificate of `zstate certs` and verifies the peer; native wire",
        *ROLE_SETTINGS,
    ),
    install=("pip install -e '.[bench]'",),
    python=lambda: this_python() if find_spec(LIBRARY) else None,
    versions=lambda: {**zstate_versions(), LIBRARY: version(LIBRARY)},
    load=_load,
    services=_services,
)
