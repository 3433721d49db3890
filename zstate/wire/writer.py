"""Writer: who writes a stream, as others are told."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput, printable
from zstate.wire.keys import Stream, check_writer


@dataclass(frozen=True, order=True, slots=True)
class Writer:
    """One writer: which program, where, since when [ns], and the ``session`` in its samples.

    A wire that does not tell where or since when leaves ``host`` empty, ``pid`` and ``since`` zero.
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
        """All of it in one chunk of a key."""
        fields = (self.program, self.host, self.pid, self.since, self.session)
        return ",".join(quote(str(field), safe="") for field in fields)

    @classmethod
    def parse(cls, identity: str) -> Writer:
        """The writer whose ``identity`` this is. Raises InvalidInput for anything else."""
        fields = identity.split(",")
        if len(fields) != 5 or not all(field.isascii() and field.isdigit() for field in fields[2:]):
            raise InvalidInput(f"{identity!r} is not 'program,host,pid,since,session'")
        program, host = unquote(fields[0]), unquote(fields[1])
        return cls(program, host, int(fields[2]), int(fields[3]), int(fields[4]))


@dataclass(frozen=True, slots=True)
class Announced:
    """What a liveliness token says: ``writer`` writes ``stream`` of ``robot``.

    ``name`` is the one under which it writes static edges; empty for other streams, and where the wire
    does not tell.
    """

    robot: str
    stream: Stream
    writer: Writer
    name: str = ""

    @property
    def identity(self) -> str:
        """Writer and name in one chunk of a key."""
        named = f",{quote(self.name, safe='')}" if self.name else ""
        return self.writer.identity + named

    @classmethod
    def parse(cls, robot: str, stream: Stream, identity: str) -> Announced:
        """What a token with this ``identity`` says. Raises InvalidInput for anything else."""
        fields = identity.split(",")
        named = len(fields) == 6 and stream == "tf_static"
        name = check_writer(unquote(fields.pop())) if named else ""
        return cls(robot, stream, Writer.parse(",".join(fields)), name)

    def excludes(self, other: Announced) -> bool:
        """Whether only one of the two writers can be meant: both say the same, and neither knows the other.

        Several writers of static edges have a name each; whose name is not known may be any.
        """
        same = (self.robot, self.stream, self.name) == (other.robot, other.stream, other.name)
        is_one = self.stream != "tf_static" or bool(self.name)
        return same and is_one and self.writer.session != other.writer.session
