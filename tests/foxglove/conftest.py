"""A server of robots on the sessions of a test."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from zstate.foxglove.bridge import FoxgloveBridge
from zstate.foxglove.server import FoxgloveServer
from zstate.net.session import Session


@pytest.fixture
def serve(sessions: tuple[Session, Session]) -> Iterator[Any]:
    """``serve(*robots)`` serves robots on a free port; the server."""
    with ExitStack() as opened:

        def serving(*robots: str, **options: Any) -> FoxgloveServer:
            server = opened.enter_context(FoxgloveServer(port=0))
            opened.enter_context(FoxgloveBridge(sessions[1], server, robots, **options))
            return server

        yield serving
