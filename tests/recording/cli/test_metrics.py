"""`zstate record --metrics`: what a recorder has written."""

from __future__ import annotations

from pathlib import Path

from helpers.cli_runner import Command, published_robot, run_watched
from helpers.processes import until
from helpers.prometheus_text import grown, row, scraped, url_of, wait_for_names

ROWS = [
    "zstate_build_info{kernel,version}",
    "zstate_recorder_dropped_total{}",
    "zstate_recorder_files{}",
    "zstate_recorder_messages_total{robot,stream}",
    "zstate_recorder_missed_total{}",
    "zstate_recorder_size_bytes{}",
    "zstate_recorder_unwritten_total{}",
    "zstate_robots{}",
    "zstate_writers{robot,stream}",
]
"""Each metric with the names of its labels, on which dashboards depend."""


def test_recorder_serves_its_metrics(tmp_path: Path):
    def scrape(command: Command) -> None:
        url = url_of(command)
        messages = row("zstate_recorder_messages_total", robot="rrbot", stream="joint_states")
        until(lambda: messages in scraped(url))
        rows = grown(url, messages)
        assert rows[row("zstate_recorder_files")] == 1
        assert rows[row("zstate_recorder_size_bytes")] > 0
        wait_for_names(url, ROWS)

    with published_robot():
        run_watched(scrape, "record", str(tmp_path / "run.mcap"), "rrbot", "--metrics", "0")
