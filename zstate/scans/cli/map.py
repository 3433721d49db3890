"""zstate map: publisher of an occupancy grid."""

from __future__ import annotations

import threading

import click

from zstate.cli import options
from zstate.cli.output.console import print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session


@click.command("map")
@click.argument("file", type=options.EXISTING_FILE)
@click.option(
    "--name",
    metavar="NAME",
    help="The place, announced like a robot, or the robot that has made the map; default: the file's name.",
)
@click.option(
    "--frame",
    default="map",
    show_default=True,
    metavar="FRAME",
    help="The frame of the map; a bare name belongs to the place, so that `map` of hall is hall/map.",
)
@click.option(
    "--writer",
    default="map",
    show_default=True,
    metavar="NAME",
    help="Name of the writer, which distinguishes several maps of one place.",
)
@options.wires_option
@options.session_options
def map_command(
    *, file: str, name: str | None, frame: str, writer: str, wires: tuple[str, ...], network: SessionOptions
) -> None:
    """Publish the map of map_server whose YAML file is FILE, until Ctrl-C, which withdraws it.

    Late joiners receive it at once. The modes trinary, scale and raw, negate, and the yaw of the origin are
    those of map_server; every mistake in the file is reported with its line. A static edge from the map's
    frame to the root of a robot puts the robot into the map.

    \b
    zstate map hall.yaml
    zstate static hall/map r1/odom --xyz 2 1 0          # r1 is in the hall
    zstate map floor2.yaml --name hall --writer floor2
    zstate map slam.yaml --name r1                      # made by r1, in r1/map
    zstate map hall.yaml --wire ros2                    # /map, for rviz2 and nav2
    """
    from zstate.clock import wait_interruptible
    from zstate.errors import InvalidInput
    from zstate.scans import MapPublisher, load_map
    from zstate.streams import GRID_CELLS
    from zstate.wire.keys import check_robot, check_writer

    place = check_robot(name or options.place_name(file), "place")
    check_writer(writer)
    grid = load_map(file, frame)
    height, width = grid.cells.shape
    if width * height > GRID_CELLS:
        raise InvalidInput(
            f"{file} has {width} x {height} cells; a map on the network has at most {GRID_CELLS}, for "
            "instance 4096 x 4096: publish parts of it, each with its own --writer, or a map of larger cells"
        )
    with open_session(network, wires) as session, MapPublisher(session, place, grid, wires, writer=writer):
        width_m, height_m = grid.size
        places = [messages_for(wire).topics(place, ("map",)) for wire in wires]
        places = [f"{one}/{writer}" if one.startswith("zstate/") else one for one in places]
        print_wrapped(
            f"{place}: {width} x {height} cells of {grid.resolution:g} m, {width_m:g} x {height_m:g} m, "
            f"in {frame}, on {' and on '.join(places)}, until Ctrl-C"
        )
        wait_interruptible(threading.Event())
