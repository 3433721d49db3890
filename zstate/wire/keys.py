"""The native key space: one prefix for each robot, one chunk for its name.

================================================  ==========================================
``zstate/<robot>/joint_states``                   JointState, each sample; a query returns a HistoryPage
``zstate/<robot>/partial_joint_states/<writer>``  JointState with the names of its joints; likewise
``zstate/<robot>/tf``                             TransformSample, each sample; likewise
``zstate/<robot>/tf_static/<writer>``             StaticTransforms, latched
``zstate/<robot>/transforms/<writer>``            WriterTransforms, each sample; likewise
``zstate/<robot>/robot_description``              RobotDescription, latched
``zstate/<robot>/<stream>/<writer>``              any other stream with names, such as ``imu`` and ``scan``;
                                                  on ``odometry``, a query returns a HistoryPage
``zstate/<robot>/joint_commands``                 JointCommand, to a driver
``zstate/<robot>/joint_setpoints``                JointState with joint names, of a driver, while read
``zstate/<robot>/driver``                         DriverState, latched
``zstate/<robot>/stop/<id>``                      Stop, latched: of one program that stops the driver
``zstate/<robot>/relax/<id>``                     Stop, latched: of one that switches its torque off, too
``zstate/<robot>/release/<id>``                   Release, of a commander
``zstate/<robot>/@motion``                        a queryable: JointTrajectory or MotionCancel, to a driver
``zstate/<robot>/lookup``                         a queryable
``zstate/<robot>/status/<id>``                    Status of one writer, once a second while read
``zstate/<robot>/@writer/<streams>/<id>``         liveliness token of one writer, with all its streams
``zstate/<robot>/@clock/<id>``                    a queryable: the time by that writer's clock
``zstate/<robot>/@edge/<child>/<parent>/<id>``    liveliness token of a writer that places a moving edge, or
                                                  is about to place a static one
``zstate/@reader/<robot>/<streams>/<id>``         liveliness token of one reader, likewise
``zstate/clock``                                  ClockMessage
================================================  ==========================================

``<id>`` is the identity of a writer or reader, already one chunk; ``<streams>`` are joined by commas. A
writer has one token for all, because what tokens cost a router grows with the square of their number.
Functions that build a key raise InvalidInput for names that are not one chunk of a key, and functions that
parse one for any other key. An expression for the robot ``"*"`` matches all robots.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput
from zstate.plugins import all_streams, find_stream, in_canonical_order, is_named
from zstate.streams import StreamName

CLOCK_KEY = "zstate/clock"
ANY = "*"

STOP_STREAMS: tuple[StreamName, ...] = ("stop", "relax")
"""The streams of stops. Access control lets every identity write the first, which never drops a load."""

READERS = "zstate/@reader/*/*/*"
"""The key expression of the tokens of all readers."""

VERBATIM_CHUNKS = ("@writer", "@clock", "@edge", "@reader")
"""The chunks of tokens and clocks: ``*`` and ``**`` do not match them (Zenoh: verbatim chunks)."""

MOTION_CHUNK = "@motion"
"""The chunk of requests for motions. It is verbatim, too: access control lets viewers query ``zstate/**``."""

ODOMETRY_CHUNK = "@odometry"
"""The chunk of requests to the writer of an odometry, likewise verbatim."""

MODEL_WRITER = "robot_description"
"""The writer of the edges that a robot's own model fixes."""

MAX_NAME_LENGTH = 255
"""The longest name of a robot, a writer, a program or a host, as in file systems."""

MAX_FRAME_NAME_LENGTH = 1024
_MAX_KEY_LENGTH = 16_384
"""A name of ``MAX_NAME_LENGTH`` is up to 12 times as long when it is quoted."""

_RESERVED = frozenset("/*$?#")
_CLOCK_CHUNK = CLOCK_KEY.rpartition("/")[2]


def check_writer(name: str) -> str:
    """``check_robot`` for the name under which a writer publishes on a named stream."""
    return check_robot(name, "writer")


def check_robot(name: str, what: str = "robot") -> str:
    """``name`` if it can be one chunk of a key. Raises InvalidInput with the reason otherwise."""
    if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]  # e.g. of a missing variable
        raise InvalidInput(f"a {what} name is text; got {name!r} of type {type(name).__name__}")
    problem = _chunk_problem(name)
    if what == "robot" and name == _CLOCK_CHUNK:
        problem = f"is that of the simulated time, {CLOCK_KEY!r}"
    if problem:
        raise InvalidInput(
            f"the {what} name {shortened(name)!r} {problem}; it is one chunk of a Zenoh key: "
            "use letters, digits, '_', '-' or '.', for instance 'arm_1'"
        )
    return name


def _chunk_problem(name: str) -> str:
    """Why ``name`` cannot be one chunk of a key; empty if it can."""
    if not name:
        return "is empty"
    if name.startswith("@"):
        return "begins with '@'"
    if len(name) > MAX_NAME_LENGTH:
        return f"has {len(name)} characters, more than {MAX_NAME_LENGTH}"
    for character in name:
        if character in _RESERVED or character.isspace() or not character.isprintable():
            return f"contains {character!r}"
    return ""


def _check_robot_or_any(robot: str) -> str:
    return robot if robot == ANY else check_robot(robot)


def shortened(text: str) -> str:
    """``text`` for an error message, cut off after 255 characters."""
    return text if len(text) <= MAX_NAME_LENGTH else f"{text[:MAX_NAME_LENGTH]}..."


def stream_key(robot: str, stream: StreamName, writer: str = "") -> str:
    """The key of ``stream``: of the named ones one for each ``writer``; ``clock`` has only one."""
    if stream == "clock":
        return CLOCK_KEY
    key = f"zstate/{check_robot(robot)}/{stream}"
    return f"{key}/{check_writer(writer)}" if is_named(stream) else key


def stream_from_key(key: str) -> StreamName:
    """The stream of a ``stream_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    stream = find_stream(chunks[2]) if len(chunks) > 2 and chunks[0] == "zstate" else None
    if stream is not None and len(chunks) == (4 if stream.named else 3):
        return stream.name
    raise _form_error(key, "zstate/<robot>/<stream>")


def stream_expression(robot: str, stream: StreamName) -> str:
    """The key expression of every writer of ``stream``."""
    if stream == "clock":
        return CLOCK_KEY
    key = f"zstate/{_check_robot_or_any(robot)}/{stream}"
    return f"{key}/*" if is_named(stream) else key


def lookup_key(robot: str) -> str:
    """The key of the queryable that serves lookups to devices without a buffer."""
    return f"zstate/{check_robot(robot)}/lookup"


def status_key(robot: str, identity: str) -> str:
    """The key on which one writer publishes its Status."""
    return f"zstate/{check_robot(robot)}/status/{identity}"


def status_expression(robot: str) -> str:
    """The key expression of every status of ``robot``."""
    return f"zstate/{_check_robot_or_any(robot)}/status/*"


def parse_status_key(key: str) -> tuple[str, str]:
    """Robot and identity in a ``status_key``."""
    robot, identity = _parse(key, "zstate/<robot>/status/<identity>")
    return check_robot(robot), identity


def driver_key(robot: str) -> str:
    """The key on which the driver of a robot publishes its DriverState."""
    return f"zstate/{check_robot(robot)}/driver"


def driver_expression(robot: str) -> str:
    """The key expression of the ``driver_key`` of ``robot``, or of all robots."""
    return f"zstate/{_check_robot_or_any(robot)}/driver"


def stop_key(robot: str, identity: str) -> str:
    """The key on which one program stops the driver of a robot, whose joints hold."""
    return f"zstate/{check_robot(robot)}/stop/{identity}"


def relax_key(robot: str, identity: str) -> str:
    """The key on which one program stops the driver of a robot, and switches its torque off.

    Access control separates it from the ``stop_key``: without torque, joints without brakes fall.
    """
    return f"zstate/{check_robot(robot)}/relax/{identity}"


def stop_expressions(robot: str) -> tuple[str, ...]:
    """The key expressions of every Stop of ``robot``, on both keys."""
    return tuple(stream_expression(robot, stream) for stream in STOP_STREAMS)


def parse_stop_key(key: str) -> tuple[str, str, str]:
    """Robot, identity, and whether it is a "stop" or "relax", in a ``stop_key`` or ``relax_key``."""
    robot, stream, identity = _parse(key, "zstate/<robot>/<stream>/<identity>")
    if stream not in STOP_STREAMS:
        raise _form_error(key, "zstate/<robot>/stop/<identity>")
    return check_robot(robot), identity, stream


def release_key(robot: str, identity: str) -> str:
    """The key on which a commander releases stops. Access control separates it from that of stops."""
    return f"zstate/{check_robot(robot)}/release/{identity}"


def release_expression(robot: str) -> str:
    """The key expression of every Release of ``robot``."""
    return f"zstate/{_check_robot_or_any(robot)}/release/*"


def parse_release_key(key: str) -> tuple[str, str]:
    """Robot and identity in a ``release_key``."""
    robot, identity = _parse(key, "zstate/<robot>/release/<identity>")
    return check_robot(robot), identity


def motion_key(robot: str) -> str:
    """The key of the queryable of a driver that takes requests for motions."""
    return f"zstate/{check_robot(robot)}/{MOTION_CHUNK}"


def odometry_request_key(robot: str, writer: str) -> str:
    """The key of the queryable of an odometry node that starts anew, or sets its pose, on request."""
    return f"zstate/{check_robot(robot)}/{ODOMETRY_CHUNK}/{check_writer(writer)}"


def writer_key(robot: str, streams: StreamName | Collection[StreamName], identity: str) -> str:
    """The liveliness token of one writer of ``streams``."""
    return f"zstate/{check_robot(robot)}/@writer/{_joined(streams)}/{identity}"


def writer_expression(robot: str, stream: StreamName | None = None) -> str:
    """The key expression of all writer tokens of ``robot``, or of those with ``stream`` in their streams.

    The tokens of streams whose names contain that of ``stream`` match, too.
    """
    streams = "*" if stream is None else f"$*{stream}$*"
    return f"zstate/{_check_robot_or_any(robot)}/@writer/{streams}/*"


def parse_writer_key(key: str) -> tuple[str, tuple[StreamName, ...], str]:
    """Robot, streams and identity in a ``writer_key``."""
    robot, streams, identity = _parse(key, "zstate/<robot>/@writer/<streams>/<identity>")
    return check_robot(robot), _split(streams), identity


def reader_key(robot: str, streams: StreamName | Collection[StreamName], identity: str) -> str:
    """The liveliness token of one reader of ``streams``; robot ``"*"`` means all.

    Readers write below no robot's prefix.
    """
    return f"zstate/@reader/{quote(robot, safe='')}/{_joined(streams)}/{identity}"


def parse_reader_key(key: str) -> tuple[str, tuple[StreamName, ...], str]:
    """Robot, streams and identity in a ``reader_key``."""
    robot, streams, identity = _parse(key, "zstate/@reader/<robot>/<streams>/<identity>")
    return _check_robot_or_any(unquote(robot)), _split(streams), identity


def _joined(streams: StreamName | Collection[StreamName]) -> str:
    """``streams`` in one chunk, each once, in one canonical order."""
    return ",".join(in_canonical_order((streams,) if isinstance(streams, str) else streams))


def _split(chunk: str) -> tuple[StreamName, ...]:
    """The streams in a chunk. Raises InvalidInput unless they are in canonical form."""
    streams = in_canonical_order(chunk.split(","))
    # One canonical form: two tokens of one writer would count as two writers.
    if not streams or ",".join(streams) != chunk:
        order = ", ".join(row.name for row in all_streams())
        raise InvalidInput(f"{shortened(chunk)!r} is not a list of streams, each once, in the order {order}")
    return streams


def clock_key(robot: str, identity: str) -> str:
    """The key of the queryable that replies with the time of one writer's clock."""
    return f"zstate/{check_robot(robot)}/@clock/{identity}"


def clock_expression(robot: str) -> str:
    """The key expression of the clocks of all writers of ``robot``."""
    return f"zstate/{_check_robot_or_any(robot)}/@clock/*"


def parse_clock_key(key: str) -> tuple[str, str]:
    """Robot and identity in a ``clock_key``."""
    robot, identity = _parse(key, "zstate/<robot>/@clock/<identity>")
    return check_robot(robot), identity


def edge_key(robot: str, edge: tuple[str, str], identity: str) -> str:
    """The token of a writer of ``edge``, or of the joint that moves it: full names of parent and child."""
    parent, child = (quote(frame, safe="") for frame in edge)
    return f"zstate/{check_robot(robot)}/@edge/{child}/{parent}/{identity}"


def edge_expression(child: str) -> str:
    """The key expression of the edge tokens of ``child``, from writers of any robot."""
    return f"zstate/*/@edge/{quote(child, safe='')}/*/*"


def parse_edge_key(key: str) -> tuple[str, tuple[str, str], str]:
    """Robot, edge and identity in an ``edge_key``."""
    robot, child, parent, identity = _parse(key, "zstate/<robot>/@edge/<child>/<parent>/<identity>")
    check_robot(robot)
    edge = unquote(parent), unquote(child)
    for frame in edge:
        full_name(robot, frame)
    return robot, edge, identity


@lru_cache(4096)  # called for each received sample
def robot_from_key(key: str) -> str:
    """The robot of a key under ``zstate/<robot>/``; a wildcard is refused, as it makes it several keys."""
    chunks = _chunks(key)
    if len(chunks) < 3 or chunks[0] != "zstate" or not chunks[1] or "*" in key:
        raise _form_error(key, "zstate/<robot>/...")
    return check_robot(chunks[1])


def _parse(key: str, form: str) -> list[str]:
    """The chunks of ``key`` at the placeholders of ``form``."""
    names, chunks = form.split("/"), _chunks(key)
    if len(chunks) != len(names):
        raise _form_error(key, form)
    for name, chunk in zip(names, chunks, strict=True):
        if name[0] != "<" and name != chunk:
            raise _form_error(key, form)
    return [chunk for name, chunk in zip(names, chunks, strict=True) if name[0] == "<"]


def _chunks(key: str) -> list[str]:
    return key.split("/") if len(key) <= _MAX_KEY_LENGTH else []


def _form_error(key: str, form: str) -> InvalidInput:
    return InvalidInput(f"the key {shortened(key)!r} is not of the form {form!r}")


def full_name(robot: str, frame: str) -> str:
    """The name of a frame of ``robot`` among several robots: ``robot/frame``; a name with a slash is one.

    Raises InvalidInput for a name that is empty, begins or ends with a slash, has control characters, or
    is longer than 1024 characters.
    """
    if len(frame) > MAX_FRAME_NAME_LENGTH:
        raise InvalidInput(
            f"the frame name {shortened(frame)!r} of robot {robot!r} has {len(frame)} characters, "
            f"more than {MAX_FRAME_NAME_LENGTH}"
        )
    if not frame or frame.startswith("/") or frame.endswith("/"):
        raise InvalidInput(
            f"the frame name {frame!r} of robot {robot!r} is empty or has a slash at its end; "
            "write 'frame' or 'robot/frame'"
        )
    if not frame.isprintable():
        raise InvalidInput(f"the frame name {frame!r} of robot {robot!r} has control characters in it")
    return frame if "/" in frame else f"{robot}/{frame}"


def wire_name(robot: str, link: str) -> str:
    """The name of a link of ``robot`` in its own messages: bare, or the full name if it has a slash."""
    return f"{robot}/{link}" if "/" in link else link


EdgeNames = tuple[str, str]
"""Full names of parent and child."""

FOREIGN_FRAME = "foreign frame"
"""The reason of an InsertRefused for an edge that places another robot's frame."""


def frame_owner(frame: str) -> str:
    """The first part of a full name: the robot that owns the frame, if there is such a robot."""
    return frame.partition("/")[0]


def foreign_edge_problem(
    robot: str, edge: EdgeNames, robots: Collection[str], placers: Collection[str] | None = None
) -> str:
    """Why a writer of ``robot`` may not publish ``edge`` at all; empty if it may.

    ``robots`` are the robots on the network. Only ``placers`` may place the root of another robot; None
    permits all.
    """
    parent, child = edge
    owner, other = frame_owner(child), frame_owner(parent)
    if owner == robot or owner not in robots:
        return ""
    whose = f"{child!r} is a frame of robot {owner!r}, and the edge from {parent!r} came from robot {robot!r}"
    if placers is not None and robot not in placers:
        allowed = ", ".join(map(repr, sorted(placers))) or "no robot"
        return f"{whose}, which is not among the placers ({allowed}); publish it as robot {owner!r}"
    if other != robot and other in robots:
        return (
            f"{whose}, which may place the root of {owner!r} in frames of its own, and {parent!r} is a frame "
            f"of {other!r}; publish it as robot {owner!r} (--robot {owner})"
        )
    return ""
