"""A second session of the same identity, which checks what a router forwards."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

import zenoh

from zstate.net.open import open_zenoh

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials


@dataclass(frozen=True, slots=True)
class ProbeSession:
    """Configuration of a second client with the same ``identity``, which checks what a router forwards."""

    config: zenoh.Config
    identity: str

    @classmethod
    def for_config(cls, config: zenoh.Config, credentials: Credentials) -> ProbeSession | None:
        """For the session that ``config`` opened; None unless it is a client with an identity."""
        if not credentials.identity or json.loads(config.get_json("mode")) != "client":
            return None
        config.insert_json5("connect/timeout_ms", "0")  # each endpoint once
        return cls(config, credentials.identity)

    def open(self) -> zenoh.Session:
        """Open it. Raises zenoh.ZError if no router answers."""
        return open_zenoh(self.config)
