"""zstate move and zstate stop: move the joints of a driver, stop it, and release the stop."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_json, print_result, print_status
from zstate.cli.session import SessionOptions, open_session
from zstate.driving.cli.drive import parse_joint_value
from zstate.driving.errors import MotionRefused, MotionTimeout
from zstate.errors import InvalidInput, SecondWriter, Unreachable, ZStateError, printable

if TYPE_CHECKING:
    from zstate.driving import Commander
    from zstate.driving.driver import StopMode
    from zstate.driving.messages import DriverState
    from zstate.driving.motion import Motion, Outcome
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session

_SECONDS = 1.0
_SEND_PERIOD_S = 0.05
_CHECK_S = 1.0
_WHEEL_RATE = 4.0
_CANCELLED_WITHIN_S = 2.0
_CACHES_WITHIN_S = 0.5
_DEGREES_HINT = "this looks like degrees"


def _parse_wheels(text: str) -> tuple[str, str]:
    left, _, right = text.partition(",")
    if not left or not right or left == right or "," in right:
        raise InvalidInput(f"{text!r} is not LEFT,RIGHT, the names of two joints")
    return left, right


def _check_wheel_rate(rate: float) -> float:
    if not 0.0 < rate < math.inf:
        raise InvalidInput(f"a rate of wheels is positive and finite [rad/s], not {rate!r}")
    return rate


@click.command("move")
@click.argument("robot")
@click.argument(
    "positions",
    nargs=-1,
    type=options.Checked("JOINT=VALUE", parse_joint_value),
    metavar="[JOINT=VALUE]...",
)
@click.option(
    "--seconds",
    type=options.SECONDS,
    help=f"Arrive after so many seconds; default: {_SECONDS:g}, or as many as the limits need.",
)
@click.option(
    "--file",
    type=options.EXISTING_FILE,
    metavar="CSV",
    help="Move through the points of a file: a line time,JOINT,... then the seconds after the start and the "
    "positions of each point.",
)
@click.option(
    "--velocity",
    is_flag=True,
    help="Each VALUE is a velocity [rad/s or m/s]: move at it for --seconds, then brake.",
)
@click.option("--deg", is_flag=True, help="Numbers of joints that turn are in degrees, not in radians.")
@click.option("--stretch", is_flag=True, help="Move slower where the limits need it, instead of refusing.")
@click.option("--keys", is_flag=True, help="Drive a robot on two wheels by the keys of this terminal.")
@click.option(
    "--wheels",
    type=options.Checked("LEFT,RIGHT", _parse_wheels),
    help="The joints that --keys turns; default: those of the driver that are called left... and right....",
)
@click.option(
    "--wheel-rate",
    type=options.number("RAD/S", _check_wheel_rate),
    default=_WHEEL_RATE,
    show_default=True,
    help="How fast --keys turns the wheels; half of it to turn on the spot.",
)
@options.timeout_option("Fail if no driver has published its state after this time [s].", 5.0)
@options.json_option("One JSON object, also for a motion that is refused.")
@options.session_options
def move_command(
    *,
    robot: str,
    positions: tuple[tuple[str, float], ...],
    seconds: float | None,
    file: str | None,
    velocity: bool,
    deg: bool,
    stretch: bool,
    keys: bool,
    wheels: tuple[str, str] | None,
    wheel_rate: float,
    timeout: float,
    as_json: bool,
    network: SessionOptions,
) -> None:
    """Move joints of ROBOT, which has a driver, and wait until they are there.

    VALUE is a position in radians, or in degrees with --deg, or metres for a linear joint; other joints stay
    where they are. The motion starts and ends at rest, and is checked as a whole against the limits of
    position, velocity and acceleration: a motion that would leave them is refused with all findings, and
    nothing moves. Ctrl-C cancels it, and the joints brake. The exit code is 0 if the joints have reached the
    last point.

    With --velocity the joints, such as wheels, speed up within the limit of acceleration, keep VALUE for
    --seconds, and brake, also on Ctrl-C and when this command ends otherwise. They slow down before the
    limits of their positions.

    With --keys the wheels of a mobile robot turn while a key is held: w a s d or the arrow keys; space stops
    them, q quits. A terminal does not report that a key was released: a short press drives for 0.6 s.

    This is NOT a safety-rated channel: an emergency stop is wired to the power of the hardware.

    \b
    zstate move panda panda_joint4=-1.2 panda_joint6=2
    zstate move panda panda_joint4=-1.2 --seconds 3
    zstate move panda panda_joint4=-70 --deg
    zstate move panda --file wave.csv --stretch
    zstate move diffbot --velocity left_wheel_joint=2 right_wheel_joint=2 --seconds 3
    zstate move rover --keys
    """
    if keys:
        if positions or file is not None or seconds is not None or velocity or deg or stretch or as_json:
            raise click.UsageError("--keys goes with --wheels, --wheel-rate and --timeout alone")
        _move_by_keys(robot, wheels, wheel_rate, timeout, network)
        return
    numbers = _by_joint(positions)
    if bool(numbers) is (file is not None):
        raise click.UsageError("give JOINT=VALUE for some joints, such as elbow=0.5, or --file CSV")
    _check_options(file=file is not None, seconds=seconds is not None, velocity=velocity, stretch=stretch)
    from zstate.driving import Commander

    if file is not None:
        points, times_s = _read_points(file)
    else:
        points = {joint: [value] for joint, value in numbers.items()}
        times_s = None if seconds is None else [seconds]
    with open_session(network) as session, Commander(session, robot) as commander:
        state = commander.wait_for_driver(timeout)
        if deg:
            points = _in_radians(points, _turning_joints(session, robot, timeout))
        if velocity:
            rates = {joint: values[0] for joint, values in points.items()}
            _keep_velocities(commander, state, rates, seconds or _SECONDS)
            if as_json:
                _print_outcome(robot, "ended")
            return
        started = time.monotonic()
        motion = _begun(commander, points, times_s, stretch=stretch, as_json=as_json)
        print_status(f"moving {', '.join(points)} of {robot!r}; Ctrl-C cancels", event="moving", robot=robot)
        outcome = _outcome(commander, motion)
    if as_json:
        _print_outcome(robot, *outcome)
    elif outcome.name == "reached":
        print_result(f"reached in {time.monotonic() - started:.1f} s")
    if outcome.name != "reached":
        fail(f"the motion of {robot!r} was {outcome.name}: {printable(outcome.reason)}")


def _check_options(*, file: bool, seconds: bool, velocity: bool, stretch: bool) -> None:
    """Raise UsageError for options that exclude each other."""
    if file and seconds:
        raise click.UsageError("--file has its own times; leave out --seconds")
    if velocity and (file or stretch):
        raise click.UsageError("--velocity takes JOINT=VALUE and --seconds; leave out --file and --stretch")


def _by_joint(values: Sequence[tuple[str, float]]) -> dict[str, float]:
    """A number for each joint. Raises UsageError for a joint with two."""
    if len(dict(values)) < len(values):
        raise click.UsageError("a joint is given twice")
    return dict(values)


def _begun(
    commander: Commander,
    points: dict[str, list[float]],
    times_s: list[float] | None,
    *,
    stretch: bool,
    as_json: bool,
) -> Motion:
    """The motion through ``points``. Raises MotionRefused, with a hint at --deg for degrees."""
    try:
        return commander.move(points, times_s, stretch=stretch)
    except MotionRefused as refusal:
        if as_json:
            _print_outcome(commander.robot, "refused", findings=refusal.findings)
        if any(_DEGREES_HINT in text for text in refusal.findings):
            fail(f"{refusal}\n--deg takes numbers in degrees")
        raise


def _in_radians(points: dict[str, list[float]], turning: set[str]) -> dict[str, list[float]]:
    """``points`` with the numbers of the joints ``turning`` in radians, which are given in degrees."""
    return {
        joint: [math.radians(value) for value in values] if joint in turning else values
        for joint, values in points.items()
    }


def _turning_joints(session: Session, robot: str, timeout_s: float) -> set[str]:
    """The joints of ``robot`` whose positions are angles, by its model. Ends the command without one."""
    from zstate.clock import wait_interruptible
    from zstate.sources.joint_state_listener import DescriptionSubscriber

    turning: set[str] = set()
    has_arrived = threading.Event()

    def on_model(_: str, model: RobotModel) -> None:
        turning.update(joint.name for joint in model.joints if joint.type != "prismatic")
        has_arrived.set()

    with DescriptionSubscriber(session, robot, on_model):
        if not wait_interruptible(has_arrived, timeout_s):
            fail(f"--deg needs the model of {robot!r}, which has not arrived within {timeout_s:g} s")
    return turning


def _keep_velocities(
    commander: Commander, before: DriverState, velocities: dict[str, float], seconds: float
) -> None:
    """Move joints at ``velocities`` for ``seconds``, and brake them, also after a signal or a failure."""
    period_s = min(_SEND_PERIOD_S, 0.25e-9 * before.ttl)
    end = time.monotonic() + seconds
    try:
        commander.send(velocities=velocities)
        text = f"{', '.join(velocities)} of {commander.robot!r}"
        print_status(
            f"moving {text} for {seconds:g} s; Ctrl-C ends it", event="moving", robot=commander.robot
        )
        while time.monotonic() < end:
            time.sleep(period_s)
            _check_moves(commander, before)
            commander.send(velocities=velocities)
    finally:
        with suppress(ZStateError):
            commander.send(velocities=dict.fromkeys(velocities, 0.0))
    if (state := commander.driver) is not None and state.state != "active":
        reason = printable(state.last_refusal) or state.state
        fail(f"the joints of {commander.robot!r} have not moved: {reason}")


def _check_moves(commander: Commander, before: DriverState) -> None:
    """End the command if the driver is silent or stopped, or has refused commands since ``before``."""
    from zstate.driving.driver_state import state_text

    state = commander.driver
    if state is None:
        fail(f"the driver of {commander.robot!r} has fallen silent")
    if state.state in ("stopped", "fault", "off"):
        fail(f"the driver of {commander.robot!r} is {state_text(state)}")
    if state.state != "active" and sum(state.refused.values()) > sum(before.refused.values()):
        fail(f"the driver of {commander.robot!r} refuses it: {printable(state.last_refusal)}")


def _print_outcome(robot: str, outcome: str, reason: str = "", *, findings: Sequence[str] = ()) -> None:
    print_json({"robot": robot, "outcome": outcome, "reason": reason, "findings": findings})


def _outcome(commander: Commander, motion: Motion) -> Outcome:
    """How the motion has ended. A signal cancels it."""
    try:
        while (outcome := motion.outcome) is None:
            if commander.driver is None:
                fail(
                    f"the driver of {motion.robot!r} has fallen silent at {motion.progress:.0%} of the motion"
                )
            with suppress(MotionTimeout):
                motion.wait(_CHECK_S)
    except SystemExit:
        motion.cancel()
        ended = motion.wait(_CANCELLED_WITHIN_S)
        print_status(f"{ended.name}: the joints of {motion.robot!r} brake", event="cancelled")
        raise
    return outcome


def _move_by_keys(
    robot: str, wheels: tuple[str, str] | None, rate: float, timeout_s: float, network: SessionOptions
) -> None:
    """Turn the wheels of ``robot`` while keys are held, until q or a signal."""
    from zstate.driving import Commander
    from zstate.driving.cli.keyboard import KEYS_TEXT, HeldKey, KeyReader

    with KeyReader() as reader, open_session(network) as session, Commander(session, robot) as commander:
        left, right = wheels or _wheels_of(commander.wait_for_driver(timeout_s), robot)
        print_status(f"driving {left} and {right} of {robot!r}: {KEYS_TEXT}", event="driving", robot=robot)
        held, was_moving, shown = HeldKey(), False, ""
        try:
            while True:
                for key in reader.read(_SEND_PERIOD_S):
                    if key == "q":
                        return
                    held.press(key, time.monotonic())
                rates = held.wheel_rates(time.monotonic(), rate)
                if rates is not None or was_moving:
                    commander.send(velocities=dict(zip((left, right), rates or (0.0, 0.0), strict=True)))
                was_moving = rates is not None
                if (problem := commander.problem) != shown:
                    shown = problem
                    print_status(problem or f"driving {robot!r} again", event="state", robot=robot)
        finally:
            if was_moving:  # also after q and Ctrl-C: else the wheels turn until the ttl
                with suppress(ZStateError):
                    commander.send(velocities={left: 0.0, right: 0.0})


def _wheels_of(state: DriverState, robot: str) -> tuple[str, str]:
    """The two joints of a driver that are called left and right. Ends the command for others."""
    found = [[name for name in state.joint_names if side in name.lower()] for side in ("left", "right")]
    if [len(names) for names in found] != [1, 1]:
        fail(
            f"which joints of {robot!r} are its wheels? Name them with --wheels LEFT,RIGHT; it has "
            f"{', '.join(state.joint_names)}"
        )
    return found[0][0], found[1][0]


@click.command("stop")
@click.argument("robots", nargs=-1, metavar="[ROBOT]...")
@click.option("--all", "everything", is_flag=True, help="Every robot that has a driver.")
@click.option(
    "--relax",
    is_flag=True,
    help="Switch the torque off, too: joints without brakes fall. Only commanders may.",
)
@click.option("--reason", default="", metavar="TEXT", help="Why; shown to users until the release.")
@click.option("--release", is_flag=True, help="Release the stops instead, of all programs.")
@options.timeout_option("Fail if the driver has not confirmed it after this time [s].", 2.0)
@options.json_option("One JSON object for each robot.")
@options.session_options
def stop_command(
    *,
    robots: tuple[str, ...],
    everything: bool,
    relax: bool,
    reason: str,
    release: bool,
    timeout: float,
    as_json: bool,
    network: SessionOptions,
) -> None:
    """Stop the driver of ROBOT, until the stop is released.

    The joints stay where they are. A stop is latched: the robot stays stopped, also if its driver restarts,
    until `zstate stop ROBOT --release`, or Commander.release in a program. Then it stands until the next
    command, and motions do not continue. Every program may stop a robot; behind a router with access control
    only commanders and operators release it, or switch its torque off: with --relax the joints hold for
    others, and the exit code is 1.

    The exit code is 1 if a driver has not confirmed the stop, which it then may not have received.

    This is NOT a safety-rated channel: a stop is lost with the network, and waits for the calls of the
    driver. An emergency stop is wired to the power of the hardware.

    \b
    zstate stop panda --reason "door open"
    zstate stop --all
    zstate stop panda --release
    """
    if bool(robots) is everything:
        raise click.UsageError("name the robots to stop, or give --all")
    if release and (relax or reason):
        raise click.UsageError("--release ends stops; leave out --relax and --reason")
    from zstate.cli.processes import BackgroundCall  # loads numpy, which --help does not need
    from zstate.driving.messages import state_text

    act = partial(_release, timeout_s=timeout)
    if not release:
        act = partial(_stop, reason=reason, how="relax" if relax else "hold", timeout_s=timeout)
    failures: list[str] = []
    with open_session(network) as session:
        names = robots or _driven_robots(session)
        calls = {name: BackgroundCall("zstate stop", partial(act, session, name)) for name in names}
        for name, call in calls.items():  # all at once, reported in their order
            try:
                state, error = call.result(), None
            except ZStateError as failure:
                state, error = None, str(failure)
                failures.append(f"{name}: {failure}")
            if as_json:
                print_json(_as_document(name, state, error))
            elif state is not None:
                print_result(f"{name}: {state_text(state)}")
            if release and state is not None and state.stops:
                failures.append(f"{name} has been stopped again")
    if failures:
        fail("\n".join(failures))


def _driven_robots(session: Session) -> list[str]:
    """The robots that have a driver. Ends the command if there is none."""
    from zstate.net.latched import cached_values
    from zstate.net.ownership import wait_for_discovery
    from zstate.wire.keys import ANY, robot_from_key, stream_expression

    wait_for_discovery(session)
    values = cached_values(session, stream_expression(ANY, "driver"), _CACHES_WITHIN_S)
    return sorted({robot_from_key(value.key) for value in values}) or fail("no robot has a driver")


def _stop(session: Session, robot: str, *, reason: str, how: StopMode, timeout_s: float) -> DriverState:
    from zstate.driving import stop
    from zstate.driving.stops import STAYS_LATCHED

    try:
        return stop(session, robot, reason, how=how, timeout_s=timeout_s)
    except Unreachable as error:
        text = str(error).replace(STAYS_LATCHED, "One that starts later does not obey this stop")
        raise Unreachable(text, endpoints=()) from None


def _release(session: Session, robot: str, *, timeout_s: float) -> DriverState:
    from zstate.driving import Commander

    try:
        with Commander(session, robot) as commander:
            return commander.release(timeout_s)
    except SecondWriter as error:
        raise ZStateError(
            f"it is commanded by {str(error.first)!r}, and only its commander releases a stop: end that "
            "program, or let it call Commander.release"
        ) from None


def _as_document(robot: str, state: DriverState | None, error: str | None) -> dict[str, object]:
    if state is None:
        return {"robot": robot, "state": None, "reason": None, "is_stopped": None, "error": error}
    is_stopped = bool(state.stops)
    return {
        "robot": robot,
        "state": state.state,
        "reason": state.reason,
        "is_stopped": is_stopped,
        "error": error,
    }


def _read_points(path: str) -> tuple[dict[str, list[float]], list[float]]:
    """Positions by joint, and the times [s], of the points in a CSV file. Ends the command if it has none."""
    text = Path(path).read_text(encoding="utf-8", errors="replace")
    lines = [line.split(",") for line in text.splitlines()] or [[""]]
    first, *joints = [word.strip() for word in lines[0]]
    if first != "time" or not joints or not all(joints) or len(set(joints)) < len(joints):
        fail(f"{path} starts with {','.join(lines[0])!r}, not with time,JOINT,... of different joints")
    rows = [
        _numbers(words, 1 + len(joints), f"{path}, line {number}")
        for number, words in enumerate(lines[1:], start=2)
        if words != [""]
    ]
    if not rows:
        fail(f"{path} has no point below its first line")
    return {joint: [row[1 + n] for row in rows] for n, joint in enumerate(joints)}, [row[0] for row in rows]


def _numbers(words: Sequence[str], count: int, place: str) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        fail(f"{place}: {error}")
    if len(numbers) != count:
        fail(f"{place} has {count_text(len(numbers), 'number')}, and the first line {count}")
    return numbers
