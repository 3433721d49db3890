import threading

import pytest
import zenoh
from helpers.processes import until

from zstate.net.config import default_config
from zstate.net.open import open_zenoh
from zstate.net.rendezvous import RendezvousRegistration, free_endpoint
from zstate.net.session import connect


@pytest.fixture
def lobby(rendezvous: str) -> str:
    """Where the lobby of this test is to be."""
    return f"tcp/{rendezvous}"


def are_linked(one: zenoh.Session, other: zenoh.Session) -> bool:
    return str(other.zid()) in [str(zid) for zid in one.info.peers_zid()]


def test_a_session_that_the_lobby_does_not_know_is_introduced_and_meets_everybody(lobby: str):
    endpoint, stop = free_endpoint(), threading.Event()
    with (
        connect() as keeper,
        connect() as guest,
        open_zenoh(default_config("peer", (), [endpoint])) as stranger,
    ):
        membership = RendezvousRegistration(stranger, endpoint, lobby)

        def has_met_both() -> bool:
            membership.refresh(stop)
            return are_linked(stranger, keeper.zenoh) and are_linked(stranger, guest.zenoh)

        assert not are_linked(stranger, guest.zenoh)
        until(has_met_both)


def test_a_link_to_somebody_who_keeps_no_lobby_does_not_count(lobby: str):
    elsewhere, endpoint, stop = free_endpoint(), free_endpoint(), threading.Event()
    with (
        open_zenoh(default_config("peer", (), [elsewhere])) as ghost,
        open_zenoh(default_config("peer", [elsewhere], [endpoint])) as haunted,
    ):
        until(lambda: are_linked(haunted, ghost))
        membership = RendezvousRegistration(haunted, endpoint, lobby)
        with connect() as guest:

            def has_met() -> bool:
                membership.refresh(stop)
                return are_linked(haunted, guest.zenoh)

            until(has_met)


def test_an_introduction_ends_as_soon_as_it_is_told_to(lobby: str):
    endpoint, stop = free_endpoint(), threading.Event()
    with open_zenoh(default_config("peer", (), [endpoint])) as stranger:
        membership = RendezvousRegistration(stranger, endpoint, lobby)  # of a lobby that nobody keeps

        def renew() -> None:
            while not stop.is_set():
                membership.refresh(stop)

        renewing = threading.Thread(target=renew)
        renewing.start()
        until(lambda: list(stranger.info.peers_zid()))
        stop.set()
        until(lambda: not renewing.is_alive())


def test_a_session_that_is_closed_has_no_membership_any_more(lobby: str):
    endpoint = free_endpoint()
    stranger = open_zenoh(default_config("peer", (), [endpoint]))
    membership = RendezvousRegistration(stranger, endpoint, lobby)
    stranger.close()
    with pytest.raises(zenoh.ZError, match="closed"):
        until(lambda: membership.refresh(threading.Event()))
