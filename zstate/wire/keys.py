"""The native key space: one prefix for each robot, one chunk for its name.

==============================================  ==========================================
``zstate/<robot>/joint_states``                 JointState, each sample; a query gets a Past, the last ones
``zstate/<robot>/tf``                           TransformSample, each sample; likewise
``zstate/<robot>/tf_static/<writer>``           StaticTransforms, latched
``zstate/<robot>/robot_description``            RobotDescription, latched
``zstate/<robot>/joint_commands``               JointCommand, to a driver
``zstate/<robot>/lookup``                       a queryable
``zstate/<robot>/status/<id>``                  Status of one writer, once a second while read
``zstate/<robot>/@writer/<stream>/<id>``        liveliness token of one writer
``zstate/<robot>/@clock/<id>``                  a queryable: what time it is by that writer's clock
``zstate/<robot>/@edge/<child>/<parent>/<id>``  liveliness token of one who is about to place a static edge
``zstate/@reader/<robot>/<stream>/<id>``        liveliness token of one reader
``zstate/clock``                                Clock
==============================================  ==========================================
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import Literal, get_args
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput

Stream = Literal["joint_states", "tf", "tf_static", "robot_description", "joint_commands", "clock"]

CLOCK_KEY = "zstate/clock"
ANY = "*"

READERS = "zstate/@reader/*/*/*"
"""The key expression of the tokens of all readers."""

MODEL_WRITER = "robot_description"
"""The writer of the edges that a robot's own model fixes."""

MOST_CHARACTERS = 255
"""The longest name of a robot, a writer, a program or a host, as in file systems."""

MOST_OF_A_FRAME = 1024
_MOST_OF_A_KEY = 16_384
"""A name of ``MOST_CHARACTERS`` is up to 12 times as long when it is quoted."""

_RESERVED = frozenset("/*$?#")


def check_robot(name: str) -> str:
    """``name`` if it can be one chunk of a key; InvalidInput saying what is wrong otherwise."""
    return _check_chunk("robot", name)


def check_writer(name: str) -> str:
    """The same for the name under which static edges are written."""
    return _check_chunk("writer", name)


def _check_chunk(what: str, name: str) -> str:
    problem = _chunk_problem(name)
    if problem:
        raise InvalidInput(
            f"the {what} name {shortened(name)!r} {problem}; it is one chunk of a Zenoh key: "
            "use letters, digits, '_', '-' or '.', for instance 'arm_1'"
        )
    return name


def _chunk_problem(name: str) -> str:
    if not name:
        return "is empty"
    if name.startswith("@"):
        return "begins with '@'"
    if len(name) > MOST_CHARACTERS:
        return f"has {len(name)} characters, more than {MOST_CHARACTERS}"
    for character in name:
        if character in _RESERVED or character.isspace() or not character.isprintable():
            return f"contains {character!r}"
    return ""


def shortened(text: str) -> str:
    """``text`` for an error message, which nobody should be able to fill."""
    return text if len(text) <= MOST_CHARACTERS else f"{text[:MOST_CHARACTERS]}..."


def stream_key(robot: str, stream: Stream, writer: str = "") -> str:
    """The key on which a writer puts ``stream``; ``tf_static`` has one per ``writer``, ``clock`` only one."""
    if stream == "clock":
        return CLOCK_KEY
    key = f"zstate/{check_robot(robot)}/{stream}"
    return f"{key}/{check_writer(writer)}" if stream == "tf_static" else key


def stream_expression(robot: str, stream: Stream) -> str:
    """The key expression that hears every writer of ``stream``; robot ``"*"`` means all robots."""
    if stream == "clock":
        return CLOCK_KEY
    key = f"zstate/{robot if robot == ANY else check_robot(robot)}/{stream}"
    return f"{key}/*" if stream == "tf_static" else key


def lookup_key(robot: str) -> str:
    """The key that answers lookups for devices without a buffer."""
    return f"zstate/{check_robot(robot)}/lookup"


def status_key(robot: str, identity: str) -> str:
    """The key on which one writer says how it does; ``identity`` is already one chunk."""
    return f"zstate/{check_robot(robot)}/status/{identity}"


def status_expression(robot: str) -> str:
    """The key expression of every status of ``robot``, or of every robot for ``"*"``."""
    return f"zstate/{robot if robot == ANY else check_robot(robot)}/status/*"


def parse_status_key(key: str) -> tuple[str, str]:
    """Robot and identity in a ``status_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    if len(chunks) == 4 and chunks[0] == "zstate" and chunks[2] == "status":
        return check_robot(chunks[1]), chunks[3]
    raise _other_form(key, "zstate/<robot>/status/<identity>")


def writer_key(robot: str, stream: Stream, identity: str) -> str:
    """The liveliness token of one writer; ``identity`` is already one chunk."""
    return f"zstate/{check_robot(robot)}/@writer/{stream}/{identity}"


def writer_expression(robot: str) -> str:
    """The key expression of all tokens of ``robot``, or of every robot for ``"*"``."""
    return f"zstate/{robot if robot == ANY else check_robot(robot)}/@writer/*/*"


def parse_writer_key(key: str) -> tuple[str, Stream, str]:
    """Robot, stream and identity in a ``writer_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    if len(chunks) == 5 and chunks[0] == "zstate" and chunks[2] == "@writer":
        for stream in get_args(Stream):
            if chunks[3] == stream:
                return check_robot(chunks[1]), stream, chunks[4]
    raise _other_form(key, "zstate/<robot>/@writer/<stream>/<identity>")


