"""The order of requests to many writers."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from zstate.net.sample_history import RoundRobinQueue


def popped(queue: RoundRobinQueue[str], now_s: float) -> list[str]:
    items: list[str] = []
    while (item := queue.pop(now_s)) is not None:
        items.append(item)
    return items


def test_sources_take_turns_and_keep_their_own_order():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    for item in ("a1", "a2", "a3", "b1", "c1", "c2"):
        queue.add(item[0], item)
    assert popped(queue, 0.0) == ["a1", "b1", "c1", "a2", "c2", "a3"]
    assert len(queue) == 0


def test_a_source_with_many_items_delays_another_by_one():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    for number in range(1000):
        queue.add("a", f"a{number}")
    assert queue.pop(0.0) == "a0"
    queue.add("b", "b")
    assert [queue.pop(0.0) for _ in range(3)] == ["a1", "b", "a2"]


def test_item_is_not_popped_before_it_is_due():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    queue.add("a", "late", 2.0)
    queue.add("b", "soon", 1.0)
    assert (queue.pop(0.5), queue.next_s(0.5)) == (None, 1.0)
    assert (popped(queue, 1.5), queue.next_s(1.5)) == (["soon"], 2.0)
    assert queue.next_s(3.0) == 3.0
    assert popped(queue, 3.0) == ["late"]
    assert queue.next_s(3.0) is None


def test_cleared_items_are_not_popped():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    queue.add("a", "a1")
    queue.add("a", "a2")
    queue.add("b", "later", 5.0)
    queue.pop(0.0)
    queue.clear()
    assert (len(queue), popped(queue, 9.0)) == (0, [])


@given(st.lists(st.tuples(st.sampled_from("abc"), st.floats(0.0, 10.0))), st.floats(0.0, 10.0))
def test_each_due_item_is_popped_once(added: list[tuple[str, float]], now_s: float):
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    for number, (source, due_s) in enumerate(added):
        queue.add(source, f"{source}{number}", due_s)
    due = [f"{source}{number}" for number, (source, due_s) in enumerate(added) if due_s <= now_s]
    assert sorted(popped(queue, now_s)) == sorted(due)
    assert len(queue) == len(added) - len(due)
