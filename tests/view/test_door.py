"""Who is let in, and who is not."""

from __future__ import annotations

import pytest

from zstate.view.door import Door, is_loopback

UPGRADE = {"Upgrade": "websocket", "Connection": "Upgrade"}
HERE = Door.at("127.0.0.1")
OPEN = Door("0.0.0.0", "secret")


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:9000", "[::1]:8080", "localhost"])
def test_on_loopback_whoever_asks_for_this_machine_comes_in(host: str):
    assert HERE.objection("/", {"Host": host}) is None
    assert HERE.objection("/", {"Host": host, "Origin": f"http://{host}", **UPGRADE}) is None


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8080", "localhost.evil.example", "", "::"])
def test_a_name_that_leads_to_loopback_from_elsewhere_does_not_come_in(host: str):
    refused = HERE.objection("/", {"Host": host})
    assert refused is not None
    assert refused.status == 403


@pytest.mark.parametrize("door", [HERE, OPEN])
def test_a_page_from_elsewhere_opens_no_websocket(door: Door):
    headers = {"Host": "127.0.0.1:8080", "Origin": "https://evil.example", **UPGRADE}
    refused = door.objection("/?token=secret", headers)
    assert refused is not None
    assert "evil.example" in refused.text


def test_another_port_of_the_same_host_is_elsewhere():
    headers = {"Host": "localhost:8080", "Origin": "http://localhost:3000", **UPGRADE}
    assert HERE.objection("/", headers) is not None


def test_beyond_loopback_the_token_opens_page_and_websocket():
    for headers in ({"Host": "robot:8080"}, {"Host": "robot:8080", **UPGRADE}):
        assert OPEN.objection("/?token=secret", headers) is None
        assert OPEN.objection("/", {**headers, "Cookie": "a=b; zstate_view_8080=secret"}) is None


@pytest.mark.parametrize(
    "query", ["", "?token=", "?token=Secret", "?token=secret2", "?other=secret", "?token=ü"]
)
@pytest.mark.parametrize("cookie", ["", "zstate_view_8080=wrong", "other=secret", "=;;=", "zstate_view_8080"])
@pytest.mark.parametrize("more", [{}, UPGRADE])
def test_beyond_loopback_nothing_else_does(query: str, cookie: str, more: dict[str, str]):
    refused = OPEN.objection(f"/{query}", {"Host": "robot:8080", "Cookie": cookie, **more})
    assert refused is not None
    assert refused.status == 401
    assert "secret" not in refused.text


def test_the_token_is_kept_for_the_port_it_belongs_to():
    assert "zstate_view_8081=secret;" in OPEN.headers(8081)["Set-Cookie"]
    assert "HttpOnly" in OPEN.headers(8081)["Set-Cookie"]
    assert "Set-Cookie" not in HERE.headers(8080)


def test_two_doors_have_two_tokens_which_nobody_guesses():
    first, second = Door.at("0.0.0.0").token, Door.at("0.0.0.0").token
    assert first != second
    assert first is not None
    assert len(first) > 20


def test_loopback_is_known_by_its_names():
    assert [host for host in ("127.0.0.1", "127.1.2.3", "localhost", "::1") if not is_loopback(host)] == []
    assert [host for host in ("0.0.0.0", "::", "192.168.1.2", "robot", "") if is_loopback(host)] == []
