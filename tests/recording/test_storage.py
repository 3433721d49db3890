"""Time order: the merge of sorted parts, against a sort of everything."""

from __future__ import annotations

from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from zstate.recording.storage import Channel, Record, SortedPart, merge_by_log_time

CHANNEL = Channel("/a", "t", "cdr", {}, 0)


def part(number: int, times: list[int], opened: list[int], early: int = 0) -> SortedPart:
    def records() -> Iterator[Record]:
        opened.append(number)
        for place, time in enumerate(times):
            yield Record(CHANNEL, b"", time, number, place)

    return SortedPart(min(times, default=0) - early, records)


@given(st.lists(st.tuples(st.lists(st.integers(0, 30)).map(sorted), st.integers(0, 5))))
def test_merge_is_a_stable_sort(parts: list[tuple[list[int], int]]):
    merged = merge_by_log_time([part(n, times, [], early) for n, (times, early) in enumerate(parts)])
    everything = [
        Record(CHANNEL, b"", time, number, place)
        for number, (times, _) in enumerate(parts)
        for place, time in enumerate(times)
    ]
    assert list(merged) == sorted(everything, key=lambda record: record.log_time)


def test_part_is_opened_when_its_start_is_reached():
    opened: list[int] = []
    merged = merge_by_log_time([part(0, [5, 6], opened), part(1, [1, 2], opened), part(2, [9], opened)])
    seen = [(record.log_time, list(opened)) for record in merged]
    assert seen == [(1, [1]), (2, [1]), (5, [1, 0]), (6, [1, 0]), (9, [1, 0, 2])]
