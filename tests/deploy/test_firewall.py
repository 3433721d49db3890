"""deploy/router.nft: a host that floods the port of a router keeps no robot out."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from helpers.deployment import DEPLOY
from helpers.network_namespaces import NamespaceHosts
from helpers.processes import until

RULES = DEPLOY / "router.nft"
PORT = 7447
WITHIN_S = 60.0
"""A TLS handshake and a query, beside a flood, on a busy machine."""

pytestmark = pytest.mark.netns

FLOOD = """
import socket, sys, time
address, begun = (sys.argv[1], int(sys.argv[2])), False
held = []
while True:
    # 100 connections that send nothing, and new ones that are closed at once, about 500 a second.
    batch = [socket.socket() for _ in range(50)]
    for one in batch:
        one.setblocking(False)
        one.connect_ex(address)
    time.sleep(0.1)
    for one in batch:
        if len(held) < 100:
            held.append(one)
        else:
            one.close()
    if len(held) == 100 and not begun:
        begun = True
        print("flooding", flush=True)
"""


@contextmanager
def running(namespace: str, *command: str) -> Iterator[subprocess.Popen[str]]:
    """A Python process in a namespace, killed at the end."""
    process = subprocess.Popen(
        ["ip", "netns", "exec", namespace, sys.executable, *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def in_namespace(namespace: str, *command: str) -> subprocess.CompletedProcess[str]:
    full = ["ip", "netns", "exec", namespace, *command]
    return subprocess.run(full, capture_output=True, text=True, timeout=WITHIN_S, check=False)


def is_listening(namespace: str) -> bool:
    return f":{PORT}" in in_namespace(namespace, "ss", "-Hltn").stdout


def options(hosts: NamespaceHosts, certs: Path, identity: str) -> Sequence[str]:
    endpoint = f"tls/{hosts.address('fleet')}:{PORT}"
    return ("--mode", "client", "--connect", endpoint, "--certs", str(certs), "--identity", identity)


def test_nft_accepts_the_rules():
    with NamespaceHosts("fleet") as hosts:
        checked = in_namespace(hosts.namespace("fleet"), "nft", "--check", "--file", str(RULES))
    assert (checked.returncode, checked.stderr) == (0, "")


@pytest.mark.processes
@pytest.mark.timeout(240)
def test_a_flood_from_one_address_keeps_no_robot_out(tmp_path: Path):
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    from zstate.fleet.certificates import issue_identities

    certs = tmp_path / "certs"
    with NamespaceHosts("fleet", "robot", "attacker") as hosts, ExitStack() as opened:
        issue_identities(certs, ("router", "r1", "desk"), hosts=("router", hosts.address("fleet")))
        fleet, robot, attacker = map(hosts.namespace, ("fleet", "robot", "attacker"))
        if os.environ.get("ZSTATE_NO_FIREWALL") is None:  # to see what happens without
            loaded = in_namespace(fleet, "nft", "--file", str(RULES))
            assert loaded.returncode == 0, loaded.stderr
        listen = ("--listen", f"tls/0.0.0.0:{PORT}", "--certs", str(certs), "--identity", "router")
        opened.enter_context(running(fleet, "-m", "zstate", "router", *listen))
        until(lambda: is_listening(fleet), WITHIN_S)
        flood = opened.enter_context(running(attacker, "-c", FLOOD, hosts.address("fleet"), str(PORT)))
        assert flood.stdout is not None
        assert flood.stdout.readline() == "flooding\n"

        client = ("-m", "zstate", "publish", "rrbot", "--name", "r1", "--source", "sine")
        opened.enter_context(running(robot, *client, *options(hosts, certs, "r1")))
        reader = (sys.executable, "-m", "zstate", "ls", *options(hosts, certs, "desk"))

        def is_listed() -> bool:
            listed = in_namespace(robot, *reader)
            return listed.returncode == 0 and "r1" in listed.stdout

        until(is_listed, WITHIN_S)
        assert flood.poll() is None
