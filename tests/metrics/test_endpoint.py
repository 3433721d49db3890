from __future__ import annotations

import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, suppress

import pytest
from helpers.processes import DEADLINE_S, new_threads, until
from helpers.prometheus_text import row, scraped
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

import zstate
from zstate.errors import InvalidInput, PortBusy
from zstate.metrics.endpoint import _MAX_CONNECTIONS, BindAddress, MetricsEndpoint


class Counting(Collector):
    """Counts its scrapes."""

    def __init__(self) -> None:
        self.scrapes = 0

    def collect(self):
        self.scrapes += 1
        yield GaugeMetricFamily("scrapes", "How often.", self.scrapes)


def test_collectors_are_called_at_each_scrape():
    counting = Counting()
    with MetricsEndpoint([counting]) as endpoint:
        before = counting.scrapes
        first, second = (scraped(endpoint.url)[row("scrapes")] for _ in range(2))
    assert (first, second) == (before + 1, before + 2)


def test_version_and_process_resources_are_reported():
    with MetricsEndpoint([]) as endpoint:
        metrics = scraped(endpoint.url)
    assert metrics[row("zstate_build_info", version=zstate.__version__, kernel=str(zstate.kernel))] == 1.0
    assert metrics[row("process_cpu_seconds_total")] > 0.0
    assert metrics[row("process_resident_memory_bytes")] > 1e6


def test_two_endpoints_of_one_process_are_separate():
    with MetricsEndpoint([Counting()]) as one, MetricsEndpoint([]) as other:
        assert row("scrapes") in scraped(one.url)
        assert row("scrapes") not in scraped(other.url)


def test_only_this_host_reaches_the_endpoint_by_default():
    with MetricsEndpoint([]) as endpoint:
        assert endpoint.url.startswith("http://127.0.0.1:")
    with MetricsEndpoint([], "::1") as endpoint:
        assert endpoint.url.startswith("http://[::1]:")
        assert scraped(endpoint.url)


def port_of(endpoint: MetricsEndpoint) -> int:
    return int(endpoint.url.rsplit(":", 1)[1].split("/")[0])


def response(port: int, *lines: str) -> bytes:
    """The response to a request of these lines."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return connection.makefile("rb").read()


def test_other_hosts_are_refused_on_loopback():
    """The page of a site whose name resolves to 127.0.0.1 asks for the host of that site."""
    counting = Counting()
    with MetricsEndpoint([counting]) as endpoint:
        port, before = port_of(endpoint), counting.scrapes
        for host in (
            "evil.example",
            f"evil.example:{port}",
            f"127.0.0.1:{port + 1}",
            f"127.0.0.1.evil:{port}",
        ):
            answer = response(port, "GET /metrics HTTP/1.1", f"Host: {host}")
            assert b" 403 " in answer.splitlines()[0]
            assert b"open it to others with `--metrics HOST:PORT`" in answer
        twice = response(port, "GET /metrics HTTP/1.1", f"Host: 127.0.0.1:{port}", "Host: evil.example")
        assert b" 400 " in twice.splitlines()[0]
        assert counting.scrapes == before
        good = response(port, "GET /metrics HTTP/1.1", f"Host: localhost:{port}")
        assert b" 200 " in good.splitlines()[0]
    with MetricsEndpoint([Counting()], "0.0.0.0") as endpoint:
        opened = response(port_of(endpoint), "GET /metrics HTTP/1.1", "Host: robot.example")
        assert b" 200 " in opened.splitlines()[0]


def test_a_connection_without_a_whole_request_is_closed_in_silence(monkeypatch, capfd):
    monkeypatch.setattr("zstate.metrics.endpoint._REQUEST_WITHIN_S", 0.5)
    with MetricsEndpoint([]) as endpoint:
        port = port_of(endpoint)
        with (
            socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as idle,
            socket.create_connection(("127.0.0.1", port), timeout=DEADLINE_S) as trickling,
        ):
            # One byte at a time, each well within the time of a whole request.
            def trickle() -> bool:
                try:
                    trickling.sendall(b"G")
                except OSError:
                    return True
                return False

            until(trickle)
            assert idle.recv(100) == b""
        assert scraped(endpoint.url)
    assert capfd.readouterr() == ("", "")


def test_idle_connections_keep_neither_threads_nor_scrapes(monkeypatch, capfd):
    monkeypatch.setattr("zstate.metrics.endpoint._REQUEST_WITHIN_S", 60.0)
    before = threading.enumerate()
    with MetricsEndpoint([]) as endpoint, ExitStack() as opened:
        address = ("127.0.0.1", port_of(endpoint))
        for _ in range(300):
            opened.enter_context(socket.create_connection(address, timeout=DEADLINE_S))
        until(lambda: len(new_threads(before)) > 1)

        def is_scraped() -> bool:
            with suppress(OSError):
                return bool(scraped(endpoint.url))
            return False

        until(is_scraped)
        assert len(new_threads(before)) <= 1 + _MAX_CONNECTIONS
    assert capfd.readouterr() == ("", "")


def test_close_ends_threads_connections_and_the_port():
    before = threading.enumerate()
    endpoint = MetricsEndpoint([])
    port = int(endpoint.url.split(":")[2].split("/")[0])
    scraped(endpoint.url)
    idle = socket.create_connection(("127.0.0.1", port))
    endpoint.close()
    endpoint.close()
    idle.close()
    until(lambda: not new_threads(before))
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port))


def test_a_used_port_and_a_remote_host_are_refused():
    with MetricsEndpoint([]) as endpoint:
        port = int(endpoint.url.split(":")[2].split("/")[0])
        with pytest.raises(PortBusy, match=f"'127.0.0.1:{port}'.*or 0 for a free one") as busy:
            MetricsEndpoint([], port=port)
    assert busy.value.endpoint == f"127.0.0.1:{port}"
    with pytest.raises(InvalidInput, match="give an address of this host"):
        MetricsEndpoint([], "192.0.2.1")


def test_a_missing_library_error_names_the_package():
    code = (
        "import sys; sys.modules['prometheus_client'] = None\n"
        "import zstate.nodes.metered_buffer, zstate.metrics.collectors\n"
        "from zstate.errors import LibraryMissing\n"
        "try:\n"
        "    from zstate.metrics.endpoint import MetricsEndpoint\n"
        "    MetricsEndpoint([])\n"
        "except LibraryMissing as error:\n"
        "    print(error)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "pip install 'zstate[metrics]'" in printed


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("9100", ("127.0.0.1", 9100)),
        ("0", ("127.0.0.1", 0)),
        ("0.0.0.0:9100", ("0.0.0.0", 9100)),
        ("robot.local:65535", ("robot.local", 65535)),
        ("[::1]:9100", ("::1", 9100)),
    ],
)
def test_a_port_without_host_is_on_this_host(text: str, address: tuple[str, int]):
    assert BindAddress.parse(text) == address


@pytest.mark.parametrize("text", ["", "65536", "-1", "host:", "::1:9100", "tcp/1.2.3.4:5", "a b:1", "\u0661"])
def test_an_invalid_address_error_shows_the_correct_form(text: str):
    with pytest.raises(InvalidInput, match=r"for instance 9100, or 0\.0\.0\.0:9100"):
        BindAddress.parse(text)
