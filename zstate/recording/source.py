"""Joint states of a recording, replayed at the present time."""

from __future__ import annotations

from pathlib import Path

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput, MessageError
from zstate.model.robot import RobotModel
from zstate.recording.decode import DecodedMessage, DecodedRecording, robot_with_joint_states
from zstate.recording.reader import RecordingReader
from zstate.sources.joint_source import JointReading, JointStateValidator
from zstate.wire.joint_order import JointNumbers
from zstate.wire.messages import JointState

# Stamps that step back further belong to a restarted clock; a late sample is skipped.
_LATE_NS = 10_000_000_000


class RecordedSource(Closeable):
    """The recorded motion of ``robot``, shifted to the present: it starts with the first ``read``.

    ``robot`` may be None if the file has joint states of one robot only. ``read`` returns the newest reading
    that is due, stamped as long after the start as it was recorded; ``ended`` is True after the last one. If
    a writer restarted with other stamps, its motion follows at its log times. Unusable states are counted in
    ``refused``, by reason; the first of each is logged.

    Raises RecordingError, and InvalidInput without joint states of ``robot``.
    """

    def __init__(self, path: str | Path, robot: str | None, model: RobotModel) -> None:
        self._refusals = Refusals("recorded joint_states")
        self.refused = self._refusals.counts
        self._states = JointStateValidator(model)
        self._reader = RecordingReader(path)
        try:
            recording = DecodedRecording(self._reader, self._refusals.count)
            self.robot = robot_with_joint_states(recording, robot)
        except BaseException:
            self.close()
            raise
        first, last = self._reader.span or (0, 0)
        self.duration_s = (last - first) / 1e9
        """Length of the recording [s]: by then everything is due."""
        self._messages = recording.messages((self.robot,), ("joint_states",))
        self._shift: _StampShift | None = None
        self._next = self._advance(None)

    @property
    def ended(self) -> bool:
        """Whether everything has been read."""
        return self._next is None

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading that is due at ``stamp`` [ns]; None if no new one is due."""
        newest: JointReading | None = None
        while self._next is not None:
            decoded, numbers = self._next
            self._shift = self._shift or _StampShift(decoded, stamp)
            due = self._shift.shifted(decoded)
            if due > stamp:
                break
            newest = JointReading(*numbers, stamp=due)
            self._next = self._advance(self._shift)
        return newest

    def _advance(self, shift: _StampShift | None) -> tuple[DecodedMessage, JointNumbers] | None:
        for decoded in self._messages:
            assert isinstance(decoded.message, JointState)
            if shift is not None and shift.is_late(decoded):
                continue
            try:
                numbers = self._states.read(decoded.message)
            except MessageError as error:
                self._refusals.count(error.reason, error)
            except InvalidInput as error:
                self._refusals.count("bad numbers", error)
            else:
                return decoded, numbers
        return None

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._reader.close()


class _StampShift:
    """Shifts recorded stamps by the distance of the first one from the present."""

    def __init__(self, first: DecodedMessage, now: int) -> None:
        self._session: int = first.writer.session
        self._newest = _stamp(first)
        self._log_time = first.log_time
        self._offset = now - self._newest

    def is_late(self, decoded: DecodedMessage) -> bool:
        """Whether a newer sample of the same session came before."""
        back = self._newest - _stamp(decoded)
        return decoded.writer.session == self._session and 0 <= back <= _LATE_NS

    def shifted(self, decoded: DecodedMessage) -> int:
        """When the sample is due; to be called in the order of the recording."""
        stamp, session = _stamp(decoded), decoded.writer.session
        if stamp < self._newest - _LATE_NS or (session != self._session and stamp <= self._newest):
            before = self._newest + self._offset
            self._offset = before + max(0, decoded.log_time - self._log_time) - stamp
        self._session, self._newest, self._log_time = session, stamp, decoded.log_time
        return stamp + self._offset


def _stamp(decoded: DecodedMessage) -> int:
    assert isinstance(decoded.message, JointState)
    return decoded.message.stamp
