"""zstate publish: the state publisher of a robot."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

import click

from zstate.cli import options
from zstate.cli.metrics import publisher_rows, serve_metrics
from zstate.cli.options import load_robot, open_clock
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped, report_text
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.nodes.publisher import StatePublisher
    from zstate.rate import RateReport
    from zstate.sources import JointReading, JointStateListener
    from zstate.sources.joint_source import JointSource
    from zstate.streams import StreamName

_RATE_HZ = 100.0
_DERIVED: tuple[StreamName, ...] = ("robot_description", "tf_static", "tf")
_EVERYTHING: tuple[StreamName, ...] = ("joint_states", *_DERIVED)


def _check_source(source: str) -> str:
    if source not in ("joints", "sine") and not Path(source).exists():
        raise InvalidInput(f"{source!r} is neither 'joints' nor 'sine' nor a recording that exists")
    return source


@click.command("publish")
@click.argument("robot", type=options.MODEL)
@options.xacro_arguments
@click.option(
    "--source",
    type=options.Checked("text", _check_source),
    default="joints",
    show_default=True,
    metavar="joints|sine|FILE",
    help="joints: the joint_states of another writer; sine: every joint swings; FILE: the motion of a "
    "recording, once, with new stamps.",
)
@click.option(
    "--rate",
    type=options.RATE,
    help="Exact rate of samples. Default: every sample of joint_states; 100 for other sources.",
)
@click.option(
    "--max-age",
    type=options.SECONDS,
    default=0.5,
    show_default=True,
    metavar="S",
    help="Joints from several drivers: publish no reading with a value older than this.",
)
@options.wires_option
@options.clock_option
@options.seconds_option
@options.name_option
@options.takeover_option
@options.metrics_option
@options.session_options
def publish_command(
    *,
    robot: str,
    xacro_args: dict[str, str],
    source: str,
    rate: float | None,
    max_age: float,
    wires: tuple[str, ...],
    clock: str,
    seconds: float | None,
    name: str | None,
    takeover: bool,
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Publish the state of ROBOT: its model, its fixed edges, and transforms.

    ROBOT is a name such as panda, or a URDF or xacro file; NAME:=VALUE are xacro arguments. By default
    subscribes to the robot's joint_states, which a driver or `zstate joints ROBOT` publishes, and publishes
    the transforms of every sample. The joints may come from several drivers, each with its own joints
    (`zstate joints ROBOT --only NAME`). With another source it publishes joint_states as well.

    On the native wire it keeps the last seconds for late joiners, and answers lookups on zstate/ROBOT/lookup
    for devices without a buffer.

    With several wires joint_states are read from the first, and the others get everything. ROS 2 nodes are
    reached through their router. With ROS wires only, the router of this host is the default; otherwise pass
    --connect, or run `zstate bridge`.

    \b
    zstate publish panda --source sine
    zstate publish arm.urdf --rate 250
    zstate publish arm.urdf.xacro prefix:=left_
    zstate publish panda --source run.mcap
    zstate publish panda --source sine --clock sim     # in the time of a simulation or a replay
    zstate publish arm.urdf --wire ros2                # instead of robot_state_publisher
    zstate publish panda --wire native --wire ros2 --connect tcp/127.0.0.1:7447
    """
    from zstate.nodes.publisher import StatePublisher
    from zstate.sources import JointStateListener, SineSource

    model, robot_name = load_robot(robot, name, xacro_args)
    # Joint states are read from the first wire, which gets only what is derived from them.
    derived_wires = wires[:1] if source == "joints" else ()
    whole_wires = wires[len(derived_wires) :]
    with (
        open_session(network, wires) as session,
        open_clock(session, clock, wires[0]) as time,
        StatePublisher(
            session,
            model,
            robot_name,
            derived_wires,
            streams=_DERIVED,
            clock=time,
            takeover=takeover,
            pinocchio_on_demand=True,
        ) as derived,
        StatePublisher(
            session,
            model,
            robot_name,
            whole_wires,
            clock=time,
            takeover=takeover,
            pinocchio_on_demand=True,
        ) as whole,
        serve_metrics(metrics, publisher_rows(derived, whole)),
    ):
        places = [messages_for(wire).topics(robot_name, _DERIVED) for wire in derived_wires]
        places += [messages_for(wire).topics(robot_name, _EVERYTHING) for wire in whole_wires]
        size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joint_names), 'joint')}"
        print_wrapped(f"publishing {robot_name!r} ({size}) on {' and on '.join(places)}")
        if model.findings:
            print_status(
                f"{count_text(len(model.findings), 'warning')} about the model; `zstate check` shows them"
            )
        if not network.is_explicit and len(set(map(is_ros, wires))) == 2:
            print_status("ROS 2 nodes are behind their router; pass --connect, such as tcp/127.0.0.1:7447")
        rate_hz = rate or _RATE_HZ
        if derived_wires:
            source_joints = JointStateListener(
                session, robot_name, model, wire=derived_wires[0], max_age_s=max_age
            )
            _publish_joint_states(source_joints, derived_wires[0], derived, whole, rate, seconds)
        elif source == "sine":
            run_publisher(whole, SineSource(model), rate_hz, seconds)
        else:
            from zstate.recording.player import RecordedSource

            with RecordedSource(source, None, model) as recorded:
                # One tick more than the recording is long, for its last sample.
                run_publisher(whole, recorded, rate_hz, seconds or recorded.duration_s + 1.0 / rate_hz)


