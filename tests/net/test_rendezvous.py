import os
import signal
import socket
import threading
import time

import pytest
from helpers.processes import DEADLINE_S, Child, until
from helpers.tokens import have_met

from zstate.errors import ConfigError
from zstate.net.rendezvous import rendezvous_addresses, silent_addresses
from zstate.net.session import Session, connect

# Publishes its name on k/<name> until a line arrives on stdin; prints every name it receives.
NODE = """
    import sys, threading
    from zstate.net.session import connect
    from zstate.net.streams import KeyPublisher, StreamSubscriber
    name = sys.argv[1]
    received = set()

    def on_samples(samples):
        for name_ in {sample.payload.decode() for sample in samples} - received:
            received.add(name_)
            print(name_)

    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.readline(), stop.set()), daemon=True).start()
    with connect() as session, StreamSubscriber(session, "k/*", on_samples):
        with KeyPublisher(session, "k/" + name, "text/plain") as out:
            while not stop.wait(0.01):
                out.put(name.encode())
"""


def receives(child: Child, *names: str) -> None:
    waiting = set(names)
    while waiting:
        waiting.discard(child.line())


def test_two_processes_discover_each_other_and_exchange_data(spawn):
    first, second = spawn(NODE, "first"), spawn(NODE, "second")
    receives(first, "second")
    receives(second, "first")
    for child in (first, second):
        child.send_line()
        assert child.wait() == 0
        assert child.stderr == ""


def test_new_process_discovers_the_others_after_the_owner_was_killed(spawn):
    owner = spawn(NODE, "owner")
    receives(owner, "owner")  # it alone has the port before the second comes
    second = spawn(NODE, "second")
    receives(second, "owner")
    owner.kill()
    third = spawn(NODE, "third")
    receives(third, "second")
    receives(second, "third")


def test_processes_that_start_together_all_discover_each_other(spawn):
    names = [f"n{index}" for index in range(5)]
    children = [spawn(NODE, name) for name in names]
    for child in children:
        receives(child, *names)


def test_rendezvous_port_is_taken_over_when_its_session_closes():
    owner, heir = connect(), connect()
    owner.close()
    with connect() as newcomer:
        until(lambda: heir.zid in [str(zid) for zid in newcomer.zenoh.info.peers_zid()])
    heir.close()


def connect_while_closing(owner: Session, delay_s: float) -> Session:
    """A session that opens while ``owner`` closes, which starts ``delay_s`` later."""
    closing = threading.Timer(delay_s, owner.close)
    closing.start()
    newcomer = connect()
    closing.join()
    return newcomer


def test_session_opened_while_the_rendezvous_peer_closes_discovers_later_sessions():
    connect().close()
    started = time.monotonic()
    connect().close()
    usual_s = time.monotonic() - started
    rounds = 30
    for index in range(rounds):  # from both at once to one after the other
        with (
            connect_while_closing(connect(), usual_s * index / rounds) as early,
            connect() as late,
        ):
            until(lambda early=early, late=late: have_met(early, late) and have_met(late, early))


@pytest.fixture
def two_addresses(rendezvous: str, free_port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rendezvous addresses for this test."""
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", f"{rendezvous} 127.0.0.1:{free_port}")


@pytest.mark.usefixtures("two_addresses")
def test_sessions_meet_at_the_next_address_while_the_owner_of_the_first_is_stopped(spawn):
    owner = spawn(NODE, "owner")
    receives(owner, "owner")  # it alone has the port before the others come
    early = spawn(NODE, "early")
    receives(early, "owner")
    owner.freeze()
    try:
        late, _ = spawn(NODE, "late"), spawn(NODE, "last")
        receives(late, "early", "last")
        receives(early, "late")
    finally:
        os.kill(owner.process.pid, signal.SIGCONT)
    receives(owner, "late", "last")
    receives(late, "owner")
    with connect() as newcomer:
        until(lambda: len(list(newcomer.zenoh.info.peers_zid())) >= 4)


@pytest.mark.usefixtures("two_addresses")
def test_session_opened_while_the_owner_is_stopped_has_discovered_the_others(spawn):
    owner = spawn(NODE, "owner")
    receives(owner, "owner")
    with connect() as other:
        until(lambda: len(list(other.zenoh.info.peers_zid())) >= 2)  # the owner and its rendezvous peer
        owner.freeze()
        until(silent_addresses)
        with connect() as newcomer:
            until(lambda: have_met(newcomer, other), DEADLINE_S)
            assert len(silent_addresses()) == 1
        os.kill(owner.process.pid, signal.SIGCONT)
        until(lambda: not silent_addresses())


@pytest.mark.usefixtures("two_addresses")
def test_a_session_that_opens_before_the_answer_is_due_knows_that_there_is_none(
    spawn, monkeypatch: pytest.MonkeyPatch
):
    """As on a busy machine, where an attempt to register takes longer than a session takes to open."""
    monkeypatch.setattr("zstate.net.rendezvous._DISCOVERY_TIMEOUT_S", 0.0)
    owner = spawn(NODE, "owner")
    receives(owner, "owner")
    owner.freeze()
    with connect():
        assert len(silent_addresses()) == 1


def test_second_address_is_unused_while_the_first_answers(
    rendezvous: str, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", f"{rendezvous} 127.0.0.1:{free_port}")
    with connect() as one, connect() as other, socket.socket() as probe:
        until(lambda: have_met(one, other))
        probe.bind(("127.0.0.1", free_port))


def test_session_with_endpoints_does_not_use_the_rendezvous(rendezvous: str, free_port: int):
    host, port = rendezvous.split(":")
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        connect(listen=endpoint),
        connect(endpoints=endpoint),
        socket.socket() as probe,
        pytest.raises(ConnectionRefusedError),
    ):
        probe.connect((host, int(port)))


def test_rendezvous_addresses_are_read_from_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", "box.local:1234")
    assert rendezvous_addresses() == (("box.local", 1234),)
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", "127.0.0.1:1 127.0.0.1:2")
    assert rendezvous_addresses() == (("127.0.0.1", 1), ("127.0.0.1", 2))
    monkeypatch.delenv("ZSTATE_RENDEZVOUS")
    assert rendezvous_addresses() == tuple(("127.0.0.1", port) for port in (7450, 7451, 7452))


@pytest.mark.parametrize(
    "text", ["7450", "box:", "box:0", "box:70000", "tcp/box:1", ":1", " ", "box:1 box", "box:1,box:2"]
)
def test_invalid_rendezvous_address_is_refused(text: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", text)
    with pytest.raises(ConfigError, match="host:port") as caught:
        connect()
    assert repr(text) in str(caught.value)
    assert caught.value.path == "ZSTATE_RENDEZVOUS"
