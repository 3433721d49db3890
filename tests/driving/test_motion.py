"""A motion as its commander sees it, by the states of its driver."""

from __future__ import annotations

import pytest

from zstate.driving.messages import DriverState, MotionOutcome, OutcomeName
from zstate.driving.motion import Motion

HOST, IDENTITY = 5, (7, 3)


def state(motion: tuple[int, int] | None, progress: float, *outcomes: MotionOutcome) -> DriverState:
    return DriverState(
        *(0, HOST, "host", "active", "", ("elbow",), 250_000_000),
        motion=motion,
        progress=progress,
        outcomes=outcomes,
    )


@pytest.mark.parametrize(
    ("name", "progress"),
    [("reached", 1.0), ("aborted", 0.4), ("cancelled", 0.4), ("replaced", 0.4), ("stopped", 0.4)],
)
def test_the_progress_of_a_motion_that_ends_early_is_where_it_has_ended(name: OutcomeName, progress: float):
    motion = Motion("arm", IDENTITY, HOST, lambda: None)
    motion.update(state(IDENTITY, 0.4))
    motion.update(state(None, 0.0, MotionOutcome(*IDENTITY, name, "")))
    assert motion.outcome is not None
    assert (motion.outcome.name, motion.progress) == (name, progress)