def _publish_joint_states(  # noqa: PLR0917 - one use, in the order of the data
    joints: JointStateListener,
    wire: str,
    derived: StatePublisher,
    whole: StatePublisher,
    rate_hz: float | None,
    seconds: float | None,
) -> None:
    """Publish the joint states of ``wire``: what they imply with ``derived``, everything with ``whole``."""
    from zstate.net.topic_statistics import mean_rate_hz
    from zstate.wire.registry import get_wire

    messages, robot = messages_for(wire), derived.robot
    place = messages.topics(robot, ("joint_states",))
    count = first = last = 0

    def on_reading(reading: JointReading) -> None:
        nonlocal count, first, last
        assert reading.stamp is not None
        if not count:
            first = reading.stamp
            is_merged = reading.oldest_stamp is not None
            parts = messages.topics(robot, (get_wire(wire).partial_joint_states,))
            print_status(f"receiving {parts if is_merged else place}: {len(reading.positions)} positions")
        count, last = count + 1, reading.stamp
        whole.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)

    print_status(f"waiting for {place} ...")
    with joints as source:
        if rate_hz is not None:
            run_publisher(derived, _ObservedSource(source, on_reading), rate_hz, seconds)
        else:
            if seconds is not None:
                timer = threading.Timer(seconds, source.close)
                timer.daemon = True
                timer.start()
            try:
                for reading in source:
                    on_reading(reading)
                    derived.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
            finally:
                if count:
                    mean_hz = mean_rate_hz(count, last - first) or 0.0
                    print_wrapped(f"{count_text(count, 'sample')} published, {mean_hz:.2f} Hz")
        if not count:
            advice = messages.translate("`zstate ls` shows the writers")
            fail(f"received nothing on {place} in {seconds:g} s; {advice}")


class _ObservedSource:
    """A joint source whose readings are also passed to ``on_reading``."""

    def __init__(self, source: JointSource, on_reading: Callable[[JointReading], None]) -> None:
        self._source, self._on_reading = source, on_reading

    def read(self, stamp: int) -> JointReading | None:
        reading = self._source.read(stamp)
        if reading is not None:
            self._on_reading(reading)
        return reading


Source_contra = TypeVar("Source_contra", contravariant=True)


class RatePublisher(Protocol[Source_contra]):
    """A publisher that reads a source at an exact rate."""

    def run(self, source: Source_contra, rate_hz: float, *, seconds: float | None) -> RateReport: ...
    def close(self) -> None: ...


def run_publisher(
    publisher: RatePublisher[Source_contra], source: Source_contra, rate_hz: float, seconds: float | None
) -> None:
    """``publisher.run``, with its report at the end, also after a signal.

    A signal interrupts only the calling thread, which waits, so that the loop of the publisher ends in order.
    """
    from zstate.cli.processes import BackgroundCall

    call = BackgroundCall("zstate publish", lambda: publisher.run(source, rate_hz, seconds=seconds))
    try:
        report = call.result()
    except SystemExit:
        publisher.close()
        print_wrapped(report_text(call.result(1.0)))
        raise
    print_wrapped(report_text(report))
