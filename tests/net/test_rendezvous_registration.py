import threading

import pytest
import zenoh
from helpers.processes import until

from zstate.net.config import default_config
from zstate.net.open import open_zenoh
from zstate.net.rendezvous import RendezvousRegistration, free_endpoint
from zstate.net.session import connect


@pytest.fixture
def peer(rendezvous: str) -> str:
    """The endpoint of the rendezvous peer of this test."""
    return f"tcp/{rendezvous}"


def are_linked(one: zenoh.Session, other: zenoh.Session) -> bool:
    return str(other.zid()) in [str(zid) for zid in one.info.peers_zid()]


def test_unregistered_session_registers_and_discovers_all_sessions(peer: str):
    endpoint, stop = free_endpoint(), threading.Event()
    with (
        connect() as owner,
        connect() as other,
        open_zenoh(default_config("peer", (), [endpoint])) as session,
    ):
        registration = RendezvousRegistration(session, endpoint, peer)

        def has_met_both() -> bool:
            registration.refresh(stop)
            return are_linked(session, owner.zenoh) and are_linked(session, other.zenoh)

        assert not are_linked(session, other.zenoh)
        until(has_met_both)


def test_link_to_a_process_without_a_rendezvous_peer_is_not_a_registration(peer: str):
    elsewhere, endpoint, stop = free_endpoint(), free_endpoint(), threading.Event()
    with (
        open_zenoh(default_config("peer", (), [elsewhere])) as ghost,
        open_zenoh(default_config("peer", [elsewhere], [endpoint])) as haunted,
    ):
        until(lambda: are_linked(haunted, ghost))
        registration = RendezvousRegistration(haunted, endpoint, peer)
        with connect() as other:

            def has_met() -> bool:
                registration.refresh(stop)
                return are_linked(haunted, other.zenoh)

            until(has_met)


def test_registration_ends_when_stop_is_set(peer: str):
    endpoint, stop = free_endpoint(), threading.Event()
    with open_zenoh(default_config("peer", (), [endpoint])) as session:
        registration = RendezvousRegistration(session, endpoint, peer)  # no process runs the peer

        def refresh_until_stop() -> None:
            while not stop.is_set():
                registration.refresh(stop)

        refreshing = threading.Thread(target=refresh_until_stop)
        refreshing.start()
        until(lambda: list(session.info.peers_zid()))
        stop.set()
        until(lambda: not refreshing.is_alive())


def test_refresh_of_a_closed_session_raises(peer: str):
    endpoint = free_endpoint()
    session = open_zenoh(default_config("peer", (), [endpoint]))
    registration = RendezvousRegistration(session, endpoint, peer)
    session.close()
    with pytest.raises(zenoh.ZError, match="closed"):
        until(lambda: registration.refresh(threading.Event()))
