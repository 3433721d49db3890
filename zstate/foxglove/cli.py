"""zstate foxglove: robots live in Foxglove."""

from __future__ import annotations

import os

import click

from zstate.cli import options
from zstate.cli.output.console import print_result, print_status
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session

_DISCOVERY_S = 0.5


@click.command("foxglove")
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Listen at this address; 0.0.0.0 is all of them."
)
@click.option(
    "--port", type=click.IntRange(0, 65535), help="0: any free port; default: the first free one from 8765."
)
@click.option(
    "--allow-origin",
    "origins",
    multiple=True,
    metavar="ORIGIN",
    help="Also accept pages of this site, such as http://lichtblick.lan:8080; repeatable.",
)
@options.wire_option
@options.session_options
def foxglove_command(
    *,
    robots: tuple[str, ...],
    host: str,
    port: int | None,
    origins: tuple[str, ...],
    wire: str,
    network: SessionOptions,
) -> None:
    """Serve ROBOTs, by default all, to Foxglove until Ctrl-C.

    Open the printed address in Foxglove as a Foxglove WebSocket. The channels are those of `zstate record`,
    ROS 2 messages with their schemas: /tf, /tf_static, /joint_states, /robot_description, odometry, sensors,
    maps, /diagnostics of drivers. Robots come and go with their writers. Only what a client displays is
    received and encoded. Descriptions are parameters, too, and simulated time is that of Foxglove. Clients
    cannot publish or set anything.

    By default only this host can connect, and of the pages in its browsers only Foxglove's own and those of
    --allow-origin. From another host forward the port with ssh -L 8765:127.0.0.1:8765 HOST. With --host,
    other hosts can connect with the token in the printed address; the connection is not encrypted.

    A client that reads too slowly loses its oldest messages, which are counted; it delays no other client.
    Needs websockets: pip install 'zstate[foxglove]'.

    \b
    zstate foxglove
    zstate foxglove panda
    zstate foxglove --wire ros2             # robots of ROS 2 nodes that run rmw_zenoh
    zstate foxglove --host 0.0.0.0 --port 9000
    """
    from zstate.foxglove import check_library

    check_library()  # before anything starts
    from zstate.foxglove.bridge import FoxgloveBridge
    from zstate.foxglove.server import FoxgloveServer
    from zstate.web_access import is_loopback

    with (
        open_session(network, (wire,)) as session,
        FoxgloveServer(host, port, origins=origins, on_event=print_status) as server,
    ):
        print_result(f"Foxglove can connect to {server.url}")
        if not is_loopback(host):
            print_status("anyone with this address can read the robots; it is sent unencrypted")
        elif os.environ.get("SSH_CONNECTION"):
            tunnel = f"ssh -L {server.port}:127.0.0.1:{server.port} {os.uname().nodename}"
            print_status(f"from your own machine: {tunnel}")
        with (
            FoxgloveBridge(session, server, robots, wire=wire, on_event=print_status) as bridge,
            RobotDirectory(session, robots[0] if len(robots) == 1 else "*", wire) as directory,
        ):
            if not bridge.wait(_DISCOVERY_S):
                announced = directory.robots()
                missing = set(robots) - {info.name for info in announced}
                for robot in sorted(missing):
                    print_status(f"waiting: {directory.messages.unknown(robot, announced)}")
                if not robots and not announced:
                    print_status(f"waiting: {directory.messages.announced(announced)}")
                bridge.wait()
            if bridge.failure is not None:
                raise bridge.failure
