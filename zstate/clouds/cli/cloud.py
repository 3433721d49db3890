"""zstate cloud: publisher of clouds without a sensor."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Literal

import click

from zstate.cli import options
from zstate.cli.metrics import publisher_rows, serve_metrics
from zstate.cli.output.console import print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress

_RATE_HZ = 10.0
_NOISE_M = 0.01


class _CloudCommand(click.Command):
    """Wrong usage is refused before the command runs: a file of `zstate up` is checked in full."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        rest = super().parse_args(ctx, args)
        if not ctx.params["simulate"] and not ctx.resilient_parsing:
            raise click.UsageError("give --simulate: there is no other source of clouds", ctx)
        if ctx.params["resolution"] is not None and ctx.params["compression"] is None:
            raise click.UsageError("give --compression with --resolution", ctx)
        return rest


@click.command("cloud", cls=_CloudCommand)
@click.argument("robot")
@click.option(
    "--frame", required=True, metavar="FRAME", help="The frame of the lidar, which turns about its z."
)
@click.option("--simulate", is_flag=True, help="Measure a room of 12 x 8 x 3 m from the robot's pose.")
@click.option(
    "--room-frame",
    default="map",
    show_default=True,
    metavar="FRAME",
    help="The frame in whose origin the floor of the room has its middle, if the robot has that frame; else "
    "the root of the robot.",
)
@click.option("--rate", type=options.RATE, default=_RATE_HZ, show_default=True, help="Clouds a second.")
@options.seconds_option
@click.option(
    "--sensor", default="lidar", show_default=True, metavar="NAME", help="The lidar's name; in ROS the topic."
)
@click.option(
    "--compression",
    type=click.Choice(["lz4", "zstd"]),
    help="Compress clouds, for networks that are slower than it.",
)
@click.option(
    "--resolution",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="M",
    help="Round x, y and z to multiples of this [m], which compresses them further.",
)
@options.wires_option
@options.metrics_option
@options.session_options
def cloud_command(
    *,
    robot: str,
    frame: str,
    simulate: bool,
    room_frame: str,
    rate: float,
    seconds: float | None,
    sensor: str,
    compression: Literal["lz4", "zstd"] | None,
    resolution: float | None,
    wires: tuple[str, ...],
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Publish the clouds of a simulated lidar of ROBOT.

    A cloud has 128 x 1016 points with intensity, ring and time, and noise of 1 cm. The lidar turns once per
    cloud: each column of points is measured from the robot's pose at its own instant, as ROBOT's transforms
    on the network give it, and a cloud ends at the newest of them. While no newer transforms arrive there are
    no clouds.

    \b
    zstate publish diffbot --source sine
    zstate cloud diffbot --frame lidar_link --simulate
    zstate cloud diffbot --frame lidar_link --simulate --compression zstd --resolution 0.001
    """
    from zstate.cli.commands.publish import run_publisher
    from zstate.cli.mounted_sensor import Words, mounted_on_robot
    from zstate.clouds import CloudPublisher, SimulatedLidar
    from zstate.clouds.simulated_lidar import MountedLidar
    from zstate.wire.keys import check_robot

    check_robot(robot)
    lidar = SimulatedLidar(turn_ns=round(1e9 / rate), frame=frame, noise_m=_NOISE_M)
    with open_session(network, wires) as session, ExitStack() as opened:
        words = Words("lidar", "cloud", "the room")
        mount, frames = partial(MountedLidar, lidar), (frame, room_frame)
        source, _ = mounted_on_robot(
            mount,
            session,
            robot,
            frames=frames,
            wire=wires[0],
            seconds=seconds,
            opened=opened,
            words=words,
        )
        publisher = CloudPublisher(
            session, robot, sensor, wires, frame=frame, compression=compression, resolution=resolution
        )
        opened.enter_context(publisher)
        opened.enter_context(serve_metrics(metrics, publisher_rows(publisher)))
        places = [messages_for(wire).topics(robot, ("cloud",)) for wire in wires]
        places = [f"{one}/{sensor}" if one.startswith("zstate/") else one for one in places]
        print_wrapped(f"{robot}: clouds in {frame}, {rate:g} Hz, on {' and on '.join(places)}")
        run_publisher(publisher, source, rate, seconds)
