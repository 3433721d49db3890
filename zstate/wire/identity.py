"""Writer identity, and the content of a writer's liveliness token."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput, printable
from zstate.stream_registry import is_named
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.keys import MAX_NAME_LENGTH, check_writer, shortened

_MAX_DIGITS = 20
_MAX_IDENTITY_LENGTH = 4 * 12 * MAX_NAME_LENGTH


@dataclass(frozen=True, order=True, slots=True)
class WriterId:
    """One writer: its program, host, process, start time ``since`` [ns], and the ``session`` of its samples.

    On wires without them ``host`` is empty, and ``pid`` and ``since`` are zero.
    ``pid`` and ``since`` are below 2^63, ``session`` is below 2^64.
    """

    program: str
    host: str
    pid: int
    since: int
    session: int

    def __str__(self) -> str:
        program, host = printable(self.program), printable(self.host)
        return f"{program}@{host} pid {self.pid}" if host else program

    @property
    def identity(self) -> str:
        """All fields in one chunk of a key."""
        fields = (self.program, self.host, self.pid, self.since, self.session)
        return ",".join(_quoted(str(field)) for field in fields)

    @classmethod
    def parse(cls, identity: str) -> WriterId:
        """The writer with this ``identity``. Raises InvalidInput if it is not one."""
        fields = identity.split(",") if len(identity) <= _MAX_IDENTITY_LENGTH else []
        if len(fields) == 5 and all(
            text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS for text in fields[2:]
        ):
            program, host = unquote(fields[0]), unquote(fields[1])
            pid, since, session = map(int, fields[2:])
            found = cls(program, host, pid, since, session)
            in_range = max(pid, since) < 2**63 and session < 2**64
            # One canonical form: two tokens of one writer would count as two writers.
            if in_range and max(len(program), len(host)) <= MAX_NAME_LENGTH and found.identity == identity:
                return found
        raise InvalidInput(
            f"{shortened(identity)!r} is not 'program,host,pid,since,session', names of at most "
            f"{MAX_NAME_LENGTH} characters and 64-bit numbers"
        )


@dataclass(frozen=True, slots=True)
class Announcement:
    """The content of a liveliness token: ``writer`` writes ``stream`` of ``robot``.

    ``name`` is the name under which it writes, on a named stream; empty for others, and on
    wires without such names. ``node`` is the same for all streams of one ROS node, whose name other nodes may
    have, too; empty where nodes are not announced.
    """

    robot: str
    stream: StreamName
    writer: WriterId
    name: str = ""
    node: str = ""

    @property
    def identity(self) -> str:
        """Writer and name in one chunk of a key."""
        return self.writer.identity + (f",{_quoted(self.name)}" if self.name else "")

    @classmethod
    def parse(cls, robot: str, stream: StreamName, identity: str) -> Announcement:
        """The content of a token with this ``identity``. Raises InvalidInput if it is not one."""
        fields = identity.split(",", 6)
        has_name = len(fields) == 6 and is_named(stream)
        name = check_writer(unquote(fields.pop())) if has_name else ""
        found = cls(robot, stream, WriterId.parse(",".join(fields)), name)
        if found.identity != identity:
            raise InvalidInput(f"{shortened(identity)!r} is not the identity of a writer and a name")
        return found

    @classmethod
    def parse_all(cls, robot: str, streams: Sequence[StreamName], identity: str) -> tuple[Announcement, ...]:
        """The contents of one token for several ``streams``, of which the named ones have one name.

        Raises InvalidInput as ``parse`` does.
        """
        first = cls.parse(robot, max(streams, key=is_named), identity)
        return tuple(
            cls(robot, stream, first.writer, first.name if is_named(stream) else "") for stream in streams
        )

    def conflicts_with(self, other: Announcement) -> bool:
        """Whether the two are different writers of the same stream, of which only one may be active.

        Writers of a named stream conflict if their names are equal; without a name they never do. A writer of
        all joints conflicts with each writer of some of them.
        """
        if self.robot == other.robot and frozenset((self.stream, other.stream)) == JOINT_STREAMS:
            return self.writer.session != other.writer.session
        same = (self.robot, self.stream, self.name) == (other.robot, other.stream, other.name)
        is_exclusive = not is_named(self.stream) or bool(self.name)
        return same and is_exclusive and self.writer.session != other.writer.session


def _quoted(text: str) -> str:
    # A script name may have bytes that are not text.
    return quote(text, safe="", errors="replace")
