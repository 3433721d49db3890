from __future__ import annotations

import pytest

from zstate.errors import InvalidInput
from zstate.metrics.endpoint import BindAddress


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
def test_a_port_alone_is_one_of_this_host(text: str, address: tuple[str, int]):
    assert BindAddress.parse(text) == address


@pytest.mark.parametrize("text", ["", "65536", "-1", "host:", "::1:9100", "tcp/1.2.3.4:5", "a b:1", "\u0661"])
def test_what_is_neither_port_nor_host_and_port_is_refused_with_the_right_form(text: str):
    with pytest.raises(InvalidInput, match=r"for instance 9100, or 0\.0\.0\.0:9100"):
        BindAddress.parse(text)
