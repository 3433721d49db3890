from __future__ import annotations

import pickle
from collections.abc import Iterator

import pytest
from helpers.access_routers import join, router_with_users, write_users
from helpers.processes import find_free_port
from helpers.robots import RRBOT

from zstate import StatePublisher, StaticPublisher, connect, discover
from zstate.errors import AccessDenied
from zstate.fleet.acl import AclRoles

USERS = ("r1", "r2", "desk", "stranger")


@pytest.fixture
def endpoint(tmp_path) -> Iterator[str]:
    """The endpoint of a router with the robots r1 and r2, and the viewer desk."""
    with router_with_users(tmp_path, AclRoles(("r1", "r2"), ("desk",)), USERS) as endpoint:
        yield endpoint


def test_robot_may_write_its_own_keys(endpoint: str):
    with (
        join(endpoint, "r1") as session,
        StatePublisher(session, RRBOT, "r1"),
        StaticPublisher(session, "r1", "mount"),
    ):
        assert [info.name for info in discover(session)] == ["r1"]


@pytest.mark.parametrize("user", ["r2", "desk", "stranger"])
def test_denial_names_the_identity_and_the_missing_rule(endpoint: str, user: str):
    with join(endpoint, user) as session:
        with pytest.raises(AccessDenied) as refused:
            StatePublisher(session, RRBOT, "r1")
        text = str(refused.value)
        for needed in (f"user '{user}'", "robot 'r1'", "'r1 writes'", "`zstate acl --robot r1`"):
            assert needed in text
        assert "zstate/r1/@writer/" in refused.value.endpoint
        assert refused.value.reason == "not allowed to write"
        assert str(pickle.loads(pickle.dumps(refused.value))) == text
        with pytest.raises(AccessDenied):
            StaticPublisher(session, "r1", "mount")
        # A publisher that failed to open leaves no token.
        assert discover(session, 0.2) == ()


def test_session_without_credentials_has_no_probe():
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as session,
        StatePublisher(session, RRBOT, "r1"),
    ):
        assert session.probe is None


def test_writer_is_not_refused_after_its_router_closed(tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    settings = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "transport": {"auth": {"usrpwd": {"dictionary_file": str(write_users(tmp_path, ["r1"]))}}},
    }
    router = connect(settings)
    with join(endpoint, "r1") as session:
        router.close()
        with StatePublisher(session, RRBOT, "r1") as publisher:
            publisher.publish([0.1, 0.2])
