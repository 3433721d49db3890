"""Message filter: sensor samples, each with the transform at its own stamp (tf2_ros ``MessageFilter``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable
from typing import Any, Generic, TypeAlias, TypeVar

from zstate.errors import LookupFailed
from zstate.transform import Transform

S = TypeVar("S")

Wait: TypeAlias = Callable[[str, str, int, float], Awaitable[Transform]]
"""``wait_async`` of a buffer: target, source, stamp, timeout_s."""


def frame_of(sample: Any) -> str:
    """The frame of a sample: its attribute ``frame``."""
    return sample.frame


def stamp_of(sample: Any) -> int:
    """The stamp of a sample [ns]: its attribute ``stamp``."""
    return sample.stamp


class MessageFilter(Generic[S]):
    """``async for sample, transform in filter``: samples in their order, each with ``target_from_frame``.

    A sample waits up to ``timeout_s`` for the transform at its stamp. One that gets none is left out
    and counted in ``dropped`` by the name of the error; ``last_reason`` is the last of these errors.
    """

    def __init__(
        self,
        wait: Wait,
        samples: AsyncIterable[S],
        target: str,
        *,
        frame: Callable[[S], str] = frame_of,
        stamp: Callable[[S], int] = stamp_of,
        timeout_s: float = 1.0,
    ) -> None:
        self.target = target
        self.joined = 0
        self.dropped: Counter[str] = Counter()
        self.last_reason: LookupFailed | None = None
        self._wait = wait
        # One iterator, so that a loop over the filter can be left and continued.
        self._samples = samples.__aiter__()
        self._frame = frame
        self._stamp = stamp
        self._timeout_s = timeout_s

    def __repr__(self) -> str:
        reasons = ", ".join(f"{count} {name}" for name, count in self.dropped.items())
        dropped = f", {self.dropped.total()} dropped ({reasons})" if reasons else ""
        return f"<MessageFilter for {self.target!r}: {self.joined} joined{dropped}>"

    def __aiter__(self) -> AsyncIterator[tuple[S, Transform]]:
        return self

    async def __anext__(self) -> tuple[S, Transform]:
        async for sample in self._samples:
            frame, stamp = self._frame(sample), self._stamp(sample)
            try:
                transform = await self._wait(self.target, frame, stamp, self._timeout_s)
            except LookupFailed as reason:
                self.last_reason = reason
                # A timeout is counted under the error that the lookup ended with.
                self.dropped[type(reason).__name__.removesuffix("Timeout")] += 1
            else:
                self.joined += 1
                return sample, transform
        raise StopAsyncIteration
