"""Follower: one robot's samples on their way into a buffer."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence

from zstate.clock import SYSTEM
from zstate.errors import InsertRefused, InvalidInput, MessageError, duration_text
from zstate.following.absent import Absent
from zstate.following.bounded import remember
from zstate.following.ownership import FrameOwnership
from zstate.locks import outlive_fork
from zstate.wire.messages import RobotDescription, Sample

# So many samples are kept that arrive before the robot is described, which takes milliseconds.
_EARLY = 1024
_EARLY_PAST = 20_000

# Simulated time that goes back by more was set back: nothing on the way holds a sample up by that much.
_SET_BACK_NS = 100_000_000


class Follower(ABC):
    """One robot's samples on their way into a buffer, whatever they are made of."""

    def __init__(self, robot: str, ownership: FrameOwnership) -> None:
        self.robot = robot
        self.heard = False
        self._ownership = ownership
        self._buffer = ownership.buffer
        self._tally = ownership.tally
        self._writers: dict[int, str] = {}
        self._session: int | None = None
        self._ended_sessions: dict[int, None] = {}
        self._next_seq: int | None = None
        self._last_late: Sample | None = None
        self._early: deque[Sample] = deque(maxlen=_EARLY)
        self._past: list[Sample] = []
        self._absent = Absent()
        self._objection = ""
        self._is_simulated = False
        self._newest: int | None = None
        self._lock = outlive_fork(threading.RLock())
        self._buffer.name_robot(robot)

    @property
    def writer(self) -> str | None:
        """Who writes the samples that are taken now, if that was announced."""
        return None if self._session is None else self._writers.get(self._session)

    def note_heard(self) -> None:
        """Something of this robot has arrived."""
        self.heard = True

    def name_writer(self, session: int, writer: str) -> None:
        """The writer behind a session, as announced."""
        with self._lock:
            remember(self._writers, session, writer)
            self._writer_changed()

    def writer_left(self, session: int) -> None:
        """The writer behind a session is gone: one that had to give way to it may be followed again."""
        with self._lock:
            if session == self._session:
                self._ended_sessions.clear()

    def take(self, sample: Sample, *, overflowed: bool) -> None:
        """Put a sample into the buffer; ``overflowed`` says that our ring lost some before it."""
        self.heard = True
        with self._lock:
            if self._objection:
                self._tally.refuse("clock domain", self._objection)
                return
            if sample.session != self._session and not self._follow_session(sample):
                self._tally.refuse(
                    "second writer", f"{self.robot!r} has another, newer writer than {sample.session}"
                )
                return
            if sample.seq == self._next_seq:
                self._next_seq = sample.seq + 1
            else:
                self._count_gap(sample.seq, overflowed)
            if self._can_read(sample):
                self._insert_counted(sample)
            else:
                self._keep_early(sample)

    def take_past(self, samples: Sequence[Sample]) -> bool:
        """Put what its writer said before into the buffer: some of its samples, oldest first.

        Only what is missing is taken, and it counts for nothing else. What is known grows backwards from
        the newest, so that who joins never has a gap that is about to be filled. Says whether still older
        ones are wanted.
        """
        self.heard = True
        for sample in reversed(samples):
            with self._lock:  # one by one: what is live need not wait for all of it
                if self._objection or not self._follow_session(sample):
                    return False
                if self._lacks(sample.seq) and not self._recall(sample):
                    return False
                self._absent.stop_at(sample.seq)
        return bool(self._absent) or self._lacks(samples[0].seq - 1)

    def _lacks(self, seq: int) -> bool:
        # After a cut the past may come before the first live sample, which shows the gap.
        return seq in self._absent or (self._next_seq is not None and seq >= self._next_seq)

    def _recall(self, sample: Sample) -> bool:
        """Whether an older one would be taken, too."""
        if not self._can_read(sample):
            self._past.append(sample)
            return len(self._past) < _EARLY_PAST
        try:
            taken = self._insert(sample)
        except (InvalidInput, MessageError) as error:
            self._refuse(error)
            return False
        self._tally.count("recalled", int(taken))
        return taken

    def _keep_early(self, sample: Sample) -> None:
        if len(self._early) == _EARLY:
            self._refuse_undescribed()
        self._early.append(sample)

    def _insert_early(self) -> None:
        """The samples that came before the robot was described."""
        early, self._early = self._early, deque(maxlen=_EARLY)
        for sample in early:
            if self._can_read(sample):
                self._insert_counted(sample)
            else:
                self._refuse_undescribed()
        past, self._past = self._past, []
        for sample in past:
            if not (self._can_read(sample) and self._recall(sample)):
                break

    def _refuse_undescribed(self) -> None:
        self._tally.refuse("no description", f"{self.robot!r}: no robot_description fits its samples")

    def _insert_counted(self, sample: Sample) -> None:
        try:
            if self._is_simulated and self._went_back(sample.stamp):
                taken = self._begin_again(sample) or self._insert(sample)
            else:
                taken = self._insert(sample) or self._begin_again(sample)
        except (InvalidInput, MessageError) as error:
            self._refuse(error)
        else:
            self._tally.count("received" if taken else "late")

    def _refuse(self, error: InvalidInput | MessageError) -> None:
        reason = error.reason if isinstance(error, InsertRefused | MessageError) else "bad numbers"
        self._tally.refuse(reason, f"{self.robot!r}: {error}")

    def _keeps_our_time(self, description: RobotDescription) -> bool:
        """Whether stamps of this robot may stand beside those of the others in the buffer."""
        domain = self._buffer.domain
        objection = domain.objection(self.robot, description.clock)
        with self._lock:
            if objection and not self._objection:
                self._restart()  # what came before its description was of that time, too
                self._early.clear()
            self._objection = objection
            self._is_simulated = (description.clock or domain.name or SYSTEM) != SYSTEM
        if objection:
            self._tally.refuse("clock domain", objection)
        return not objection

    def _went_back(self, stamp: int) -> bool:
        """Whether simulated time was set back: long before a sample would be too old for the history."""
        newest = stamp if self._newest is None else self._newest
        self._newest = max(stamp, newest)
        return stamp < newest - _SET_BACK_NS

    def _begin_again(self, sample: Sample) -> bool:
        """A new epoch with this sample, if it shows that the writer's clock was set back.

        One sample that is older than the history may have been held up; two that follow each other were not.
        """
        before, self._last_late = self._last_late, sample
        if before is None or sample.seq != before.seq + 1 or not before.stamp < sample.stamp:
            return False
        if not self._may_begin_again():
            return False
        size = self._step_back(before.stamp)
        self._last_late, self._newest = None, sample.stamp
        self._restart()
        self._tally.note(
            f"{self.robot} back",
            f"the clock of {self.robot!r} went back{size}: its history begins anew, that of others stays",
        )
        return self._insert(sample)

    def _step_back(self, stamp: int) -> str:
        """By how much ``stamp`` is before what is kept of the robot; empty where nothing is."""
        frames = self._buffer.frames()
        own = (frame.newest for frame in frames if frame.name.startswith(f"{self.robot}/"))
        newest = max((one for one in own if one is not None), default=None)
        return "" if newest is None else f" by {duration_text(newest - stamp)}"

    def _follow_session(self, sample: Sample) -> bool:
        """Whether samples of this session count: those of the newest writer to appear."""
        session = sample.session
        if session in self._ended_sessions:
            return False
        if session != self._session:
            if self._session is not None:
                remember(self._ended_sessions, self._session, None)
                self._early.clear()
                self._succeed(sample)
            self._session = session
            self._past.clear()
            self._absent = Absent()
            self._next_seq = None
            self._last_late = self._newest = None
            self._writer_changed()
        return True

    def _succeed(self, sample: Sample) -> None:
        """The first sample of another writer: what the old one said is another epoch."""
        self._restart()

    def _count_gap(self, seq: int, overflowed: bool) -> None:
        if self._next_seq is None:
            self._absent.stop_at(seq)
        elif seq > self._next_seq:
            self._absent.add(self._next_seq, seq)
            self._tally.count("dropped" if overflowed else "missed", seq - self._next_seq)
        self._next_seq = max(seq + 1, self._next_seq or 0)

    @abstractmethod
    def describe(self, description: RobotDescription) -> None:
        """Learn what the robot is."""

    @abstractmethod
    def _can_read(self, sample: Sample) -> bool:
        """Whether enough is known of the robot to use a sample."""

    @abstractmethod
    def _insert(self, sample: Sample) -> bool: ...

    @abstractmethod
    def _restart(self) -> None:
        """A new epoch: forget what was said in the old one."""

    @abstractmethod
    def _may_begin_again(self) -> bool:
        """Whether nobody else writes what this follower would forget."""

    @abstractmethod
    def _writer_changed(self) -> None:
        """The name of the writer is known, or another one."""
