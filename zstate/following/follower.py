"""Follower: one robot's samples on their way into a buffer."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TypeAlias

from zstate.clock import SET_BACK_NS
from zstate.errors import InsertRefused, InvalidInput, MessageError, duration_text
from zstate.following.absent import Absent
from zstate.following.bounded import remember
from zstate.following.ownership import FrameOwnership
from zstate.locks import outlive_fork
from zstate.wire.messages import RobotDescription, Sample
from zstate.wire.sizes import Waiting, size_of

# So many samples are kept that arrive before the robot is described, which takes milliseconds.
_EARLY = 1024
_EARLY_PAST = 20_000
_EARLY_PAST_BYTES = 16 * 2**20

SetBack: TypeAlias = Callable[[str, int, str], None]
"""Called with a robot, the session of its writer, and what happened in words."""


class Follower(ABC):
    """One robot's samples on their way into a buffer, whatever they are made of.

    Where the clock of its writer was set back, ``on_set_back(robot, session, text)`` is called.
    """

    def __init__(self, robot: str, ownership: FrameOwnership, on_set_back: SetBack | None = None) -> None:
        self.robot = robot
        self.heard = False
        self._ownership = ownership
        self._buffer = ownership.buffer
        self._tally = ownership.tally.of(robot)
        self._on_set_back = on_set_back
        self._writers: dict[int, str] = {}
        self._session: int | None = None
        self._ended_sessions: dict[int, None] = {}
        self._next_seq: int | None = None
        self._last_late: Sample | None = None
        self._early: Waiting[Sample] = Waiting(_EARLY)
        self._past: list[Sample] = []
        self._past_bytes = 0
        self._absent = Absent()
        # By session, which clock its description names; and the last one named.
        self._domains: dict[int, str] = {}
        self._domain: str | None = None
        self._is_counted = False
        self._left: int | None = None
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
            if session == self._left:
                self._left = None
            self._writer_changed()

    def writer_left(self, session: int) -> None:
        """The writer behind a session is gone: one that had to give way to it may be followed again."""
        with self._lock:
            if session == self._session:
                self._ended_sessions.clear()
                self._left = session
                self._is_counted = False
                self._buffer.domain.leave(self.robot)

    def take(self, sample: Sample, *, overflowed: bool) -> None:
        """Put a sample into the buffer; ``overflowed`` says that our ring lost some before it."""
        self.heard = True
        with self._lock:
            if sample.session != self._session and not self._follow_session(sample):
                self._tally.refuse(
                    "second writer", f"{self.robot!r} has another, newer writer than {sample.session}"
                )
                return
            is_in_turn = True
            if sample.seq == self._next_seq:
                self._next_seq = sample.seq + 1
            else:
                # The network reorders only what comes after a larger number. The samples of one message of
                # ROS have the same number.
                is_in_turn = sample.seq >= (self._next_seq or 0) - 1
                self._count_gap(sample.seq, overflowed)
            if self._can_read(sample):
                self._insert_counted(sample, is_in_turn=is_in_turn)
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
                if not self._follow_session(sample):
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
            self._past_bytes += size_of(sample)
            return len(self._past) < _EARLY_PAST and self._past_bytes < _EARLY_PAST_BYTES
        try:
            taken = self._insert(sample)
        except (InvalidInput, MessageError) as error:
            self._refuse(error)
            return False
        if taken:
            self._reach(sample)
        self._tally.count("recalled", int(taken))
        return taken

    def _keep_early(self, sample: Sample) -> None:
        for _ in range(self._early.append(sample, size_of(sample))):
            self._refuse_undescribed()

    def _insert_early(self) -> None:
        """The samples that came before the robot was described."""
        early, self._early = self._early, Waiting(_EARLY)
        largest = 0
        for sample in early:
            if self._can_read(sample):
                self._insert_counted(sample, is_in_turn=sample.seq >= largest)
                largest = max(largest, sample.seq)
            else:
                self._refuse_undescribed()
        past, self._past = self._past, []
        self._past_bytes = 0
        for sample in past:
            if not (self._can_read(sample) and self._recall(sample)):
                break

    def _refuse_undescribed(self) -> None:
        self._tally.refuse("no description", f"{self.robot!r}: no robot_description fits its samples")

    def _insert_counted(self, sample: Sample, *, is_in_turn: bool) -> None:
        try:
            taken = self._insert(sample)
            newest, stamp = self._newest, sample.stamp
            if taken and newest is not None and stamp >= newest:
                self._newest = stamp  # as nearly always, without the calls below
            elif (self._reach(sample) and is_in_turn) or not taken:
                taken = self._begin_again(sample) or taken
        except (InvalidInput, MessageError) as error:
            self._refuse(error)
        else:
            self._tally.count("received" if taken else "late")
            if not self._is_counted and sample.session != self._left:
                self._is_counted = True
                self._buffer.domain.join(self.robot)

    def _refuse(self, error: InvalidInput | MessageError) -> None:
        reason = error.reason if isinstance(error, InsertRefused | MessageError) else "bad numbers"
        self._tally.refuse(reason, f"{self.robot!r}: {error}")

    def _learn_domain(self, description: RobotDescription) -> None:
        """Learn which clock stamps the samples of the writer that sent ``description``."""
        with self._lock:
            self._domain = description.clock
            remember(self._domains, description.session, description.clock)
            self._set_domain()

    def _set_domain(self) -> bool:
        """Set the clock domain of the followed writer; whether that is another one than before."""
        # A robot may be described by another program than the one whose samples are followed.
        domain = self._domain if self._session is None else self._domains.get(self._session, self._domain)
        before = self._buffer.domain.domain_of(self.robot)
        return domain is not None and self._buffer.set_domain(self.robot, domain) and bool(before)

    def _reach(self, sample: Sample) -> bool:
        """Note how far samples reach; whether this one is from before the writer's clock was set back."""
        newest, stamp = self._newest, sample.stamp
        if newest is None or stamp >= newest:
            self._newest = stamp
            return False
        return stamp < newest - SET_BACK_NS

    def _begin_again(self, sample: Sample) -> bool:
        """A new epoch with this sample, if it shows that the writer's clock was set back.

        One sample from before may have a wrong stamp, or may have been held up; two that follow each other
        were not.
        """
        before, self._last_late = self._last_late, sample
        if before is None or sample.seq != before.seq + 1 or not before.stamp < sample.stamp:
            return False
        if not self._may_begin_again():
            return False
        reached = self._reached(sample)
        size = "" if reached is None else f" by {duration_text(reached - before.stamp)}"
        self._last_late = self._newest = None
        self._absent.stop_at(0)  # what was missed before belongs to the old epoch
        self._past.clear()
        self._past_bytes = 0
        self._restart()
        text = f"the clock of {self.robot!r} went back{size}: its history begins anew, that of others stays"
        self._tally.note(f"{self.robot} back", text)
        if self._on_set_back is not None:
            self._on_set_back(self.robot, sample.session, text)
        taken = self._insert(sample)
        self._reach(sample)
        return taken

    def _reached(self, sample: Sample) -> int | None:
        """The newest stamp of the epoch that ``sample`` ends, where that is known."""
        return self._newest

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
            self._past_bytes = 0
            self._absent = Absent()
            self._next_seq = None
            self._last_late = self._newest = None
            if self._set_domain():
                self._restart()  # stamps of two clocks do not make one history
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
