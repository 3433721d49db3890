"""zstate drive: the host of a driver, the one program that owns a robot's hardware."""

from __future__ import annotations

import inspect
import json
import math
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import click

from zstate._util.closeable import Closeable
from zstate._util.format import did_you_mean
from zstate.cli import options
from zstate.cli.options import load_robot
from zstate.cli.output.console import count_text, fail, print_wrapped, report_text
from zstate.cli.session import SessionOptions, open_session
from zstate.cli.signals import SignalExit
from zstate.driving.errors import DriverFault
from zstate.errors import InvalidInput, MessageError, ZStateError, format_duration

if TYPE_CHECKING:
    from zstate.driving import Driver, DriverHost, DriverReport, Limits
    from zstate.driving.driver_state import Spread
    from zstate.driving.messages import Mode
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.wire.protocol import SerializedSample

_SIMULATED = "sim"
_DEVICE = "device"
_FIRST_READING_S = 2.0
"""It is a line of its own if the first reading takes longer."""
_MODULE = "zstate_driver"
"""The name of the module that a driver's file becomes."""

_Limit: TypeAlias = "tuple[str | None, float]"
"""A number for the joint of this name, or for all joints."""


def _check_driver(text: str) -> str:
    file, _, name = text.rpartition(":")
    if text == _SIMULATED or (name.isidentifier() and Path(file).is_file()):
        return text
    if name.isidentifier() and file.endswith(".py"):
        raise InvalidInput(f"there is no file {file!r}")
    raise InvalidInput(f"{text!r} is neither 'sim' nor FILE.py:CLASS, such as servos.py:ServoBus")


def _parse_parameter(text: str) -> tuple[str, str]:
    key, sign, value = text.partition("=")
    if not sign or not key.isidentifier():
        raise InvalidInput(f"{text!r} is not a parameter; write KEY=VALUE, such as port=/dev/ttyUSB0")
    return key, value


def parse_joint_value(text: str) -> tuple[str, float]:
    """``JOINT=VALUE``. Raises InvalidInput."""
    joint, sign, value = text.partition("=")
    try:
        if joint and sign:
            return joint, float(value)
    except ValueError:
        pass
    raise InvalidInput(f"{text!r} is not JOINT=VALUE with a number, such as elbow=0.5 [rad or m]")


def _parse_limit(text: str) -> _Limit:
    if "=" in text:
        return parse_joint_value(text)
    with suppress(ValueError):
        return None, float(text)
    raise InvalidInput(f"{text!r} is neither a number for all joints nor JOINT=NUMBER for one")


def _parse_rate(value: str | float) -> float | None:
    return None if value == _DEVICE else options.RATE.convert(value, None, None)


_RATE = options.Checked("HZ|device", _parse_rate)
_PARAMETER = options.Checked("KEY=VALUE", _parse_parameter)
_LIMIT = options.Checked("[JOINT=]V", _parse_limit)


