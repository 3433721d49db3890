"""Writer: who writes a stream, as others are told."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import quote, unquote

from zstate.errors import InvalidInput
from zstate.wire.keys import Stream


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
        return f"{self.program}@{self.host} pid {self.pid}" if self.host else self.program

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
    """What a liveliness token says: ``writer`` writes ``stream`` of ``robot``."""

    robot: str
    stream: Stream
    writer: Writer
