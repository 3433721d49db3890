"""Fixtures of the network tests: routers that accept some sessions and refuse others."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import pytest
from helpers.processes import Child, find_free_port

if TYPE_CHECKING:
    from helpers.access_routers import AccessRouters


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AccessRouters]:
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    from helpers.access_routers import ROUTERS_PROGRAM, AccessRouters

    from zstate.fleet.certificates import issue_identities

    now, two_days = datetime.now(UTC), timedelta(days=2)
    folder, strangers = tmp_path_factory.mktemp("fleet"), tmp_path_factory.mktemp("strangers")
    issue_identities(folder, ["router", "r1"])
    issue_identities(folder, ["expired"], days=1, valid_from=now - two_days)
    issue_identities(folder, ["early"], days=1, valid_from=now + two_days)
    issue_identities(strangers, ["r1"])
    (folder / "users").touch(0o600)
    (folder / "users").write_text("alice:wonder\nbob:build:it\n")
    names = ("mtls", "mtls and users", "expired", "early", "users", "open")
    fleet = AccessRouters(folder, strangers, {name: find_free_port() for name in names})
    is_plain = {"users", "open"}
    endpoints = [fleet.tcp(name) if name in is_plain else fleet.tls(name) for name in names]
    child = Child(ROUTERS_PROGRAM, str(folder), *endpoints)
    try:
        assert child.line() == "ready"
        yield fleet
    finally:
        child.kill()
