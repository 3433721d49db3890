from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

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


def full() -> BoundedDict[int, str]:
    known: BoundedDict[int, str] = BoundedDict()
    for number in range(MAX_ENTRIES):
        known[number] = "old"
    return known


def test_no_way_of_adding_entries_exceeds_the_bound():
    known = full()
    for number in range(MAX_ENTRIES, 2 * MAX_ENTRIES):
        assert known.setdefault(number, "new") == "new"
        assert known.setdefault(number, "other") == "new"
    assert list(known) == list(range(MAX_ENTRIES, 2 * MAX_ENTRIES))
    known.update(full())
    assert list(known) == list(range(MAX_ENTRIES))
    known |= {MAX_ENTRIES: "new"}
    assert type(known) is BoundedDict
    assert list(known) == list(range(1, MAX_ENTRIES + 1))


@pytest.fixture
def _fast_switches():
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(usual)


@pytest.mark.usefixtures("_fast_switches")
def test_threads_that_add_and_drop_entries_need_no_lock():
    known, threads = full(), 4
    start = Barrier(threads)

    def add(thread: int) -> None:
        start.wait()
        for number in range(5000):
            known[number % 50] = f"of {thread}"
            known[MAX_ENTRIES + thread + threads * number] = "new"
            known.setdefault(-1 - thread - threads * number, "new")
            known.pop(number % 50, None)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(add, range(threads)))
    known[-1] = "last"
    assert len(known) <= MAX_ENTRIES
    assert list(known)[-1] == -1


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
