"""Twin: one more session like a given one, to see through other eyes what became of its words."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import json
from dataclasses import dataclass

import zenoh

from zstate.net.runtime import open_zenoh
from zstate.net.security import Credentials


@dataclass(frozen=True, slots=True)
class Twin:
    """How to open one more client like this one, whom routers take for ``identity``."""

    config: zenoh.Config
    identity: str

    @classmethod
    def of(cls, config: zenoh.Config, credentials: Credentials | None) -> Twin | None:
        """That of the session that ``config`` has opened; None unless it is a client that shows who it is."""
        if credentials is None or not credentials.identity or json.loads(config.get_json("mode")) != "client":
            return None
        config.insert_json5("connect/timeout_ms", "0")  # each endpoint once
        return cls(config, credentials.identity)

    def open(self) -> zenoh.Session:
        """It. Raises zenoh.ZError where nobody answers."""
        return open_zenoh(self.config)
