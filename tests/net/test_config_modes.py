"""Connection modes: refused endpoints and discovery."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.processes import Child, find_free_port, until

from zstate.errors import ConfigError, InvalidInput
from zstate.fleet.certificates import issue_identities
from zstate.net.config import default_config
from zstate.net.session import connect

LAN_PEER = """
    import sys
    from zstate.net.session import connect
    endpoints, listen = sys.argv[1:]
    with connect(mode="lan", endpoints=endpoints.split(), listen=listen.split()) as session:
        print(session.zid)
        for line in sys.stdin:
            print(*(str(zid) for zid in session.zenoh.info.peers_zid()), "")
"""


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/192.168.1.10:7447",
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/[::ffff:192.168.1.10]:7447",
        "tcp/robot.local:7447",
        "udp/224.0.0.1:7447",
        "serial//dev/ttyUSB0#baudrate=9600",
        "tcp/10.0.0.1:7447#iface=lo",
    ],
)
def test_loopback_refuses_endpoints_that_leave_this_host(endpoint: str):
    for use in ({"endpoints": ["tcp/127.0.0.1:1", endpoint]}, {"listen": endpoint}):
        with pytest.raises(InvalidInput) as caught:
            connect(mode="loopback", **use)
        assert f"{endpoint!r} leaves this host" in str(caught.value)


def test_loopback_accepts_endpoints_of_this_host(free_port: int, tmp_path):
    here = [f"tcp/127.0.3.4:{free_port}", f"tcp/localhost:{free_port}", f"unixsock-stream/{tmp_path}/s"]
    with connect(mode="loopback", endpoints=[*here, f"tcp/[::1]:{free_port}"], listen=here[0]):
        pass


def test_the_lease_of_a_link_is_three_seconds_and_1000_connections_may_be_pending_for_as_long():
    settings = default_config("peer", (), ()).get_json
    assert settings("transport/link/tx/lease") == "3000"
    assert settings("transport/unicast/accept_pending") == "1000"
    assert settings("transport/unicast/accept_timeout") == "3000"


def test_loopback_discovers_processes_of_this_host():
    with connect(mode="loopback") as one, connect() as other:
        until(lambda: other.zid in [str(zid) for zid in one.zenoh.info.peers_zid()])


def test_loopback_refuses_a_configuration_and_a_remote_rendezvous(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ConfigError, match="'loopback' stays on this host"):
        connect({}, mode="loopback")
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", "10.0.0.1:7450")
    with pytest.raises(InvalidInput, match=r"'tcp/10\.0\.0\.1:7450' leaves this host"):
        connect(mode="loopback")


def test_client_that_loses_its_router_uses_another(spawn, free_port: int):
    router = """
        import sys
        from zstate.net.session import connect
        with connect(mode="router", listen=sys.argv[1]) as session:
            print(session.zid)
            sys.stdin.readline()
    """
    endpoints = [f"tcp/127.0.0.1:{port}" for port in (free_port, find_free_port())]
    first, second = (spawn(router, endpoint) for endpoint in endpoints)
    zids = {first.line(): first, second.line(): second}
    with connect(mode="client", endpoints=endpoints) as client:

        def routers() -> list[str]:
            return [str(zid) for zid in client.zenoh.info.routers_zid()]

        (lost,) = routers()
        zids.pop(lost).kill()
        until(lambda: routers() == list(zids))


@pytest.fixture
def machines() -> Iterator[Callable[..., Child]]:
    """``start(machine, code, *arguments)``: a Child on machine 0, 1 or 2 of the network 10.98.0.0/24."""
    names = [f"zstate-{os.getpid()}-{number}" for number in range(3)]
    children: list[Child] = []

    def start(machine: int, code: str, *arguments: str) -> Child:
        enter = "import os, sys; os.execvp('ip', ['ip', 'netns', 'exec', *sys.argv[1:]])"
        command = (names[machine], sys.executable, "-u", "-c", textwrap.dedent(code))
        children.append(Child(enter, *command, *arguments))
        return children[-1]

    try:
        _wire_up(names)
        yield start
    finally:
        for child in children:
            child.kill()
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False)


def _wire_up(names: list[str]) -> None:
    """Creates a switch in the first namespace, with a cable to each of the others."""
    for name in names:
        _ip("netns", "add", name)
    _ip("-n", names[0], "link", "add", "switch", "type", "bridge")
    _ip("-n", names[0], "link", "set", "switch", "up", "address", "02:00:00:00:00:aa")
    _ip("-n", names[0], "addr", "add", "10.98.0.1/24", "dev", "switch")
    for number, name in enumerate(names[1:], 2):
        cable = ("link", "add", f"cable{number}", "type", "veth", "peer", "name", "lan", "netns", name)
        _ip("-n", names[0], *cable)
        _ip("-n", names[0], "link", "set", f"cable{number}", "up", "master", "switch")
        _ip("-n", name, "addr", "add", f"10.98.0.{number}/24", "dev", "lan")
        _ip("-n", name, "link", "set", "lan", "up")
    for name in names:
        _ip("-n", name, "link", "set", "lo", "up")


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def discovers(child: Child, zid: str) -> bool:
    child.send_line()
    return zid in child.line().split()


@pytest.mark.netns
def test_lan_machines_discover_each_other_by_multicast(machines):
    children = [machines(number, LAN_PEER, "", "") for number in range(3)]
    zids = [child.line() for child in children]
    for child, own in zip(children, zids, strict=True):
        for zid in zids:
            until(lambda child=child, own=own, zid=zid: zid == own or discovers(child, zid))


@pytest.mark.netns
def test_without_multicast_lan_machines_meet_through_a_common_peer(machines):
    for number, link in ((1, "lan"), (2, "lan"), (0, "switch")):
        turn_off = f"import os; os.execvp('ip', 'ip link set {link} multicast off'.split())"
        assert machines(number, turn_off).wait() == 0
    hub = machines(0, LAN_PEER, "", "tcp/0.0.0.0:7448")
    hub.line()
    one, other = (machines(number, LAN_PEER, "tcp/10.98.0.1:7448", "") for number in (1, 2))
    zids = one.line(), other.line()
    until(lambda: discovers(one, zids[1]))
    until(lambda: discovers(other, zids[0]))


SECURED = """
    import logging, sys
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import connect
    logging.basicConfig(format="%(message)s")
    folder, name = sys.argv[1:]
    credentials = Credentials.from_folder(folder, name) if folder else None
    with connect(mode="lan", credentials=credentials) as session:
        print(session.zid)
        for line in sys.stdin:
            print(*(str(zid) for zid in session.zenoh.info.peers_zid()), "")
