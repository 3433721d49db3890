"""zstate publish: the state publisher."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import click

from zstate.cli.console import count_text, fail, note, say
from zstate.cli.network import Network, open_session
from zstate.cli.options import checked_rate, load_robot, name_option, seconds_option, session_options

if TYPE_CHECKING:
    from zstate.cli.heard_source import HeardSource
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.publisher import StatePublisher
    from zstate.wire.keys import Stream

_SINE_RATE_HZ = 100.0
_DERIVED: tuple[Stream, ...] = ("robot_description", "tf_static", "tf")


@click.command("publish")
@click.argument("robot")
@click.option(
    "--source",
    type=click.Choice(["joints", "sine"]),
    default="joints",
    show_default=True,
    help="joints: what somebody else writes on joint_states; sine: every joint swings.",
)
@click.option(
    "--rate",
    type=float,
    callback=checked_rate,
    metavar="HZ",
    help="Samples a second, exactly; default: every sample that comes in, and 100 for a sine.",
)
@click.option(
    "--wire",
    "wires",
    multiple=True,
    default=("native",),
    show_default=True,
    help="The format of the messages; may be repeated.",
)
@seconds_option
@name_option
@session_options
def publish_command(
    *,
    robot: str,
    source: str,
    rate: float | None,
    wires: tuple[str, ...],
    seconds: float | None,
    name: str | None,
    network: Network,
) -> None:
    """Publish the state of ROBOT: its model, its fixed edges, and transforms.

    ROBOT is a name such as panda, or a URDF file. By default follows its joint_states, which a driver
    or `zstate joints ROBOT` writes, and publishes every sample. With another source writes joint_states
    as well.
    """
    from zstate.publisher import STREAMS, StatePublisher
    from zstate.sources import SineSource

    model, called = load_robot(robot, name)
    streams = STREAMS if source == "sine" else _DERIVED
    with (
        open_session(network) as session,
        StatePublisher(session, model, called, wires, streams=streams) as publisher,
    ):
        _introduce(publisher, streams)
        if source == "sine":
            from zstate.cli.publishing import run

            run(publisher, SineSource(model), rate or _SINE_RATE_HZ, seconds)
        else:
            _follow(session, publisher, rate, seconds)


def _introduce(publisher: StatePublisher, streams: tuple[Stream, ...]) -> None:
    model, robot = publisher.model, publisher.robot
    size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joint_names), 'joint')}"
    say(f"publishing {robot!r} ({size}) on zstate/{robot}/{{{','.join(streams)}}}")
    _mention_warnings(model)


def _mention_warnings(model: RobotModel) -> None:
    if model.findings:
        note(f"{count_text(len(model.findings), 'warning')} about the model; `zstate check` shows them")


def _follow(session: Session, publisher: StatePublisher, rate: float | None, seconds: float | None) -> None:
    from zstate.cli.heard_source import HeardSource
    from zstate.cli.publishing import run

    robot = publisher.robot
    note(f"waiting for joint_states of {robot!r} ...")
    with HeardSource(session, publisher.model, robot) as source:
        if rate is not None:
            run(publisher, source, rate, seconds)
        else:
            _publish_every_sample(publisher, source, seconds)
        if not source.count:
            fail(f"heard no joint_states of {robot!r} in {seconds:g} s; `zstate ls` shows who writes what")


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
            say(f"{count_text(source.count, 'sample')} published, {source.rate_hz:.2f} Hz")
