"""zstate: between peers, through routers, on the ROS 2 wire, and with mutual TLS."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING

from bench.job import Job
from bench.subjects.subject import Roles, Service, Subject

if TYPE_CHECKING:
    from zstate.net.session import Session

INSTALL = ("pip install -e '.[bench]'",)
PACKAGES = ("zstate", "eclipse-zenoh", "numpy", "pin", "msgspec")
ROLES = (
    "writer: StatePublisher.publish(positions, stamp=...); all other settings by default, so that it also "
    "caches two seconds for late joiners",
    "reader: TransformListener; a watch of its buffer calls it at each sample, and it calls "
    "buffer.lookup(base, tip, stamp)",
)


def versions() -> dict[str, str]:
    """Versions of zstate and its dependencies."""
    return {package: version(package) for package in PACKAGES}


def router(job: Job, *options: str, protocol: str = "tcp", number: int = 0) -> Service:
    """``zstate router`` at one of the job's ports, connected to the router before it."""
    endpoints = [f"{protocol}/127.0.0.1:{port}" for port in job.ports]
    row = ("--connect", endpoints[number - 1]) if number else ()
    command = (sys.executable, "-m", "zstate", "router", "--listen", endpoints[number], *row, *options)
    return Service("router", command, ready_text="listens at", port=job.ports[number])


def router_row(job: Job) -> tuple[Service, ...]:
    """The routers of the job, each connected to the one before it."""
    return tuple(router(job, number=number) for number in range(job.routers))


def _loads(connect: Callable[[Job, str], Session], wire: str = "native") -> Callable[[], Roles]:
    def load() -> Roles:
        from bench.subjects.zstate_roles import roles  # noqa: PLC0415 - imported late, as the protocol requires

        return roles(connect, wire)

    return load


def _as_peer(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above

    return connect()


def _through_router(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above

    return connect(mode="client", endpoints=f"tcp/127.0.0.1:{job.router_port(role)}")


def _as_ros_node(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above

    return connect(endpoints=f"tcp/127.0.0.1:{job.ports[0]}")


def _with_certificate(job: Job, role: str) -> Session:
    from zstate import connect  # noqa: PLC0415 - as above
    from zstate.net.security.credentials import Credentials  # noqa: PLC0415

    credentials = Credentials.from_folder(job.folder, role)
    return connect(mode="client", endpoints=f"tls/127.0.0.1:{job.ports[0]}", credentials=credentials)


def _tls_router(job: Job) -> Sequence[Service]:
    from zstate.fleet.certificates import issue_identities  # noqa: PLC0415 - as above

    issue_identities(job.folder, ("router", "writer", "reader"))
    return (router(job, "--certs", job.folder, "--identity", "router", protocol="tls"),)


SUBJECTS = (
    Subject(
        "zstate_peer",
        "zstate",
        ("all defaults: peers of one host, native wire, no router", *ROLES),
        INSTALL,
        python=lambda: sys.executable,
        versions=versions,
        load=_loads(_as_peer),
        # A rendezvous address of this run alone, so that no other zstate takes part.
        environment=lambda job: {"ZSTATE_RENDEZVOUS": f"127.0.0.1:{job.ports[0]}"},
    ),
    Subject(
        "zstate_router",
        "zstate, router",
        (
            "writer and reader are clients of one `zstate router` on loopback, or of two in a row; native",
            *ROLES,
        ),
        INSTALL,
        python=lambda: sys.executable,
        versions=versions,
        load=_loads(_through_router),
        services=router_row,
        fleet=True,
    ),
    Subject(
        "zstate_ros2",
        "zstate, ROS 2 wire",
        (
            "CDR on the keys of rmw_zenoh_cpp: /joint_states and /robot_description are read, as a zstate "
            "reader does by default, and /tf is not published because it has no subscriber",
            "peers that find each other through `zstate router --ros2`, as ROS nodes do; data goes directly",
            *ROLES,
        ),
        INSTALL,
        python=lambda: sys.executable,
        versions=versions,
        load=_loads(_as_ros_node, "ros2"),
        services=lambda job: (router(job, "--ros2"),),
    ),
    Subject(
        "zstate_mtls",
        "zstate, mutual TLS",
        (
            "writer and reader are clients of one `zstate router` on loopback over TLS 1.3; each presents a "
            "certificate of `zstate certs` and verifies the peer; native wire",
            *ROLES,
        ),
        INSTALL,
        python=lambda: sys.executable if find_spec("cryptography") else None,
        versions=lambda: {**versions(), "cryptography": version("cryptography")},
        load=_loads(_with_certificate),
        services=_tls_router,
    ),
)
