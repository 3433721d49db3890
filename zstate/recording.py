"""Recording: lookups in a recorded file, of one robot or of all."""

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
    """A recorded MCAP file or ROS 2 bag, read for ``robot``, or for all robots in it.

    ``robots`` are the robots it contains, ``info`` is its summary. Raises RecordingError
    if it cannot be read, InvalidInput if it contains nothing of ``robot``. A context manager.
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
        """As ``buffer().lookup_many``: pose7 at each stamp, (T, 7), and which are valid, (T,).

        Reads the recording once from its beginning to its end, and keeps only the samples around the
        stamps [ns], which may be in any order: memory grows with their number, not with the
        recording. Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        instants = check_stamps(stamps)
        buffer = TransformBuffer(HISTORY_S)
        fill(buffer, self._reader, self.robot, around=instants)
        return buffer.lookup_many(target, source, instants)

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._reader.close()
