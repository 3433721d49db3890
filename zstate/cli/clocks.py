"""Which time a command keeps."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from zstate.cli.output.console import print_status
from zstate.clock import SYSTEM, Clock, SystemClock, stamp_text
from zstate.errors import NoClock

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.simulated_clock import SimulatedClock

# Whoever tells the time does it many times a second; waiting is mentioned only afterwards.
_GRACE_S = 0.5


@contextmanager
def open_clock(
    session: Session, kind: str | None, wire: str, *, timeout_s: float | None = None
) -> Generator[Clock | None]:
    """The clock that ``--clock`` asks for, once it goes; None where nothing was said.

    A simulated time is heard on ``wire``. Raises NoClock when nobody tells it within ``timeout_s``.
    """
    if kind is None or kind == SYSTEM:
        yield None if kind is None else SystemClock()
        return
    from zstate.simulated_clock import SimulatedClock

    with SimulatedClock(session, wire) as clock:
        _await(clock, timeout_s)
        yield clock


def _await(clock: SimulatedClock, timeout_s: float | None) -> None:
    grace_s = _GRACE_S if timeout_s is None else min(timeout_s, _GRACE_S)
    try:
        clock.wait(grace_s)
    except NoClock:
        print_status(f"waiting for the simulated time on {clock.key} ...")
        clock.wait(timeout_s)
        print_status(f"heard {clock.key}: it is {stamp_text(clock.now())}")
