"""Fixtures of the fault suite: processes with queries, and networks that can be cut."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from helpers.fault_processes import Start, starter
from helpers.processes import Child


@pytest.fixture
def start(spawn: Callable[..., Child]) -> Start:
    return starter(spawn)


@pytest.fixture
def endpoint(free_port: int) -> str:
    return f"tcp/127.0.0.1:{free_port}"
