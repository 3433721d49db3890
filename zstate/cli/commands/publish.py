"""zstate publish: the state publisher.

Joint states of somebody else, with a word when they begin.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli.metrics import publisher_collector, serve_metrics
from zstate.cli.options import (
    checked_rate,
    clock_option,
    load_robot,
    metrics_option,
    name_option,
    seconds_option,
    session_options,
    takeover_option,
    wires_option,
    xacro_arguments,
)
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped, report_text
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.processes import BackgroundCall
from zstate.cli.session import SessionOptions, open_session
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.topic_statistics import mean_rate_hz
from zstate.nodes.publisher import StatePublisher
from zstate.sources import JointReading, SubscribedSource

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.nodes.publisher import StatePublisher
    from zstate.sources.joint_source import JointSource
    from zstate.wire.keys import Stream

_RATE_HZ = 100.0
_DERIVED: tuple[Stream, ...] = ("robot_description", "tf_static", "tf")
_EVERYTHING: tuple[Stream, ...] = ("joint_states", *_DERIVED)


def _source(_: click.Context, __: click.Parameter, source: str) -> str:
    if source not in ("joints", "sine") and not Path(source).exists():
        raise click.BadParameter(f"{source!r} is neither 'joints' nor 'sine' nor a recording that exists")
    return source


@click.command("publish")
@click.argument("robot")
@xacro_arguments
@click.option(
    "--source",
    callback=_source,
    default="joints",
    show_default=True,
    metavar="joints|sine|FILE",
    help="joints: what somebody else writes on joint_states; sine: every joint swings; FILE: the motion of a "
    "recording, once, as if it were now.",
)
@click.option(
    "--rate",
    type=float,
    callback=checked_rate,
    metavar="HZ",
    help="Samples a second, exactly; default: every sample that comes in, and 100 for another source.",
)
@wires_option
@clock_option
@seconds_option
@name_option
@takeover_option
@metrics_option
@session_options
def publish_command(
    *,
    robot: str,
    xacro_args: dict[str, str],
    source: str,
    rate: float | None,
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
    follows its joint_states, which a driver or `zstate joints ROBOT` writes, and publishes every sample.
    With another source writes joint_states as well.

    On the native wire it remembers the last seconds for whoever joins, and answers lookups on
    zstate/ROBOT/lookup, for devices without a buffer.

    With several wires joint_states are heard on the first, and the others get everything. ROS 2 nodes
    are met at their router: where ROS 2 is spoken alone, that of this host is found; otherwise say
    --connect, or let `zstate bridge` carry the robot over.

    \b
    zstate publish panda --source sine
    zstate publish arm.urdf --rate 250
    zstate publish arm.urdf.xacro prefix:=left_
    zstate publish panda --source run.mcap
    zstate publish panda --source sine --clock sim     # as time goes on in a simulation or a replay
    zstate publish arm.urdf --wire ros2                # in the place of robot_state_publisher
    zstate publish panda --wire native --wire ros2 --connect tcp/127.0.0.1:7447
    """
    from zstate.cli.options import open_clock
    from zstate.nodes.publisher import StatePublisher
    from zstate.sources import SineSource

    model, called = load_robot(robot, name, xacro_args)
    followed = wires[:1] if source == "joints" else ()
    with (
        open_session(network, wires) as session,
        open_clock(session, clock, wires[0]) as time,
        StatePublisher(
            session, model, called, followed, streams=_DERIVED, clock=time, takeover=takeover
        ) as derived,
        StatePublisher(
            session, model, called, wires[len(followed) :], clock=time, takeover=takeover
        ) as whole,
        serve_metrics(metrics, publisher_collector(derived, whole)),
    ):
        places = [messages_for(wire).place(called, _DERIVED) for wire in followed]
        places += [messages_for(wire).place(called, _EVERYTHING) for wire in wires[len(followed) :]]
        _introduce(whole, places)
        _mention_router(network, wires)
        if followed:
            _follow(session, followed[0], derived, whole, rate, seconds)
        elif source == "sine":
            run_publisher(whole, SineSource(model), rate or _RATE_HZ, seconds)
        else:
            _publish_recording(whole, source, rate or _RATE_HZ, seconds)


