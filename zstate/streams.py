"""Streams: all that is true of one, once, in a row that every tool reads.

The rows here are those of the core. Plugins have rows of their own: those of zstate in the ``plugin``
module of their folder, those of other packages where their entry point leads (see ``zstate.plugins``). These
are read when a stream is met that zstate does not bring, once in a process, and by the tools that list all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass, field
from functools import cache, cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from zstate.errors import InvalidInput, printable

if TYPE_CHECKING:
    from zstate.wire.messages import Message, StampedMessage

StreamName: TypeAlias = str
"""The name of a stream: one chunk of its keys, and the word of every tool for it."""

Group: TypeAlias = Literal["model", "joints", "edges", "driver", "measurement", "time"]
"""What tools treat alike: what follows from a robot's model, joint positions, moving edges of writers, what
goes to a driver and comes from it, what sensors and other programs measure, and the simulated time."""

KILOBYTE, MEGABYTE = 1_000, 1_000_000
MEASUREMENT_BYTES = 10 * KILOBYTE
"""Odometry with the longest names of its frames takes less on each wire."""
SAMPLE_BYTES = 256 * KILOBYTE
"""The transforms of 2000 links, names included, take less; in CDR they take up to four times as many."""
GRID_CELLS = 16 * 2**20
"""The cells of the largest map."""
LATCHED_BYTES = GRID_CELLS + 8 * 2**10
"""A grid of ``GRID_CELLS`` takes less on each wire."""


@dataclass(frozen=True, eq=False)
class Stream:
    """One stream of robots, of which each tool knows all that it needs.

    - ``name``: lower-case letters, digits and underscores.
    - ``message``: the class of its messages, a subclass of ``StampedMessage``, or ``"module:Class"``, which
      is loaded when a message is encoded or decoded.
    - ``summary``: what it is, for lists.
    - ``group``: what tools treat alike; other packages have measurements.
    - ``named``: writers have names of their own, one key each: zstate/<robot>/<name>/<writer>. Otherwise one
      writer has zstate/<robot>/<name>.
    - ``latched``: it has one current value, which late joiners receive as well.
    - ``max_bytes``: larger payloads are refused. That bounds the memory that a writer can make a reader use.
      Without ``latched`` they are refused above 1 MB in any case.
    - ``version``: of its messages, in their Zenoh encoding. Fields may be appended within a version.
    - ``start``: how to start a writer, for the tools that miss one; ``{robot}`` in it is the robot's name.
    - ``document``: ``"module:function"`` that makes a dict of a message and the name of its robot, as `zstate
      echo` prints it; by default of all fields.

    Raises InvalidInput for a name that is none.
    """

    name: StreamName
    message: type[Message] | str
    _: KW_ONLY
    summary: str = ""
    group: Group = "measurement"
    named: bool = False
    latched: bool = False
    max_bytes: int = MEASUREMENT_BYTES
    version: int = 1
    start: str = ""
    document: str = ""

    def __post_init__(self) -> None:
        text = self.name
        if not (text.isascii() and text.islower() and text.isidentifier()):
            raise InvalidInput(
                "the name of a stream has lower-case letters, digits and underscores; got "
                f"{printable(text)!r}"
            )

    def __repr__(self) -> str:
        return f"<stream {self.name!r}>"

    @cached_property
    def type(self) -> type[Message]:
        """The class of its messages."""
        if not isinstance(self.message, str):
            return self.message
        return _loaded(self.message)

    @property
    def is_measured(self) -> bool:
        """Whether it has what sensors and programs measure, sample by sample."""
        return self.group == "measurement" and not self.latched

    @property
    def is_sampled(self) -> bool:
        """Whether its messages are samples, which come at a rate."""
        return not self.latched and (self.group not in ("driver", "time") or self.name == "joint_setpoints")

    @property
    def is_echoed(self) -> bool:
        """Whether its messages can be printed as documents."""
        is_of_joints = self.group == "joints" or self.name == "joint_setpoints"
        return is_of_joints or bool(self.document) or self.is_measured

    def to_document(self, message: Message, robot: str) -> dict[str, Any]:
        """What `zstate echo` prints of ``message``."""
        if self.document:
            return _loaded(self.document)(message, robot)
        return {name: getattr(message, name) for name in message.__struct_fields__ if name != "session"}


def _loaded(place: str) -> Any:
    """What is at ``"module:name"``."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


_MESSAGES = "zstate.wire.messages"

__all__ = [
    "Message",
    "StampedMessage",
    "Stream",
    "StreamName",
    "all_streams",
    "find_stream",
    "stream_named",
]

