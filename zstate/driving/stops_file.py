"""The file with the stops of a robot, which a restarted host reads, and the lock of its one host."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate.driving.driver import StopMode
from zstate.errors import ConfigError, InvalidInput, SecondWriter
from zstate.net.presence import local_writer
from zstate.wire.identity import WriterId

_SET_IT = "set XDG_STATE_HOME to a folder that can be written"


StopId: TypeAlias = tuple[int, int]
"""The session and the number of a stop."""


@dataclass(frozen=True, slots=True)
class ActiveStop:
    """A stop that is not released: of ``who``, with the ``seq`` of that program's ``session``."""

    session: int
    seq: int
    how: StopMode
    reason: str
    who: str

    @property
    def id(self) -> StopId:
        """Its session and ``seq``, by which it is released."""
        return self.session, self.seq

    def __str__(self) -> str:
        return f"stopped by {self.who}" + (f": {self.reason}" if self.reason else "")


def stops_file(robot: str) -> Path:
    """The file with the stops of ``robot``: below $XDG_STATE_HOME, or ~/.local/state.

    Raises ConfigError if this user has no home folder.
    """
    folder = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    try:
        return Path(folder).expanduser() / "zstate" / "stops" / f"{robot}.json"
    except RuntimeError as error:
        raise ConfigError(f"{folder}: {error} {_SET_IT}", path="XDG_STATE_HOME") from None


def read_stops(path: Path) -> tuple[list[ActiveStop], dict[int, list[int]]]:
    """The stops in ``path``, and the numbers of the last released ones by session; empty without a file.

    Raises OSError, and ValueError if the file is damaged.
    """
    try:
        text = path.read_text()
    except FileNotFoundError:
        return [], {}
    try:
        document = json.loads(text)
        stops = [_stop(**fields) for fields in document["stops"]]
        released: dict[int, list[int]] = {}
        for session, seq in document["released"]:
            released.setdefault(_session(session), []).append(_count(seq))
    except (TypeError, KeyError, RecursionError) as error:
        raise ValueError(repr(error)) from None
    return stops, released


def write_stops(path: Path, stops: Sequence[ActiveStop], released: Mapping[int, Sequence[int]]) -> None:
    """Write what ``read_stops`` returns, so that also a loss of power leaves all of it. Raises OSError."""
    document = {
        "stops": [asdict(one) for one in stops],
        "released": [[session, seq] for session, seqs in released.items() for seq in seqs],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(f".{os.getpid()}")
    with draft.open("w") as file:
        json.dump(document, file)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def copy_aside(path: Path) -> Path:
    """Copy the damaged file ``path``, and return the name of the copy. Raises OSError.

    The file stays until another replaces it: without one, a host that is restarted now would know no stop.
    """
    kept = path.with_suffix(".damaged")
    kept.write_bytes(path.read_bytes())
    return kept


class HostLock(Closeable):
    """The lock of the one host of ``robot`` among the processes of this user, on all networks.

    It is a file in the folder of ``stops_file``, which names its process, and is free once that has ended.
    Raises SecondWriter if another host has it, and ConfigError if it cannot be written.
    """

    def __init__(self, robot: str) -> None:
        path = stops_file(robot).with_suffix(".lock")
        with ExitStack() as opening:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = opening.enter_context(path.open("a+"))
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._file.truncate(0)
                self._file.write(local_writer(0).identity)
                self._file.flush()
            except BlockingIOError:
                self._file.seek(0)
                raise _second_host(robot, path, self._file.read()) from None
            except OSError as error:
                text = f"the lock of the host of {robot!r} cannot be written: {error}; {_SET_IT}"
                raise ConfigError(text, path=str(path)) from None
            opening.pop_all()
        fork_safe(self)

    def close(self) -> None:
        """Let another host have it."""
        if not self._file.closed:
            fcntl.flock(self._file, fcntl.LOCK_UN)
            self._file.close()

    def _at_fork_reinit(self) -> None:
        # The lock stays with the parent, and must not outlive it in a child.
        self._file.close()


def _second_host(robot: str, path: Path, identity: str) -> SecondWriter:
    first = WriterId("another program", "", 0, 0, 0)
    with suppress(InvalidInput):  # it has the lock, and has not written its name yet
        first = WriterId.parse(identity)
    return SecondWriter(
        f"{str(first)!r} already hosts a driver of {robot!r} for this user, maybe on another network; stop "
        f"it, or give the second robot another name: they would share their stops (it has locked {path})",
        robot=robot,
        stream="driver",
        first=first,
    )


def _stop(*, session: object, seq: object, how: object, reason: object, who: object) -> ActiveStop:
    """The stop with these fields. Raises ValueError for those that ``write_stops`` does not write."""
    if how not in ("hold", "relax") or not isinstance(reason, str) or not isinstance(who, str):
        raise ValueError(f"how {how!r}, reason {reason!r} and who {who!r} are not those of a stop")
    return ActiveStop(_session(session), _count(seq), "hold" if how == "hold" else "relax", reason, who)


def _session(number: object) -> int:
    return _number(number, 64)


def _count(number: object) -> int:
    return _number(number, 63)


def _number(number: object, bits: int) -> int:
    if type(number) is not int or not 0 <= number < 2**bits:
        raise ValueError(f"{number!r} is not a number below 2^{bits}")
    return number