def reader_key(robot: str, stream: Stream, identity: str) -> str:
    """The liveliness token of one reader; robot ``"*"`` means all. Readers write below no robot's prefix."""
    return f"zstate/@reader/{quote(robot, safe='')}/{stream}/{identity}"


def parse_reader_key(key: str) -> tuple[str, Stream, str]:
    """Robot, stream and identity in a ``reader_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    if len(chunks) == 5 and chunks[:2] == ["zstate", "@reader"]:
        for stream in get_args(Stream):
            if chunks[3] == stream:
                robot = unquote(chunks[2])
                return robot if robot == ANY else check_robot(robot), stream, chunks[4]
    raise _other_form(key, "zstate/@reader/<robot>/<stream>/<identity>")


def clock_key(robot: str, identity: str) -> str:
    """The key on which one writer tells what time it is; ``identity`` is already one chunk."""
    return f"zstate/{check_robot(robot)}/@clock/{identity}"


def clock_expression(robot: str) -> str:
    """The key expression of the clocks of all writers of ``robot``, or of every robot for ``"*"``."""
    return f"zstate/{robot if robot == ANY else check_robot(robot)}/@clock/*"


def parse_clock_key(key: str) -> tuple[str, str]:
    """Robot and identity in a ``clock_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    if len(chunks) == 4 and chunks[0] == "zstate" and chunks[2] == "@clock":
        return check_robot(chunks[1]), chunks[3]
    raise _other_form(key, "zstate/<robot>/@clock/<identity>")


def edge_key(robot: str, edge: tuple[str, str], identity: str) -> str:
    """The token of one who is about to place ``edge``: parent and child, named in full."""
    parent, child = (quote(frame, safe="") for frame in edge)
    return f"zstate/{check_robot(robot)}/@edge/{child}/{parent}/{identity}"


def edge_expression(child: str) -> str:
    """The key expression of all who are about to place ``child``, for whichever robot."""
    return f"zstate/*/@edge/{quote(child, safe='')}/*/*"


def parse_edge_key(key: str) -> tuple[str, tuple[str, str], str]:
    """Robot, edge and identity in an ``edge_key``. Raises InvalidInput for any other key."""
    chunks = _chunks(key)
    if len(chunks) == 6 and chunks[0] == "zstate" and chunks[2] == "@edge":
        robot = check_robot(chunks[1])
        parent, child = unquote(chunks[4]), unquote(chunks[3])
        for frame in (parent, child):
            full_name(robot, frame)
        return robot, (parent, child), chunks[5]
    raise _other_form(key, "zstate/<robot>/@edge/<child>/<parent>/<identity>")


@lru_cache(4096)  # of each sample that comes
def robot_from_key(key: str) -> str:
    """The robot whose key this is.

    InvalidInput for a key that is not under ``zstate/<robot>/``, or has a wildcard: then it is several keys.
    """
    chunks = _chunks(key)
    if len(chunks) < 3 or chunks[0] != "zstate" or not chunks[1] or "*" in key:
        raise _other_form(key, "zstate/<robot>/...")
    return check_robot(chunks[1])


def _chunks(key: str) -> list[str]:
    return key.split("/") if len(key) <= _MOST_OF_A_KEY else []


def _other_form(key: str, form: str) -> InvalidInput:
    return InvalidInput(f"the key {shortened(key)!r} is not of the form {form!r}")


def full_name(robot: str, frame: str) -> str:
    """How a frame of ``robot`` is called among several robots: ``robot/frame``.

    A name that has a slash is a full name already. An empty one, one that begins or ends with a slash, one
    with control characters, and one of more than 1024 characters are InvalidInput.
    """
    if len(frame) > MOST_OF_A_FRAME:
        raise InvalidInput(
            f"the frame name {shortened(frame)!r} of robot {robot!r} has {len(frame)} characters, "
            f"more than {MOST_OF_A_FRAME}"
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
    """How a link of ``robot`` is named in its own messages: bare, unless a slash in it would mislead."""
    return f"{robot}/{link}" if "/" in link else link


EdgeNames = tuple[str, str]
"""Parent and child, named in full."""

FOREIGN = "foreign frame"
"""The reason of refusals of edges that place another robot's frames."""


def robot_in(frame: str) -> str:
    """The first part of a full name: the robot whose frame that is, if there is such a robot."""
    return frame.partition("/")[0]


def foreign_objection(
    robot: str, edge: EdgeNames, robots: Collection[str], placers: Collection[str] | None = None
) -> str:
    """Why a writer of ``robot`` may not publish ``edge`` at all; empty where it may.

    ``robots`` are those on the network. Of those that place other robots' roots only ``placers`` count,
    unless that is None.
    """
    parent, child = edge
    owner, other = robot_in(child), robot_in(parent)
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
