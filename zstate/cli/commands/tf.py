"""zstate tf: the pose of one frame in another, as it comes in."""

from __future__ import annotations

import time
from decimal import Decimal, InvalidOperation
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import note, say, say_json
from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    checked_rate,
    heard_robot_option,
    json_option,
    reading_clock_option,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.roster import Roster
from zstate.cli.words import followed
from zstate.errors import LookupFailed

if TYPE_CHECKING:
    from zstate.cli.awaited_pose import AwaitedPose
    from zstate.listener import TransformListener
    from zstate.transform import Transform, Twist

# So long without a newer answer is worth a word.
_SILENCE_S = 2.0

# The second sample of whoever has no velocities comes sooner.
_SPEED_WITHIN_S = 1.0
_LOOK_EVERY_S = 0.02


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
@heard_robot_option
@json_option()
@wire_option
@reading_clock_option
@session_options
def tf_command(
    *,
    network: Network,
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
    from zstate.cli.awaited_pose import AwaitedPose
    from zstate.cli.clocks import open_clock
    from zstate.listener import TransformListener

    ends = once or at is not None
    with (
        open_session(network, (wire,)) as session,
        Roster(session, robot, wire) as roster,
        open_clock(session, clock, wire, timeout_s=timeout if ends else None) as time_kept,
        TransformListener(session, robot, wire=wire, follow=followed(wire), clock=time_kept) as listener,
    ):
        awaited = AwaitedPose(listener, roster, target, source)

        def show(transform: Transform) -> None:
            speed = _speed(listener, transform) if twist else None
            if as_json:
                _show_json(transform, awaited.age_s(transform), speed)
            else:
                say(transform_text(transform, precision))
                if twist:
                    say(twist_text(speed, precision))

        if not as_json:
            say(f"pose of {source} in {target}")
        if ends:
            show(awaited.answer(at, timeout_s=timeout))
        else:
            _follow(awaited, rate, show)


def _follow(awaited: AwaitedPose, rate_hz: float, show: Any) -> None:
    """Show each answer that is new. Never returns."""
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    shown: Transform | None = None
    news_at, silent = time.monotonic(), False
    for _ in Rate(rate_hz, SystemClock(), Event()):
        transform = awaited.answer()
        if transform != shown:
            show(transform)
            shown, news_at, silent = transform, time.monotonic(), False
        elif not silent and transform.stamp is not None and time.monotonic() - news_at > _SILENCE_S:
            silent = True
            note(awaited.silence())


def _speed(listener: TransformListener, transform: Transform) -> Twist | None:
    """How fast the source moves, soon; None where one sample without velocities does not tell."""
    deadline = time.monotonic() + _SPEED_WITHIN_S
    speed = _twist(listener, transform)
    while speed is None and time.monotonic() < deadline:
        time.sleep(_LOOK_EVERY_S)
        speed = _twist(listener, transform)
    return speed


def _twist(listener: TransformListener, transform: Transform) -> Twist | None:
    try:
        return listener.buffer.twist(transform.source, transform.target, transform.stamp)
    except LookupFailed:
        return None


def _show_json(transform: Transform, age_s: float | None, speed: Twist | None) -> None:
    facts = {**transform.to_dict(), "rpy": transform.rpy.tolist(), "age_s": age_s}
    if speed is not None:
        facts |= {"linear": speed.linear.tolist(), "angular": speed.angular.tolist()}
    say_json(facts)


def transform_text(transform: Transform, precision: int = 3) -> str:
    """A transform as tf2_echo prints it, with all nine digits of the stamp."""
    from math import degrees

    from zstate.clock import stamp_text

    pose, rpy = transform.pose7.tolist(), transform.rpy.tolist()
    when = "At any time (static)" if transform.stamp is None else f"At time {stamp_text(transform.stamp)}"
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
