"""Recording: lookups in a recorded file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer
from zstate.clock import check_stamps
from zstate.recording.decode import DecodedRecording
from zstate.recording.info import RecordingInfo, read_info
from zstate.recording.load import HISTORY_S, check_has_robot, load_into
from zstate.recording.reader import RecordingReader


class Recording(Closeable):
    """A recorded MCAP file or bag, restricted to ``robot`` if one is given.

    ``robots`` are the names of the robots in it, ``info`` describes the file. Raises RecordingError if it
    cannot be read, and InvalidInput if it has no ``robot``. A context manager.
    """

    def __init__(self, path: str | Path, robot: str | None = None) -> None:
        self.info: RecordingInfo = read_info(path)
        self.robot = robot
        self._reader = RecordingReader(path)
        recording = DecodedRecording(self._reader, Refusals().count)
        self.robots = recording.robots
        try:
            if robot is not None:
                check_has_robot(recording, robot)
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        robots = ", ".join(map(repr, self.robots)) or "none"
        return f"<Recording {str(self.info.path)!r}: {self.info.duration_s:g} s, robots {robots}>"

    def buffer(self) -> TransformBuffer:
        """A buffer with all of the recording, or with all of ``robot``."""
        buffer = TransformBuffer(HISTORY_S)
        load_into(buffer, self._reader, self.robot)
        return buffer

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The result of ``buffer().lookup_many``: pose7 at each stamp, (T, 7), and which are valid, (T,).

        Reads the recording once from beginning to end, and keeps only the samples around the stamps [ns],
        which may be in any order: memory grows with their number, not with the recording.
        Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        instants = check_stamps(stamps)
        buffer = TransformBuffer(HISTORY_S)
        load_into(buffer, self._reader, self.robot, around=instants)
        return buffer.lookup_many(target, source, instants)

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._reader.close()
