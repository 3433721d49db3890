from __future__ import annotations

import pytest

from zstate._util.endpoint import Endpoint, format_host, parse_endpoint, parse_host_port


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tcp/127.0.0.1:7447", ("tcp", "127.0.0.1", 7447)),
        ("tls/[fe80::1%eth0]:1", ("tls", "fe80::1%eth0", 1)),
        ("udp/robot.local:65535#iface=lo", ("udp", "robot.local", 65535)),
        ("tcp/10.0.0.1:0?rel=1#bind=2", ("tcp", "10.0.0.1", 0)),
    ],
)
def test_an_endpoint_has_protocol_host_and_port(text: str, parts: tuple[str, str, int]):
    assert parse_endpoint(text) == Endpoint(*parts)


@pytest.mark.parametrize(
    "text",
    ["tcp/::1:7447", "tcp/a:65536", "tcp/a", "tcp/:1", "a:1", "/a:1", "serial//dev/ttyUSB0", "tcp/a b:1"],
)
def test_other_texts_are_no_endpoints(text: str):
    assert parse_endpoint(text) is None


@pytest.mark.parametrize("host", ["::1", "0.0.0.0", "robot"])
def test_a_formatted_host_is_parsed_back(host: str):
    assert parse_host_port(f"{format_host(host)}:80") == (host, 80)
