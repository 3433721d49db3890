"""Samples that arrive before the description of their robot, which takes milliseconds."""

from __future__ import annotations

from collections.abc import Iterable

from zstate._util.bounded import BoundedQueue
from zstate.wire.messages import Sample, message_size

EARLY_BYTES = 4 * 2**20
_EARLY = 1024
_HISTORY_BYTES = 16 * 2**20
_HISTORY = 20_000


class EarlySamples:
    """Live samples and samples of the history that wait for a description, in bounded memory.

    Not thread-safe.
    """

    def __init__(self) -> None:
        self._live: BoundedQueue[Sample] = BoundedQueue(_EARLY, EARLY_BYTES)
        self._history: list[Sample] = []
        self._history_bytes = 0

    def add(self, sample: Sample) -> int:
        """Keep a live sample. Returns how many older ones are dropped for it."""
        return self._live.append(sample, message_size(sample))

    def add_old(self, sample: Sample) -> bool:
        """Keep a sample of the history, whose newest comes first; True if there is room for another."""
        self._history.append(sample)
        self._history_bytes += message_size(sample)
        return self._history_bytes < _HISTORY_BYTES and len(self._history) < _HISTORY

    def take_live(self) -> Iterable[Sample]:
        """Remove and return the live samples, oldest first."""
        live, self._live = self._live, BoundedQueue(_EARLY, EARLY_BYTES)
        return live

    def take_history(self) -> Iterable[Sample]:
        """Remove and return the samples of the history, newest first."""
        history = self._history
        self.clear_history()
        return history

    def clear(self) -> None:
        """Drop all: they are of a writer that was replaced."""
        self._live.clear()
        self.clear_history()

    def clear_history(self) -> None:
        """Drop those of the history."""
        self._history = []
        self._history_bytes = 0
