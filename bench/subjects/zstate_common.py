"""Shared parts of the zstate subjects."""

from __future__ import annotations

import sys
from importlib.metadata import version

from bench.job import Job
from bench.subjects.subject import Service

INSTALL = ("pip install -e '.[bench]'",)
PACKAGES = ("zstate", "eclipse-zenoh", "numpy", "pin", "msgspec")

ROLE_SETTINGS = (
    "writer: StatePublisher.publish(positions, stamp=...); all other settings by default, so that it also "
    "caches two seconds for late joiners",
    "reader: TransformListener; a watch of its buffer calls it at each sample, and it calls "
    "buffer.lookup(base, tip, stamp)",
    "slow reader: a loop of buffer.wait for a newer stamp and buffer.lookup of the newest",
)


def this_python() -> str | None:
    """The interpreter that runs the harness."""
    return sys.executable


def zstate_versions() -> dict[str, str]:
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
