"""A publisher at work, until its time is over or a signal comes, and what it achieved."""

from __future__ import annotations

import queue
import threading

from zstate.cli.console import report_text, say
from zstate.publisher import StatePublisher
from zstate.rate import RateReport
from zstate.sources.source import JointSource


def run(publisher: StatePublisher, source: JointSource, rate_hz: float, seconds: float | None) -> None:
    """``publisher.run``, with its report at the end even when a signal ends it.

    The signal interrupts this thread, which only waits, so that the publisher's loop ends in order.
    """
    outcomes: queue.SimpleQueue[RateReport | Exception] = queue.SimpleQueue()

    def work() -> None:
        try:
            outcomes.put(publisher.run(source, rate_hz, seconds=seconds))
        except Exception as error:  # raised again where it is waited for
            outcomes.put(error)

    worker = threading.Thread(target=work, name="zstate publish", daemon=True)
    worker.start()
    try:
        outcome = outcomes.get()
    except SystemExit:
        publisher.close()
        _tell(outcomes.get(timeout=1.0))
        raise
    _tell(outcome)


def _tell(outcome: RateReport | Exception) -> None:
    if isinstance(outcome, Exception):
        raise outcome
    say(report_text(outcome))
