"""zstate transform: publisher of moving edges."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

import click

from zstate.cli import options
from zstate.cli.metrics import publisher_rows, serve_metrics
from zstate.cli.output.console import count_text, print_status, print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session
    from zstate.nodes.transform_publisher import TransformPublisher
    from zstate.transform import Transform

_RATE_HZ = 50.0


@click.command("transform")
@click.argument("target", required=False)
@click.argument("source", required=False)
@options.pose_options
@click.option("--rate", type=options.RATE, help=f"Samples a second; default: {_RATE_HZ:g}.")
@click.option(
    "--stdin",
    "from_stdin",
    is_flag=True,
    help="Publish each line of standard input: a transform in JSON, as `zstate tf --json` prints it.",
)
@click.option(
    "--robot",
    metavar="NAME",
    help="The robot that owns the edges; default: that of a full frame name, or the only announced one.",
)
@click.option(
    "--writer", metavar="NAME", help="Name of the writer; default: this program and its process id."
)
@options.wire_option
@options.metrics_option
@options.session_options
def transform_command(
    *,
    target: str | None,
    source: str | None,
    rate: float | None,
    from_stdin: bool,
    robot: str | None,
    writer: str | None,
    wire: str,
    metrics: BindAddress | None,
    network: SessionOptions,
    **pose: Any,
) -> None:
    """Publish the pose of SOURCE in TARGET again and again, as an edge that may move, until Ctrl-C.

    SOURCE becomes a child of TARGET. Give --xyz, a rotation, or both; each defaults to zero. Bare frame names
    belong to the robot; `robot/frame` is a full name. `zstate static` publishes an edge that never moves.

    With --stdin each line is one JSON object with target, source, translation [m] and rotation (a unit
    quaternion x y z w); its stamp [ns] is optional, by default now. A line that cannot be published is
    reported and counted, and the next ones are published; the exit code is then 1.

    \b
    zstate transform odom base_link --xyz 1 0 0 --rate 50 --robot r1
    zstate transform map marker --rpy-deg 0 0 90 --robot r1 --writer camera
    ./odometry | zstate transform --stdin --robot r1
    zstate tf odom base_link --robot r1 --json | zstate transform --stdin --robot twin
    zstate transform odom base_link --xyz 1 0 0 --wire ros2         # on /tf
    """
    has_pose = any(part is not None for part in pose.values())
    if from_stdin and (target is not None or rate is not None or has_pose):
        raise click.UsageError(
            "--stdin reads edges and stamps; leave out TARGET, SOURCE, the pose and --rate"
        )
    if not from_stdin and (target is None or source is None or not has_pose):
        raise click.UsageError("give TARGET, SOURCE and --xyz, a rotation or both; or --stdin")
    if from_stdin:
        _publish_lines(network, wire, robot, writer, metrics)
    else:
        from zstate.cli.up.cell import StaticSection

        edge = StaticSection(target, source, **pose).transform()
        _publish_pose(network, wire, robot, writer, metrics, edge, rate or _RATE_HZ)


def _publish_pose(  # noqa: PLR0917 - one use, in the order of the options
    network: SessionOptions,
    wire: str,
    robot: str | None,
    writer: str | None,
    metrics: BindAddress | None,
    edge: Transform,
    rate_hz: float,
) -> None:
    """Publish ``edge`` at ``rate_hz`` until a signal, then print a summary."""
    from zstate.cli.commands.publish import run_publisher
    from zstate.cli.commands.static import pose_text

    with (
        open_session(network, (wire,)) as session,
        _open_publisher(session, wire, robot, writer, edge) as publisher,
        serve_metrics(metrics, publisher_rows(publisher)),
    ):
        publisher.publish([edge])
        print_wrapped(f"{pose_text(edge)}, {rate_hz:g} Hz, {_place_text(publisher, wire)}")
        run_publisher(publisher, _FixedPose(edge), rate_hz, None)


class _FixedPose:
    """A source of the same transform at every stamp."""

    def __init__(self, edge: Transform) -> None:
        self._edges = [edge]

    def read(self, stamp: int) -> list[Transform]:
        return self._edges


def _publish_lines(
    network: SessionOptions, wire: str, robot: str | None, writer: str | None, metrics: BindAddress | None
) -> None:
    """Publish the lines of standard input until it ends or a signal comes, then print a summary."""
    lines = _Lines(sys.stdin)
    with open_session(network, (wire,)) as session:
        print_status("reading transforms from standard input ...")
        try:
            first = next(lines, None)
            if first is not None:
                with (
                    _open_publisher(session, wire, robot, writer, first) as publisher,
                    serve_metrics(metrics, publisher_rows(publisher)),
                ):
                    print_wrapped(
                        f"publishing the transforms of standard input {_place_text(publisher, wire)}"
                    )
                    lines.publish(publisher, first)
        finally:
            print_wrapped(lines.summary())
    if lines.refused or not lines.published:
        click.get_current_context().exit(1)


def _open_publisher(
    session: Session, wire: str, robot: str | None, writer: str | None, edge: Transform
) -> TransformPublisher:
    from zstate.cli.commands.static import only_owner, owner_in_names
    from zstate.nodes.transform_publisher import TransformPublisher

    owner = robot or owner_in_names(edge, (wire,)) or only_owner(session, (wire,))
    return TransformPublisher(session, owner, writer, wire)


def _place_text(publisher: TransformPublisher, wire: str) -> str:
    from zstate.wire.registry import get_wire

    place = messages_for(wire).topics(publisher.robot, (get_wire(wire).transforms,))
    return f"on {place}/{publisher.writer}, until Ctrl-C" if wire == "native" else f"on {place}, until Ctrl-C"


class _Lines:
    """The transforms in lines of JSON; iteration reports and counts the lines that are none."""

    def __init__(self, texts: Iterable[str]) -> None:
        self._texts = texts
        self._number = 0
        self.published = 0
        self.refused = 0

    def __iter__(self) -> Iterator[Transform]:
        return self

    def __next__(self) -> Transform:
        for text in self._texts:
            self._number += 1
            if text.strip():
                try:
                    return _parse_line(text)
                except InvalidInput as error:
                    self._refuse(error)
        raise StopIteration

    def publish(self, publisher: TransformPublisher, first: Transform) -> None:
        """Publish ``first`` and the transforms after it; report and count those that are refused."""
        edge: Transform | None = first
        while edge is not None:
            self.published += 1  # before: a signal may arrive right after it is published
            try:
                publisher.publish([edge])
            except InvalidInput as error:
                self.published -= 1
                self._refuse(error)
            edge = next(self, None)

    def summary(self) -> str:
        """The numbers of lines so far."""
        refused = f", {count_text(self.refused, 'line')} refused" if self.refused else ""
        return f"{count_text(self.published, 'transform')} published{refused}"

    def _refuse(self, error: InvalidInput) -> None:
        self.refused += 1
        print_status(f"line {self._number}: {error}", event="refused", level="warning")


def _parse_line(text: str) -> Transform:
    """The transform in one line of JSON. Raises InvalidInput if there is none."""
    from zstate.transform import Transform

    try:
        values = json.loads(text)
    except ValueError as error:
        raise InvalidInput(f"not JSON: {error}") from None
    except RecursionError:
        raise InvalidInput("not a transform: its brackets are nested too deeply") from None
    if not isinstance(values, dict):
        raise InvalidInput(f"a transform is a JSON object, not {type(values).__name__}")
    # `zstate tf --json` also prints how it computed the pose, which is no part of the edge.
    return Transform.from_dict({"stamp": None, **values, "kind": None})
