"""zstate scan: publisher of laser scans without a sensor."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import publisher_rows, serve_metrics
from zstate.cli.output.console import print_status, print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.scans import RangeSource, Scan
    from zstate.scans.simulated_laser import MountedLaser

_RATE_HZ = 30.0
_RAYS_PER_TURN = 1440
"""For a scanner with a ray every 0.25 degrees, which turns once per scan."""


class _ScanCommand(click.Command):
    """Wrong usage is refused before the command runs: a file of `zstate up` is checked in full."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        rest = super().parse_args(ctx, args)
        is_simulated = ctx.params["map_file"] is not None
        if ctx.params["dummy"] is is_simulated and not ctx.resilient_parsing:
            raise click.UsageError("give --simulate MAP.yaml or --dummy, one of them", ctx)
        return rest


@click.command("scan", cls=_ScanCommand)
@click.argument("robot")
@click.option(
    "--frame", required=True, metavar="FRAME", help="The frame of the scanner: ray 0 degrees is along its x."
)
@click.option(
    "--simulate",
    "map_file",
    type=options.EXISTING_FILE,
    metavar="MAP.yaml",
    help="Measure this map of map_server from the robot's pose.",
)
@click.option(
    "--dummy", is_flag=True, help="The pattern of ROS 2's dummy_laser: all ranges are |sin(3 t)| [m]."
)
@click.option(
    "--map-frame",
    default="map",
    show_default=True,
    metavar="FRAME",
    help="The frame in which the map of --simulate stands, if the robot has that frame; else the map stands "
    "in the root of the robot.",
)
@click.option("--rate", type=options.RATE, default=_RATE_HZ, show_default=True, help="Scans a second.")
@options.seconds_option
@click.option(
    "--sensor",
    default="scan",
    show_default=True,
    metavar="NAME",
    help="The scanner's name; in ROS the topic.",
)
@options.wires_option
@options.metrics_option
@options.session_options
def scan_command(
    *,
    robot: str,
    frame: str,
    map_file: str | None,
    dummy: bool,
    map_frame: str,
    rate: float,
    seconds: float | None,
    sensor: str,
    wires: tuple[str, ...],
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Publish the scans of a laser scanner of ROBOT: simulated in a map, or a dummy.

    A scan has 1081 rays from -135 to 135 degrees, up to 10 m. The simulated scanner turns once per scan: each
    ray is measured from the robot's pose at its own instant, as ROBOT's transforms on the network give it,
    and a scan ends at the newest of them. While no newer transforms arrive there are no scans.

    \b
    zstate publish diffbot --source sine
    zstate scan diffbot --frame lidar_link --simulate hall.yaml
    zstate scan r1 --frame laser --simulate hall.yaml --map-frame hall/map
    zstate scan r1 --frame laser --dummy --sensor front
    zstate scan rrbot --frame lower --dummy --wire ros2    # /scan
    """
    from zstate.cli.commands.publish import run_publisher
    from zstate.cli.mounted_sensor import Words, mounted_on_robot
    from zstate.scans import ScanPublisher, SimulatedLaser, load_map
    from zstate.scans.simulated_laser import (
        DUMMY_ANGLE_INCREMENT,
        DUMMY_ANGLE_MIN,
        DUMMY_RANGE_MAX,
        MountedLaser,
    )
    from zstate.wire.keys import check_robot

    check_robot(robot)
    ray_ns = 0 if dummy else round(1e9 / (rate * _RAYS_PER_TURN))
    laser = None
    if map_file is not None:
        laser = SimulatedLaser(load_map(map_file), ray_ns=ray_ns, frame=frame)
    with open_session(network, wires) as session, ExitStack() as opened:
        source: RangeSource = _DummyLaser(frame)
        if laser is not None:
            words = Words("scanner", "scan", "the map")
            mount, frames = partial(MountedLaser, laser), (frame, map_frame)
            mounted, place = mounted_on_robot(
                mount,
                session,
                robot,
                frames=frames,
                wire=wires[0],
                seconds=seconds,
                opened=opened,
                words=words,
            )
            source = _WatchedLaser(mounted, f"{frame} is outside the map, which stands in {place}")
        publisher = ScanPublisher(
            session,
            robot,
            sensor,
            wires,
            angle_min=DUMMY_ANGLE_MIN,
            angle_increment=DUMMY_ANGLE_INCREMENT,
            range_min=0.0,
            range_max=DUMMY_RANGE_MAX,
            ray_ns=ray_ns,
            frame=frame,
        )
        opened.enter_context(publisher)
        opened.enter_context(serve_metrics(metrics, publisher_rows(publisher)))
        places = [messages_for(wire).topics(robot, ("scan",)) for wire in wires]
        places = [f"{one}/{sensor}" if one.startswith("zstate/") else one for one in places]
        print_wrapped(f"{robot}: scans in {frame}, {rate:g} Hz, on {' and on '.join(places)}")
        run_publisher(publisher, source, rate, seconds)


class _WatchedLaser:
    """The sweeps of ``source``; prints ``warning`` each time that it has left the map."""

    def __init__(self, source: MountedLaser, warning: str) -> None:
        self._source, self._warning = source, warning
        self._was_off_map = False

    def read(self, stamp: int) -> Scan | None:
        scan, is_off_map = self._source.read(stamp), self._source.is_off_map
        if is_off_map and not self._was_off_map:
            print_status(self._warning, event="off the map", level="warning")
        self._was_off_map = is_off_map
        return scan


class _DummyLaser:
    """A source of the scans of ROS 2's dummy_laser, in ``frame``."""

    def __init__(self, frame: str) -> None:
        self._frame = frame

    def read(self, stamp: int) -> Scan:
        from zstate.scans import dummy_scan

        return dummy_scan(stamp, self._frame)
