"""Identities, and the services of compose.yaml as processes."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.deployment import Deployment


@pytest.fixture
def certs(tmp_path) -> Path:
    """Test identities of a router, the robots r1 and r2, and the viewer desk."""
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    from zstate.fleet.certificates import issue_identities

    issue_identities(tmp_path / "certs", ("router", "r1", "r2", "desk"), hosts=("router",))
    return tmp_path / "certs"


@pytest.fixture
def deployment(certs: Path) -> Deployment:
    return Deployment(certs.parent)
