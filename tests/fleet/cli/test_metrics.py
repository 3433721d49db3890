"""`zstate router --metrics`: its connections, and the writers that are announced."""

from __future__ import annotations

from helpers.cli_runner import Command, published_robot, run_watched
from helpers.processes import until
from helpers.prometheus_text import row, scraped, url_of, wait_for_names

ROWS = [
    "zstate_build_info{kernel,version}",
    "zstate_robots{}",
    "zstate_router_links{protocol}",
    "zstate_router_sessions{mode}",
    "zstate_writers{robot,stream}",
]
"""Each metric with the names of its labels, on which dashboards depend."""


def test_router_serves_its_connections_and_writers(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def scrape(command: Command) -> None:
        url = url_of(command)
        assert scraped(url)[row("zstate_router_sessions", mode="client")] == 0
        with published_robot(router=endpoint):
            until(lambda: scraped(url).get(row("zstate_writers", robot="rrbot", stream="joint_states")) == 1)
            rows = scraped(url)
            wait_for_names(url, ROWS)
        assert rows[row("zstate_router_sessions", mode="client")] == 1
        assert rows[row("zstate_router_links", protocol="tcp")] == 1

    run_watched(scrape, "router", "--listen", endpoint, "--metrics", "0")
