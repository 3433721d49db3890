"""Joint states out of a recording."""

from __future__ import annotations

from pathlib import Path

from zstate._util.refusals import Refusals
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.model.robot import RobotModel
from zstate.record.reader import RecordReader
from zstate.record.transcript import Said, Transcript
from zstate.sources.source import JointReading
from zstate.sources.states import StateReader
from zstate.wire.joint_order import JointNumbers
from zstate.wire.messages import JointState

# Stamps that go so far back are those of a clock that began anew; a late sample is passed over.
_LATE_NS = 10_000_000_000


class RecordedSource(Closing):
    """The recorded motion of ``robot``, moved to the present: it begins with the first ``read``.

    ``robot`` may be left out where only one has joint states in the file. ``read`` gives the newest
    reading that is due, stamped as long after the beginning as it was recorded; ``ended`` says that
    there is no more. Where a writer began anew with other stamps, its motion follows as it was heard.
    States that cannot be used are counted in ``refused``, by reason; the first of each is logged.

    Raises RecordingError, and InvalidInput when there are no joint states of ``robot``.
    """

    def __init__(self, path: str | Path, robot: str | None, model: RobotModel) -> None:
        self._refusals = Refusals("recorded joint_states")
        self.refused = self._refusals.counts
        self._states = StateReader(model)
        self._reader = RecordReader(path)
        try:
            transcript = Transcript(self._reader, self._refusals.count)
            self.robot = _told(transcript, robot)
        except BaseException:
            self.close()
            raise
        first, last = transcript.span or (0, 0)
        self.duration_s = (last - first) / 1e9
        """How long the recording is [s]: by then everything is due."""
        self._said = transcript.said((self.robot,), ("joint_states",))
        self._moved: _Moved | None = None
        self._next = self._advance(None)

    @property
    def ended(self) -> bool:
        """Whether everything has been read."""
        return self._next is None

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading that is due at ``stamp`` [ns]; None when none has become due."""
        newest: JointReading | None = None
        while self._next is not None:
            said, numbers = self._next
            self._moved = self._moved or _Moved(said, stamp)
            due = self._moved.stamp_of(said)
            if due > stamp:
                break
            newest = JointReading(*numbers, stamp=due)
            self._next = self._advance(self._moved)
        return newest

    def _advance(self, moved: _Moved | None) -> tuple[Said, JointNumbers] | None:
        for said in self._said:
            assert isinstance(said.message, JointState)
            if moved is not None and moved.is_late(said):
                continue
            try:
                numbers = self._states.read(said.message)
            except MessageError as error:
                self._refusals.count(error.reason, error)
            except InvalidInput as error:
                self._refusals.count("bad numbers", error)
            else:
                return said, numbers
        return None

    def close(self) -> None:
        """Let go of the file. A second call does nothing."""
        self._reader.close()


class _Moved:
    """Recorded stamps, as far from now as they were from the first."""

    def __init__(self, first: Said, now: int) -> None:
        self._session: int = first.speaker.session
        self._newest = _stamp(first)
        self._heard = first.log_time
        self._offset = now - self._newest

    def is_late(self, said: Said) -> bool:
        """Whether the robot has been further by then."""
        back = self._newest - _stamp(said)
        return said.speaker.session == self._session and 0 <= back <= _LATE_NS

    def stamp_of(self, said: Said) -> int:
        """When it is due; asked in the order of the recording."""
        stamp, session = _stamp(said), said.speaker.session
        if stamp < self._newest - _LATE_NS or (session != self._session and stamp <= self._newest):
            before = self._newest + self._offset
            self._offset = before + max(0, said.log_time - self._heard) - stamp
        self._session, self._newest, self._heard = session, stamp, said.log_time
        return stamp + self._offset


def _stamp(said: Said) -> int:
    assert isinstance(said.message, JointState)
    return said.message.stamp


def _told(transcript: Transcript, robot: str | None) -> str:
    robots = sorted({s.robot for s in transcript.speakers if s.stream == "joint_states"})
    if robot in robots:
        return robot
    if robot is None and len(robots) == 1:
        return robots[0]
    there = ", ".join(map(repr, robots)) or "none"
    what = f"joint_states of {robot!r}" if robot else "the joint_states of one robot"
    raise InvalidInput(f"the recording does not hold {what}; it has those of {there}")
