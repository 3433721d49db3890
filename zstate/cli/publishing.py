"""A publisher at work, until its time is over or a signal comes, and what it achieved."""

from __future__ import annotations

from zstate.cli.output.console import print_wrapped, report_text
from zstate.cli.processes import BackgroundCall
from zstate.nodes.publisher import StatePublisher
from zstate.sources.source import JointSource


def run(publisher: StatePublisher, source: JointSource, rate_hz: float, seconds: float | None) -> None:
    """``publisher.run``, with its report at the end even when a signal ends it.

    The signal interrupts this thread, which only waits, so that the publisher's loop ends in order.
    """
    worker = BackgroundCall("zstate publish", lambda: publisher.run(source, rate_hz, seconds=seconds))
    try:
        report = worker.result()
    except SystemExit:
        publisher.close()
        print_wrapped(report_text(worker.result(1.0)))
        raise
    print_wrapped(report_text(report))
