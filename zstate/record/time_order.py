"""Time order: many sorted parts as one sorted stream, each opened when its time has come."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from zstate.record.channel import Record


class Part(NamedTuple):
    """Records in the order of their log times, none of them before ``start``."""

    start: int
    records: Callable[[], Iterator[Record]]


def in_time_order(parts: Sequence[Part]) -> Iterator[Record]:
    """All records by log time; those of one instant in the order of the parts.

    A part is opened when the stream reaches its start, so that a long recording is never in memory
    as a whole.
    """
    later = sorted(enumerate(parts), key=lambda item: item[1].start, reverse=True)
    heads: list[tuple[int, int, Record, Iterator[Record]]] = []
    while later or heads:
        while later and (not heads or later[-1][1].start <= heads[0][0]):
            number, part = later.pop()
            records = part.records()
            if (record := next(records, None)) is not None:
                heapq.heappush(heads, (record.log_time, number, record, records))
        if heads:
            _, number, record, records = heads[0]
            yield record
            if (following := next(records, None)) is None:
                heapq.heappop(heads)
            else:
                heapq.heapreplace(heads, (following.log_time, number, following, records))