@click.command("drive")
@click.argument("driver", type=options.Checked("text", _check_driver), metavar="FILE.py:CLASS|sim")
@click.argument("robot", type=options.MODEL)
@options.xacro_arguments
@click.option(
    "--param",
    "parameters",
    type=_PARAMETER,
    multiple=True,
    help="A keyword argument of CLASS: VALUE is JSON (1000000, true, [1, 2]), or else text, and of the type "
    "that CLASS annotates. Repeatable.",
)
@click.option(
    "--plant",
    type=click.Choice(["mirror", "lag", "dynamics"]),
    help="With sim: joints are at their setpoints, follow with a lag of 50 ms, or are rigid bodies with the "
    "inertias and effort limits of the URDF; default: lag.",
)
@click.option(
    "--rate",
    type=_RATE,
    default=100.0,
    show_default=True,
    help="Rate of the loop; with `device` it is that of the driver's read, which waits for a new reading.",
)
@click.option(
    "--realtime",
    type=click.Choice(["fifo", "spin"]),
    help="fifo: schedule the loop before other programs, with locked memory; spin: also wait for each tick "
    "without sleep, which takes a quarter of a processor at 1000 Hz. Needs permission.",
)
@click.option(
    "--ttl",
    type=options.SECONDS,
    default=0.25,
    show_default=True,
    help="How long a command is valid at most, from its sending; then the joints hold, or relax.",
)
@click.option(
    "--on-silence",
    type=click.Choice(["hold", "relax"]),
    default="hold",
    show_default=True,
    help="When no command is valid any more: brake and hold, or switch the torque off.",
)
@click.option(
    "--velocity",
    "velocities",
    type=_LIMIT,
    multiple=True,
    help="Limit of the speed, of all joints or of one [rad/s or m/s]; default: that of the URDF. Repeatable.",
)
@click.option(
    "--acceleration",
    "accelerations",
    type=_LIMIT,
    multiple=True,
    help="The same for the acceleration [rad/s^2 or m/s^2], which a URDF has only in <ros2_control>; "
    "default: the one that brakes a joint from its velocity limit in 0.2 s; inf lets joints stop at once. "
    "Repeatable.",
)
@click.option(
    "--effort",
    "efforts",
    type=_LIMIT,
    multiple=True,
    help="The same for the effort [Nm or N]; default: that of the URDF. Repeatable.",
)
@options.wires_option
@click.option(
    "--ros2-controller",
    metavar="NAME",
    help="With `--wire ros2`: ROS 2 nodes command the joints as a controller of this name, on NAME/commands "
    "(std_msgs/Float64MultiArray) and NAME/joint_trajectory (trajectory_msgs/JointTrajectory).",
)
@click.option(
    "--ros2-mode",
    type=click.Choice(("position", "velocity", "effort")),
    default="position",
    show_default=True,
    help="What the numbers on NAME/commands are.",
)
@options.seconds_option
@options.name_option
@options.session_options
def drive_command(
    *,
    driver: str,
    robot: str,
    xacro_args: dict[str, str],
    parameters: tuple[tuple[str, str], ...],
    plant: str | None,
    rate: float | None,
    realtime: Literal["fifo", "spin"] | None,
    ttl: float,
    on_silence: Literal["hold", "relax"],
    velocities: tuple[_Limit, ...],
    accelerations: tuple[_Limit, ...],
    efforts: tuple[_Limit, ...],
    wires: tuple[str, ...],
    ros2_controller: str | None,
    ros2_mode: Mode,
    seconds: float | None,
    name: str | None,
    network: SessionOptions,
) -> None:
    """Host the driver of ROBOT: publish its joints, and write the commands that are sent to it.

    It takes the place of ros2_control_node with a hardware component, joint_state_broadcaster,
    forward_command_controller and joint_trajectory_controller.

    CLASS in FILE.py is a driver as in zstate.driving.Driver; sim is one without hardware. ROBOT is a name
    such as panda, or a URDF or xacro file; NAME:=VALUE are xacro arguments. CLASS is called with the --param
    as keywords, and gets the robot's RobotModel as `model` and the names of its joints as `joint_names` if it
    has parameters of these names.

    `zstate move` or a zstate.driving.Commander moves the joints, within the limits of the URDF: those of a
    joint, of the joints that mimic it, of its safety_controller and of ros2_control. `zstate stop` stops
    them. Each change of state is a line. After Ctrl-C the joints are stopped as after silence, and the driver
    is closed.

    A driver that fails three times in a row is stopped, and the exit code is 1. It does not connect again by
    itself: start the command again once the hardware is back, or let `zstate up` (restart = "on-failure").
    The joints then stay stopped until `zstate stop ROBOT --release`.

    With `--wire ros2` ROS 2 nodes receive the joints on /joint_states, and with --ros2-controller they
    command them. `zstate move`, `zstate stop` and the driver's state are on the native wire in any case.

    This is NOT a safety-rated channel: an emergency stop is wired to the power of the hardware.

    \b
    zstate drive sim panda
    zstate drive sim arm.urdf --plant dynamics --rate 500
    zstate drive servos.py:ServoBus arm.urdf --param port=/dev/ttyUSB0 --param ids=[1,2,3]
    zstate drive arm.py:Arm arm.urdf --rate 1000 --realtime fifo
    zstate drive servos.py:ServoBus arm.urdf --velocity 0.5 --acceleration elbow=4 --acceleration wrist=8
    zstate drive sim panda --wire native --wire ros2 --ros2-controller arm_controller
    """
    from zstate.driving import DriverHost

    if plant is not None and driver != _SIMULATED:
        raise click.UsageError("--plant is of `sim`; a driver in a file gets its arguments by --param")
    model, robot_name = load_robot(robot, name, xacro_args)
    inputs = _controller_text(wires, robot_name, ros2_controller) if ros2_controller else ""
    given = dict(parameters) | ({} if plant is None else {"plant": plant})
    hardware = _new_driver(driver, model, given)
    limits = _limits(model, hardware, velocities, accelerations, efforts)
    with open_session(network, wires) as session, ExitStack() as opened:
        with _failures_of(driver):
            host = opened.enter_context(
                DriverHost(
                    *(session, hardware, model, robot_name),
                    rate_hz=rate,
                    ttl_s=ttl,
                    limits=limits,
                    on_silence=on_silence,
                    wires=wires,
                    ros2_controller=ros2_controller or "",
                    ros2_mode=ros2_mode,
                    realtime=realtime,
                )
            )
        joints = count_text(len(hardware.joint_names), "joint")
        pace = "the pace of the device" if rate is None else f"{rate:g} Hz"
        then = "hold" if on_silence == "hold" else "lose their torque"
        print_wrapped(
            f"driving {robot_name!r} ({joints}, {driver}) at {pace}; the joints {then} after "
            f"{format_duration(round(ttl * 1e9))} without a command"
        )
        for line in _limit_lines(model, limits):
            print_wrapped(line)
        if inputs:
            print_wrapped(
                f"ROS 2 nodes command {', '.join(hardware.joint_names)}, in this order, on {inputs}"
            )
        opened.enter_context(_StateLines(session, robot_name))
        run_host(host, seconds)


