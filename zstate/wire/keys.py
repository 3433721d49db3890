"""The native key space: one prefix for each robot, one chunk for its name.

A stream has the key ``zstate/<robot>/<stream>``, or ``zstate/<robot>/<stream>/<writer>`` if its writers have
names (``stream_key``); the simulated time has ``zstate/clock``. All other keys are a ``Key`` below, but for
the token of a site (``zstate.net.sites``). The table in docs/wire.md has all of them, with what is sent on
each.

``<identity>`` is that of a writer or reader, already one chunk; ``<streams>`` are joined by commas. A writer
has one token for all, because what tokens cost a router grows with the square of their number.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVarTuple, cast
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput
from zstate.stream_registry import all_streams, find_stream, in_canonical_order, is_named
from zstate.streams import StreamName

CLOCK_KEY = "zstate/clock"
ANY = "*"

STOP_STREAMS: tuple[StreamName, ...] = ("stop", "relax")
"""The streams of stops. Access control lets every identity write the first, which never drops a load."""

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


def frame_owner(frame: str) -> str:
    """The first part of a full name: the robot that owns the frame, if there is such a robot."""
    return frame.partition("/")[0]


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


class Chunk(NamedTuple):
    """How a value is written as one chunk of a key, and read from it."""

    write: Callable[[Any], str]
    read: Callable[[str], Any]


def _quoted(text: str) -> str:
    return quote(text, safe="")


def _read_reader_robot(chunk: str) -> str:
    return _check_robot_or_any(unquote(chunk))


_NAME_CHUNKS = {
    "robot": Chunk(check_robot, check_robot),
    "writer": Chunk(check_writer, check_writer),
    "identity": Chunk(str, str),
    "streams": Chunk(_joined, _split),
    "child": Chunk(_quoted, unquote),
    "parent": Chunk(_quoted, unquote),
}
_READER_ROBOT = Chunk(_quoted, _read_reader_robot)

Values = TypeVarTuple("Values")


class Key(Generic[*Values]):
    """A form of keys, such as ``zstate/<robot>/status/<identity>``: one value for each placeholder.

    ``check`` raises InvalidInput for parsed values that are invalid together.
    """

    def __init__(self, form: str, check: Callable[[*Values], None] | None = None, **chunks: Chunk) -> None:
        self.form = form
        self._check = check
        self._form = form.split("/")
        by_name = _NAME_CHUNKS | chunks
        names = [(place, text[1:-1]) for place, text in enumerate(self._form) if text[0] == "<"]
        self._placeholders = [(place, name, by_name[name]) for place, name in names]
        self._fixed = [(place, text) for place, text in enumerate(self._form) if text[0] != "<"]

    @property
    def verbatim(self) -> str:
        """Its chunk that begins with ``@``, which ``*`` and ``**`` do not match (Zenoh: verbatim chunks)."""
        return next(chunk for chunk in self._form if chunk[0] == "@")

    def key(self, *values: *Values) -> str:
        """The key with ``values``. Raises InvalidInput for names that are not one chunk of a key."""
        chunks = self._form.copy()
        for (place, _, chunk), value in zip(self._placeholders, values, strict=True):
            chunks[place] = chunk.write(value)
        return "/".join(chunks)

    def expression(self, robot: str = ANY, **others: str) -> str:
        """The key expression of all keys with these values; a value that is not given, or ``"*"``, is any."""
        values, chunks = {"robot": robot, **others}, self._form.copy()
        for place, name, chunk in self._placeholders:
            value = values.get(name, ANY)
            chunks[place] = value if value == ANY else chunk.write(value)
        return "/".join(chunks)

    def parse(self, key: str) -> tuple[*Values]:
        """The values in ``key``. Raises InvalidInput for a key of another form, or with invalid names."""
        chunks = _chunks(key)
        if len(chunks) != len(self._form) or any(chunks[place] != text for place, text in self._fixed):
            raise _form_error(key, self.form)
        parsed = tuple(chunk.read(chunks[place]) for place, _, chunk in self._placeholders)
        values = cast("tuple[*Values]", parsed)
        if self._check is not None:
            self._check(*values)
        return values


def _chunks(key: str) -> list[str]:
    return key.split("/") if len(key) <= _MAX_KEY_LENGTH else []


def _form_error(key: str, form: str) -> InvalidInput:
    return InvalidInput(f"the key {shortened(key)!r} is not of the form {form!r}")


def _check_frames(robot: str, child: str, parent: str, _identity: str) -> None:
    full_name(robot, parent)
    full_name(robot, child)


STATUS = Key[str, str]("zstate/<robot>/status/<identity>")
"""The Status of one writer, once a second while it is read."""

LOOKUP = Key[str]("zstate/<robot>/lookup")
"""A queryable of transforms, for devices without a buffer."""

WRITER_CLOCK = Key[str, str]("zstate/<robot>/@clock/<identity>")
"""A queryable of the time by one writer's clock."""

