"""Streams: all that is true of one, once, in a row that every tool reads.

The rows here are those of the core. Plugins have rows of their own: those of zstate in the ``plugin``
module of their folder, those of other packages where their entry point leads. ``zstate.stream_registry``
finds them.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from zstate._util.lazy_names import loaded
from zstate.errors import InvalidInput, printable

if TYPE_CHECKING:
    from zstate.message import Message, StampedMessage

__all__ = [
    "BULK_BYTES",
    "CLOCK",
    "CORE",
    "GRID_CELLS",
    "JOINT_STREAMS",
    "KILOBYTE",
    "LATCHED_BYTES",
    "MEASUREMENT_BYTES",
    "MEGABYTE",
    "SAMPLE_BYTES",
    "Group",
    "StampedMessage",
    "Stream",
    "StreamName",
]

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
BULK_BYTES = 64 * MEGABYTE
"""The largest sample of bulk data."""


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
      Without ``latched`` they are refused above 1 MB in any case, with ``bulk`` above 64 MB.
    - ``bulk``: its samples are large, as clouds and images are, and give way to those of all other streams:
      Zenoh sends them with a lower priority, and no more than 8 wait for a reader.
    - ``private``: it shows people and places, as pictures do; access control has a role that does not read
      it.
    - ``version``: of its messages, in their Zenoh encoding. Fields may be appended within a version.
    - ``start``: how to start a writer, for the tools that miss one; ``{robot}`` in it is the robot's name.
    - ``document``: ``"module:function"`` that makes a dict of a message and the name of its robot, as `zstate
      echo` prints it; by default of all fields, a ``frame`` with its full name.
    - ``full_document``: the same for its options --json, --csv and --field, if that has more.
    - ``columns``: ``"module:function"`` that makes columns of numbers of a message and the name of its robot,
      by name and of one length, the first of them ``stamp`` [ns]: `zstate export` writes several rows for
      each message, as a cloud has several points. By default a message is one row, with its fields.
    - ``recorded``: ``"module:name"`` of how recordings have it where ROS 2 does not carry it
      (zstate.wire.ros2.streams.RecordedForm).
    - ``ros``: ``"module:name"`` of how ROS 2 carries it (zstate.wire.ros2.streams.RosStream); empty if it
      does not.

    Raises InvalidInput for a name that is none, and for ``bulk`` with ``latched``.
    """

    name: StreamName
    message: type[Message] | str
    _: KW_ONLY
    summary: str = ""
    group: Group = "measurement"
    named: bool = False
    latched: bool = False
    bulk: bool = False
    private: bool = False
    max_bytes: int = MEASUREMENT_BYTES
    version: int = 1
    start: str = ""
    document: str = ""
    full_document: str = ""
    columns: str = ""
    recorded: str = ""
    ros: str = ""

    def __post_init__(self) -> None:
        text = self.name
        if not (text.isascii() and text.islower() and text.isidentifier()):
            raise InvalidInput(
                "the name of a stream has lower-case letters, digits and underscores; got "
                f"{printable(text)!r}"
            )
        if self.bulk and self.latched:
            raise InvalidInput(
                f"the stream {text!r} is latched and bulk; a latched value always arrives, bulk data may not"
            )

    def __repr__(self) -> str:
        return f"<stream {self.name!r}>"

    @cached_property
    def type(self) -> type[Message]:
        """The class of its messages."""
        if not isinstance(self.message, str):
            return self.message
        return loaded(self.message)

    @cached_property
    def ros_form(self) -> Any:
        """How ROS 2 carries it."""
        return loaded(self.ros)

    @cached_property
    def recorded_form(self) -> Any:
        """How recordings have it."""
        return loaded(self.recorded)

    @property
    def is_measured(self) -> bool:
        """Whether it has what sensors and programs measure, sample by sample."""
        return self.group == "measurement" and not self.latched

    @property
    def is_value(self) -> bool:
        """Whether it has one current value of what was measured, as a map is."""
        return self.group == "measurement" and self.latched

    @property
    def is_sampled(self) -> bool:
        """Whether its messages are samples, which come at a rate."""
        return not self.latched and (self.group not in ("driver", "time") or self.name == "joint_setpoints")

    @property
    def is_echoed(self) -> bool:
        """Whether its messages can be printed as documents."""
        is_of_joints = self.group == "joints" or self.name == "joint_setpoints"
        return is_of_joints or bool(self.document) or self.is_measured

    def to_document(self, message: Message, robot: str, *, in_full: bool = False) -> dict[str, Any]:
        """What `zstate echo` prints of ``message``; ``in_full`` for programs."""
        if reference := (in_full and self.full_document) or self.document:
            return loaded(reference)(message, robot)
        document = {name: getattr(message, name) for name in message.__struct_fields__ if name != "session"}
        if isinstance(frame := document.get("frame"), str):
            with suppress(InvalidInput):  # no name of a frame: as it is
                document["frame"] = loaded("zstate.wire.keys:full_name")(robot, frame)
        return document


CORE = (
    Stream(
        "joint_states",
        "zstate.wire.messages:JointState",
        summary="positions, velocities and efforts of all joints",
        group="joints",
        ros="zstate.wire.ros2.streams:JOINT_STATES",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "partial_joint_states",
        "zstate.wire.messages:JointState",
        summary="the same of some joints, by the names of their drivers",
        named=True,
        group="joints",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "tf",
        "zstate.wire.messages:TransformSample",
        summary="poses of all joints of a model",
        group="model",
        ros="zstate.wire.ros2.streams:TF",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "transforms",
        "zstate.wire.messages:WriterTransforms",
        summary="moving edges, by the names of their writers",
        document="zstate.cli.output.joint_state_text:transforms_document",
        named=True,
        group="edges",
        max_bytes=SAMPLE_BYTES,
    ),
    Stream(
        "tf_static",
        "zstate.wire.messages:StaticTransforms",
        summary="fixed edges, by the names of their writers",
        named=True,
        group="model",
        latched=True,
        ros="zstate.wire.ros2.streams:TF_STATIC",
        max_bytes=MEGABYTE,
    ),
    Stream(
        "robot_description",
        "zstate.wire.messages:RobotDescription",
        summary="the URDF, and the order of joints and edges",
        group="model",
        latched=True,
        ros="zstate.wire.ros2.streams:ROBOT_DESCRIPTION",
        max_bytes=LATCHED_BYTES,
    ),
)
CLOCK = Stream(
    "clock",
    "zstate.wire.messages:ClockMessage",
    summary="the simulated time",
    group="time",
    named=False,
    ros="zstate.wire.ros2.streams:SIMULATED_TIME",
    max_bytes=KILOBYTE,
)

JOINT_STREAMS = frozenset(row.name for row in CORE if row.group == "joints")
"""The streams of joint positions."""


def __getattr__(name: str) -> Any:
    # The base class of messages, for those who add a stream; msgspec is loaded then.
    if name == "StampedMessage":
        return loaded("zstate.message:StampedMessage")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
