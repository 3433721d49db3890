"""zstate hz: rate of arriving samples."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

import click

from zstate.cli import options
from zstate.cli.options import named_robot, refuse_topic
from zstate.cli.output.console import fail, print_json, print_status, print_wrapped
from zstate.cli.output.wire_text import is_ros
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.stream_reader import StreamReader, TimedSample
    from zstate.net.topic_statistics import Window
    from zstate.streams import StreamName

_SETTLING_S = 0.1


@click.command("hz")
@click.argument("robot", required=False)
@click.option(
    "--stream",
    type=options.StreamChoice(lambda row: row.is_sampled),
    default="joint_states",
    show_default=True,
)
@click.option(
    "--window",
    type=click.IntRange(min=2),
    default=10_000,
    metavar="N",
    show_default=True,
    help="Measure the last N samples.",
)
@click.option("--once", is_flag=True, help="Print one measurement, of the first second, and exit.")
@options.seconds_option
@options.timeout_option("How long --once waits for the first sample [s].")
@options.json_option()
@options.wire_option
@options.session_options
def hz_command(
    *,
    network: SessionOptions,
    robot: str | None,
    stream: StreamName,
    window: int,
    once: bool,
    seconds: float | None,
    timeout: float,
    as_json: bool,
    wire: str,
) -> None:
    """Print once a second the rate at which samples of ROBOT arrive.

    ROBOT may be left out if only one robot is announced. On a ROS wire this is the rate of the messages of a
    topic, from all nodes together; that of transforms, odometry, partial joint states and sensors is the rate
    of all their writers together.

    \b
    zstate hz
    zstate hz panda
    zstate hz panda --stream transforms --seconds 10
    zstate hz diffbot --stream scan
    zstate hz --wire ros2                              # /joint_states
    zstate hz --wire ros2 --stream tf --once           # /tf
    """
    from zstate.cli.stream_reader import StreamReader
    from zstate.net.sites import discover_sites
    from zstate.stream_registry import is_named
    from zstate.wire.protocol import carrier
    from zstate.wire.registry import get_wire

    of_all = is_ros(wire) or is_named(stream)
    stream = carrier(get_wire(wire), stream)
    options.check_end(seconds, once=once)
    refuse_topic(robot, wire)
    with (
        open_session(network, (wire,)) as session,
        StreamReader(session, named_robot(session, robot, wire), stream, wire) as reader,
    ):
        thinning = None if is_ros(wire) else discover_sites(session).thinning(reader.robot, stream)
        statistics = MessageStatistics(window, of_all=of_all)
        reader.first(timeout if once else seconds)
        _read_for(_SETTLING_S, reader, MessageStatistics(2))  # what queued up while this process was starting
        deadline, silent = time.monotonic() + timeout, False
        end = math.inf if seconds is None else time.monotonic() + seconds
        while time.monotonic() < end:
            count, facts = _read_for(1.0, reader, statistics), statistics.facts()
            if facts is not None and (count or once):
                newest = statistics.window()
                is_thinned = facts["missed"] and thinning is not None and thinning.explains(newest)
                by_site = thinning if is_thinned else None
                if as_json:
                    print_json({**facts, "thinned_by": None if by_site is None else by_site.site})
                else:
                    missed = f" missed: {facts['missed']}" if facts["missed"] else ""
                    if by_site is not None:
                        missed = f" {by_site}"
                    print_wrapped(f"average rate: {facts['rate_hz']:.3f}")
                    print_wrapped(
                        f"\tmin: {facts['min_s']:.3f}s max: {facts['max_s']:.3f}s "
                        f"std dev: {facts['std_dev_s']:.5f}s window: {facts['window']}{missed}"
                    )
                if once:
                    return
            elif once and time.monotonic() > deadline:
                fail(f"gave up after {timeout:g} s: fewer than two samples arrived, so there is no rate")
            elif not once and not count and not silent:
                print_status(reader.no_sample_text())
            silent = not count


class MessageStatistics:
    """Rate and spread of the last ``window`` messages: from the newest writer, or from all if ``of_all``."""

    def __init__(self, window: int, *, of_all: bool = False) -> None:
        from zstate.net.topic_statistics import IntervalStatistics, SequenceGaps

        self._statistics, self._gaps = IntervalStatistics(window), SequenceGaps()
        self._of_all = of_all

    def add(self, received: TimedSample) -> None:
        """Add a sample. Several samples of one message count once."""
        from zstate.net.topic_statistics import Arrival
        from zstate.wire.messages import StampedMessage

        sample, statistics = received.sample, self._statistics
        assert isinstance(sample, StampedMessage)  # not a map, which has no rate
        if self._gaps.add(sample.session, sample.seq):
            if sample.session != statistics.session and not self._of_all:
                statistics.clear()
            statistics.add(Arrival(received.arrival, sample.stamp, sample.seq, 0), sample.session)

    def window(self) -> Window | None:
        """The last messages; None before the first."""
        return self._statistics.window()

    def facts(self) -> dict[str, Any] | None:
        """The printed figures; None before two messages. ``missed`` counts since the start."""
        window = self.window()
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


def _read_for(seconds: float, reader: StreamReader, statistics: MessageStatistics) -> int:
    """Add the samples that arrive within ``seconds``, and return their number."""
    deadline, count = time.monotonic() + seconds, 0
    while (left_s := deadline - time.monotonic()) > 0.0:
        received = reader.next(left_s)
        if received is not None:
            statistics.add(received)
            count += 1
    return count
