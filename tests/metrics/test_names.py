"""The names of metrics and of their labels, on which dashboards and alerts depend."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
from helpers.cli_runner import Command, published_robot, run_watched
from helpers.prometheus_text import url_of, wait_for_names

ROWS = {
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
}
"""By command: each metric with the names of its labels."""


@pytest.mark.parametrize(
    "command",
    [("publish", "rrbot", "--source", "sine"), ("monitor", "--robots", "--robot", "rrbot")],
    ids=lambda command: command[0],
)
def test_names_of_metrics_and_their_labels(command: tuple[str, ...]):
    def scrape(running: Command) -> None:
        wait_for_names(url_of(running), ROWS[command[0]])

    with nullcontext() if command[0] == "publish" else published_robot():
        run_watched(scrape, *command, "--metrics", "0")
