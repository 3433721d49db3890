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
from zstate.metrics.endpoint import MetricsEndpoint


class Counting(Collector):
    """How often it was asked."""

    def __init__(self) -> None:
        self.asked = 0

    def collect(self):
        self.asked += 1
        yield GaugeMetricFamily("asked", "How often.", self.asked)


def test_it_asks_its_collectors_at_each_scrape():
    counting = Counting()
    with MetricsEndpoint([counting]) as endpoint:
        before = counting.asked
        first, second = (scraped(endpoint.url)[row("asked")] for _ in range(2))
    assert (first, second) == (before + 1, before + 2)


def test_it_tells_the_version_and_what_the_process_uses():
    with MetricsEndpoint([]) as endpoint:
        metrics = scraped(endpoint.url)
    assert metrics[row("zstate_build_info", version=zstate.__version__, kernel=str(zstate.kernel))] == 1.0
    assert metrics[row("process_cpu_seconds_total")] > 0.0
    assert metrics[row("process_resident_memory_bytes")] > 1e6


def test_two_of_one_process_do_not_mix():
    with MetricsEndpoint([Counting()]) as one, MetricsEndpoint([]) as other:
        assert row("asked") in scraped(one.url)
        assert row("asked") not in scraped(other.url)


def test_it_is_reached_at_this_host_alone_unless_told_otherwise():
    with MetricsEndpoint([]) as endpoint:
        assert endpoint.url.startswith("http://127.0.0.1:")
    with MetricsEndpoint([], "::1") as endpoint:
        assert endpoint.url.startswith("http://[::1]:")
        assert scraped(endpoint.url)


def test_nothing_is_left_when_it_has_closed():
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


def test_a_port_that_is_taken_and_a_host_elsewhere_are_told():
    with MetricsEndpoint([]) as endpoint:
        port = int(endpoint.url.split(":")[2].split("/")[0])
        with pytest.raises(PortBusy, match=f"'127.0.0.1:{port}'.*or 0 for a free one") as busy:
            MetricsEndpoint([], port=port)
    assert busy.value.endpoint == f"127.0.0.1:{port}"
    with pytest.raises(InvalidInput, match="give an address of this host"):
        MetricsEndpoint([], "192.0.2.1")


def test_without_the_library_one_is_told_what_to_install():
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
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "pip install 'zstate[metrics]'" in said
