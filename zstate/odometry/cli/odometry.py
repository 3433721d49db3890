"""zstate odometry: where the base of a robot is, live or from a recording."""

from __future__ import annotations

import shlex
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import LookupFailed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator

    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.nodes.listener import TransformListener
    from zstate.odometry import DiffDrive, MapEstimator, OdometryNode
    from zstate.odometry.cli.heard import Heard
    from zstate.odometry.cli.reference import ReferenceName
    from zstate.odometry.cli.settings_file import LegSettings, OdometrySettings, PlanarPose
    from zstate.odometry.messages import SensorMessage
    from zstate.odometry.source_noise import SensorNoise
    from zstate.streams import StreamName


def _parse_diff_drive(text: str) -> DiffDrive:
    from zstate.odometry.cli.settings_file import parse_diff_drive

    return parse_diff_drive(text)


def _parse_feet(text: str) -> LegSettings:
    from zstate.odometry.cli.settings_file import parse_feet

    return parse_feet(text)


def _parse_sensor(kind: str, text: str) -> tuple[str, SensorNoise]:
    from zstate.odometry.cli.settings_file import parse_sensor

    return parse_sensor(kind, text)


def _sensor_option(
    kind: str, stated: str, help_text: str, name: str = "SENSOR"
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """``--kind SENSOR[:...]``, repeatable: further sensors, of whose noise ``stated`` may be stated."""
    return click.option(
        f"--{kind}",
        metavar=f"{name}[:{stated}]",
        type=options.Checked(name, partial(_parse_sensor, kind)),
        multiple=True,
        help=f"{help_text} Repeatable.",
    )


def _parse_reference(text: str) -> ReferenceName:
    from zstate.odometry.cli.reference import parse_reference

    return parse_reference(text)


def _parse_plot(file: str) -> Path:
    from zstate.recording.cli.plot import plot_file

    return plot_file(file)


_OF_ALL = (*options.NETWORK, "log_format")
"""The parameters that any run of the command has a use for."""

_OF_REQUESTS = ("robot", "writer", "reset", "set_pose", *_OF_ALL)
"""The parameters of the command that a request to a running odometry has a use for."""

_OF_INIT = ("robot", "imu", "odom", "base", "init", "overwrite", "replay", "seconds", *_OF_ALL)
"""Those that the first file of a robot has a use for."""

_INIT_S = 5.0
"""How long it listens: a receiver sends once a second, and an IMU at rest shows its noise."""


@click.command("odometry")
@click.argument("robot")
@click.option("--imu", metavar="SENSOR", help="The IMU: a stream of ROBOT; default: imu.")
@_sensor_option(
    "velocity",
    "sigma=M/S,scale=PART,axes=x+y,...",
    "A further stream of measured velocities. Its noise is that of its messages, or the standard deviation "
    "sigma; scale is that of a constant relative error. axes are the numbers that are used.",
)
@_sensor_option(
    "pose",
    "sigma=M,sigma_deg=DEG,axes=x+yaw,...",
    "A further stream of measured poses in the frame of the odometry. Its noise is that of its messages, or "
    "sigma and sigma_deg. axes are the numbers that are used, of x, y, z, roll, pitch and yaw.",
)
@_sensor_option(
    "relative",
    "sigma=M,sigma_deg=DEG,scale=PART,...",
    "Another odometry, such as that of cameras: pose/NAME, or odometry/NAME of ROS or of a recording. Only "
    "its motion counts. sigma and sigma_deg are those of a metre of its way, scale is that of a constant "
    "factor.",
    "STREAM/NAME",
)
@_sensor_option(
    "heading",
    "sigma_deg=DEG,...",
    "An IMU whose orientation shows the yaw, as by a compass. Its noise is that of its messages, or "
    "sigma_deg.",
)
@_sensor_option(
    "magnetometer",
    "sigma_deg=DEG",
    "A magnetometer, whose field shows the yaw. Its noise is sigma_deg, by default 5; calibration and place "
    "are set by --file.",
)
@_sensor_option(
    "fix",
    "sigma=M,...",
    "A satellite receiver, which places the odometry in a map, x east and y north. Its noise is that of its "
    "messages, or sigma.",
)
@_sensor_option(
    "barometer",
    "sigma=M",
    "A barometer, which bounds the drift of the height. The noise of its heights is that of its messages, or "
    "sigma; that of weather comes on top.",
)
@click.option("--map", "map_frame", metavar="FRAME", help="The frame of that map; default: map.")
@click.option(
    "--datum",
    type=float,
    nargs=3,
    metavar="LAT LON ALT",
    help="Its origin [degrees, metres above the ellipsoid]; default: the first fix.",
)
@click.option(
    "--diff-drive",
    type=options.Checked("WHEELS", _parse_diff_drive),
    help="Wheels on one axle: left=JOINT,right=JOINT,radius=M,track=M; several on a side are repeated.",
)
@click.option(
    "--feet",
    type=options.Checked("LINK,LINK,...", _parse_feet),
    help="Links that touch the ground in turn; needs velocities in the joint states.",
)
@click.option(
    "--file",
    type=options.EXISTING_FILE,
    metavar="FILE.toml",
    help="The settings of the robot, with the noise of its sensors; options take precedence.",
)
@click.option(
    "--init",
    metavar="FILE.toml",
    help="Write the first such file, by what ROBOT publishes in --seconds, by default 5, or by --replay.",
)
@click.option("--overwrite", is_flag=True, help="With --init: replace an existing FILE.toml.")
@click.option("--odom", metavar="FRAME", help="The frame of the odometry; default: odom.")
@click.option(
    "--base", metavar="FRAME", help="The frame that is placed in it; default: the root of the model."
)
@click.option(
    "--initial-pose",
    type=float,
    nargs=3,
    metavar="X Y YAW",
    help="Where the base starts [m, degrees]; default: at the origin, after a second at rest.",
)
@click.option(
    "--planar",
    is_flag=True,
    help="Publish z, roll and pitch of the base as zero, for planners in the plane; gravity still levels.",
)
@click.option(
    "--rate", type=options.RATE, help="Publish so often at most; default: with each reading of the IMU."
)
@click.option(
    "--writer", default="odometry", show_default=True, metavar="NAME", help="The name to publish under."
)
@click.option(
    "--reset",
    is_flag=True,
    help="Restart the odometry that runs as --writer: pose, biases and alignment, at rest.",
)
@click.option(
    "--set-pose",
    type=float,
    nargs=3,
    metavar="X Y YAW",
    help="Have it place the base there [m, degrees], at z = 0; with --reset it restarts there.",
)
@click.option(
    "--replay",
    metavar="RECORDING",
    help="Compute from a recording instead, and publish nothing: a table of its sources.",
)
@click.option(
    "--reference",
    metavar="pose/SENSOR[:sigma=M]",
    type=options.Checked("REFERENCE", _parse_reference),
    help="With --replay: compare with poses in the recording, or with odometry/WRITER: ATE, the error at the "
    "end, NEES. Its noise is that of its messages, or sigma.",
)
@click.option(
    "--plot",
    type=options.Checked("FILE", _parse_plot),
    help="With --replay: draw the path with ellipses of 95 %, and the NIS of each source. PNG, SVG or PDF.",
)
@options.wires_option
@options.seconds_option
@options.session_options
def odometry_command(
    *,
    robot: str,
    imu: str | None,
    map_frame: str | None,
    datum: tuple[float, float, float] | None,
    diff_drive: DiffDrive | None,
    feet: LegSettings | None,
    file: str | None,
    init: str | None,
    overwrite: bool,
    odom: str | None,
    base: str | None,
    initial_pose: PlanarPose | None,
    planar: bool,
    rate: float | None,
    writer: str,
    reset: bool,
    set_pose: PlanarPose | None,
    replay: str | None,
    reference: ReferenceName | None,
    plot: Path | None,
    seconds: float | None,
    wires: tuple[str, ...],
    network: SessionOptions,
    **sensors: tuple[tuple[str, SensorNoise], ...],
) -> None:
    """Publish where the base of ROBOT is: odom -> base, from its IMU, its joints and its velocities.

    The estimate has a pose, a velocity and the covariances of both, and corrects the biases of the IMU. The
    mounts of the sensors are those of the robot's model. Data may be late and out of order. The robot should
    stand still for a few seconds at first: gravity aligns the IMU, and its gyro is zeroed. Later rests,
    on wheels or on all feet, zero it again.

    Each of these sensors may also state delay_s, by how much its stamps are late against those of the IMU
    [s], and gate, the part of right readings that pass, by default 0.999.

    Each source has a NIS, the mean square of what it contradicts in units of its sigmas. `zstate monitor` and
    `zstate doctor` show the sentences about sources whose sigmas are wrong. The settings of a robot with the
    noise of its sensors are a file, which `--replay` checks on a recording:

    \b
    zstate odometry r1 --init r1.toml                              # the first file, of a robot at rest
    zstate odometry r1 --imu imu --diff-drive left=lw,right=rw,radius=0.08,track=0.32
    zstate odometry go2 --feet FL_foot,FR_foot,RL_foot,RR_foot
    zstate odometry r1 --file r1.toml
    zstate odometry r1 --velocity wheels:sigma=0.05                # [m/s]; messages without covariance
    zstate odometry r1 --diff-drive ... --relative pose/camera     # visual odometry
    zstate odometry r1 --diff-drive ... --fix gps                  # and map -> odom, by GPS
    zstate odometry r1 --file r1.toml --replay run.mcap --plot run.png
    zstate odometry r1 --file r1.toml --replay run.mcap --reference pose/mocap
    zstate odometry r1 --file r1.toml --wire ros2 --wire native    # sensors of ROS 2 nodes
    zstate odometry r1 --set-pose 2 1 90                           # the base of the one that runs
    """
    if reset or set_pose is not None:
        _check_options(_OF_REQUESTS, "--reset and --set-pose go to an odometry that runs")
        with open_session(network) as session:
            _request(session, robot, writer, reset=reset, place=set_pose)
        return
    from zstate.odometry.cli.settings_file import OdometrySettings, read_settings

    if init is not None:
        from zstate.odometry.cli.heard import heard_in, heard_live

        _check_options(_OF_INIT, "--init writes a file")
        settings = OdometrySettings(imu=imu or "imu", odom=odom or "odom", base=base)
        _check_new(init, overwrite=overwrite)
        if replay is not None:
            heard = heard_in(replay, robot, seconds or _INIT_S)
        else:
            with open_session(network) as session:
                print_status(f"listening to {robot!r} for {seconds or _INIT_S:g} s; it should stand")
                heard = heard_live(session, robot, seconds or _INIT_S)
        _write_initial_file(init, heard, settings)
        return
    for option, value in (("--plot", plot), ("--reference", reference)):
        if value is not None and replay is None:
            raise click.UsageError(f"{option} needs --replay RECORDING")
    if overwrite:
        raise click.UsageError("--overwrite needs --init FILE.toml")
    settings = OdometrySettings() if file is None else read_settings(file)
    given = {
        "imu": imu,
        **{kind: dict(given) or None for kind, given in sensors.items()},
        "map": map_frame,
        "datum": datum,
        "odom": odom,
        "base": base,
        "initial_pose": initial_pose,
        "planar": planar or None,
        "legs": feet,
    }
    settings = replace(settings, **{key: value for key, value in given.items() if value is not None})
    if diff_drive is not None:
        settings = replace(settings, diff_drive=diff_drive, ackermann=None, mecanum=None)
    if not settings.has_joints and not any(one.kind.is_enough for one in settings.sensors):
        raise click.UsageError(
            "an IMU alone drifts by metres in seconds; add --diff-drive, --feet, --velocity, --pose, "
            "--relative or --file"
        )
    if replay is not None:
        _replay(replay, robot, settings, reference, plot)
        return
    with open_session(network, wires) as session:
        _publish(session, robot, settings, wires, writer=writer, rate_hz=rate, seconds=seconds)


def _check_options(known: Collection[str], purpose: str) -> None:
    """Refuse options that have no use with those of ``purpose``."""
    context = click.get_current_context()
    for one in context.command.params:
        name = one.name or ""
        if name not in known and context.get_parameter_source(name) == ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{purpose}; {one.opts[0]} is not for it")


def _check_new(file: str, *, overwrite: bool) -> None:
    if Path(file).exists() and not overwrite:
        fail(f"{file!r} exists; choose another name, or pass --overwrite")


def _write_initial_file(file: str, heard: Heard, settings: OdometrySettings) -> None:
    """Write the first settings of a robot, by what was heard of it."""
    from zstate.odometry.cli.initial_file import initial_file

    found = initial_file(heard, file, settings)
    try:
        Path(file).write_text(found.text, encoding="utf-8")
    except OSError as error:
        fail(f"{file!r} cannot be written: {error.strerror}")
    for note in found.notes:
        print_wrapped(note)
    command = f"zstate odometry {shlex.quote(heard.robot)} --file {shlex.quote(file)}"
    print_wrapped(f"wrote {file}: look it through, then run `{command}`")


def _request(session: Session, robot: str, writer: str, *, reset: bool, place: PlanarPose | None) -> None:
    """Send a request to the odometry that runs, and print what it did."""
    from zstate.odometry import request_odometry
    from zstate.odometry.cli.settings_file import planar_transform

    pose = None if place is None else planar_transform("odom", "base", place)
    request_odometry(session, robot, "reset" if reset else "set_pose", pose, writer=writer)
    done = ["restarted"] if reset else []
    if place is not None:
        done.append("placed the base at x {:g} m, y {:g} m, yaw {:g} deg".format(*place))
    print_wrapped(f"the odometry {writer!r} of {robot!r} {' and '.join(done)}")


def _publish(
    session: Session,
    robot: str,
    settings: OdometrySettings,
    wires: tuple[str, ...],
    *,
    writer: str,
    rate_hz: float | None,
    seconds: float | None,
) -> None:
    """Publish until a signal, or for ``seconds``, with a report of each source at the end."""
    from zstate.clock import wait_interruptible
    from zstate.nodes.listener import TransformListener
    from zstate.odometry import OdometryNode

    for one in settings.sensors:
        one.check_live(wires[0])
    with ExitStack() as opened:
        listener = opened.enter_context(TransformListener(session, robot, wire=wires[0]))
        base, imu_frame, model = _wait_for_sensors(session, robot, settings, listener, wires[0])
        estimator = settings.estimator(robot, base, imu_frame, listener.buffer, model)
        in_map = settings.map_estimator(robot, estimator, listener.buffer)
        node = opened.enter_context(
            OdometryNode(
                session,
                robot,
                estimator,
                imu=settings.imu,
                sensors=[(one.name, one.noise) for one in settings.sensors],
                in_map=in_map,
                has_joints=settings.has_joints,
                planar=settings.planar,
                writer=writer,
                wires=wires,
                rate_hz=rate_hz,
            )
        )
        print_wrapped(
            f"publishing the odometry of {robot!r}, {settings.odom} -> {base}, as {writer!r}, from "
            f"{_sources_text(settings)}"
        )
        try:
            if wait_interruptible(node.has_failed, seconds):
                fail(str(node.failure))
        finally:
            for line in _end_lines(node, in_map):
                print_wrapped(line)


def _wait_for_sensors(
    session: Session, robot: str, settings: OdometrySettings, listener: TransformListener, wire: str
) -> tuple[str, str, RobotModel | None]:
    """The frames of the base and of the IMU, and the model, once each sensor has sent and the mount is known.

    What is missing is printed. There may be no model with ``settings.base`` and without legs. Raises
    InvalidInput for a sensor whose noise is not known.
    """
    from zstate.cli.waiting import ConditionWaiter
    from zstate.odometry import SensorListener
    from zstate.odometry.cli.settings_file import others_text
    from zstate.odometry.messages import frame_of
    from zstate.sources.joint_state_listener import DescriptionSubscriber
    from zstate.wire.keys import full_name

    waiter = ConditionWaiter()
    models: dict[str, RobotModel] = {}
    needed = [("imu", settings.imu), *((one.stream, one.writer) for one in settings.sensors)]
    """The stream and the name of each sensor."""
    heard: dict[StreamName, dict[str, SensorMessage]] = {stream: {} for stream, _ in needed}
    """The first message of each sensor, by stream."""

    def base() -> str:
        return settings.base or models[robot].root

    def on_message(stream: StreamName, name: str, message: SensorMessage) -> None:
        if name not in heard[stream]:
            heard[stream][name] = message
            waiter.notify()

    def on_description(name: str, model: RobotModel) -> None:
        models.setdefault(name, model)
        waiter.notify()

    def reason() -> str:
        for stream, name in needed:
            if name not in heard[stream]:
                return f"{robot!r} has no message on {stream}/{name}{others_text(name, heard[stream])}"
        if robot not in models and settings.legs is not None:
            return f"the model of {robot!r}, which feet need, has no publisher; start it"
        if robot not in models and settings.base is None:
            return f"the model of {robot!r} has no publisher; start it, or give --base"
        try:
            for stream, name in needed:
                if frame := frame_of(heard[stream][name]):
                    listener.buffer.lookup(full_name(robot, base()), frame)
        except LookupFailed as missing:
            return str(missing)
        return ""

    listener.add_observer(waiter.notify)
    with (
        SensorListener(session, robot, {stream: partial(on_message, stream) for stream in heard}, wire=wire),
        DescriptionSubscriber(session, robot, on_description, wire),
    ):
        waiter.wait_for(lambda: not reason(), None, reason)
    for one in settings.sensors:
        one.covariance(heard[one.stream][one.writer])
    return base(), frame_of(heard["imu"][settings.imu]), models.get(robot)


def _sources_text(settings: OdometrySettings) -> str:
    wheels = ["its wheels"] if settings.wheels is not None else []
    feet = ["its feet"] if settings.legs is not None else []
    return ", ".join(
        [
            f"its IMU {settings.imu!r}",
            *wheels,
            *feet,
            *map(str, settings.sensors),
        ]
    )


def _end_lines(node: OdometryNode, in_map: MapEstimator | None) -> Iterator[str]:
    from zstate.odometry.cli.replay import health_text, jump_lines

    yield f"{count_text(node.published, 'sample')} published"
    for one in node.health():
        yield health_text(one)
    if in_map is not None:
        yield from jump_lines(in_map.refused_jumps())


def _replay(
    path: str, robot: str, settings: OdometrySettings, reference: ReferenceName | None, plot: Path | None
) -> None:
    """Print the report of a recording, and draw it. Ends the command if nothing can be estimated."""
    from zstate.odometry.cli.replay import odometry_figure, replay, report_lines
    from zstate.recording.cli.plot import new_figure, save_figure

    if plot is not None:
        new_figure("", 1.0)  # reports a missing Matplotlib before it reads the recording
    replayed = replay(path, robot, settings, reference)
    if not replayed.states:
        fail(f"{path} has no odometry of {robot!r}: it needs a second of rest, or of readings of the IMU")
    for line in report_lines(replayed):
        print_wrapped(line)
    if plot is not None:
        save_figure(odometry_figure(replayed, f"odometry of {robot}"), plot)
        print_wrapped(f"wrote {plot}")
