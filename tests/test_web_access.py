"""AccessCheck: which requests are answered, and which are refused."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from websockets.datastructures import Headers

from zstate.web_access import AccessCheck, AccessDeniedResponse, is_loopback

UPGRADE = {"Upgrade": "websocket", "Connection": "Upgrade"}
HERE = AccessCheck.at("127.0.0.1", 8080)
OPEN = AccessCheck("0.0.0.0", 8080, "secret")


def denied(access: AccessCheck, path: str, headers: Mapping[str, str]) -> AccessDeniedResponse | None:
    return access.check(path, Headers(headers))


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
def test_loopback_server_answers_requests_for_this_machine(host: str):
    assert denied(HERE, "/", {"Host": host}) is None
    for origin in (f"http://{host}", f"http://{host.upper()}", f"http://{host.lower()}"):
        assert denied(HERE, "/", {"Host": host, "Origin": origin, **UPGRADE}) is None


def test_host_header_may_omit_port_80():
    access = AccessCheck.at("::1", 80)
    assert denied(access, "/", {"Host": "localhost"}) is None
    assert denied(access, "/", {"Host": "[::1]"}) is None
    assert denied(HERE, "/", {"Host": "localhost"}) is not None


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
def test_other_names_and_ports_are_refused_even_if_they_resolve_to_loopback(host: str):
    for more in ({}, {"Origin": f"http://{host}", **UPGRADE}):
        refused = denied(HERE, "/", {"Host": host, **more})
        assert refused is not None
        assert refused.status == 403


@pytest.mark.parametrize("name", ["Host", "Origin", "Upgrade", "Cookie"])
@pytest.mark.parametrize("access", [HERE, OPEN])
def test_repeated_decisive_header_is_refused(access: AccessCheck, name: str):
    headers = Headers(
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080", **UPGRADE, "Cookie": "a=b"}
    )
    headers[name] = headers[name]
    refused = access.check("/?token=secret", headers)
    assert refused is not None
    assert refused.status == 400
    assert name in refused.text


@pytest.mark.parametrize(
    "origin", ["null", "", "http://", "127.0.0.1:8080", "http://[::1", "http://a@127.0.0.1:8080"]
)
def test_websocket_is_refused_for_an_origin_without_this_host(origin: str):
    for access, host in ((HERE, "127.0.0.1:8080"), (OPEN, "")):
        refused = denied(access, "/?token=secret", {"Host": host, "Origin": origin, **UPGRADE})
        assert refused is not None
        assert refused.status == 403


@pytest.mark.parametrize("access", [HERE, OPEN])
def test_websocket_is_refused_for_a_page_of_another_site(access: AccessCheck):
    headers = {"Host": "127.0.0.1:8080", "Origin": "https://evil.example", **UPGRADE}
    refused = denied(access, "/?token=secret", headers)
    assert refused is not None
    assert "evil.example" in refused.text


def test_websocket_is_refused_for_another_port_of_the_same_host():
    headers = {"Host": "localhost:8080", "Origin": "http://localhost:3000", **UPGRADE}
    assert denied(HERE, "/", headers) is not None


def test_beyond_loopback_the_token_gives_access_to_page_and_websocket():
    for headers in ({"Host": "robot:8080"}, {"Host": "robot:8080", **UPGRADE}):
        assert denied(OPEN, "/?token=secret", headers) is None
        assert denied(OPEN, "/", {**headers, "Cookie": "a=b; zstate_view_8080=secret"}) is None


WITHOUT_TOKEN = [
    *((query, "") for query in ("", "?token=", "?token=Secret", "?token=secret2", "?other=secret")),
    *((query, "") for query in ("?token=ü", "?token=\udcff")),
    *(("", cookie) for cookie in ("zstate_view_8080=wrong", "other=secret", "=;;=", "zstate_view_8080")),
    ("?token=wrong", "zstate_view_8080=wrong"),
]


@pytest.mark.parametrize(("query", "cookie"), WITHOUT_TOKEN)
def test_beyond_loopback_requests_without_the_token_are_refused(query: str, cookie: str):
    for more in ({}, UPGRADE):
        refused = denied(OPEN, f"/{query}", {"Host": "robot:8080", "Cookie": cookie, **more})
        assert refused is not None
        assert refused.status == 401
        assert "secret" not in refused.text


def test_token_cookie_is_named_after_the_port():
    access = AccessCheck("0.0.0.0", 8081, "secret")
    assert "zstate_view_8081=secret;" in access.headers()["Set-Cookie"]
    assert "HttpOnly" in access.headers()["Set-Cookie"]
    assert "Set-Cookie" not in HERE.headers()


def test_each_server_has_its_own_long_token():
    first, second = AccessCheck.at("0.0.0.0", 80).token, AccessCheck.at("0.0.0.0", 80).token
    assert first != second
    assert first is not None
    assert len(first) > 20


def test_is_loopback_accepts_loopback_names_and_addresses_only():
    assert [host for host in ("127.0.0.1", "127.1.2.3", "localhost", "::1") if not is_loopback(host)] == []
    assert [
        host
        for host in ("0.0.0.0", "::", "192.168.1.2", "robot", "", "127.evil.example", "127.0.0.1.")
        if is_loopback(host)
    ] == []
