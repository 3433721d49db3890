"""Who is let in, and who is not."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from websockets.datastructures import Headers

from zstate.view.access import AccessCheck, AccessDeniedResponse, is_loopback

UPGRADE = {"Upgrade": "websocket", "Connection": "Upgrade"}
HERE = AccessCheck.at("127.0.0.1", 8080)
OPEN = AccessCheck("0.0.0.0", 8080, "secret")


def objection(door: AccessCheck, path: str, headers: Mapping[str, str]) -> AccessDeniedResponse | None:
    return door.check(path, Headers(headers))


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1:8080",
        "127.8.7.6:8080",
        "localhost:8080",
        "LocalHost:8080",
        "[::1]:8080",
        "[0:0:0:0:0:0:0:1]:8080",
    ],
)
def test_on_loopback_whoever_asks_for_this_machine_comes_in(host: str):
    assert objection(HERE, "/", {"Host": host}) is None
    for origin in (f"http://{host}", f"http://{host.upper()}", f"http://{host.lower()}"):
        assert objection(HERE, "/", {"Host": host, "Origin": origin, **UPGRADE}) is None


def test_the_port_of_http_need_not_be_named():
    door = AccessCheck.at("::1", 80)
    assert objection(door, "/", {"Host": "localhost"}) is None
    assert objection(door, "/", {"Host": "[::1]"}) is None
    assert objection(HERE, "/", {"Host": "localhost"}) is not None


@pytest.mark.parametrize(
    "host",
    [
        "",
        ":8080",
        "::",
        "evil.example:8080",
        "localhost.evil.example:8080",
        "127.0.0.1.evil.example:8080",
        "127.evil.example:8080",
        "127.0.0.1.:8080",
        "localhost.:8080",
        "127.0.0.256:8080",
        "0127.0.0.1:8080",
        "127.1:8080",
        "0.0.0.0:8080",
        "[::]:8080",
        "[::1.evil.example]:8080",
        "[::1:8080",
        "::1:8080",
        "evil.example@127.0.0.1:8080",
        "127.0.0.1:8080@evil.example",
        "127.0.0.1:8080.evil.example",
        "127.0.0.1:8080/evil.example",
        "127.0.0.1\\evil.example:8080",
        "127.0.0.1:8080, evil.example",
        "127.0.0.1",
        "127.0.0.1:80",
        "127.0.0.1:8081",
        "127.0.0.1:99999",
        "127.0.0.1:x",
    ],
)
def test_another_name_or_port_does_not_come_in_even_if_it_leads_to_loopback(host: str):
    for more in ({}, {"Origin": f"http://{host}", **UPGRADE}):
        refused = objection(HERE, "/", {"Host": host, **more})
        assert refused is not None
        assert refused.status == 403


@pytest.mark.parametrize("name", ["Host", "Origin", "Upgrade", "Cookie"])
@pytest.mark.parametrize("door", [HERE, OPEN])
def test_a_header_that_decides_comes_once(door: AccessCheck, name: str):
    headers = Headers(
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", **UPGRADE, "Cookie": "a=b"}
    )
    headers[name] = headers[name]
    refused = door.check("/?token=secret", headers)
    assert refused is not None
    assert refused.status == 400
    assert name in refused.text


@pytest.mark.parametrize(
    "origin", ["null", "", "http://", "127.0.0.1:8080", "http://[::1", "http://a@127.0.0.1:8080"]
)
def test_an_origin_without_this_host_opens_no_websocket(origin: str):
    for door, host in ((HERE, "127.0.0.1:8080"), (OPEN, "")):
        refused = objection(door, "/?token=secret", {"Host": host, "Origin": origin, **UPGRADE})
        assert refused is not None
        assert refused.status == 403


@pytest.mark.parametrize("door", [HERE, OPEN])
def test_a_page_from_elsewhere_opens_no_websocket(door: AccessCheck):
    headers = {"Host": "127.0.0.1:8080", "Origin": "https://evil.example", **UPGRADE}
    refused = objection(door, "/?token=secret", headers)
    assert refused is not None
    assert "evil.example" in refused.text


def test_another_port_of_the_same_host_is_elsewhere():
    headers = {"Host": "localhost:8080", "Origin": "http://localhost:3000", **UPGRADE}
    assert objection(HERE, "/", headers) is not None


def test_beyond_loopback_the_token_opens_page_and_websocket():
    for headers in ({"Host": "robot:8080"}, {"Host": "robot:8080", **UPGRADE}):
        assert objection(OPEN, "/?token=secret", headers) is None
        assert objection(OPEN, "/", {**headers, "Cookie": "a=b; zstate_view_8080=secret"}) is None


@pytest.mark.parametrize(
    "query", ["", "?token=", "?token=Secret", "?token=secret2", "?other=secret", "?token=ü", "?token=\udcff"]
)
@pytest.mark.parametrize(
    "cookie",
    ["", "zstate_view_8080=wrong", "other=secret", "=;;=", "zstate_view_8080"],
)
@pytest.mark.parametrize("more", [{}, UPGRADE])
def test_beyond_loopback_nothing_else_does(query: str, cookie: str, more: dict[str, str]):
    refused = objection(OPEN, f"/{query}", {"Host": "robot:8080", "Cookie": cookie, **more})
    assert refused is not None
    assert refused.status == 401
    assert "secret" not in refused.text


def test_the_token_is_kept_for_the_port_it_belongs_to():
    door = AccessCheck("0.0.0.0", 8081, "secret")
    assert "zstate_view_8081=secret;" in door.headers()["Set-Cookie"]
    assert "HttpOnly" in door.headers()["Set-Cookie"]
    assert "Set-Cookie" not in HERE.headers()


def test_two_doors_have_two_tokens_which_nobody_guesses():
    first, second = AccessCheck.at("0.0.0.0", 80).token, AccessCheck.at("0.0.0.0", 80).token
    assert first != second
    assert first is not None
    assert len(first) > 20


def test_loopback_is_known_by_its_names():
    assert [host for host in ("127.0.0.1", "127.1.2.3", "localhost", "::1") if not is_loopback(host)] == []
    assert [
        host
        for host in ("0.0.0.0", "::", "192.168.1.2", "robot", "", "127.evil.example", "127.0.0.1.")
        if is_loopback(host)
    ] == []
