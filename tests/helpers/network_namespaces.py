"""Several hosts on one machine: network namespaces around a router that can drop packets.

Each host has its own cable to the router. Needs root and iproute2.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from types import TracebackType


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


class NamespaceHosts:
    """``names`` are hosts that reach each other; a context manager."""

    def __init__(self, *names: str) -> None:
        self._mark = f"zs{os.getpid()}"
        self._numbers = {name: number for number, name in enumerate(names, 1)}

    def __enter__(self) -> NamespaceHosts:
        _ip("netns", "add", self._router)
        self._run_in_router("echo 1 > /proc/sys/net/ipv4/ip_forward")
        for name in self._numbers:
            self._add_host(name)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for namespace in (*map(self.namespace, self._numbers), self._router):
            if Path(f"/run/netns/{namespace}").exists():
                _ip("netns", "del", namespace)

    @property
    def _router(self) -> str:
        return f"{self._mark}-router"

    def namespace(self, name: str) -> str:
        return f"{self._mark}-{name}"

    def address(self, name: str) -> str:
        return f"10.77.{self._numbers[name]}.2"

    def _port(self, name: str) -> str:
        """The router's end of a host's cable."""
        return f"port{self._numbers[name]}"

    def _add_host(self, name: str) -> None:
        host, port, net = self.namespace(name), self._port(name), f"10.77.{self._numbers[name]}"
        _ip("netns", "add", host)
        _ip(
            "link", "add", "cable", "netns", host, "type", "veth", "peer", "name", port, "netns", self._router
        )
        _ip("-n", self._router, "address", "add", f"{net}.1/24", "dev", port)
        _ip("-n", self._router, "link", "set", port, "up")
        _ip("-n", host, "address", "add", f"{net}.2/24", "dev", "cable")
        for device in ("lo", "cable"):
            _ip("-n", host, "link", "set", device, "up")
        _ip("-n", host, "route", "add", "default", "via", f"{net}.1")

    def _run_in_router(self, command: str) -> None:
        _ip("netns", "exec", self._router, "sh", "-c", command)

    def unplug(self, name: str) -> None:
        """Takes the link down; both ends notice it."""
        _ip("-n", self._router, "link", "set", self._port(name), "down")

    def plug(self, name: str) -> None:
        _ip("-n", self._router, "link", "set", self._port(name), "up")

    def drop_packets(self, name: str) -> None:
        """Drops all packets to and from this host without any error."""
        self._run_in_router(f"echo 0 > /proc/sys/net/ipv4/conf/{self._port(name)}/forwarding")
        _ip("-n", self._router, "route", "add", "blackhole", f"{self.address(name)}/32")

    def pass_packets(self, name: str) -> None:
        """Ends ``drop_packets``."""
        self._run_in_router(f"echo 1 > /proc/sys/net/ipv4/conf/{self._port(name)}/forwarding")
        _ip("-n", self._router, "route", "del", "blackhole", f"{self.address(name)}/32")
