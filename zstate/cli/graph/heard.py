"""The graph of the native wire and that of ROS, as they are announced."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from zstate.cli.graph.graph import Graph, StreamUse
from zstate.cli.ros_graph import heard_graph as heard_ros_graph
from zstate.net.presence import discover, discover_readers
from zstate.net.topic_statistics import FEW, TopicStatistics, WriterKey
from zstate.net.wires import wire_named
from zstate.wire.keys import ANY, MODEL_WRITER, Stream
from zstate.wire.ros2.wire import Ros2Wire
from zstate.wire.writer import Announced, Writer

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_MEASURED_WITHIN_S = 0.4
_READERS_WITHIN_S = 0.15


def native_graph(session: Session) -> Graph:
    """Who announces to write and to read what, with the rates of what moves."""
    with TopicStatistics(session, wire_named("native"), window=FEW) as statistics:
        statistics.subscribe("joint_states")
        robots = discover(session)
        readers = discover_readers(session, _READERS_WITHIN_S)
        # Transforms are said only while somebody reads them: looking must not make it so.
        for robot in _robots_whose_transforms_are_read(robots, readers):
            statistics.subscribe("tf", robot)
        statistics.wait(list(_sources(robots, readers)), _MEASURED_WITHIN_S)
        return Graph(tuple(_uses(robots, readers, statistics)))


def ros_graph(session: Session, wire: str) -> Graph:
    """The topics that carry robots' states, in all namespaces of the domain, and the nodes at their ends."""
    spoken = wire_named(wire)
    assert isinstance(spoken, Ros2Wire)
    topics = heard_ros_graph(session, spoken).topics
    return Graph(
        tuple(
            StreamUse(
                "",
                topic.name,
                None,
                tuple(sorted({end.node for end in topic.publishers})),
                tuple(sorted({end.node for end in topic.subscribers})),
            )
            for topic in topics
        )
    )


def _robots_whose_transforms_are_read(robots: Iterable[RobotInfo], readers: Iterable[Announced]) -> set[str]:
    read = {one.robot for one in readers if one.stream == "tf"}
    return {robot.name for robot in robots if read & {robot.name, ANY}}


def _sources(robots: Sequence[RobotInfo], readers: Sequence[Announced]) -> Iterator[WriterKey]:
    read = _robots_whose_transforms_are_read(robots, readers)
    for robot in robots:
        for stream, writer in robot.writers:
            if stream == "joint_states" or (stream == "tf" and robot.name in read):
                yield WriterKey(robot.name, stream, writer.session)


def _uses(
    robots: Sequence[RobotInfo], readers: Sequence[Announced], statistics: TopicStatistics
) -> Iterator[StreamUse]:
    written: set[tuple[str, Stream]] = {(one.name, stream) for one in robots for stream, _ in one.writers}
    # Whoever reads all robots does not miss what one of them lacks.
    read: set[tuple[str, Stream]] = {
        (one.robot, one.stream) for one in readers if one.robot != ANY or not written
    }
    for robot, stream in sorted(written | read):
        reading = _programs(
            one.writer for one in readers if one.stream == stream and one.robot in (robot, ANY)
        )
        named = [pair for info in robots if info.name == robot for pair in _names(info, stream)]
        for name in dict.fromkeys(name for name, _ in named) or ("",):
            writers = [writer for of, writer in named if of == name]
            rate_hz = _rate_hz(statistics, robot, stream, writers)
            shown = f"{stream}/{name}" if name else stream
            yield StreamUse(robot, shown, rate_hz, _programs(writers), reading)


def _names(robot: RobotInfo, stream: Stream) -> list[tuple[str, Writer]]:
    """The writers of a stream, with the names under which static edges are written."""
    found: list[tuple[str, Writer]] = []
    for said, writer in robot.writers:
        if said == stream:
            names = [name for name in robot.names_of(writer) if name != MODEL_WRITER]
            found += [(name, writer) for name in (names if stream == "tf_static" and names else [""])]
    return found


def _rate_hz(
    statistics: TopicStatistics, robot: str, stream: Stream, writers: Iterable[Writer]
) -> float | None:
    """That of the first writer of whom it is known: usually there is one."""
    known = (statistics.get(WriterKey(robot, stream, writer.session)) for writer in writers)
    return next((one.published_hz() for one in known if one is not None), None)


def _programs(writers: Iterable[Writer]) -> tuple[str, ...]:
    return tuple(sorted({str(writer) for writer in writers}))
