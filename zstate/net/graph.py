"""Graph of the programs that write and read the streams of robots, and of ROS nodes and topics.

It is discovered from the liveliness tokens of writers and readers. Programs that subscribe to keys without
zstate have no token.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from zstate._util.closeable import Closeable
from zstate.errors import NetworkError, Unreachable
from zstate.net.discovery import RobotInfo, discover, discover_readers, discover_tokens
from zstate.net.session import Session
from zstate.net.sites import NO_SITES, Sites, Thinning
from zstate.net.status_monitor import StatusMonitor, WriterState
from zstate.stream_registry import edge_streams
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, MODEL_WRITER

if TYPE_CHECKING:
    from zstate.wire.ros2.graph import DdsToken, EndpointToken, NodeToken
    from zstate.wire.ros2.wire import Ros2Wire

    RosEndpoint = EndpointToken | DdsToken

_PERIOD_S = 2.0
_FIRST_PERIOD_S = 0.5
_DISCOVERY_TIMEOUT_S = 0.3
_IDLE_AFTER_S = 3.0
_JOIN_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class StreamUse:
    """One stream of ``robot`` with the programs that write and read it, each once, sorted.

    A ROS topic belongs to no robot: ``robot`` is empty, ``name`` is the topic with its namespace.
    ``rate_hz`` is None for latched streams and if it was not measured; ``thinning`` is that of its site, if
    the robot has one.
    """

    robot: str
    name: str
    writers: tuple[str, ...]
    readers: tuple[str, ...]
    rate_hz: float | None = None
    thinning: Thinning | None = None

    @property
    def label(self) -> str:
        """The name, the rate if it is known, and what passes of it beyond the robot's site."""
        rate = "" if self.rate_hz is None else f"{self.rate_hz:.1f} Hz"
        facts = ", ".join(filter(None, (rate, str(self.thinning or ""))))
        return f"{self.name} ({facts})" if facts else self.name


@dataclass(frozen=True, slots=True)
class StreamGroup:
    """Streams of one robot that have the same writers and readers."""

    robot: str
    writers: tuple[str, ...]
    readers: tuple[str, ...]
    streams: tuple[StreamUse, ...]


@dataclass(frozen=True, slots=True)
class Graph:
    """All streams, by robot; of each those without a writer last."""

    streams: tuple[StreamUse, ...] = ()

    @property
    def programs(self) -> list[str]:
        """All writers and readers, sorted."""
        return sorted({one for stream in self.streams for one in (*stream.writers, *stream.readers)})

    @property
    def groups(self) -> list[StreamGroup]:
        """The streams, grouped by robot, writers and readers."""
        groups: dict[tuple[str, tuple[str, ...], tuple[str, ...]], list[StreamUse]] = {}
        for stream in self.streams:
            groups.setdefault((stream.robot, stream.writers, stream.readers), []).append(stream)
        return [StreamGroup(*ends, tuple(streams)) for ends, streams in groups.items()]


RateLookup = Callable[[str, StreamName, WriterId], float | None]
"""The measured rate [Hz] of a robot's stream, as one writer publishes it; None if it is unknown."""


def _is_optional(stream: StreamName) -> bool:
    """Whether a robot with other streams does not lack this one."""
    return stream in (*edge_streams(), "partial_joint_states", "joint_commands")


def build_graph(
    robots: Sequence[RobotInfo],
    readers: Sequence[Announcement],
    rate_of: RateLookup | None = None,
    sites: Sites = NO_SITES,
) -> Graph:
    """The graph of discovered writers and readers.

    A stream with names, such as static edges, is one stream for each name under which it is written. The rate
    is that of the first writer whose rate is known: usually there is only one.
    """

    def programs(writers: Iterable[WriterId]) -> tuple[str, ...]:
        return tuple(sorted({str(writer) for writer in writers}))

    written: dict[tuple[str, StreamName], dict[str, list[WriterId]]] = {}
    """The writers of each stream, by the name under which they write; else ""."""
    for robot in robots:
        for stream, writer in robot.writers:
            by_name = written.setdefault((robot.name, stream), {})
            names = [name for name in robot.names_of(writer, stream) if name != MODEL_WRITER]
            for name in names or ("",):
                by_name.setdefault(name, []).append(writer)
    # A reader of all robots does not miss a stream that one of them lacks, and no reader misses a named one.
    used: set[tuple[str, StreamName]] = {
        *written,
        *(
            (one.robot, one.stream)
            for one in readers
            if not _is_optional(one.stream) and (one.robot != ANY or not written)
        ),
    }
    unwritten: dict[str, list[WriterId]] = {"": []}
    uses: list[StreamUse] = []
    for robot, stream in sorted(used, key=lambda one: (one[0], one not in written, one[1])):
        reading = programs(
            one.writer for one in readers if one.stream == stream and one.robot in (robot, ANY)
        )
        for name, writers in written.get((robot, stream), unwritten).items():
            rates = (rate_of(robot, stream, writer) for writer in writers) if rate_of else ()
            rate_hz = next((rate for rate in rates if rate is not None), None)
            label = f"{stream}/{name}" if name else stream
            thinning = sites.thinning(robot, stream) if writers else None
            uses.append(StreamUse(robot, label, programs(writers), reading, rate_hz, thinning))
    return Graph(tuple(uses))


