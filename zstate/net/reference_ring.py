"""The reference in Python of the ring of cached samples, used without the C extension."""

from __future__ import annotations

from collections import deque


class ReferenceRing:
    """The last ``capacity`` samples, and of these the ones of the ``span_ns`` [ns] before the newest.

    A stamp more than ``set_back_ns`` before an earlier one means that the clock was set back: then the
    earlier samples are dropped. The reference of the kernel's ``SampleRing``.
    """

    def __init__(self, capacity: int, span_ns: int, set_back_ns: int) -> None:
        self._span_ns, self._set_back_ns = span_ns, set_back_ns
        # Plain tuples: a named one takes longer to create than all the rest of ``append``.
        self._samples: deque[tuple[int, int, bytes]] = deque(maxlen=capacity)
        self._newest = 0

    def append(self, stamp: int, seq: int, payload: bytes) -> None:
        """Add a sample, whose ``seq`` is one more than that of the last."""
        samples = self._samples
        limit = stamp - self._span_ns
        if stamp >= self._newest:
            self._newest = stamp
        elif samples and stamp < self._newest - self._set_back_ns:
            samples.clear()  # readers start a new history, too
        if not samples:
            self._newest = stamp
        samples.append((stamp, seq, payload))
        while samples[0][0] < limit:
            samples.popleft()

    def samples(self) -> list[tuple[int, int, bytes]]:
        """The samples (stamp, seq, payload), the oldest first."""
        return list(self._samples.copy())  # the copy is atomic: the writer appends at the same time