CORE = (
    Stream(
        "joint_states",
        f"{_MESSAGES}:JointState",
        summary="positions, velocities and efforts of all joints",
        group="joints",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "partial_joint_states",
        f"{_MESSAGES}:JointState",
        summary="the same of some joints, by the names of their drivers",
        named=True,
        group="joints",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "tf",
        f"{_MESSAGES}:TransformSample",
        summary="poses of all joints of a model",
        group="model",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "transforms",
        f"{_MESSAGES}:WriterTransforms",
        summary="moving edges, by the names of their writers",
        document="zstate.cli.output.joint_state_text:transforms_document",
        named=True,
        group="edges",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "tf_static",
        f"{_MESSAGES}:StaticTransforms",
        summary="fixed edges, by the names of their writers",
        named=True,
        group="model",
        latched=True,
        max_bytes=MEGABYTE,
    ),
    Stream(
        "robot_description",
        f"{_MESSAGES}:RobotDescription",
        summary="the URDF, and the order of joints and edges",
        group="model",
        latched=True,
        max_bytes=LATCHED_BYTES,
    ),
)
CLOCK = Stream(
    "clock",
    f"{_MESSAGES}:ClockMessage",
    summary="the simulated time",
    group="time",
    named=False,
    max_bytes=KILOBYTE,
)

JOINT_STREAMS = frozenset(row.name for row in CORE if row.group == "joints")
"""The streams of joint positions."""


@dataclass
class _Registry:
    """The known rows by name, in the order of tokens: built-in ones, then those of other packages by name."""

    rows: dict[StreamName, Stream] = field(default_factory=dict[StreamName, Stream])
    has_others: bool = False

    def built_in(self) -> dict[StreamName, Stream]:
        if not self.rows:
            from zstate.plugins import built_in_plugins  # noqa: PLC0415 - it imports rows of this class

            rows = [*CORE, *(row for plugin in built_in_plugins() for row in plugin.streams), CLOCK]
            self.rows = {row.name: row for row in rows}
        return self.rows

    def all(self) -> dict[StreamName, Stream]:
        if not self.has_others:
            from zstate.plugins import other_plugins  # noqa: PLC0415 - as above

            self.built_in()
            self.has_others = True  # before: a plugin may look for a stream while it is imported
            others = [row for plugin in other_plugins() for row in plugin.streams]
            self.rows |= {row.name: row for row in sorted(others, key=lambda row: row.name)}
        return self.rows


_REGISTRY = _Registry()


def find_stream(name: StreamName) -> Stream | None:
    """The row of the stream ``name``; None if no plugin brings it."""
    return _REGISTRY.built_in().get(name) or _REGISTRY.all().get(name)


def stream_named(name: StreamName) -> Stream:
    """The row of the stream ``name``. Raises InvalidInput with the known ones if no plugin brings it."""
    found = find_stream(name)
    if found is None:
        raise InvalidInput(
            f"there is no stream {printable(name)!r}; known are {', '.join(_REGISTRY.rows)}. "
            "`zstate plugins` lists the packages that bring others"
        )
    return found


def all_streams() -> tuple[Stream, ...]:
    """All rows, those of other packages as well, in the order of liveliness tokens."""
    return tuple(_REGISTRY.all().values())


def streams_where(condition: Callable[[Stream], bool]) -> tuple[StreamName, ...]:
    """The names of the streams that meet ``condition``, those of other packages as well."""
    return tuple(row.name for row in all_streams() if condition(row))


@cache
def edge_streams() -> tuple[StreamName, ...]:
    """The streams of moving edges under the names of their writers."""
    return tuple(row.name for row in _REGISTRY.built_in().values() if row.group == "edges")


@cache
def latched_streams() -> tuple[StreamName, ...]:
    """The streams of one current value, which late joiners receive as well."""
    return streams_where(lambda row: row.latched)


@cache
def measured_streams() -> tuple[StreamName, ...]:
    """The streams of what sensors and programs measure, sample by sample."""
    return streams_where(lambda row: row.is_measured)


def is_named(name: StreamName) -> bool:
    """Whether each writer of the stream has a key of its own."""
    found = find_stream(name)
    return found is not None and found.named


def is_latched(name: StreamName) -> bool:
    """Whether the stream has one current value, which late joiners receive as well."""
    found = find_stream(name)
    return found is not None and found.latched


def is_measured(name: StreamName) -> bool:
    """Whether the stream is one of ``measured_streams``, without a search for other packages' otherwise."""
    found = find_stream(name)
    return found is not None and found.is_measured


def in_canonical_order(names: Iterable[StreamName]) -> tuple[StreamName, ...]:
    """``names``, each once, in the order of tokens, without those that no plugin brings."""
    given = set(names)
    rows = _REGISTRY.built_in()
    if not given <= rows.keys():
        rows = _REGISTRY.all()
    return tuple(name for name in rows if name in given)


def __getattr__(name: str) -> Any:
    # Base classes of messages, for those who add a stream: loaded then.
    if name in {"Message", "StampedMessage"}:
        return getattr(import_module(_MESSAGES), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
