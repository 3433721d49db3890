"""zstate wait: wait until a robot, a pose or a router is available."""

from __future__ import annotations

import time
from dataclasses import replace

import click

from zstate.cli.options import json_option, session_options, timeout_option, wire_option
from zstate.cli.output.console import GRACE_S, count_text, fail, print_json, print_result, print_status
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import Unreachable, ZStateError


@click.command("wait")
@click.argument("what", type=click.Choice(["robot", "frame", "router"]), metavar="robot|frame|router")
@click.argument("names", nargs=-1, metavar="[NAME]...")
@timeout_option("Give up after so long, with the reason.", 30.0)
@json_option("One JSON object, also after the timeout.")
@wire_option
@session_options
def wait_command(
    *, network: SessionOptions, what: str, names: tuple[str, ...], timeout: float, as_json: bool, wire: str
) -> None:
    """Wait until something is there, and end.

    A robot is there when its poses can be looked up: it has a model, and samples come. A frame is there
    when its pose in another one is known. A router is there when it lets this command in; it is the one of
    --connect, or of this host. Exit code 0 when it is there, 1 when it is not in time: the reason is said.

    \b
    zstate wait robot panda && python my_program.py
    zstate wait robot left right --timeout 60
    zstate wait frame panda_link0 panda_hand
    zstate wait router tcp/192.168.1.10:7447
    """
    _check_count(what, names)
    began = time.monotonic()
    waits = {"robot": _wait_for_robots, "frame": _wait_for_pose, "router": _wait_for_router}
    try:
        text = waits[what](network, names, wire, timeout)
    except click.UsageError:
        raise
    except (ZStateError, click.ClickException) as failure:
        if not as_json:
            raise
        _print_outcome(what, names, began, str(failure))
        raise SystemExit(1) from None
    if as_json:
        _print_outcome(what, names, began, None)
    else:
        print_result(text)


def _check_count(what: str, names: tuple[str, ...]) -> None:
    if what == "robot" and not names:
        raise click.UsageError("which robot? For instance `zstate wait robot panda`")
    if what == "frame" and len(names) != 2:
        raise click.UsageError("a pose has two frames: `zstate wait frame A B` waits for that of B in A")


def _print_outcome(what: str, names: tuple[str, ...], began: float, reason: str | None) -> None:
    waited_s = round(time.monotonic() - began, 3)
    print_json(
        {"what": what, "names": names, "ready": reason is None, "waited_s": waited_s, "reason": reason}
    )


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


def _wait_for_pose(network: SessionOptions, names: tuple[str, ...], wire: str, timeout_s: float) -> str:
    from zstate.cli.output.wire_text import default_stream
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.cli.waiting import PoseWaiter
    from zstate.nodes.listener import TransformListener

    target, source = names
    deadline = time.monotonic() + timeout_s
    with (
        open_session(network, (wire,), timeout_s=timeout_s) as session,
        RobotDirectory(session, "*", wire) as directory,
        TransformListener(session, wire=wire, follow=default_stream(wire)) as listener,
    ):
        PoseWaiter(listener, directory, target, source).wait(
            timeout_s=max(round(deadline - time.monotonic(), 1), 0.1)
        )
    return f"ready: the pose of {source!r} in {target!r} is known"


def _wait_for_router(network: SessionOptions, names: tuple[str, ...], wire: str, timeout_s: float) -> str:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.config import ROUTER_ENDPOINT

    endpoints = names or network.connect or (() if network.is_explicit else (ROUTER_ENDPOINT,))
    client = replace(network, mode="client", connect=endpoints)
    where = " or ".join(map(repr, endpoints)) or "the configured endpoints"

    def connect() -> None:
        with open_session(client, timeout_s=timeout_s):
            pass

    call = BackgroundCall("zstate wait", connect)
    try:
        call.result(min(GRACE_S, timeout_s))
    except Unreachable:
        raise
    except TimeoutError:
        print_status(f"waiting: nobody answers at {where} yet", event="waiting")
        call.result()
    return f"ready: the router at {where}"