def _controller_text(wires: tuple[str, ...], robot: str, name: str) -> str:
    """The topics of the ROS 2 controller ``name``. Raises UsageError if it has no wire."""
    from zstate.driving.ros2 import get_controller

    try:
        return " and ".join(get_controller(wires, robot, name).topics)
    except InvalidInput as error:
        if sum(wire.partition(":")[0] == "ros2" for wire in wires) == 1:
            raise
        text = "--ros2-controller needs one wire `ros2`, as in `--wire native --wire ros2`"
        raise click.UsageError(text) from error


def run_host(host: DriverHost, seconds: float | None) -> None:
    """Run the loop, with the report at its end, also after a signal or a fault.

    A signal interrupts only the calling thread, which waits: never a call of the driver. A second one does
    not interrupt the driver's stop, which may take 3 s.
    """
    from zstate.cli.processes import BackgroundCall, orderly_exit

    with orderly_exit() as begin_end:
        call = BackgroundCall("zstate drive", partial(_run, host, seconds))
        try:
            call.result()
        finally:
            begin_end()
            host.close()
            for line in _report_lines(host.report()):
                print_wrapped(line)


def _run(host: DriverHost, seconds: float | None) -> None:
    """Run the loop. Raises DriverFault for what would end this thread alone, such as SystemExit of an SDK."""
    try:
        host.run(seconds=seconds)
    except Exception:
        raise
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise DriverFault(
            f"the driver of {host.robot!r} raised {error!r} ({place.filename}, line {place.lineno}); it has "
            "been stopped, and the loop has ended",
            robot=host.robot,
        ) from error