def _introduce(publisher: StatePublisher, places: list[str]) -> None:
    model = publisher.model
    size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joint_names), 'joint')}"
    print_wrapped(f"publishing {publisher.robot!r} ({size}) on {' and on '.join(places)}")
    _mention_warnings(model)


def _mention_router(network: SessionOptions, wires: tuple[str, ...]) -> None:
    if not network.is_explicit and len(set(map(is_ros, wires))) == 2:
        print_status("ROS 2 nodes are met at their router: say --connect, for instance tcp/127.0.0.1:7447")


def _mention_warnings(model: RobotModel) -> None:
    if model.findings:
        print_status(
            f"{count_text(len(model.findings), 'warning')} about the model; `zstate check` shows them"
        )


def _follow(  # noqa: PLR0917 - one use, in the order of what happens
    session: Session,
    wire: str,
    derived: StatePublisher,
    whole: StatePublisher,
    rate_hz: float | None,
    seconds: float | None,
) -> None:

    words, robot = messages_for(wire), derived.robot
    place = words.place(robot, ("joint_states",))
    print_status(f"waiting for {place} ...")
    with HeardSource(session, derived.model, robot, wire, further=whole) as source:
        if rate_hz is not None:
            run_publisher(derived, source, rate_hz, seconds)
        else:
            _publish_every_sample(derived, source, seconds)
        if not source.count:
            who = words.translate("`zstate ls` shows who writes what")
            fail(f"heard nothing on {place} in {seconds:g} s; {who}")


def run_publisher(
    publisher: StatePublisher, source: JointSource, rate_hz: float, seconds: float | None
) -> None:
    """``publisher.run``, and its report at the end, also after a signal.

    A signal interrupts only the calling thread, which waits, so that the loop of the publisher ends in order.
    """

    worker = BackgroundCall("zstate publish", lambda: publisher.run(source, rate_hz, seconds=seconds))
    try:
        report = worker.result()
    except SystemExit:
        publisher.close()
        print_wrapped(report_text(worker.result(1.0)))
        raise
    print_wrapped(report_text(report))


def _publish_recording(publisher: StatePublisher, path: str, rate_hz: float, seconds: float | None) -> None:
    from zstate.recording.source import RecordedSource

    with RecordedSource(path, None, publisher.model) as source:
        # One tick more than the recording is long, for its last sample.
        run_publisher(publisher, source, rate_hz, seconds or source.duration_s + 1.0 / rate_hz)


def _publish_every_sample(publisher: StatePublisher, source: HeardSource, seconds: float | None) -> None:
    if seconds is not None:
        timer = threading.Timer(seconds, source.close)
        timer.daemon = True
        timer.start()
    try:
        for reading in source:
            publisher.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
    finally:
        if source.count:
            print_wrapped(f"{count_text(source.count, 'sample')} published, {source.rate_hz:.2f} Hz")


class HeardSource(SubscribedSource):
    """A SubscribedSource that announces the first reading and counts them all.

    Each one is published by ``further`` as well.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str,
        wire: str,
        *,
        further: StatePublisher,
    ) -> None:
        super().__init__(session, model, robot, wire=wire)
        self.count = 0
        self._further = further
        self._place = messages_for(wire).place(robot, ("joint_states",))
        self._first = self._last = 0

    @property
    def rate_hz(self) -> float:
        """The rate of the readings so far, by their stamps; 0 for fewer than two."""
        return mean_rate_hz(self.count, self._last - self._first) or 0.0

    def read(self, stamp: int) -> JointReading | None:
        reading = super().read(stamp)
        if reading is not None:
            self._note(reading)
        return reading

    def __iter__(self) -> Iterator[JointReading]:
        for reading in super().__iter__():
            self._note(reading)
            yield reading

    def _note(self, reading: JointReading) -> None:
        assert reading.stamp is not None
        if not self.count:
            self._first = reading.stamp
            print_status(f"heard {self._place}: {len(reading.positions)} positions")
        self._last = reading.stamp
        self.count += 1
        self._further.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
