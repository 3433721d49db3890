"""zstate tf: the pose of one frame in another."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from decimal import Decimal, InvalidOperation
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.options import open_clock
from zstate.cli.output.console import print_json, print_result, print_status
from zstate.cli.output.wire_text import default_stream
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput, LookupFailed

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.nodes.listener import TransformListener
    from zstate.transform import Transform, Twist

# Silence is reported after this time while the period is unknown, before the second answer.
_UNKNOWN_S = 2.0
# Without velocities a twist needs a second sample, which arrives sooner.
_TWIST_WITHIN_S = 1.0


def _parse_stamp(text: str) -> int:
    """An exact stamp [ns], from nanoseconds or from seconds with a point, as this command prints them."""
    try:
        number = Decimal(text) * (1_000_000_000 if "." in text else 1)
        stamp = int(number)
    except (InvalidOperation, ValueError, OverflowError):
        number, stamp = Decimal(), None
    if stamp is None or stamp != number or abs(stamp) >= 2**63:
        raise InvalidInput(
            f"{text!r} is not a stamp: give nanoseconds since the Unix epoch, or seconds with a point and at "
            "most nine decimals"
        )
    return stamp


@click.command("tf")
@click.argument("target", metavar="A")
@click.argument("source", metavar="B")
@click.option("--once", is_flag=True, help="Print one pose; fail after --timeout with the reason.")
@click.option("--at", type=options.Checked("STAMP", _parse_stamp), help="Print one pose, at this stamp.")
@click.option(
    "--exact",
    is_flag=True,
    help="With --once or --at: ask the robot for all its samples, which a router between may thin.",
)
@options.timeout_option("How long --once and --at wait [s].")
@options.seconds_option
@click.option("--rate", type=options.RATE, default=1.0, help="Maximum rate of printed poses; default: 1.")
@click.option("--twist", is_flag=True, help="Also print the velocity of B in A.")
@click.option(
    "--precision",
    type=click.IntRange(0, 15),
    default=3,
    metavar="DIGITS",
    show_default=True,
    help="Number of decimals; JSON has all digits.",
)
@options.robot_filter_option
@options.placer_option
@options.json_option()
@options.wire_option
@options.reading_clock_option
@options.session_options
def tf_command(
    *,
    network: SessionOptions,
    target: str,
    source: str,
    once: bool,
    at: int | None,
    exact: bool,
    timeout: float,
    seconds: float | None,
    rate: float,
    twist: bool,
    precision: int,
    robot: str,
    placers: tuple[str, ...] | None,
    wire: str,
    clock: str | None,
    as_json: bool,
) -> None:
    """Print the pose of frame B in frame A, each time it changes, until Ctrl-C.

    While there is no pose, prints the reason. A frame is a bare name if that is unique, or ROBOT/FRAME.
    STAMP is in nanoseconds, or in seconds as printed.

    \b
    zstate tf panda_link0 panda_hand
    zstate tf left/panda_link0 right/panda_hand --once --json
    zstate tf panda_link0 panda_hand --twist --precision 6
    zstate tf base_link tool0 --at 1795417485.648066880 --exact
    zstate tf base_link tool0 --wire ros2              # reads /tf and /tf_static
    """
    from zstate.cli.waiting import PoseWaiter
    from zstate.clock import StopEvent, SystemClock
    from zstate.ingest.deadline import Deadline
    from zstate.nodes.listener import TransformListener
    from zstate.rate import Rate

    ends = once or at is not None
    options.check_end(seconds, once=ends)
    if exact and not ends:
        raise click.UsageError("--exact asks for one pose: give --at STAMP, or --once")
    with (
        open_session(network, (wire,)) as session,
        RobotDirectory(session, robot, wire) as directory,
        open_clock(session, clock, wire, timeout_s=timeout if ends else seconds) as selected_clock,
        TransformListener(
            session,
            robot,
            wire=wire,
            follow=default_stream(wire),
            clock=selected_clock,
            placers=placers,
        ) as listener,
    ):
        waiter = PoseWaiter(listener, directory, target, source)

        def show(transform: Transform) -> None:
            velocity = _wait_for_twist(listener, transform) if twist else None
            if as_json:
                facts = {**transform.to_dict(), "rpy": transform.rpy.tolist()}
                facts["age_s"] = waiter.age_s(transform)
                if velocity is not None:
                    facts |= {"linear": velocity.linear.tolist(), "angular": velocity.angular.tolist()}
                print_json(facts)
            else:
                print_result(transform_text(transform, precision))
                if velocity is not None:
                    for kind, vector, unit in (
                        ("linear", velocity.linear, "m/s"),
                        ("angular", velocity.angular, "rad/s"),
                    ):
                        print_result(f"- Twist: {kind} {numbers_text(vector.tolist(), precision)} {unit}")
                elif twist:
                    print_result("- Twist: not known yet")

        if not as_json:
            print_result(f"pose of {source} in {target}")
        if ends:
            transform = waiter.wait(None if exact else at, timeout_s=timeout)
            if exact:
                transform = listener.lookup(target, source, at, exact=True, timeout_s=timeout)
            show(transform)
            if not exact and transform.kind == "interpolated" and wire == "native":
                for text in _thinned(session, listener, transform):
                    print_status(f"{text}: --exact asks the robot itself")
            return
        shown: Transform | None = None
        deadline, silent = Deadline(unknown_s=_UNKNOWN_S), False
        for _ in Rate(rate, SystemClock(), StopEvent(), seconds):
            transform = waiter.wait(timeout_s=seconds)
            if transform != shown:
                show(transform)
                deadline.on_sample(time.monotonic())
                shown, silent = transform, False
            elif not silent and transform.stamp is not None and deadline.is_missed(time.monotonic()):
                silent = True
                print_status(waiter.no_sample_text())


def _thinned(session: Session, listener: TransformListener, transform: Transform) -> Iterator[str]:
    """The robots that move the path of ``transform`` and whose samples arrive thinned, with their sites."""
    from zstate.net.sites import discover_sites

    frames = listener.buffer.path_frames(transform.target, transform.source)
    moving = (frame.name for _, frame in frames if frame is not None and frame.kind in ("joint", "pose"))
    robots = dict.fromkeys(name.partition("/")[0] for name in moving)
    sites = discover_sites(session)
    for robot in robots:
        # At the site itself the samples arrive at their full rate.
        if (site := sites.site_of(robot)) and listener.stats_of(robot).missed:
            yield f"site {site!r} thins the samples of {robot!r} on purpose"


def _wait_for_twist(listener: TransformListener, transform: Transform) -> Twist | None:
    """The twist of the source in the target; None if it is still unknown after 1 s."""
    from zstate.cli.waiting import ConditionWaiter

    def twist() -> Twist | None:
        with suppress(LookupFailed):
            return listener.buffer.twist(transform.source, transform.target, transform.stamp)
        return None

    waiter = ConditionWaiter()
    with listener.buffer.watch(transform.target, transform.source, waiter.notify):
        waiter.wait_for(lambda: twist() is not None, _TWIST_WITHIN_S)
    return twist()


def transform_text(transform: Transform, precision: int = 3) -> str:
    """A transform as tf2_echo prints it, with all nine digits of the stamp."""
    from math import degrees

    from zstate.clock import format_stamp

    pose, rpy = transform.pose7.tolist(), transform.rpy.tolist()
    when = "At any time (static)" if transform.stamp is None else f"At time {format_stamp(transform.stamp)}"
    rows = [[_digits(value, precision) for value in row] for row in transform.matrix.tolist()]
    lines = [
        when,
        f"- Translation: {numbers_text(pose[:3], precision)}",
        f"- Rotation: in Quaternion (xyzw) {numbers_text(pose[3:], precision)}",
        f"- Rotation: in RPY (radian) {numbers_text(rpy, precision)}",
        f"- Rotation: in RPY (degree) {numbers_text([degrees(angle) for angle in rpy], precision)}",
        "- Matrix:",
        *(" " + " ".join(cell.rjust(precision + 3) for cell in row) for row in rows),
    ]
    return "\n".join(lines)


def numbers_text(values: list[float], precision: int) -> str:
    """Numbers with ``precision`` decimals, as in [0.100, -2.000]."""
    return f"[{', '.join(_digits(value, precision) for value in values)}]"


def _digits(value: float, precision: int) -> str:
    return f"{round(value, precision) + 0.0:.{precision}f}"  # adding zero turns -0 into 0
