import json
import os
import time

import pytest
import zenoh
from helpers.processes import ZENOH_CLOSE_S, Child, until

from zstate.errors import Closed, ConfigError, InvalidInput, NetworkError, PortBusy, Unreachable
from zstate.net.session import connect

ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]) as session:
        print(session.zid)
        sys.stdin.readline()
"""


@pytest.mark.parametrize(
    ("endpoint", "advice"),
    [
        ("localhost:7447", "write 'tcp/localhost:7447'"),
        ("192.168.1.2", "write 'tcp/192.168.1.2:7447'"),
        ("tcp/localhost", "write 'tcp/localhost:7447'"),
        ("tls/localhost", "write 'tls/localhost:7447'"),
        ("tcp/localhost:99999", "write 'tcp/host:port'"),
        ("tcp/localhost:", "write 'tcp/host:port'"),
        ("http://localhost:80", "write 'tcp/host:port'"),
        ("tcp/fe80::1:7447", "write 'tcp/host:port'"),
        ("", "write 'tcp/host:port'"),
        ("unixsock-stream/", "has no address"),
    ],
)
def test_malformed_endpoint_error_shows_the_correct_form(endpoint: str, advice: str):
    for use in ({"endpoints": [endpoint]}, {"listen": [endpoint]}, {"endpoints": endpoint}):
        with pytest.raises(InvalidInput) as caught:
            connect(mode="client", **use)
        assert advice in str(caught.value)
        assert repr(endpoint) in str(caught.value)


def test_invalid_arguments_are_named():
    with pytest.raises(InvalidInput, match="'peer', 'loopback', 'lan', 'client', 'router'"):
        connect(mode="broker")
    with pytest.raises(InvalidInput, match="'client' needs endpoints"):
        connect(mode="client")
    for timeout_s in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InvalidInput, match="timeout_s"):
            connect(timeout_s=timeout_s)


def test_client_without_a_router_gets_unreachable_within_its_timeout(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with pytest.raises(Unreachable, match="zstate router") as caught:
        connect(mode="client", endpoints=endpoint, timeout_s=0.3)
    assert caught.value.endpoints == (endpoint,)
    assert repr(endpoint) in str(caught.value)
    assert isinstance(caught.value, TimeoutError)


def test_a_busy_port_is_named(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        connect(mode="router", listen=endpoint),
        pytest.raises(PortBusy, match="another program listens") as caught,
    ):
        connect(listen=endpoint)
    assert caught.value.endpoint == endpoint


def test_remote_listen_address_error_has_no_source_locations():
    with pytest.raises(NetworkError) as caught:
        connect(listen="tcp/192.0.2.1:7447")  # a block of addresses reserved for documentation
    assert "192.0.2.1" in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_data_passes_a_router_process_and_resumes_after_its_replacement(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router: Child = spawn(ROUTER, endpoint)
    router.line()
    with (
        connect(mode="client", endpoints=endpoint, timeout_s=1.0) as writer,
        connect(mode="client", endpoints=[endpoint]) as reader,
    ):
        inbox = reader.zenoh.declare_subscriber("zstate/r/tf", zenoh.handlers.RingChannel(10))

        def goes_through() -> bool:
            writer.zenoh.put("zstate/r/tf", b"1")
            return inbox.try_recv() is not None

        until(goes_through)
        router.kill()
        until(lambda: not list(writer.zenoh.info.routers_zid()))
        # Longer than the writer's timeout, which is for the first connection only.
        with pytest.raises(Unreachable):
            connect(mode="client", endpoints=endpoint, timeout_s=1.5)
        spawn(ROUTER, endpoint).line()
        until(goes_through)


def test_peer_retries_an_endpoint_that_does_not_answer_yet(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(endpoints=endpoint) as early, connect(listen=endpoint) as late:
        until(lambda: late.zid in [str(zid) for zid in early.zenoh.info.peers_zid()])


def test_close_may_be_called_twice_and_later_use_raises_closed():
    session = connect()
    assert session.zid == str(session.zenoh.zid())
    session.close()
    session.close()
    with pytest.raises(Closed, match="connect"):
        _ = session.zenoh
    assert "closed" in repr(session)


def test_close_with_a_frozen_reader_does_not_wait_until_zenoh_gives_it_up(spawn):
    reader: Child = spawn(
        """
        import sys, zenoh
        from zstate.net.session import connect
        with connect() as session:
            inbox = session.zenoh.declare_subscriber("k", zenoh.handlers.RingChannel(1))
            print("ready")
            sys.stdin.readline()
        """
    )
    reader.line()
    session = connect()
    publisher = session.zenoh.declare_publisher("k", congestion_control=zenoh.CongestionControl.DROP)
    until(lambda: publisher.matching_status.matching)
    reader.freeze()
    for _ in range(2000):
        publisher.put(bytes(10_000))
    started = time.monotonic()
    session.close()
    assert time.monotonic() - started < ZENOH_CLOSE_S


def test_forked_child_is_refused_and_may_close_safely():
    session = connect()
    child = os.fork()
    if child == 0:
        try:
            _ = session.zenoh
        except Closed as closed:
            session.close()
            os._exit(0 if "fork" in str(closed) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    session.zenoh.put("k", b"")
    session.close()


def test_connect_is_refused_in_forks_of_a_process_that_used_zenoh(spawn):
    child: Child = spawn("""
        import os, sys, warnings
        from zstate import ZStateError, connect

        warnings.simplefilter("ignore", DeprecationWarning)  # of any fork with threads

        def try_to_connect():
            try:
                connect()
            except ZStateError as error:
                print(os.getpid(), error)

        def forked(action):
            pid = os.fork()
            if pid == 0:
                action()
                sys.exit()  # which frees what was inherited
            assert os.waitpid(pid, 0)[1] == 0

        print(os.getpid())
        forked(lambda: connect().close())  # before Zenoh was used
        session = connect()
        forked(try_to_connect)
        forked(lambda: None)
        session.close()
        forked(try_to_connect)
        forked(lambda: forked(try_to_connect))
    """)
    parent = child.line()
    for _ in range(3):
        refusal = child.line()
        assert f"process {parent} used Zenoh before this one was forked from it" in refusal
        assert "in the child processes alone" in refusal
        assert "'spawn' or 'forkserver'" in refusal
    assert (child.wait(), child.stderr) == (0, "")


def test_configuration_is_a_file_a_mapping_a_zenoh_config_or_a_variable(
    tmp_path, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    mapping = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
    }
    text = "// a comment, which JSON has not\n" + json.dumps(mapping)
    file = tmp_path / "router.json5"
    file.write_text(text)

    def is_router() -> bool:
        with connect(mode="client", endpoints=endpoint) as client:
            return bool(list(client.zenoh.info.routers_zid()))

    for config in (file, str(file), mapping, zenoh.Config.from_json5(text)):
        with connect(config):
            assert is_router()
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    with connect():
        monkeypatch.delenv("ZENOH_CONFIG")
        assert is_router()


def test_endpoints_and_mode_override_the_configuration(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    quiet = {"mode": "peer", "scouting": {"multicast": {"enabled": False}}}
    with (
        connect(quiet, mode="router", listen=endpoint) as router,
        connect(quiet, mode="client", endpoints=endpoint) as client,
    ):
        assert [str(zid) for zid in client.zenoh.info.routers_zid()] == [router.zid]


def test_invalid_configuration_is_named(tmp_path):
    with pytest.raises(ConfigError, match="bogus"):
        connect({"bogus": 1})
    with pytest.raises(ConfigError, match="missing"):
        connect(tmp_path / "missing.json5")
    with pytest.raises(ConfigError, match=r"is an endpoint, not a file: connect\(mode='client', endpoints="):
        connect("tcp/127.0.0.1:7447")
    latin = tmp_path / "latin.json5"
    latin.write_bytes(b"{mode: 'p\xe9er'}")
    with pytest.raises(ConfigError) as caught:
        connect(latin)
    assert caught.value.path == str(latin)


def test_zenoh_prints_nothing_on_the_terminal(spawn, free_port: int):
    child: Child = spawn(
        """
        import sys
        from zstate.errors import NetworkError
        from zstate.net.session import connect
        unreachable = {"mode": "client", "endpoints": sys.argv[1], "timeout_s": 0.3}
        for arguments in (unreachable, {"listen": "tcp/192.0.2.1:1"}):
            try:
                connect(**arguments)
            except NetworkError:
                print("refused")
        with connect(), connect(endpoints=sys.argv[1]):
            pass
        """,
        f"tcp/127.0.0.1:{free_port}",
    )
    assert child.wait() == 0
    assert [child.line(), child.line()] == ["refused", "refused"]
    assert child.stderr == ""
