"""Routers with different access control, and checks of what their clients can do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import zenoh
from helpers.processes import find_free_port, until
from helpers.robots import SampleCollector

from zstate.fleet.acl import AclRoles, access_control
from zstate.net.security.credentials import Credentials
from zstate.net.session import Session, connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher

ROUTERS_PROGRAM = """
    import sys
    from pathlib import Path
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import connect
    folder, *endpoints = sys.argv[1:]
    users = Path(folder) / "users"
    kinds = (
        Credentials.from_folder(folder, "router"),
        Credentials.from_folder(folder, "router", users=users),
        Credentials.from_folder(folder, "expired"),
        Credentials.from_folder(folder, "early"),
        Credentials(users=users),
        None,
    )
    sessions = [connect(mode="router", listen=e, credentials=c) for e, c in zip(endpoints, kinds)]
    print("ready")
    sys.stdin.readline()
"""


@dataclass(frozen=True)
class AccessRouters:
    """Running routers by kind, and the folders of two certificate authorities."""

    folder: Path
    strangers: Path
    ports: dict[str, int]

    def tls(self, kind: str, host: str = "127.0.0.1") -> str:
        return f"tls/{host}:{self.ports[kind]}"

    def tcp(self, kind: str) -> str:
        return f"tcp/127.0.0.1:{self.ports[kind]}"

    def identity(self, name: str, user: str | None = None, password: str | None = None) -> Credentials:
        return Credentials.from_folder(self.folder, name, user=user, password=password)


def write_users(folder: Path, users: Iterable[str]) -> Path:
    """A file of ``users``, all with the password "secret"."""
    path = folder / "users.txt"
    path.touch(0o600)
    path.write_text("".join(f"{name}:secret\n" for name in users))
    return path


@contextmanager
def router_with_users(folder: Path, roles: AclRoles, users: Iterable[str]) -> Iterator[str]:
    """A router that ``users`` can join, with the access control of ``roles``; yields its endpoint."""
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    settings = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": {"enabled": False},
        "transport": {"auth": {"usrpwd": {"dictionary_file": str(write_users(folder, users))}}},
        "access_control": access_control(roles),
    }
    with connect(settings):
        yield endpoint


def join(endpoint: str, user: str) -> Session:
    """A client with the identity ``user``."""
    return connect(mode="client", endpoints=endpoint, credentials=Credentials(user=user, password="secret"))


def assert_only_allowed_writes_arrive(
    writes: Sequence[tuple[str, str, bool]], writers: Mapping[str, Session], viewer: Session, *keys: str
) -> None:
    """Puts samples as each user of ``writes`` on its key; only the allowed ones arrive at ``viewer``."""
    collectors = [SampleCollector(viewer, key) for key in keys]
    allowed = {(user.encode(), key) for user, key, is_allowed in writes if is_allowed}

    def received() -> list[tuple[bytes, str]]:
        return [(one.payload, one.key) for collector in collectors for one in collector.arrivals]

    def publish_until_received() -> bool:
        for user, key, _ in writes:
            writers[user].zenoh.put(key, user.encode())
        return set(received()) >= allowed and len(received()) >= 10 * len(allowed)

    until(publish_until_received)
    assert set(received()) == allowed


def publish_and_check(publisher: StatePublisher, listener: TransformListener) -> bool:
    """Publishes a sample of rrbot; whether the listener can look up a moving link, by full names.

    An edge of another robot's frame ``base`` may have been in the buffer before its owner was known.
    """
    publisher.publish([0.1, 0.2])
    return listener.buffer.can_lookup(f"{publisher.robot}/base", f"{publisher.robot}/lower")


def replies(session: Session, key: str) -> list[str]:
    """The replies to a query of all queryables on ``key``."""
    answers = session.zenoh.get(key, target=zenoh.QueryTarget.ALL, timeout=1.0)
    return [answer.ok.payload.to_string() for answer in answers if answer.ok]
