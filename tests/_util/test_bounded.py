from __future__ import annotations

from zstate._util.bounded import MAX_ENTRIES, BoundedDict, BoundedQueue


def test_oldest_entry_is_dropped_first():
    known: BoundedDict[int, str] = BoundedDict()
    for number in range(MAX_ENTRIES):
        known[number] = "old"
    known[0] = "new"
    known[MAX_ENTRIES] = "new"
    assert len(known) == MAX_ENTRIES
    assert 1 not in known
    assert list(known.items())[-2:] == [(0, "new"), (MAX_ENTRIES, "new")]


def test_the_oldest_items_are_dropped_by_number_and_by_bytes():
    queue: BoundedQueue[int] = BoundedQueue(3, max_bytes=100)
    assert [queue.append(number, 10) for number in range(4)] == [0, 0, 0, 1]
    assert list(queue) == [1, 2, 3]
    assert (list(reversed(queue)), queue[-1]) == ([3, 2, 1], 3)
    assert queue.append(4, 95) == 3
    assert list(queue) == [4]
    assert queue.append(5, 101) == 2
    assert len(queue) == 0


def test_items_that_are_taken_make_room():
    queue: BoundedQueue[int] = BoundedQueue(3, max_bytes=100)
    queue.append(1, 90)
    assert queue.popleft() == 1
    assert queue.append(2, 90) == 0
