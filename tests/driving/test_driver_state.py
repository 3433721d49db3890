"""The state of a driver: durations in it, and how long one that publishes none counts as live."""

from __future__ import annotations

import pytest

from zstate.driving.driver_state import Durations, ReceivedState, Spread
from zstate.driving.messages import DriverState


@pytest.mark.parametrize(("age_s", "is_live"), [(0.499, True), (0.5, False)])
def test_a_driver_that_has_sent_no_state_for_half_a_second_is_gone_or_frozen(age_s: float, is_live: bool):
    state = DriverState(0, 5, "host", "ready", "", ("elbow",), 250_000_000)
    assert ReceivedState(state, age_s).is_live == is_live
    assert str(ReceivedState(state, age_s)) == ("ready" if is_live else "silent for 500.0 ms, was ready")


def test_durations_are_reported_in_microseconds():
    durations = Durations()
    for us in range(1001):
        durations.add(1000 * us)
    assert durations.spread() == pytest.approx(Spread(p50=500.0, p99=990.0, p999=999.0, max=1000.0))
