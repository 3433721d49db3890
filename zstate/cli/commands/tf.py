"""zstate tf: the pose of one frame in another, as it comes in."""

from __future__ import annotations

import time
from decimal import Decimal, InvalidOperation
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.options import (
    checked_rate,
    json_option,
    open_clock,
    reading_clock_option,
    robot_filter_option,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.output.console import print_json, print_result, print_status
from zstate.cli.output.wire_text import default_stream
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import LookupFailed

if TYPE_CHECKING:
    from zstate.cli.waiting import PoseWaiter
    from zstate.nodes.listener import TransformListener
    from zstate.transform import Transform, Twist

# Without a second answer the period is not known: so long without one is worth a note.
_UNKNOWN_S = 2.0

# Without velocities a twist needs a second sample, which arrives sooner.
_TWIST_WITHIN_S = 1.0


def _stamp(_: click.Context, __: click.Parameter, text: str | None) -> int | None:
    """Nanoseconds, or seconds with a point as they are printed here; exact either way."""
    if text is None:
        return None
    try:
        number = Decimal(text) * (1_000_000_000 if "." in text else 1)
        stamp = int(number)
    except (InvalidOperation, ValueError, OverflowError):
        number, stamp = Decimal(), None
    if stamp is None or stamp != number or abs(stamp) >= 2**63:
        raise click.BadParameter(
            f"{text!r} is no stamp: give nanoseconds since the Unix epoch, or seconds with a point and at "
            "most nine digits behind it"
        )
    return stamp


@click.command("tf")
@click.argument("target", metavar="A")
@click.argument("source", metavar="B")
@click.option("--once", is_flag=True, help="Print one answer; give up after --timeout with the reason.")
@click.option("--at", callback=_stamp, metavar="STAMP", help="One answer, for this instant.")
@timeout_option("How long --once and --at wait.")
@click.option(
    "--rate",
    type=float,
    callback=checked_rate,
    default=1.0,
    metavar="HZ",
    help="At most so many answers a second.",
)
@click.option("--twist", is_flag=True, help="Also how fast B moves in A.")
@click.option(
    "--precision",
    type=click.IntRange(0, 15),
    default=3,
    metavar="DIGITS",
    show_default=True,
    help="Digits behind the point; JSON has them all.",
)
@robot_filter_option
@json_option()
@wire_option
@reading_clock_option
@session_options
def tf_command(
    *,
    network: SessionOptions,
    target: str,
    source: str,
    once: bool,
    at: int | None,
    timeout: float,
    rate: float,
    twist: bool,
    precision: int,
    robot: str,
    wire: str,
    clock: str | None,
    as_json: bool,
) -> None:
    """The pose of frame B in frame A, until Ctrl-C.

    Says what it waits for, and prints each new answer. Frames are called by their bare names while these
    are unique, or ROBOT/FRAME. STAMP is in nanoseconds, or in seconds as printed.

    \b
    zstate tf panda_link0 panda_hand
    zstate tf left/panda_link0 right/panda_hand --once --json
    zstate tf panda_link0 panda_hand --twist --precision 6
    zstate tf base_link tool0 --wire ros2              # hears /tf and /tf_static
    """
    from zstate.cli.waiting import PoseWaiter
    from zstate.nodes.listener import TransformListener

    ends = once or at is not None
    with (
        open_session(network, (wire,)) as session,
        RobotDirectory(session, robot, wire) as directory,
        open_clock(session, clock, wire, timeout_s=timeout if ends else None) as time_kept,
        TransformListener(
            session, robot, wire=wire, follow=default_stream(wire), clock=time_kept
        ) as listener,
    ):
        waiter = PoseWaiter(listener, directory, target, source)

        def show(transform: Transform) -> None:
            velocity = _wait_for_twist(listener, transform) if twist else None
            if as_json:
                _show_json(transform, waiter.age_s(transform), velocity)
            else:
                print_result(transform_text(transform, precision))
                if twist:
                    print_result(twist_text(velocity, precision))

        if not as_json:
            print_result(f"pose of {source} in {target}")
        if ends:
            show(waiter.wait(at, timeout_s=timeout))
        else:
            _follow(waiter, rate, show)


def _follow(waiter: PoseWaiter, rate_hz: float, show: Any) -> None:
    """Show each answer that is new. Never returns."""
    from zstate.clock import SystemClock
    from zstate.ingest.deadline import Deadline
    from zstate.rate import Rate

    shown: Transform | None = None
    deadline, silent = Deadline(unknown_s=_UNKNOWN_S), False
    for _ in Rate(rate_hz, SystemClock(), Event()):
        transform = waiter.wait()
        if transform != shown:
            show(transform)
            deadline.on_sample(time.monotonic())
            shown, silent = transform, False
        elif not silent and transform.stamp is not None and deadline.is_missed(time.monotonic()):
            silent = True
            print_status(waiter.no_sample_text())


def _wait_for_twist(listener: TransformListener, transform: Transform) -> Twist | None:
    """The twist of the source in the target; None if it is still unknown after 1 s."""
    from zstate.cli.waiting import ConditionWaiter

    waiter = ConditionWaiter()
    with listener.buffer.watch(transform.target, transform.source, waiter.notify):
        waiter.wait_for(lambda: _twist(listener, transform) is not None, _TWIST_WITHIN_S)
    return _twist(listener, transform)


def _twist(listener: TransformListener, transform: Transform) -> Twist | None:
    try:
        return listener.buffer.twist(transform.source, transform.target, transform.stamp)
    except LookupFailed:
        return None


def _show_json(transform: Transform, age_s: float | None, speed: Twist | None) -> None:
    facts = {**transform.to_dict(), "rpy": transform.rpy.tolist(), "age_s": age_s}
    if speed is not None:
        facts |= {"linear": speed.linear.tolist(), "angular": speed.angular.tolist()}
    print_json(facts)


def transform_text(transform: Transform, precision: int = 3) -> str:
    """A transform as tf2_echo prints it, with all nine digits of the stamp."""
    from math import degrees

    from zstate.clock import format_stamp

    pose, rpy = transform.pose7.tolist(), transform.rpy.tolist()
    when = "At any time (static)" if transform.stamp is None else f"At time {format_stamp(transform.stamp)}"
    rows = [[_digits(value, precision) for value in row] for row in transform.matrix.tolist()]
    lines = [
        when,
        f"- Translation: {_listed(pose[:3], precision)}",
        f"- Rotation: in Quaternion (xyzw) {_listed(pose[3:], precision)}",
        f"- Rotation: in RPY (radian) {_listed(rpy, precision)}",
        f"- Rotation: in RPY (degree) {_listed([degrees(angle) for angle in rpy], precision)}",
        "- Matrix:",
        *(" " + " ".join(cell.rjust(precision + 3) for cell in row) for row in rows),
    ]
    return "\n".join(lines)


def twist_text(speed: Twist | None, precision: int = 3) -> str:
    """A twist in the manner of ``transform_text``."""
    if speed is None:
        return "- Twist: not known yet"
    linear, angular = (_listed(vector.tolist(), precision) for vector in (speed.linear, speed.angular))
    return f"- Twist: linear {linear} m/s\n- Twist: angular {angular} rad/s"


def _listed(values: list[float], precision: int) -> str:
    return f"[{', '.join(_digits(value, precision) for value in values)}]"


def _digits(value: float, precision: int) -> str:
    return f"{round(value, precision) + 0.0:.{precision}f}"  # adding 0.0 takes the sign off a negative zero
