"""Recording: what a file knows of robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import check_stamps
from zstate.closing import Closing
from zstate.following.recorded import HISTORY_S, check_recorded, fill
from zstate.following.tally import Tally
from zstate.record.info import RecordingInfo, describe
from zstate.record.reader import RecordReader
from zstate.record.transcript import Transcript


class Recording(Closing):
    """A recorded MCAP file or bag, asked about ``robot``, or about all robots in it.

    ``robots`` are those it tells of, ``info`` what else there is to say of it. Raises RecordingError
    for what cannot be read, and InvalidInput when it tells nothing of ``robot``. A context manager.
    """

    def __init__(self, path: str | Path, robot: str | None = None) -> None:
        self.info: RecordingInfo = describe(path)
        self.robot = robot
        self._reader = RecordReader(path)
        transcript = Transcript(self._reader, Tally().refuse)
        self.robots = transcript.robots
        try:
            if robot is not None:
                check_recorded(transcript, robot)
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        robots = ", ".join(map(repr, self.robots)) or "none"
        return f"<Recording {str(self.info.path)!r}: {self.info.duration_s:g} s, robots {robots}>"

    def buffer(self) -> TransformBuffer:
        """A buffer that holds the whole recording, of ``robot`` or of all robots.

        Its lookups are those of a listener's buffer at the time of the recording; restarts are treated as
        ``zstate.following.recorded`` describes. Unusable messages are skipped, and
        logged once for each reason.
        """
        buffer = TransformBuffer(HISTORY_S)
        fill(buffer, self._reader, self.robot)
        return buffer

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """What ``buffer().lookup_many`` answers: pose7 at each stamp, (T, 7), and which are valid, (T,).

        Reads the recording once from its beginning to its end, and keeps only the samples around the
        stamps [ns], which may stand in any order: memory grows with their number, not with the
        recording. Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        instants = check_stamps(stamps)
        buffer = TransformBuffer(HISTORY_S)
        fill(buffer, self._reader, self.robot, around=instants)
        return buffer.lookup_many(target, source, instants)

    def close(self) -> None:
        """Let go of the file. A second call does nothing."""
        self._reader.close()
