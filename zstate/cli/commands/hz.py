"""zstate hz: the rate at which samples come in."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.options import (
    json_option,
    named_robot,
    refuse_topic,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.output.console import fail, print_json, print_status, print_wrapped
from zstate.cli.output.wire_text import is_ros
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.stream_reader import StreamReader, TimedSample
    from zstate.wire.keys import Stream

_SETTLING_S = 0.1


@click.command("hz")
@click.argument("robot", required=False)
@click.option(
    "--stream", type=click.Choice(["joint_states", "tf"]), default="joint_states", show_default=True
)
@click.option(
    "--window",
    type=click.IntRange(min=2),
    default=10_000,
    metavar="N",
    show_default=True,
    help="Measure the last N samples.",
)
@click.option("--once", is_flag=True, help="Print one measurement, of the first second.")
@timeout_option("How long --once waits for the first sample.")
@json_option()
@wire_option
@session_options
def hz_command(
    *,
    network: SessionOptions,
    robot: str | None,
    stream: Stream,
    window: int,
    once: bool,
    timeout: float,
    as_json: bool,
    wire: str,
) -> None:
    """Measure, once a second, the rate at which samples of ROBOT arrive here.

    ROBOT may be left out while one robot is announced. On ROS's side that is the rate of a topic's messages,
    of all nodes together.

    \b
    zstate hz
    zstate hz panda
    zstate hz --wire ros2                              # /joint_states
    zstate hz --wire ros2 --stream tf --once           # /tf
    """
    from zstate.cli.stream_reader import StreamReader

    refuse_topic(robot, wire)
    with ExitStack() as opened:
        session = opened.enter_context(open_session(network, (wire,)))
        tap = opened.enter_context(StreamReader(session, named_robot(session, robot, wire), stream, wire))
        statistics = MessageStatistics(window, of_all=is_ros(wire))
        tap.first(timeout if once else None)
        _listen(tap, MessageStatistics(2), _SETTLING_S)  # what queued up while this process was starting
        if once:
            _show(_measured_once(tap, statistics, timeout), as_json=as_json)
        else:
            _follow(tap, statistics, as_json=as_json)


class MessageStatistics:
    """Rate and spread of the last ``window`` messages: of the newest writer or, if ``of_all``, of all."""

    def __init__(self, window: int, *, of_all: bool = False) -> None:
        from zstate.net.topic_statistics import IntervalStatistics, SequenceGaps

        self._statistics, self._gaps = IntervalStatistics(window), SequenceGaps()
        self._of_all = of_all

    def add(self, tapped: TimedSample) -> None:
        """Count a sample. Several samples of one message are one."""
        from zstate.net.topic_statistics import Received

        sample, statistics = tapped.sample, self._statistics
        if self._gaps.add(sample.session, sample.seq):
            if sample.session != statistics.session and not self._of_all:
                statistics.clear()
            statistics.add(Received(tapped.arrival, sample.stamp, sample.seq, 0), sample.session)

    def facts(self) -> dict[str, Any] | None:
        """What is printed; None before two messages. ``missed`` counts since the start."""
        window = self._statistics.window()
        if window is None or window.rate_hz is None:
            return None
        return {
            "rate_hz": window.rate_hz,
            "min_s": min(window.intervals_s),
            "max_s": max(window.intervals_s),
            "std_dev_s": window.jitter_s,
            "window": len(window.received),
            "missed": self._gaps.missed(),
        }


def _measured_once(tap: StreamReader, statistics: MessageStatistics, timeout_s: float) -> dict[str, Any]:
    deadline = time.monotonic() + timeout_s
    while True:
        _listen(tap, statistics, 1.0)
        facts = statistics.facts()
        if facts is not None:
            return facts
        if time.monotonic() > deadline:
            fail(f"gave up after {timeout_s:g} s: samples came, but no two to measure between")


def _follow(tap: StreamReader, statistics: MessageStatistics, *, as_json: bool) -> NoReturn:
    silent = False
    while True:
        count, facts = _listen(tap, statistics, 1.0), statistics.facts()
        if count and facts is not None:
            _show(facts, as_json=as_json)
        elif not count and not silent:
            print_status(tap.no_sample_text())
        silent = not count


def _listen(tap: StreamReader, statistics: MessageStatistics, seconds: float) -> int:
    """Count what arrives within ``seconds``; how many samples that were."""
    deadline, count = time.monotonic() + seconds, 0
    while (left_s := deadline - time.monotonic()) > 0.0:
        tapped = tap.next(left_s)
        if tapped is not None:
            statistics.add(tapped)
            count += 1
    return count


def _show(facts: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json(facts)
        return
    print_wrapped(f"average rate: {facts['rate_hz']:.3f}")
    missed = f" missed: {facts['missed']}" if facts["missed"] else ""
    print_wrapped(
        f"\tmin: {facts['min_s']:.3f}s max: {facts['max_s']:.3f}s "
        f"std dev: {facts['std_dev_s']:.5f}s window: {facts['window']}{missed}"
    )
