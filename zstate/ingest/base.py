"""Base of the ingest of one robot's samples: the order in which live, early and old ones are inserted."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeAlias

from zstate._util.fork_safe import fork_safe
from zstate.buffer.tracks import JointTrack
from zstate.clock import SET_BACK_NS
from zstate.errors import InsertRefused, InvalidInput, MessageError, format_duration
from zstate.ingest.counters import SequenceNumbers
from zstate.ingest.early_samples import EarlySamples
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.writer_sessions import SessionDescriptions, WriterSessions
from zstate.wire.messages import Edges, RobotDescription, Sample

ClockSetBack: TypeAlias = Callable[[str, int, str], None]
"""Called with a robot, the session of its writer, and a description of what happened."""


class _IngestLock:
    """The lock of an ingest; the fast path is stopped before the state that it shares is used."""

    def __init__(self, stop_fast_path: Callable[[], None]) -> None:
        self._lock = fork_safe(threading.RLock())
        self._stop_fast_path = stop_fast_path

    def __enter__(self) -> None:
        self._lock.acquire()
        try:
            self._stop_fast_path()
        except BaseException:
            self._lock.release()
            raise

    def __exit__(self, *_: object) -> None:
        self._lock.release()


class StreamIngest(ABC):
    """Inserts one robot's samples into the buffer of ``ownership``. Any thread may call it.

    Only samples of the newest writer are inserted. If that writer's clock is set back, a new epoch begins,
    and ``on_set_back(robot, session, text)`` is called.

    ``insert_next`` inserts nearly all samples of a writer, by a ``FastPath`` of the buffer. ``insert_sample``
    handles all others, and gives the same result for any.
    """

    def __init__(
        self, robot: str, ownership: FrameOwnership, on_set_back: ClockSetBack | None = None
    ) -> None:
        self.robot = robot
        self.has_data = False
        """Whether any message of this robot has arrived."""
        self._ownership = ownership
        self._buffer = ownership.buffer
        self._feed = ownership.feed
        self._counters = ownership.counters.for_robot(robot)
        self._on_set_back = on_set_back
        self._sessions = WriterSessions(ownership.clock)
        self._descriptions = SessionDescriptions()
        self._numbers = SequenceNumbers()
        self._early = EarlySamples()
        # The newest stamp of the epoch, and the last sample that was too late for it.
        self._newest: int | None = None
        self._last_late: Sample | None = None
        self._has_joined_domain = False
        self._fast_order = b""
        self._fast_path = self._feed.fast_path(self._counters.fast_counts, ownership)
        self._is_dropped = False
        self._lock = _IngestLock(self._stop_fast_path)
        self._feed.name_robot(robot)

    @property
    def session(self) -> int | None:
        """The session whose samples are inserted now."""
        return self._sessions.current

    @property
    def writer(self) -> str | None:
        """The writer whose samples are inserted now, if it is announced."""
        sessions = self._sessions
        return None if sessions.current is None else sessions.names.get(sessions.current)

    def name_writer(self, session: int, writer: str) -> None:
        """Set the printed name of the writer of a session, as announced."""
        with self._lock:
            self._sessions.announce(session, writer)
            self._on_writer_changed()

    def writer_left(self, session: int) -> None:
        """Handle the end of a writer: a writer that it replaced may be accepted again."""
        with self._lock:
            if self._sessions.leave(session):
                self._has_joined_domain = False
                self._feed.domain.leave(self.robot)

    def drop(self) -> None:
        """Remove all samples and edges of this writer from the buffer. Later samples are refused.

        One thread may look up an ingest, and insert its sample after another thread has dropped the ingest.
        """
        with self._lock:
            self._is_dropped = True
            self._count_dropped()
            self._remove()

    def insert_next(self, message: bytes | None, earliest: int, latest: int) -> bool:
        """Insert the live sample encoded in ``message`` if it is the usual next one; else nothing is done.

        The usual next sample has the sequence number after the last, which ``insert_sample`` inserted or this
        method, a newer stamp from ``earliest`` to ``latest`` [ns], and the same other fields but for finite
        numbers. None is a sample that cannot be it.
        """
        waiters = self._fast_path.insert(message, earliest, latest)
        if waiters is None:
            return False
        for waiter in waiters:
            if waiter.is_met():
                waiter.wake()
        return True

    def insert_sample(self, sample: Sample, *, overflowed: bool, message: bytes | None = None) -> None:
        """Insert a live sample; ``overflowed`` if the receiver's ring lost samples before it.

        With the encoded ``message`` of the sample, ``insert_next`` expects the sample after it.
        """
        self.has_data = True
        with self._lock:
            if self._is_dropped:
                self._count_dropped()
                return
            if sample.session != self._sessions.current and not self._accept_session(sample):
                self._counters.count_refusal(
                    "second writer", f"{self.robot!r} has another, newer writer than {sample.session}"
                )
                return
            is_in_order, seq, numbers = True, sample.seq, self._numbers
            if seq == numbers.next:
                numbers.next = seq + 1
            else:
                # The network reorders only samples after a larger number.
                is_in_order = seq >= (numbers.next or 0) - 1
                if gap := numbers.skip_to(seq):
                    self._counters.count("dropped" if overflowed else "missed", gap)
            inserted = self._insert_counted(sample, is_in_order=is_in_order)
            if inserted is None:
                for _ in range(self._early.add(sample)):
                    self._refuse_undescribed()
            elif inserted and message is not None and seq + 1 == self._numbers.next:
                self._expect_next(sample, message)

    def _expect_next(self, sample: Sample, message: bytes) -> None:
        """Let ``insert_next`` insert the sample after this one, if it would be inserted unchanged."""
        version = self._ownership.version  # before the decision that depends on it
        place = self._fast_place(sample)
        if place is not None and self._has_joined_domain and self._newest_of(sample) == sample.stamp:
            self._fast_order = sample.order
            self._feed.expect_next(self._fast_path, place, message, version)

    def _stop_fast_path(self) -> None:
        """Take over the state that the fast path has advanced."""
        advanced = self._fast_path.stop()
        if advanced is not None:
            self._numbers.next, stamp = advanced
            self._set_newest(self._fast_order, stamp)

    def insert_history(self, samples: Sequence[Sample], *, are_missing: bool = False) -> bool:
        """Insert samples from the writer's cache, oldest first; True if still older ones are wanted.

        With ``are_missing`` all of them are inserted: of a thinned stream more are missing than are noted.
        Inserts only missing samples, counted as "recalled". They are inserted newest first: the known
        history grows backwards, so that it never has a gap that is about to be filled. Those that fill a gap
        between others are inserted together, because each insert there copies the history.
        """
        self.has_data = True
        if are_missing:
            with self._lock:
                self._numbers.missing.add(samples[0].seq, samples[-1].seq + 1)
        together = self._insert_past_counted(samples)
        for sample in reversed(samples[: len(samples) - together]):
            with self._lock:  # for each, so that live samples need not wait for all
                if self._is_dropped or not self._accept_session(sample):
                    return False
                if self._numbers.is_missing(sample.seq) and not self._insert_old(sample):
                    return False
                self._numbers.missing.stop_at(sample.seq)
        return bool(self._numbers.missing) or self._numbers.is_missing(samples[0].seq - 1)

    def _insert_past_counted(self, samples: Sequence[Sample]) -> int:
        """Insert the newest of ``samples`` together, as many as can be. Returns how many are handled."""
        with self._lock:
            if self._is_dropped or not self._accept_session(samples[-1]):
                return 0
            missing = [sample for sample in reversed(samples) if self._numbers.is_missing(sample.seq)]
            if len(missing) < 2:
                return 0
            try:
                count = self._insert_past(missing)
            except (InvalidInput, MessageError):
                return 0  # it is counted when the samples are inserted one by one
            if not count:
                return 0
            inserted = missing[:count]
            for sample in inserted:
                self._advance(sample)
            self._numbers.recall(inserted[0].seq)
            self._counters.count("recalled", count)
            self._numbers.missing.stop_at(inserted[-1].seq)
            return sum(sample.seq >= inserted[-1].seq for sample in samples)

    def _insert_past(self, samples: Sequence[Sample]) -> int:
        """Insert the first of ``samples``, newest first, with one copy of the history. Returns how many.

        Raises InvalidInput or MessageError if nothing was inserted.
        """
        return 0

    def _insert_old(self, sample: Sample) -> bool:
        """Insert a sample of the history; True if an older one would be inserted, too."""
        try:
            inserted = self._insert(sample)
        except (InvalidInput, MessageError) as error:
            self._count_refusal(error)
            return False
        if inserted is None:
            return self._early.add_old(sample)
        if inserted:
            self._advance(sample)
            self._numbers.recall(sample.seq)
        self._counters.count("recalled", int(inserted))
        return inserted

    def _insert_early(self) -> None:
        """Insert the samples that arrived before the robot's description."""
        largest = 0
        for sample in self._early.take_live():
            if self._insert_counted(sample, is_in_order=sample.seq >= largest) is None:
                self._refuse_undescribed()
            else:
                largest = max(largest, sample.seq)
        for sample in self._early.take_history():
            if not self._insert_old(sample):
                break

    def _refuse_undescribed(self) -> None:
        self._counters.count_refusal(
            "no description", f"{self.robot!r}: no robot_description fits its samples"
        )

    def _count_dropped(self) -> None:
        self._counters.count_refusal(
            "too many writers",
            f"{self.robot!r} has too many writers that are not announced; the oldest lost its edges",
        )

    def _insert_counted(self, sample: Sample, *, is_in_order: bool) -> bool | None:
        """Insert a sample and count it: False if it was not inserted, None without a description."""
        try:
            inserted = self._insert(sample)
            if inserted is None:
                return None
            newest, stamp = self._newest, sample.stamp
            if inserted and newest is not None and stamp >= newest:
                self._newest = stamp  # nearly always; saves the calls below
            elif (self._advance(sample) and is_in_order) or not inserted:
                inserted = self._restart_epoch(sample) or inserted
        except (InvalidInput, MessageError) as error:
            self._count_refusal(error)
            if isinstance(error, InsertRefused) and sample.session not in self._sessions.names:
                # Its token may be on the way; then its history has this sample again.
                self._numbers.missing.add(sample.seq, sample.seq + 1)
            return False
        self._counters.count("received" if inserted else "late")
        if not self._has_joined_domain and sample.session != self._sessions.departed:
            self._has_joined_domain = True
            self._feed.domain.join(self.robot)
        return inserted

    def _count_refusal(self, error: InvalidInput | MessageError) -> None:
        reason = error.reason if isinstance(error, InsertRefused | MessageError) else "bad numbers"
        self._counters.count_refusal(reason, f"{self.robot!r}: {error}")

    def _set_domain(self, description: RobotDescription) -> None:
        """Set the clock domain that stamps the samples of the writer of ``description``."""
        with self._lock:
            self._descriptions.add(description)
            self._update_domain()

    def _update_domain(self) -> bool:
        """Pass the clock domain of the current writer to the buffer; True if it replaces another one."""
        domain = self._descriptions.domain(self._sessions.current)
        before = self._feed.domain.domain_of(self.robot)
        return domain is not None and self._feed.set_domain(self.robot, domain) and bool(before)

    def _advance(self, sample: Sample) -> bool:
        """Update the newest stamp; True if the sample is so old that the clock may have been set back."""
        newest, stamp = self._newest, sample.stamp
        if newest is None or stamp >= newest:
            self._newest = stamp
            return False
        return stamp < newest - SET_BACK_NS

    def _restart_epoch(self, sample: Sample) -> bool:
        """Begin a new epoch with this sample if the clock was set back; True if it was inserted.

        A single old sample may have a wrong stamp or have been delayed; two consecutive ones show that the
        clock was set back.
        """
        if sample.seq <= self._numbers.newest_recalled:
            return False  # the history overtook this sample, which waited in a queue; the clock is right
        before, self._last_late = self._last_late, sample
        if before is None or sample.seq != before.seq + 1 or not before.stamp < sample.stamp:
            return False
        if not self._may_restart_epoch():
            return False
        newest = self._newest_of(sample)
        size = "" if newest is None else f" by {format_duration(newest - before.stamp)}"
        self._last_late = self._newest = None
        self._numbers.missing.stop_at(0)  # samples missing so far belong to the old epoch
        self._early.clear_history()
        self._drop_history()
        text = f"the clock of {self.robot!r} went back{size}: its history restarts; other robots keep theirs"
        self._counters.warn_once(f"{self.robot} back", text)
        if self._on_set_back is not None:
            self._on_set_back(self.robot, sample.session, text)
        inserted = bool(self._insert(sample))
        self._advance(sample)
        return inserted

    def _newest_of(self, sample: Sample) -> int | None:
        """The newest stamp before ``sample`` in its epoch, if known."""
        return self._newest

    def _set_newest(self, order: bytes, stamp: int) -> None:
        """Set the newest stamp of the samples with this ``order``."""
        self._newest = stamp

    def _accept_session(self, sample: Sample) -> bool:
        """Whether samples of this session are inserted: those of the newest writer to appear."""
        sessions, session = self._sessions, sample.session
        if session == sessions.current:
            return True
        if not sessions.accept(session, self._numbers.next):
            return False
        if sessions.current is not None:
            self._replace_session(sample)
        sessions.replace(session)
        self._early.clear()
        self._numbers = SequenceNumbers()
        self._last_late = self._newest = None
        if self._update_domain():
            self._drop_history()  # stamps of two clocks cannot be compared
        self._on_writer_changed()
        description = self._descriptions.of(session)
        if description is not None:  # that of a writer which it replaced may be in use
            self.describe(description)
        return True

    def _replace_session(self, sample: Sample) -> None:
        """Handle the first sample of another writer, which begins a new epoch."""
        self._drop_history()

    @abstractmethod
    def describe(self, description: RobotDescription) -> None:
        """Use the robot's description from now on."""

    @abstractmethod
    def _insert(self, sample: Sample) -> bool | None:
        """Decode and insert a sample: False if it is older than the history, None without a description.

        Raises InvalidInput or MessageError if the sample cannot be used.
        """

    @abstractmethod
    def _fast_place(self, sample: Sample) -> JointTrack | Edges | None:
        """The track or edges that the fast path inserts the next samples into; None if it cannot.

        It copies the numbers of a sample as a row. ``sample`` was inserted just now, and shows whether the
        writer's samples have such numbers.
        """

    @abstractmethod
    def _drop_history(self) -> None:
        """Drop all samples inserted so far; a new epoch begins."""

    def _remove(self) -> None:
        """Remove all samples and edges: no further ones come."""
        self._drop_history()

    def _may_restart_epoch(self) -> bool:
        """Whether dropping the history would drop no samples of other writers."""
        return True

    def _on_writer_changed(self) -> None:  # noqa: B027 - most keep no names of writers
        """Called when the current writer, or its name, has changed."""