WRITER_TOKEN = Key[str, Sequence[StreamName], str]("zstate/<robot>/@writer/<streams>/<identity>")
"""The liveliness token of one writer of all its streams."""

EDGE_TOKEN = Key[str, str, str, str]("zstate/<robot>/@edge/<child>/<parent>/<identity>", _check_frames)
"""The liveliness token of a writer that places a moving edge, or is about to place a static one.

A joint that moves an edge counts as that edge. The frames are full names.
"""

READER_TOKEN = Key[str, Sequence[StreamName], str](
    "zstate/@reader/<robot>/<streams>/<identity>", robot=_READER_ROBOT
)
"""The liveliness token of one reader of a robot or of all, ``"*"``. Readers write below no robot's prefix."""

STOP = Key[str, str]("zstate/<robot>/stop/<identity>")
"""The Stop of one program, latched: the driver's joints hold."""

RELAX = Key[str, str]("zstate/<robot>/relax/<identity>")
"""The Stop of one program, latched, that switches the driver's torque off.

Access control separates it from ``STOP``: without torque, joints without brakes fall.
"""

RELEASE = Key[str, str]("zstate/<robot>/release/<identity>")
"""The Release of stops by one commander. Access control separates it from ``STOP``, too."""

MOTION = Key[str]("zstate/<robot>/@motion")
"""A queryable of a driver, for a JointTrajectory or MotionCancel.

``@`` keeps it from viewers: access control lets them query ``zstate/**``, which does not match.
"""

ODOMETRY_REQUEST = Key[str, str]("zstate/<robot>/@odometry/<writer>")
"""A queryable of an odometry node, which restarts it or sets its pose; viewers may not query it either."""


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


def stream_expression(robot: str, stream: StreamName, name: str = ANY) -> str:
    """The key expression of every writer of ``stream``, or of the one called ``name``."""
    if stream == "clock":
        return CLOCK_KEY
    key = f"zstate/{_check_robot_or_any(robot)}/{stream}"
    return f"{key}/{name}" if is_named(stream) else key


@lru_cache(4096)  # called for each received sample
def robot_from_key(key: str) -> str:
    """The robot of a key under ``zstate/<robot>/``; a wildcard is refused, as it makes it several keys."""
    chunks = _chunks(key)
    if len(chunks) < 3 or chunks[0] != "zstate" or not chunks[1] or "*" in key:
        raise _form_error(key, "zstate/<robot>/...")
    return check_robot(chunks[1])


EdgeNames = tuple[str, str]
"""Full names of parent and child."""

FOREIGN_FRAME = "foreign frame"
"""The reason of an InsertRefused for an edge that places another robot's frame."""


def is_frame_of_another(
    robot: str, frame: str, robots: Collection[str], placers: Collection[str] | None = None
) -> bool:
    """Whether ``frame`` belongs to another robot than ``robot``: one of ``robots``, which are on the network.

    With ``placers`` also to one that is not, or not yet.
    """
    owner = frame_owner(frame)
    return owner != robot and (owner in robots or (placers is not None and owner != frame))


def foreign_edge_problem(
    robot: str, edge: EdgeNames, robots: Collection[str], placers: Collection[str] | None = None
) -> str:
    """Why a writer of ``robot`` may not publish ``edge`` at all; empty if it may.

    ``robots`` are the robots on the network. Only ``placers`` may place the root of another robot, also
    before that is on the network; None permits all.
    """
    parent, child = edge
    owner, other = frame_owner(child), frame_owner(parent)
    if not is_frame_of_another(robot, child, robots, placers):
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
