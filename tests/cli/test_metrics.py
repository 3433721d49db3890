"""--metrics PORT: scraped from commands that run."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest
from helpers.cli_runner import (
    RRBOT,
    Command,
    Spawn,
    failure,
    interrupted,
    missing_library,
    published_robot,
    run_watched,
    started,
)
from helpers.processes import until
from helpers.prometheus_text import grown, row, scraped, url_of


@pytest.mark.processes
def test_publisher_serves_its_metrics(spawn: Spawn):
    command = started(spawn, "publish", RRBOT, "--source", "sine", "--metrics", "0")
    labels = {"robot": "rrbot", "wire": "native"}
    url = url_of(command)
    rows = grown(url, row("zstate_publisher_samples_total", stream="joint_states", **labels))
    assert rows[row("zstate_publisher_suppressed_total", stream="tf", **labels)] > 0
    assert rows[row("zstate_publisher_commanded_hertz", robot="rrbot")] == 100.0
    assert rows[row("process_resident_memory_bytes")] > 0
    interrupted(command)


def test_listener_serves_its_counts():
    def scrape(command: Command) -> None:
        url = url_of(command)
        with published_robot():
            until(lambda: row("zstate_listener_received_total", robot="rrbot") in scraped(url))
            rows = grown(url, row("zstate_listener_received_total", robot="rrbot"))
            received = rows[row("zstate_listener_received_total", robot="rrbot")]
            in_buckets = rows[row("zstate_listener_latency_seconds_count", robot="rrbot")]
            # It goes on while it is read.
            assert received <= in_buckets <= received + 100
            assert rows[row("zstate_writers", robot="rrbot", stream="joint_states")] == 1
            assert rows[row("zstate_listener_missed_total", robot="rrbot")] == 0
        until(lambda: scraped(url)[row("zstate_robots")] == 0)

    run_watched(scrape, "monitor", "--robots", "--robot", "rrbot", "--json", "--metrics", "0")


def test_busy_port_and_invalid_address_are_reported():
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = str(busy.getsockname()[1])
        assert "or 0 for a free one" in failure("joints", RRBOT, "--metrics", port)
    assert "for instance 9100" in failure("joints", RRBOT, "--metrics", "here", code=2)


def test_missing_library_is_reported_with_the_package_to_install():
    with missing_library("prometheus_client"):
        assert "pip install 'zstate[metrics]'" in failure("joints", RRBOT, "--metrics", "0")


@pytest.mark.processes
def test_commands_without_it_load_no_library():
    code = (
        "import sys\n"
        "import zstate.cli.commands.monitor, zstate.cli.commands.publish, zstate.nodes.metered_buffer\n"
        "print('prometheus_client' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout == b"False\n"
