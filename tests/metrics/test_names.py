"""The names of metrics and of their labels, on which dashboards and alerts depend."""

from __future__ import annotations

import re
from contextlib import nullcontext
from pathlib import Path
from urllib.request import urlopen

import pytest
from helpers.cli_runner import Command, published_robot, run_watched
from helpers.processes import until
from helpers.programs import router

from zstate import StatePublisher, connect, load_model

parser = pytest.importorskip("prometheus_client.parser", reason="pip install 'zstate[metrics]'")

ROWS = {
    "bridge": ["zstate_bridge_carried{robot,way}", "zstate_build_info{kernel,version}"],
    "monitor": [
        "zstate_build_info{kernel,version}",
        "zstate_listener_age_seconds{robot}",
        "zstate_listener_dropped_total{robot}",
        "zstate_listener_late_total{robot}",
        "zstate_listener_latency_seconds_bucket{le,robot}",
        "zstate_listener_latency_seconds_count{robot}",
        "zstate_listener_latency_seconds_sum{robot}",
        "zstate_listener_lookups_total{robot}",
        "zstate_listener_missed_total{robot}",
        "zstate_listener_off_clock_total{robot}",
        "zstate_listener_recalled_total{robot}",
        "zstate_listener_received_total{robot}",
        "zstate_listener_robots_left_out{}",
        "zstate_robots{}",
        "zstate_writers{robot,stream}",
    ],
    "publish": [
        "zstate_build_info{kernel,version}",
        "zstate_publisher_bytes_total{robot,stream,wire}",
        "zstate_publisher_commanded_hertz{robot}",
        "zstate_publisher_late_ticks_total{robot}",
        "zstate_publisher_refused_total{robot}",
        "zstate_publisher_samples_total{robot,stream,wire}",
        "zstate_publisher_skipped_ticks_total{robot}",
        "zstate_publisher_suppressed_total{robot,stream,wire}",
        "zstate_publisher_ticks_total{robot}",
    ],
    "record": [
        "zstate_build_info{kernel,version}",
        "zstate_recorder_dropped_total{}",
        "zstate_recorder_files{}",
        "zstate_recorder_messages_total{robot,stream}",
        "zstate_recorder_missed_total{}",
        "zstate_recorder_size_bytes{}",
        "zstate_recorder_unwritten_total{}",
        "zstate_robots{}",
        "zstate_writers{robot,stream}",
    ],
    "router": [
        "zstate_build_info{kernel,version}",
        "zstate_robots{}",
        "zstate_router_links{protocol}",
        "zstate_router_sessions{mode}",
        "zstate_writers{robot,stream}",
    ],
}
"""By command: each metric with the names of its labels."""


@pytest.mark.parametrize(
    "command",
    [
        ("router", "--ros2", "--listen", "ENDPOINT"),
        ("publish", "rrbot", "--source", "sine"),
        ("monitor", "--robots", "--robot", "rrbot"),
        ("record", "FILE", "rrbot"),
        ("bridge", "rrbot", "--ros", "ENDPOINT"),
    ],
    ids=lambda command: command[0],
)
def test_names_of_metrics_and_their_labels(tmp_path: Path, free_port: int, command: tuple[str, ...]):
    name, endpoint = command[0], f"tcp/127.0.0.1:{free_port}"
    given = {"ENDPOINT": endpoint, "FILE": str(tmp_path / "run.mcap")}

    def scrape(running: Command) -> None:
        until(lambda: "metrics at " in running.stderr)
        url = re.findall(r"metrics at (http:\S+)", running.stderr)[0]
        with (
            # For the rows of the router's connections.
            connect(mode="client", endpoints=endpoint) as far,
            StatePublisher(far, load_model("rrbot"), "far"),
        ):
            until(lambda: set(ROWS[name]) <= set(metric_rows(url)))
            assert metric_rows(url) == ROWS[name]

    with (
        nullcontext() if name == "router" else router(endpoint, ros2=True),
        nullcontext() if name == "publish" else published_robot(),
    ):
        run_watched(scrape, *(given.get(word, word) for word in command), "--metrics", "0")


def metric_rows(url: str) -> list[str]:
    """Each metric of zstate that is served, with the names of its labels."""
    with urlopen(url, timeout=5.0) as reply:
        families = list(parser.text_string_to_metric_families(reply.read().decode()))
    samples = (sample for family in families for sample in family.samples)
    return sorted(
        {
            f"{sample.name}{{{','.join(sorted(sample.labels))}}}"
            for sample in samples
            if sample.name.startswith("zstate")
        }
    )
