"""Who writes what: a liveliness token for every writer, which says who it is and vanishes with it."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args
from urllib.parse import quote, unquote

import zenoh

from zstate.closing import Closing
from zstate.errors import InvalidInput
from zstate.net.receiver import Receiver, Ring
from zstate.net.session import Session
from zstate.wire.keys import ANY, Stream, writer_expression, writer_key

CAPACITY = 4096
ROUND_S = 0.1


@dataclass(frozen=True, order=True, slots=True)
class Writer:
    """One writer: which program, where, since when [ns], and the ``session`` in its samples."""

    program: str
    host: str
    pid: int
    since: int
    session: int

    def __str__(self) -> str:
        return f"{self.program}@{self.host} pid {self.pid}"

    @classmethod
    def here(cls, session: int, program: str = "") -> Writer:
        """A writer in this process, starting now; ``program`` is the script's name unless given."""
        script = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] not in ("", "-c") else "python"
        return cls(program or script, socket.gethostname(), os.getpid(), time.time_ns(), session)

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


@dataclass(frozen=True, order=True, slots=True)
class RobotInfo:
    """A robot that somebody writes for: its writers as (stream, writer), sorted."""

    name: str
    writers: tuple[tuple[Stream, Writer], ...]


class Announcement(Closing):
    """The token of one writer, there until closed or until its process ends."""

    def __init__(self, session: Session, token: zenoh.LivelinessToken) -> None:
        self._session = session
        self._token = token

    def close(self) -> None:
        """Say that this writer is gone. A second call does nothing."""
        self._session.release(self._token)


def announce(session: Session, robot: str, stream: Stream, writer: Writer) -> Announcement:
    """Tell everybody that ``writer`` writes ``stream`` of ``robot``, until closed."""
    key = writer_key(robot, stream, writer.identity)
    return Announcement(session, session.zenoh.liveliness().declare_token(key))


def discover(session: Session, timeout_s: float = 1.0) -> tuple[RobotInfo, ...]:
    """Every robot that is announced, with its writers, sorted by name.

    A session that has just connected has not met everybody yet: asks until two answers in a row, a
    tenth of a second apart, name the same writers; for nobody at all it waits ``timeout_s`` [s].
    """
    if not timeout_s > 0.0:
        raise InvalidInput(f"timeout_s is {timeout_s}; give a positive number of seconds")
    deadline = time.monotonic() + timeout_s
    found: set[tuple[str, Stream, Writer]] = set()
    while (remaining_s := deadline - time.monotonic()) > 0.0:
        answer = _ask(session, remaining_s)
        if answer and answer == found:
            break
        found = answer
        time.sleep(min(ROUND_S, max(0.0, deadline - time.monotonic())))
    return _by_robot(found)


def _ask(session: Session, timeout_s: float) -> set[tuple[str, Stream, Writer]]:
    replies = session.zenoh.liveliness().get(writer_expression(ANY), timeout=timeout_s)
    samples = (reply.ok for reply in replies)
    tokens = (_parse_token(str(sample.key_expr)) for sample in samples if sample is not None)
    return {token for token in tokens if token is not None}


def _by_robot(found: set[tuple[str, Stream, Writer]]) -> tuple[RobotInfo, ...]:
    names = sorted({robot for robot, _, _ in found})
    return tuple(
        RobotInfo(name, tuple(sorted((stream, writer) for robot, stream, writer in found if robot == name)))
        for name in names
    )


class Watch(Closing):
    """Follows the writers of ``robot`` ("*": of all robots), those already there included.

    ``callback(robot, stream, writer, alive)`` is called from one thread. Losing the last router takes
    every writer behind it away as well. ``malformed`` counts tokens that nobody of ours made.
    """

    def __init__(
        self, session: Session, robot: str, callback: Callable[[str, Stream, Writer, bool], None]
    ) -> None:
        self.malformed = 0
        self._callback = callback
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        tokens = session.zenoh.liveliness().declare_subscriber(writer_expression(robot), ring, history=True)
        self._receiver = Receiver(session, tokens, self._hand_over, CAPACITY)

    def _hand_over(self, batch: list[zenoh.Sample]) -> None:
        for sample in batch:
            token = _parse_token(str(sample.key_expr))
            if token is None:
                self.malformed += 1
            else:
                self._callback(*token, sample.kind == zenoh.SampleKind.PUT)

    def close(self) -> None:
        """Stop within a second. A second call does nothing."""
        self._receiver.close()


def watch(session: Session, robot: str, callback: Callable[[str, Stream, Writer, bool], None]) -> Watch:
    """Call ``callback(robot, stream, writer, alive)`` for each writer there is, comes or goes."""
    return Watch(session, robot, callback)


def _parse_token(key: str) -> tuple[str, Stream, Writer] | None:
    """Robot, stream and writer of a token, or None if it is not one of ours."""
    _, robot, _, name, identity = key.split("/")
    for stream in get_args(Stream):
        if name == stream:
            try:
                return robot, stream, Writer.parse(identity)
            except InvalidInput:
                return None
    return None
