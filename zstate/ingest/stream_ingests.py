"""The ingests of all writers on one stream, and the bounds on those of writers that have no token.

The first samples of a writer may arrive before its token, and the last after the token has disappeared: with
the writer, with its link, or with the router, which takes the tokens of all robots along. So the ingests of
writers that have left are kept apart from those of writers that were never announced: a hostile writer can
make up any number of sessions. Both are bounded for each robot, because a writer can publish on the keys of
its own robot only, and in total, because without access control it can make up robots too.
"""

from __future__ import annotations

from typing import TypeAlias

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate.ingest.base import StreamIngest
from zstate.streams import StreamName
from zstate.wire.messages import Sample

MAX_STRANGERS = 256
"""Writers of one robot that were never announced. Beyond this number the oldest is dropped with its edges."""

MAX_DEPARTED = 1024
"""Writers of one robot that have left. Beyond this number the oldest is dropped with its edges."""

# An ingest takes 6 kB.
_MAX_ALL_STRANGERS = 4096
_MAX_ALL_DEPARTED = 16_384

_Key: TypeAlias = tuple[str, int]


class _BoundedKeys:
    """Keys of ingests, oldest first: at most ``of_robot`` of each robot, and ``of_all`` in total."""

    def __init__(self, of_robot: int, of_all: int) -> None:
        self._of_robot, self._of_all = of_robot, of_all
        self._keys: dict[_Key, None] = {}
        self._by_robot: dict[str, dict[_Key, None]] = {}

    def add(self, key: _Key) -> _Key | None:
        """Add a key as the newest. Returns the one that is removed for it, if any."""
        own = self._by_robot.setdefault(key[0], {})
        self._keys[key] = own[key] = None
        if len(own) <= self._of_robot and len(self._keys) <= self._of_all:
            return None
        oldest = next(iter(own if len(own) > self._of_robot else self._keys))
        self.discard(oldest)
        return oldest

    def discard(self, key: _Key) -> None:
        """Remove a key, if it is there."""
        if key in self._keys:
            del self._keys[key]
            own = self._by_robot[key[0]]
            del own[key]
            if not own:
                del self._by_robot[key[0]]


class StreamIngests:
    """The ingests of the writers of one stream, by robot and session; the session is 0 unless ``is_shared``.

    ``is_shared`` means that each writer publishes its own part of a robot, and has its own ingest.
    ``has_parts`` means that samples are joint states of some of the joints, or may be. Any thread may
    call it.
    """

    def __init__(self, stream: StreamName, *, is_shared: bool, has_parts: bool = False) -> None:
        self.stream: StreamName = stream
        self.is_shared = is_shared
        self.has_parts = has_parts
        self.capacity = 0
        """The capacity of the ring that the samples arrive in."""
        self.overflowed: set[StreamIngest] = set()
        """The ingests whose next gap is due to that ring."""
        self.newest_by_key: BoundedDict[str, StreamIngest] = BoundedDict()
        """The ingest of the last sample on each key, which may expect the next one."""
        self._ingests: dict[_Key, StreamIngest] = {}
        self._names: dict[_Key, str] = {}
        self._strangers = _BoundedKeys(MAX_STRANGERS, _MAX_ALL_STRANGERS)
        self._departed = _BoundedKeys(MAX_DEPARTED, _MAX_ALL_DEPARTED)
        # Taken before the lock of an ingest, never after it.
        self._lock = fork_safe_lock()

    def all(self, robot: str | None = None) -> list[StreamIngest]:
        """All ingests, or those of one robot; any thread may add others at the same time."""
        return [one for one in list(self._ingests.values()) if robot in (None, one.robot)]

    def find(self, robot: str, session: int) -> StreamIngest | None:
        """The ingest of a session, if there is one."""
        return self._ingests.get((robot, session if self.is_shared else 0))

    def start_batch(self, count: int) -> bool:
        """Begin with ``count`` samples of the ring. Returns whether they filled it."""
        is_full = count >= self.capacity
        if is_full:
            # It has lost samples of any of the writers, and loses more while it is drained.
            self.overflowed = set(self.all())
        return is_full

    def insert(
        self, ingest: StreamIngest, sample: Sample, key: str, *, is_full: bool, message: bytes | None
    ) -> None:
        """Insert a sample received on ``key``, in a batch that filled the ring if ``is_full``.

        With its encoded ``message``, the ingest may expect the next one on that key.
        """
        overflowed = is_full or ingest in self.overflowed
        ingest.insert_sample(sample, overflowed=overflowed, message=message)
        self.overflowed.discard(ingest)
        if message is not None and self.newest_by_key.get(key) is not ingest:
            self.newest_by_key[key] = ingest

    def add(self, ingest: StreamIngest, session: int) -> StreamIngest:
        """Add the ingest of a session. Returns the one to use: another thread may have added one before."""
        key = ingest.robot, session if self.is_shared else 0
        with self._lock:
            known = self._ingests.setdefault(key, ingest)
            if known is ingest and self.is_shared:
                name = self._names.get(key)
                if name is not None:
                    ingest.name_writer(session, name)
                else:
                    self._drop(self._strangers.add(key))
            return known

    def announce(self, robot: str, session: int, writer: str) -> None:
        """Keep the ingest of a writer, which is announced under the printed name ``writer``."""
        if self.is_shared:
            key = robot, session
            with self._lock:
                self._names[key] = writer
                self._strangers.discard(key)
                self._departed.discard(key)
                ingest = self._ingests.get(key)
                if ingest is not None:
                    ingest.name_writer(session, writer)

    def writer_left(self, robot: str, session: int) -> None:
        """Handle the end of a writer, whose last samples may arrive later, and which may come back."""
        key = robot, session if self.is_shared else 0
        with self._lock:
            self._names.pop(key, None)
            ingest = self._ingests.get(key)
            if ingest is not None:
                ingest.writer_left(session)
                if self.is_shared:
                    self._strangers.discard(key)
                    self._drop(self._departed.add(key))

    def _drop(self, key: _Key | None) -> None:
        if key is not None:
            self._ingests.pop(key).drop()
