"""What the tests of `zstate doctor` have: a shorter measurement of rates."""

from __future__ import annotations

import pytest

from zstate.cli.doctor import robot_probe


@pytest.fixture(autouse=True)
def short_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates are measured for half a second by doctors of this process; robots of these tests have 100 Hz."""
    assert robot_probe._MIN_WINDOW_S == 1.2
    monkeypatch.setattr(robot_probe, "_MIN_WINDOW_S", 0.5)


@pytest.fixture
def whole_window(short_window: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The window of users: writers publish their status once a second."""
    monkeypatch.setattr(robot_probe, "_MIN_WINDOW_S", 1.2)
