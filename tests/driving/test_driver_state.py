"""How long a driver that publishes no state counts as live."""

from __future__ import annotations

import pytest

from zstate.driving.driver_state import ReceivedState
from zstate.wire.messages import DriverState


@pytest.mark.parametrize(("age_s", "is_live"), [(0.499, True), (0.5, False)])
def test_a_driver_that_has_sent_no_state_for_half_a_second_is_gone_or_frozen(age_s: float, is_live: bool):
    state = DriverState(0, 5, "host", "ready", "", ("elbow",), 250_000_000)
    assert ReceivedState(state, age_s).is_live == is_live
