"""What zstate's own subjects have in common."""

from __future__ import annotations

import sys
from importlib.metadata import version

from bench.job import Job
from bench.subjects.subject import Service

INSTALL = ("pip install -e '.[robots,bench]'",)
PACKAGES = ("zstate", "eclipse-zenoh", "numpy", "pin", "msgspec")

HOW_READ = (
    "writer: StatePublisher.publish(positions, stamp=...); everything else by default, so that it also keeps "
    "two seconds for late joiners",
    "reader: TransformListener; a watch of its buffer wakes it at each sample, and it calls "
    "buffer.lookup(base, tip, stamp)",
    "slow reader: a loop of buffer.wait for a newer stamp and buffer.lookup of the newest",
)


def here() -> str | None:
    """The interpreter that runs the harness."""
    return sys.executable


def our_versions() -> dict[str, str]:
    """Of zstate and what it stands on."""
    return {package: version(package) for package in PACKAGES}


def router(job: Job, *options: str, protocol: str = "tcp") -> Service:
    """``zstate router`` at the job's first port."""
    endpoint = f"{protocol}/127.0.0.1:{job.ports[0]}"
    command = (sys.executable, "-m", "zstate", "router", "--listen", endpoint, *options)
    return Service("router", command, says="listens at", port=job.ports[0])
