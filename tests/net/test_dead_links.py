"""Connections of TLS end with their lease if the other host does not respond; others are Zenoh's alone."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.processes import until

from zstate import connect
from zstate.net.config import SETTINGS
from zstate.net.security.credentials import Credentials

certificates = pytest.importorskip("zstate.fleet.certificates")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other kernels have no TCP_USER_TIMEOUT")


def limits_ms(port: int) -> Iterator[int]:
    """The limits of the connections of this process from or to ``port``."""
    for entry in list(Path("/proc/self/fd").iterdir()):
        with suppress(OSError):
            one = socket.socket(fileno=int(entry.name))
            try:
                is_ip = one.family in (socket.AF_INET, socket.AF_INET6)
                if is_ip and port in (one.getsockname()[1], one.getpeername()[1]):
                    yield one.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
            finally:
                one.detach()


def test_both_ends_of_a_tls_link_give_up_after_the_lease(tmp_path: Path, free_port: int):
    certificates.issue_identities(tmp_path, ["hq", "desk"], hosts=["127.0.0.1"])
    hq, desk = (Credentials.from_folder(tmp_path, name) for name in ("hq", "desk"))
    endpoint = f"tls/127.0.0.1:{free_port}"
    with (
        connect(mode="router", listen=endpoint, credentials=hq),
        connect(mode="client", endpoints=endpoint, credentials=desk),
    ):
        lease_ms = SETTINGS["transport/link/tx/lease"]
        until(lambda: list(limits_ms(free_port)) == [lease_ms, lease_ms])


def test_the_ends_of_a_tcp_link_keep_the_limit_of_the_kernel(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(mode="router", listen=endpoint), connect(mode="client", endpoints=endpoint):
        until(lambda: list(limits_ms(free_port)) == [0, 0])
