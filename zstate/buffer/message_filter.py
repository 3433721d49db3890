"""Message filter (tf2_ros ``MessageFilter``): samples, each with the transform at its stamp."""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterable, AsyncIterator, Awaitable, Callable
from typing import Generic, TypeVar

from zstate.errors import LookupFailed
from zstate.transform import Transform

S = TypeVar("S")


class MessageFilter(Generic[S]):
    """``async for sample, transform in filter``: samples in their order, each with ``target_from_frame``.

    A sample waits up to ``timeout_s`` for the transform at its stamp. One that gets none is left out
    and counted in ``dropped`` by the name of the error; ``last_reason`` is the last of these errors.
    """

    def __init__(
        self,
        wait_async: Callable[[str, str, int, float], Awaitable[Transform]],
        samples: AsyncIterable[S],
        target: str,
        *,
        frame: Callable[[S], str],
        stamp: Callable[[S], int],
        timeout_s: float,
    ) -> None:
        self.target = target
        self.joined = 0
        self.dropped: Counter[str] = Counter()
        self.last_reason: LookupFailed | None = None
        self._wait_async = wait_async
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
                transform = await self._wait_async(self.target, frame, stamp, self._timeout_s)
            except LookupFailed as reason:
                self.last_reason = reason
                # A timeout is counted under the error that the lookup ended with.
                self.dropped[type(reason).__name__.removesuffix("Timeout")] += 1
            else:
                self.joined += 1
                return sample, transform
        raise StopAsyncIteration
