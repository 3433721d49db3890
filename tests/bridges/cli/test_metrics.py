"""`zstate bridge --metrics`: the robots that are carried."""

from __future__ import annotations

import pytest
from helpers.cli_runner import Command, published_robot, run_watched
from helpers.processes import until
from helpers.prometheus_text import row, scraped, url_of, wait_for_names

ROWS = [
    "zstate_bridge_carried{robot,way}",
    "zstate_build_info{kernel,version}",
]
"""Each metric with the names of its labels, on which dashboards depend."""


def test_bridge_serves_the_carried_robots(ros_router: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ZSTATE_CONNECT")
    monkeypatch.delenv("ZSTATE_WIRE")

    def scrape(command: Command) -> None:
        url = url_of(command)
        carried = row("zstate_bridge_carried", robot="rrbot", way="native to ROS")
        until(lambda: scraped(url).get(carried) == 1)
        wait_for_names(url, ROWS)

    with published_robot():
        run_watched(scrape, "bridge", "rrbot", "--ros", ros_router, "--metrics", "0")
