"""zstate wait: wait until a robot, a pose or a router is available."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_json, print_result
from zstate.cli.session import SessionOptions, endpoints_text, open_session
from zstate.errors import ZStateError


@click.command("wait")
@click.argument("what", type=click.Choice(["robot", "frame", "router"]), metavar="robot|frame|router")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@options.timeout_option("Fail after this time, with the reason [s].", 30.0)
@options.json_option("One JSON object, also after the timeout.")
@options.placer_option
@options.wire_option
@options.session_options
def wait_command(
    *,
    network: SessionOptions,
    what: str,
    names: tuple[str, ...],
    timeout: float,
    as_json: bool,
    placers: tuple[str, ...] | None,
    wire: str,
) -> None:
    """Wait until a robot, a frame or a router is available.

    A robot is available when its poses can be looked up: it has a model and samples. A frame B is available
    when its pose in frame A is known. A router is available when it accepts a session of this command;
    without NAME it is that of --connect, or of this host. Exit code 0, or 1 with the reason after --timeout.

    \b
    zstate wait robot panda && python my_program.py
    zstate wait robot left right --timeout 60
    zstate wait frame panda_link0 panda_hand
    zstate wait router tcp/192.168.1.10:7447
    """
    if what == "robot" and not names:
        raise click.UsageError("name a robot, for instance `zstate wait robot panda`")
    if what == "frame" and len(names) != 2:
        raise click.UsageError("a pose has two frames: `zstate wait frame A B` waits for the pose of B in A")
    if what != "frame" and placers is not None:
        raise click.UsageError("--placer is for `zstate wait frame A B`")
    began, reason, text = time.monotonic(), None, ""
    wait_for_pose = partial(_wait_for_pose, placers=placers)
    waits = {"robot": _wait_for_robots, "frame": wait_for_pose, "router": _wait_for_router}
    try:
        text = waits[what](network, names, wire, timeout)
    except click.UsageError:
        raise
    except (ZStateError, click.ClickException) as failure:
        if not as_json:
            raise
        reason = str(failure)
    if not as_json:
        print_result(text)
        return
    waited_s = round(time.monotonic() - began, 3)
    print_json(
        {"what": what, "names": names, "ready": reason is None, "waited_s": waited_s, "reason": reason}
    )
    if reason is not None:
        raise SystemExit(1)


def _wait_for_robots(network: SessionOptions, names: tuple[str, ...], wire: str, timeout_s: float) -> str:
    from zstate.cli.waiting import RobotReadiness
    from zstate.wire.keys import check_robot

    for name in names:
        check_robot(name)
    deadline = time.monotonic() + timeout_s
    with (
        open_session(network, (wire,), timeout_s=timeout_s) as session,
        RobotReadiness(session, names, wire) as readiness,
    ):
        reason = readiness.wait(max(deadline - time.monotonic(), 0.0))
        if reason:
            fail(f"gave up after {timeout_s:g} s: {reason}")
        ready = [f"{name!r} ({count_text(len(readiness.frames(name)), 'frame')})" for name in names]
        return f"ready: {', '.join(ready)}"


def _wait_for_pose(
    network: SessionOptions,
    names: tuple[str, ...],
    wire: str,
    timeout_s: float,
    *,
    placers: tuple[str, ...] | None,
) -> str:
    from zstate.cli.output.wire_text import default_stream
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.cli.waiting import PoseWaiter
    from zstate.nodes.listener import TransformListener

    target, source = names
    deadline = time.monotonic() + timeout_s
    with (
        open_session(network, (wire,), timeout_s=timeout_s) as session,
        RobotDirectory(session, "*", wire) as directory,
        TransformListener(session, wire=wire, follow=default_stream(wire), placers=placers) as listener,
    ):
        PoseWaiter(listener, directory, target, source).wait(
            timeout_s=max(round(deadline - time.monotonic(), 1), 0.1)
        )
    return f"ready: the pose of {source!r} in {target!r} is known"


def _wait_for_router(network: SessionOptions, names: tuple[str, ...], wire: str, timeout_s: float) -> str:
    from zstate.net.config import ROUTER_ENDPOINT

    endpoints = names or network.connect or (() if network.is_explicit else (ROUTER_ENDPOINT,))
    with open_session(replace(network, mode="client", connect=endpoints), timeout_s=timeout_s):
        return f"ready: the router at {endpoints_text(endpoints)}"
