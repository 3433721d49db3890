"""zstate static: edges that never move."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from math import degrees
from typing import TYPE_CHECKING

import click

from zstate.cli.console import fail, note, say
from zstate.cli.network import Network, open_session
from zstate.cli.options import session_options, takeover_option, wire_option
from zstate.cli.words import is_ros, words_of

if TYPE_CHECKING:
    from zstate.cli.config_file import Quaternion, StaticSection, Vector3
    from zstate.net.session import Session
    from zstate.statics import StaticPublisher
    from zstate.transform import Transform


@click.command("static")
@click.argument("target", required=False)
@click.argument("source", required=False)
@click.option("--xyz", type=float, nargs=3, metavar="X Y Z", help="Where SOURCE is in TARGET [m].")
@click.option(
    "--rpy-deg",
    type=float,
    nargs=3,
    metavar="R P Y",
    help="How it is turned, as in URDF [deg].",
)
@click.option("--rpy", type=float, nargs=3, metavar="R P Y", help="The same in radians.")
@click.option("--quat-xyzw", type=float, nargs=4, metavar="X Y Z W", help="The same as a unit quaternion.")
@click.option("--file", type=click.Path(exists=True, dir_okay=False), help="All [[static]] of a TOML file.")
@click.option("--robot", metavar="NAME", help="Whose edge it is; default: the only robot announced.")
@click.option("--writer", metavar="NAME", help="Under which name; default: this program and its process id.")
@takeover_option
@wire_option
@session_options
def static_command(
    *,
    target: str | None,
    source: str | None,
    xyz: Vector3 | None,
    rpy_deg: Vector3 | None,
    rpy: Vector3 | None,
    quat_xyzw: Quaternion | None,
    file: str | None,
    robot: str | None,
    writer: str | None,
    takeover: bool,
    wire: str,
    network: Network,
) -> None:
    """Publish the pose of SOURCE in TARGET until Ctrl-C; then it is withdrawn.

    SOURCE becomes a child of TARGET. Late joiners have it at once. Without --xyz it is at the origin of
    TARGET, without a rotation it is not turned; say at least one. Bare frame names are the robot's own;
    `robot/frame` names a frame in full.

    \b
    zstate static panda_hand camera --xyz 0.05 0 0.04 --rpy-deg 0 -90 0
    zstate static fleet/map r1/odom --xyz 2 1 0 --rpy-deg 0 0 90
    zstate static --file cell.toml
    zstate static base_link laser --xyz 0.2 0 0.1 --wire ros2      # on /tf_static
    """
    from zstate.cli.config_file import StaticSection
    from zstate.clock import wait_in_slices
    from zstate.statics import StaticPublisher

    if file is not None:
        from zstate.cli.config_file import read_config

        if target is not None:
            raise click.UsageError("give TARGET and SOURCE, or --file, not both")
        statics = read_config(file).static
    elif target is None or source is None or (xyz, rpy_deg, rpy, quat_xyzw) == (None,) * 4:
        raise click.UsageError("give TARGET, SOURCE and --xyz, a rotation or both; or --file")
    else:
        statics = (StaticSection(target, source, xyz, rpy_deg, rpy, quat_xyzw, robot),)
    if not statics:
        fail(f"{file!r} has no [[static]]")
    with open_session(network, (wire,)) as session, ExitStack() as publishers:
        owned = _by_ros_owner(statics, robot, wire) if is_ros(wire) else _by_owner(session, statics, robot)
        for owner, edges in owned.items():
            publisher = publishers.enter_context(
                StaticPublisher(session, owner, writer, (wire,), takeover=takeover)
            )
            for edge in edges:
                publisher.set(edge)
                say(_sentence(edge, publisher, wire))
        wait_in_slices(threading.Event())


def _by_owner(
    session: Session, statics: tuple[StaticSection, ...], default: str | None
) -> dict[str, list[Transform]]:
    edges: dict[str, list[Transform]] = {}
    for static in statics:
        owner = static.owner or default
        if owner is None:
            owner = default = _only_robot(session)
        edges.setdefault(owner, []).append(static.transform())
    return edges


def _by_ros_owner(
    statics: tuple[StaticSection, ...], default: str | None, wire: str
) -> dict[str, list[Transform]]:
    """On ROS's side frames are nobody's, and a slash in the name of one is just that."""
    edges: dict[str, list[Transform]] = {}
    for static in statics:
        owner = static.robot or default or words_of(wire).robot
        if owner is None:
            raise click.UsageError("say --robot NAME; on this wire each robot has a namespace of its name")
        edges.setdefault(owner, []).append(static.transform())
    return edges


def _only_robot(session: Session) -> str:
    from zstate.net.presence import discover

    note("looking for the robot this belongs to ...")
    robots = discover(session)
    if len(robots) != 1:
        fail(f"whose edge is this? Say --robot NAME ({words_of('native').announced(robots)})")
    return robots[0].name


def _sentence(edge: Transform, publisher: StaticPublisher, wire: str) -> str:
    x, y, z = edge.translation
    # Adding zero turns -0 into 0.
    roll, pitch, yaw = (round(degrees(angle), 6) + 0.0 for angle in edge.rpy)
    pose = (
        f"pose of {edge.source} in {edge.target}: xyz [{x:g}, {y:g}, {z:g}] m, "
        f"rpy [{roll:g}, {pitch:g}, {yaw:g}] deg"
    )
    if is_ros(wire):
        place = words_of(wire).place(publisher.robot, ("tf_static",))
        return f"{pose}, on {place}; Ctrl-C ends it for those who join later"
    return f"{pose}, until Ctrl-C (robot {publisher.robot!r}, writer {publisher.writer!r})"