class GraphMonitor(Closeable):
    """Keeps the graph and the status of all publishers up to date, from its own thread.

    Discovery runs every 2 s, and only if ``graph`` was called in the last 3 s.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._graph = Graph()
        self._used_at = -_IDLE_AFTER_S
        self._stop = threading.Event()
        self._statuses = StatusMonitor(session, ANY)
        self._thread = threading.Thread(target=self._run, name="zstate graph", daemon=True)
        self._thread.start()

    def graph(self) -> Graph:
        """Every stream that is written, or read by its robot's name; from the latest discovery."""
        self._used_at = time.monotonic()
        return self._graph

    def states(self) -> tuple[WriterState, ...]:
        """The newest status of every announced publisher, sorted by robot and program."""
        return self._statuses.states()

    def _run(self) -> None:
        while not self._stop.wait(_PERIOD_S if self._graph.streams else _FIRST_PERIOD_S):
            if time.monotonic() - self._used_at >= _IDLE_AFTER_S:
                continue
            try:
                robots = discover(self._session, _DISCOVERY_TIMEOUT_S)
                graph = build_graph(robots, discover_readers(self._session, _DISCOVERY_TIMEOUT_S))
            except Unreachable:
                continue
            except NetworkError:
                return
            # The process of this monitor may itself read all robots, which is no stream of a robot.
            self._graph = Graph(tuple(stream for stream in graph.streams if stream.robot != ANY))
            self._statuses.keep(
                {(robot.name, writer.session) for robot in robots for _, writer in robot.writers}
            )

    def close(self) -> None:
        self._stop.set()
        self._statuses.close()
        self._thread.join(_JOIN_TIMEOUT_S)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic, with its leading slash, that carries ``stream``."""

    name: str
    stream: StreamName
    publishers: tuple[RosEndpoint, ...]
    subscribers: tuple[RosEndpoint, ...]

    @property
    def namespace(self) -> str:
        """Without outer slashes; empty for the root."""
        return self.name.rpartition("/")[0].strip("/")


@dataclass(frozen=True, slots=True)
class RosGraph:
    """Announced nodes and topics, sorted by name. Bridges of ros2dds announce no nodes."""

    nodes: tuple[NodeToken, ...]
    topics: tuple[Topic, ...]

    @property
    def graph(self) -> Graph:
        """The topics, with the names of the nodes at their ends."""

        def names(ends: Iterable[RosEndpoint]) -> tuple[str, ...]:
            return tuple(sorted({end.full_name for end in ends}))

        uses = (StreamUse("", one.name, names(one.publishers), names(one.subscribers)) for one in self.topics)
        return Graph(tuple(uses))


def discover_ros_graph(session: Session, wire: Ros2Wire) -> RosGraph:
    """The ROS graph of all namespaces of the domain. Takes up to a second if nothing is announced.

    A topic belongs to the stream of its type, and of its last name unless its writer names it, as scans and
    maps; other topics are left out.
    """
    from zstate.wire.ros2.graph import NodeToken, parse_dds_token, parse_token  # noqa: PLC0415 - ROS only
    from zstate.wire.ros2.streams import topic_stream  # noqa: PLC0415 - ROS only

    parse = parse_dds_token if wire.name == "ros2dds" else parse_token
    nodes: list[NodeToken] = []
    ends: dict[tuple[str, StreamName], list[RosEndpoint]] = {}
    for token in map(parse, discover_tokens(session, wire.writers_expression("*"))):
        if isinstance(token, NodeToken):
            nodes.append(token)
        elif token is not None:
            stream = topic_stream(token.topic, token.dds_type)
            if stream is not None:
                ends.setdefault((f"/{token.topic.strip('/')}", stream), []).append(token)
    topics: list[Topic] = []
    for (name, stream), tokens in sorted(ends.items()):
        tokens.sort(key=lambda token: (token.full_name, token.zid, token.hash, token.key))
        publishers = tuple(token for token in tokens if token.kind == "MP")
        topics.append(Topic(name, stream, publishers, tuple(token for token in tokens if token.kind == "MS")))
    return RosGraph(tuple(sorted(nodes, key=lambda node: (node.full_name, node.key))), tuple(topics))
