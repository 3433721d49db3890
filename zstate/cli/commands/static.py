"""zstate static: publisher of static edges."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zstate.cli import options
from zstate.cli.output.console import fail, print_status, print_wrapped
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.up.static_edges import OwnedEdge
    from zstate.net.session import Session
    from zstate.nodes.static_publisher import StaticPublisher
    from zstate.transform import Transform


@click.command("static")
@click.argument("target", required=False)
@click.argument("source", required=False)
@options.pose_options
@click.option(
    "--file",
    type=options.EXISTING_FILE,
    help="All [[static]] of a `zstate up` file, or a calibration in YAML or JSON.",
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a parameter of --file.")
@click.option(
    "--robot",
    metavar="NAME",
    help="The robot that owns the edge; default: that of a full frame name, or the only announced one.",
)
@click.option(
    "--writer", metavar="NAME", help="Name of the writer; default: this program and its process id."
)
@click.option("--new", is_flag=True, help="TARGET is a new frame: do not warn that the robot lacks it.")
@options.takeover_option
@options.wire_option
@options.session_options
def static_command(
    *,
    target: str | None,
    source: str | None,
    file: str | None,
    settings: tuple[str, ...],
    robot: str | None,
    writer: str | None,
    new: bool,
    takeover: bool,
    wire: str,
    network: SessionOptions,
    **pose: Any,
) -> None:
    """Publish the pose of SOURCE in TARGET until Ctrl-C, which withdraws it.

    SOURCE becomes a child of TARGET; late joiners receive it at once. Give --xyz, a rotation, or both; each
    defaults to zero. Bare frame names belong to the robot; `robot/frame` is a full name. Warns if the robot
    has no frame TARGET, with near misses.

    A frame that several robots share, such as a map, belongs to none of them and needs a full name: with
    fleet/map, r1 and r2 are in one map; a bare `map` would be two frames, r1/map and r2/map.

    \b
    zstate static panda_hand camera --xyz 0.05 0 0.04 --rpy-deg 0 -90 0
    zstate static fleet/map r1/odom --xyz 2 1 0 --rpy-deg 0 0 90   # one map,
    zstate static fleet/map r2/odom --xyz 5 1 0                    # two robots
    zstate static --file cell.toml --set site=lab
    zstate static --file handeye.yaml                              # of easy_handeye
    zstate static panda_hand camera --file handeye.yaml            # with other frame names
    zstate static base_link laser --xyz 0.2 0 0.1 --wire ros2      # on /tf_static
    """
    from zstate.cli.frame_checks import unknown_target_warnings
    from zstate.clock import wait_interruptible
    from zstate.nodes.static_publisher import StaticPublisher

    if file is not None:
        edges = _read_edges(file, settings, target, source)
    elif target is None or source is None or all(part is None for part in pose.values()):
        raise click.UsageError("give TARGET, SOURCE and --xyz, a rotation or both; or --file")
    else:
        from zstate.cli.up.cell import StaticSection
        from zstate.cli.up.static_edges import OwnedEdge

        edges = [OwnedEdge(StaticSection(target, source, **pose).transform(), robot)]
    all_wires = {name for edge in edges for name in edge.wires or (wire,)}
    with open_session(network, tuple(sorted(all_wires))) as session, ExitStack() as publishers:
        to_check: list[tuple[StaticPublisher, list[Transform]]] = []
        for (owner, wires), owned in _by_owner(session, edges, robot, wire).items():
            publisher = publishers.enter_context(
                StaticPublisher(session, owner, writer, wires, takeover=takeover)
            )
            for edge in owned:
                publisher.set(edge)
                print_wrapped(_edge_text(edge, publisher, wires))
            if "native" in wires and not new:
                to_check.append((publisher, owned))
        for publisher, owned in to_check:
            for text in unknown_target_warnings(session, publisher, owned):
                print_status(f"warning: {text}", event="warning", robot=publisher.robot)
        wait_interruptible(threading.Event())


def _read_edges(
    file: str, settings: tuple[str, ...], target: str | None, source: str | None
) -> list[OwnedEdge]:
    from zstate.cli.up.cell import read_cell
    from zstate.cli.up.processes import robot_names
    from zstate.cli.up.static_edges import OwnedEdge, owned_edges, read_calibration, with_frames
    from zstate.cli.up.template import parse_settings

    if not file.endswith(".toml"):
        if settings:
            raise click.UsageError(f"--set needs a .toml file; {file!r} has no parameters")
        edges = read_calibration(Path(file))
        if target is not None and len(edges) > 1:
            raise click.UsageError(f"{file!r} has {len(edges)} transforms; leave out TARGET and SOURCE")
        return [OwnedEdge(with_frames(edge, target, source)) for edge in edges]
    if target is not None:
        raise click.UsageError("give TARGET and SOURCE, or a .toml file, not both")
    cell = read_cell(file, parse_settings(settings))
    if not cell.static:
        fail(f"{file!r} has no [[static]]")
    return owned_edges(cell, robot_names(cell))


def _by_owner(
    session: Session, edges: list[OwnedEdge], default: str | None, wire: str
) -> dict[tuple[str, tuple[str, ...]], list[Transform]]:
    """The edges by the robot that owns them and the wires they are published on."""
    owned: dict[tuple[str, tuple[str, ...]], list[Transform]] = {}
    for one in edges:
        wires = one.wires or (wire,)
        owner = one.robot or owner_in_names(one.edge, wires) or default
        if owner is None:
            owner = default = only_owner(session, wires)
        owned.setdefault((owner, wires), []).append(one.edge)
    return owned


def owner_in_names(edge: Transform, wires: tuple[str, ...]) -> str | None:
    """The robot in a full frame name of ``edge``, of the source first; None if both names are bare."""
    # On a ROS wire frames have no owner, and a slash in a frame name has no meaning.
    frames = (edge.source, edge.target) if "native" in wires else ()
    return next((frame.partition("/")[0] for frame in frames if "/" in frame), None)


def only_owner(session: Session, wires: tuple[str, ...]) -> str:
    """The only announced robot, or the one that ``wires`` can mean. Ends the command without one."""
    from zstate.net.discovery import discover

    if "native" in wires:
        print_status("looking for the robot that owns this edge ...")
        robots = discover(session)
        if len(robots) != 1:
            announced = messages_for("native").announced(robots)
            fail(f"cannot tell which robot owns this edge; pass --robot NAME ({announced})")
        return robots[0].name
    robot = messages_for(wires[0]).robot
    if robot is None:
        raise click.UsageError("pass --robot NAME; on this wire each robot has a namespace of its name")
    return robot


def pose_text(edge: Transform) -> str:
    """The pose of ``edge`` in a sentence, in metres and degrees."""
    x, y, z = edge.translation
    # Adding zero turns -0 into 0.
    roll, pitch, yaw = (round(degrees(angle), 6) + 0.0 for angle in edge.rpy)
    return (
        f"pose of {edge.source} in {edge.target}: xyz [{x:g}, {y:g}, {z:g}] m, "
        f"rpy [{roll:g}, {pitch:g}, {yaw:g}] deg"
    )


def _edge_text(edge: Transform, publisher: StaticPublisher, wires: tuple[str, ...]) -> str:
    pose = pose_text(edge)
    places = " and ".join(
        messages_for(wire).topics(publisher.robot, ("tf_static",)) for wire in wires if is_ros(wire)
    )
    if "native" not in wires:
        return f"{pose}, on {places}; after Ctrl-C late joiners do not receive it"
    also = f", also on {places}" if places else ""
    return f"{pose}{also}, until Ctrl-C (robot {publisher.robot!r}, writer {publisher.writer!r})"
