from __future__ import annotations

import socket
import subprocess
import sys
import threading

import pytest
from helpers.processes import until
from helpers.prometheus_text import row, scraped
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

import zstate
from zstate.errors import InvalidInput, PortBusy
from zstate.metrics.endpoint import BindAddress, MetricsEndpoint


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


def test_close_ends_threads_connections_and_the_port():
    before = threading.active_count()
    endpoint = MetricsEndpoint([])
    port = int(endpoint.url.split(":")[2].split("/")[0])
    scraped(endpoint.url)
    idle = socket.create_connection(("127.0.0.1", port))
    endpoint.close()
    endpoint.close()
    idle.close()
    until(lambda: threading.active_count() == before)
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
        "import zstate.metrics.buffer, zstate.metrics.collectors\n"
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