def _report_lines(report: DriverReport) -> Iterator[str]:
    if report.rate is not None:
        yield report_text(report.rate)
    spreads = (("late by", report.lateness_us), ("read in", report.read_us), ("written in", report.write_us))
    yield "; ".join(f"{what} {_spread_text(spread)}" for what, spread in spreads if spread.max)
    refused = ", ".join(f"{count} {reason}" for reason, count in report.refused.items())
    yield (
        f"{count_text(report.written, 'setpoint')} written, {count_text(report.faults, 'failure')} of the "
        f"driver, commands refused: {refused or 'none'}"
    )


def _spread_text(spread: Spread) -> str:
    p50, p99, _, most = (format_duration(round(microseconds * 1e3)) for microseconds in spread)
    return f"{p50} (median), {p99} (p99), {most} (max)"


class _StateLines(Closeable):
    """Prints a line for each change of the state of the driver of ``robot``, which this process hosts."""

    def __init__(self, session: Session, robot: str) -> None:
        from zstate.net.latched import LatchedSubscriber
        from zstate.wire.keys import stream_key

        self._newest, self._opened_at = "", time.monotonic()
        self._subscriber = LatchedSubscriber(session, stream_key(robot, "driver"), self._on_state)

    def close(self) -> None:
        self._subscriber.close()

    def _on_state(self, sample: SerializedSample) -> None:
        from zstate.driving.control_loop import NO_READING
        from zstate.driving.messages import DriverState, state_text
        from zstate.wire.native import decode

        with suppress(MessageError):
            state = decode(sample.payload, sample.encoding, DriverState)
            is_waiting = state.reason == NO_READING and time.monotonic() - self._opened_at < _FIRST_READING_S
            text = state_text(state)
            if state.state != "off" and text != self._newest and not is_waiting:
                print_wrapped(text)
                self._newest = text


def _limits(
    model: RobotModel,
    driver: Driver,
    velocities: Sequence[_Limit],
    accelerations: Sequence[_Limit],
    efforts: Sequence[_Limit],
) -> Limits:
    """The limits of the joints of ``driver``: those of the URDF, and those of the options."""
    from zstate.driving import Limits

    names = model.part(driver.joint_names).joint_names
    limits = Limits.of(
        model,
        names,
        velocity=_by_joint(velocities, "--velocity"),
        acceleration=_by_joint(accelerations, "--acceleration"),
        effort=_by_joint(efforts, "--effort"),
    )
    unlimited = [name for name, most in zip(names, limits.velocity.tolist(), strict=True) if most == math.inf]
    if unlimited:
        raise click.UsageError(
            f"the URDF has no limit for the velocity of {', '.join(unlimited)}; give one, such as --velocity "
            f"{unlimited[0]}=1.0"
        )
    return limits


def _limit_lines(model: RobotModel, limits: Limits) -> Iterator[str]:
    """What is not obvious about the ``limits`` of a driver: those by default, and those that are not used."""
    from zstate.driving.limits import BRAKING_S, unused_ranges
    from zstate.model.command_limits import NOT_LIMITING

    names = limits.joint_names
    is_default = (limits.acceleration == limits.velocity / BRAKING_S).tolist()
    if any(is_default):
        which = "the joints" if all(is_default) else ", ".join(compress(names, is_default))
        yield f"{which} brake from their velocity limits in {BRAKING_S:g} s; --acceleration sets others"
    for text in unused_ranges(model, names):
        yield f"warning: {text}"
    for finding in model.findings:
        if NOT_LIMITING in finding.message:
            yield f"warning: {finding.message}"


def _by_joint(limits: Sequence[_Limit], option: str) -> float | Mapping[str, float] | None:
    """One number for all joints, or numbers by joint. Raises UsageError for both."""
    for_all = [value for joint, value in limits if joint is None]
    if for_all and len(limits) > 1:
        raise click.UsageError(f"{option} is one number for all joints, or JOINT=NUMBER for each")
    if for_all:
        return for_all[0]
    return {joint: value for joint, value in limits if joint is not None} or None


