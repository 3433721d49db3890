"""Routers with different access control."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zstate.net.security.credentials import Credentials

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
