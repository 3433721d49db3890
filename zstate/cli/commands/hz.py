"""zstate hz: the rate at which samples come in."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING, NoReturn

import click

from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    json_option,
    named_robot,
    refuse_topic,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.output.console import fail, print_json, print_status, print_wrapped
from zstate.cli.words import is_ros

if TYPE_CHECKING:
    from zstate.cli.arrivals import Arrivals, Intervals
    from zstate.cli.tap import Tap
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
    network: Network,
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
    from zstate.cli.arrivals import Arrivals
    from zstate.cli.tap import Tap

    refuse_topic(robot, wire)
    with ExitStack() as opened:
        session = opened.enter_context(open_session(network, (wire,)))
        tap = opened.enter_context(Tap(session, named_robot(session, robot, wire), stream, wire))
        arrivals = Arrivals(window, of_all=is_ros(wire))
        if once:
            _show(_measured_once(tap, arrivals, timeout), as_json=as_json)
        else:
            _follow(tap, arrivals, as_json=as_json)


def _begin(tap: Tap, timeout_s: float | None) -> None:
    """Wait for samples, and let those pass that queued up while this process was starting."""
    from zstate.cli.arrivals import Arrivals

    tap.first(timeout_s)
    _listen(tap, Arrivals(2), _SETTLING_S)


def _measured_once(tap: Tap, arrivals: Arrivals, timeout_s: float) -> Intervals:
    _begin(tap, timeout_s)
    deadline = time.monotonic() + timeout_s
    measured = None
    while measured is None:
        if time.monotonic() > deadline:
            fail(f"gave up after {timeout_s:g} s: samples came, but no two to measure between")
        _listen(tap, arrivals, 1.0)
        measured = arrivals.intervals()
    return measured


def _follow(tap: Tap, arrivals: Arrivals, *, as_json: bool) -> NoReturn:
    _begin(tap, None)
    silent = False
    while True:
        came = _listen(tap, arrivals, 1.0)
        measured = arrivals.intervals()
        if came and measured is not None:
            _show(measured, as_json=as_json)
        elif not came and not silent:
            print_status(tap.silence())
        silent = not came


def _listen(tap: Tap, arrivals: Arrivals, seconds: float) -> int:
    """Note what comes within ``seconds``; how many samples that were."""
    deadline, count = time.monotonic() + seconds, 0
    while (left_s := deadline - time.monotonic()) > 0.0:
        tapped = tap.next(left_s)
        if tapped is not None:
            arrivals.note(tapped)
            count += 1
    return count


def _show(measured: Intervals, *, as_json: bool) -> None:
    if as_json:
        print_json(asdict(measured))
        return
    print_wrapped(f"average rate: {measured.rate_hz:.3f}")
    missed = f" missed: {measured.missed}" if measured.missed else ""
    print_wrapped(
        f"\tmin: {measured.min_s:.3f}s max: {measured.max_s:.3f}s "
        f"std dev: {measured.std_dev_s:.5f}s window: {measured.window}{missed}"
    )