def _new_driver(text: str, model: RobotModel, parameters: Mapping[str, str]) -> Driver:
    """The driver that ``text`` names, called with ``parameters``, and what it takes of ``model``."""
    from zstate.driving import Driver

    factory = _driver_class(text)
    signature = _signature_of(factory)
    offered = {"model": model, "joint_names": model.joint_names}
    arguments: dict[str, Any] = {
        name: value for name, value in offered.items() if name in signature.parameters
    }
    for key, value in parameters.items():
        kind = signature.parameters[key].annotation if key in signature.parameters else Any
        arguments[key] = _argument(text, key, value, kind)
    try:
        signature.bind(**arguments)
    except TypeError as error:
        fail(f"{text} cannot be called: {error}; it is {text}{signature}, and --param KEY=VALUE sets one")
    with _failures_of(text):
        driver = factory(**arguments)
    missing = [name for name in vars(Driver) if not name.startswith("_") and not hasattr(driver, name)]
    if missing:
        fail(f"{text} is no driver: it has no {', '.join(missing)}; zstate.driving.Driver describes them")
    return driver


def _signature_of(factory: Callable[..., Any]) -> inspect.Signature:
    """The parameters of ``factory``, with types as annotations where they are known."""
    with suppress(Exception):  # an annotation is any expression, often one for type checkers only
        return inspect.signature(factory, eval_str=True)
    return inspect.signature(factory)


def _argument(driver: str, key: str, text: str, kind: Any) -> Any:
    """``text`` as JSON, or else as it is, if that is of the type ``kind``. Ends the command otherwise."""
    import msgspec

    value: Any = text
    with suppress(ValueError, RecursionError):
        value = json.loads(text)
    with suppress(msgspec.ValidationError):
        return _converted(value, kind)
    with suppress(msgspec.ValidationError):
        return _converted(text, kind)
    return fail(
        f"--param {key}={text} does not fit {driver}, which takes {inspect.formatannotation(kind)} as "
        f"{key!r}; VALUE is JSON, such as 5, true or [1, 2], or else text"
    )


def _converted(value: Any, kind: Any) -> Any:
    """``value`` as the type ``kind``, such as Path. Raises msgspec.ValidationError if that is impossible.

    An annotation that is no type, or unknown, is not checked.
    """
    import msgspec

    if kind is inspect.Parameter.empty or isinstance(kind, str):
        return value
    try:
        return msgspec.convert(value, kind, dec_hook=lambda wanted, given: wanted(given))
    except TypeError:
        return value


def _driver_class(text: str) -> Callable[..., Any]:
    """The class in ``FILE.py:CLASS``; the file may import modules of its folder, as a script may."""
    if text == _SIMULATED:
        from zstate.driving import SimulatedDriver

        return SimulatedDriver
    file, _, name = text.rpartition(":")
    sys.path.insert(0, str(Path(file).resolve().parent))
    spec = spec_from_file_location(_MODULE, file)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[_MODULE] = module_from_spec(spec)
    with _failures_of(file):
        spec.loader.exec_module(module)
    try:
        return getattr(module, name)
    except AttributeError:
        classes = [key for key, value in vars(module).items() if inspect.isclass(value)]
        fail(f"{file} has no {name!r}{did_you_mean(name, classes)}")


@contextmanager
def _failures_of(driver: str) -> Generator[None]:
    """End the command for exceptions of a driver, with the line of its code instead of a traceback.

    That is the last one in its own file: what it calls, such as the SDK of a vendor, may raise, or exit.
    """
    try:
        yield
    except (ZStateError, click.ClickException, SignalExit):
        raise
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        file = str(Path(driver.rpartition(":")[0] or driver).resolve())
        own = [frame for frame in frames if str(Path(frame.filename).resolve()) == file]
        place = (own or frames)[-1]
        at = f"{place.filename}, line {place.lineno}"
        what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        fail(f"{driver} failed: {what} ({at})")
