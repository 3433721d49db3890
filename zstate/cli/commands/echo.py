"""zstate echo: joint states, setpoints, transforms, scans or maps as documents."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import click

from zstate.cli import options
from zstate.cli.options import named_robot, refuse_topic
from zstate.cli.output.console import print_json, print_result
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.streams import StreamName


def _check_amount(amount: float) -> float:
    if not (math.isfinite(amount) and amount >= 0.0):
        raise InvalidInput(f"an amount is finite and at least 0; got {amount}")
    return amount


@click.command("echo")
@click.argument("robot", required=False)
@click.option(
    "--stream",
    type=options.StreamChoice(lambda row: row.is_echoed),
    default="joint_states",
    show_default=True,
)
@click.option("--once", is_flag=True, help="Print one document; fail after --timeout with the reason.")
@options.seconds_option
@options.timeout_option("How long --once waits [s].")
@click.option("--field", metavar="NAME", help="Print only this: stamp, positions, positions.JOINT, or JOINT.")
@click.option(
    "--changed",
    is_flag=True,
    help="Skip documents that differ from the last printed one only in stamp and seq.",
)
@click.option(
    "--by",
    type=options.number("AMOUNT", _check_amount),
    default=0.0,
    help="Skip documents without a number that changed by more than this since the last printed one.",
)
@click.option("--csv", "form", flag_value="csv", help="Comma-separated values below a line of names.")
@click.option("--json", "form", flag_value="json", help="One JSON value per line.")
@options.wire_option
@options.session_options
def echo_command(
    *,
    network: SessionOptions,
    robot: str | None,
    stream: StreamName,
    once: bool,
    seconds: float | None,
    timeout: float,
    field: str | None,
    changed: bool,
    by: float,
    form: str | None,
    wire: str,
) -> None:
    """Print joint states, setpoints, transforms, odometry, what sensors measure, or maps of ROBOT as they
    arrive, as YAML documents.

    ROBOT may be left out if only one robot is announced. Transforms, and partial joint states, are those of
    all their writers; on a ROS wire these are all messages of /tf, or /joint_states. Joint setpoints are what
    the program that owns the robot's hardware writes to it, while it moves or holds the joints. Known
    covariances of odometry and measurements are printed as standard deviations, in the same units. A
    scan or a map is a summary: geometry and counts; --json, --csv and --field also have the ranges of a scan
    [m], null where nothing was measured.

    \b
    zstate echo
    zstate echo panda
    zstate echo panda --stream transforms
    zstate echo panda --stream joint_setpoints
    zstate echo diffbot --stream scan --json
    zstate echo rover --stream odometry --field translation
    zstate echo hall --stream map --once
    zstate echo panda --field panda_joint1 --csv > joint1.csv
    zstate echo panda --by 0.001
    zstate echo --wire ros2 --once                     # /joint_states
    zstate echo --wire ros2:namespace=r1               # /r1/joint_states
    """
    from zstate.cli.output.joint_state_text import (
        ChangeFilter,
        CsvFormatter,
        DescribedJointStates,
        select_field,
        yaml_text,
    )
    from zstate.cli.stream_reader import StreamReader
    from zstate.clock import LONGEST_WAIT_S
    from zstate.stream_registry import stream_named
    from zstate.wire.messages import JointState
    from zstate.wire.protocol import carrier
    from zstate.wire.registry import get_wire

    table, changes = CsvFormatter(), ChangeFilter(by) if changed or by else None

    def show(document: Any) -> None:
        value = document if field is None else select_field(document, field)
        if changes is not None and not changes.accepts(value):
            return
        if form == "json":
            print_json(_with_nulls(value))
        elif form == "csv":
            print_result("\n".join(table.lines(value, field or "")))
        elif field is not None and not isinstance(value, dict):
            print_result(yaml_text(value))
        else:
            print_result(f"{yaml_text(value)}\n---")

    options.check_end(seconds, once=once)
    refuse_topic(robot, wire)
    with (
        open_session(network, (wire,)) as session,
        ExitStack() as opened,
    ):
        selected = named_robot(session, robot, wire)
        document: Callable[[Any], Any]
        row = stream_named(stream)
        if row.type is JointState:
            document = opened.enter_context(DescribedJointStates(session, selected, wire)).document
        else:
            document = partial(row.to_document, robot=selected, in_full=(form or field) is not None)
        carrying = carrier(get_wire(wire), stream)
        reader = opened.enter_context(StreamReader(session, selected, carrying, wire))
        received = reader.first(timeout if once else seconds)
        end = math.inf if seconds is None else time.monotonic() + seconds
        while time.monotonic() < end:
            if received is not None:
                sample: Any = received.sample  # of the class that ``stream`` carries
                show(document(sample))
            if once:
                return
            received = reader.next(min(LONGEST_WAIT_S, end - time.monotonic()))


def _with_nulls(value: Any) -> Any:
    """``value`` with null for NaN, which ROS drivers send for quantities they do not measure."""
    if isinstance(value, dict):
        return {name: _with_nulls(inner) for name, inner in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [_with_nulls(inner) for inner in cast("list[Any]", value)]
    return None if value != value else value  # noqa: PLR0124 - true of NaN only