"""


@pytest.fixture
def folders(tmp_path: Path) -> tuple[str, str]:
    """The identities r1 and r2 of the machines 0 and 1, and of another authority."""
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    ours, theirs = (str(tmp_path / name) for name in ("ours", "theirs"))
    for folder in (ours, theirs):
        issue_identities(folder, ["r1", "r2"], hosts=["10.98.0.1", "10.98.0.2"])
    return ours, theirs


@pytest.mark.netns
def test_lan_machines_with_certificates_of_one_authority_connect(machines, folders: tuple[str, str]):
    one, other = (machines(number, SECURED, folders[0], f"r{number + 1}") for number in (0, 1))
    zids = one.line(), other.line()
    until(lambda: discovers(one, zids[1]))
    until(lambda: discovers(other, zids[0]))


@pytest.mark.netns
@pytest.mark.parametrize(
    ("has_certificate", "told_us", "told_them"),
    [
        (True, "its certificate is not signed by", "its certificate is not signed by"),
        (False, "it does not use TLS", "and this session was given no other to trust"),
    ],
)
def test_lan_machines_of_different_authorities_are_refused_with_the_reason(
    machines, folders: tuple[str, str], has_certificate: bool, told_us: str, told_them: str
):
    ours = machines(0, SECURED, folders[0], "r1")
    theirs = machines(1, SECURED, folders[1] if has_certificate else "", "r2")
    zids = ours.line(), theirs.line()
    until(lambda: told_us in ours.stderr and "/10.98.0.2:" in ours.stderr)
    until(lambda: told_them in theirs.stderr and "tls/10.98.0.1:" in theirs.stderr)
    assert not discovers(ours, zids[1])
    assert not discovers(theirs, zids[0])
