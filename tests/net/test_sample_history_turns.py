"""The order in which many writers are asked."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from zstate.net.sample_history import RoundRobinQueue


def taken(turns: RoundRobinQueue[str], now_s: float) -> list[str]:
    items: list[str] = []
    while (item := turns.pop(now_s)) is not None:
        items.append(item)
    return items


def test_each_source_has_its_turn_and_keeps_its_own_order():
    turns: RoundRobinQueue[str] = RoundRobinQueue()
    for item in ("a1", "a2", "a3", "b1", "c1", "c2"):
        turns.add(item[0], item)
    assert taken(turns, 0.0) == ["a1", "b1", "c1", "a2", "c2", "a3"]
    assert len(turns) == 0


def test_a_source_with_many_items_delays_another_by_one():
    turns: RoundRobinQueue[str] = RoundRobinQueue()
    for number in range(1000):
        turns.add("a", f"a{number}")
    turns.pop(0.0)
    turns.add("b", "b")
    assert "b" in (turns.pop(0.0), turns.pop(0.0))


def test_nothing_is_taken_before_it_is_due():
    turns: RoundRobinQueue[str] = RoundRobinQueue()
    turns.add("a", "late", 2.0)
    turns.add("b", "soon", 1.0)
    assert (turns.pop(0.5), turns.next_s(0.5)) == (None, 1.0)
    assert (taken(turns, 1.5), turns.next_s(1.5)) == (["soon"], 2.0)
    assert turns.next_s(3.0) == 3.0
    assert taken(turns, 3.0) == ["late"]
    assert turns.next_s(3.0) is None


def test_what_is_cleared_is_not_taken():
    turns: RoundRobinQueue[str] = RoundRobinQueue()
    turns.add("a", "a1")
    turns.add("a", "a2")
    turns.add("b", "later", 5.0)
    turns.pop(0.0)
    turns.clear()
    assert (len(turns), taken(turns, 9.0)) == (0, [])


@given(st.lists(st.tuples(st.sampled_from("abc"), st.floats(0.0, 10.0))), st.floats(0.0, 10.0))
def test_all_that_is_due_is_taken_once(added: list[tuple[str, float]], now_s: float):
    turns: RoundRobinQueue[str] = RoundRobinQueue()
    for number, (source, due_s) in enumerate(added):
        turns.add(source, f"{source}{number}", due_s)
    due = [f"{source}{number}" for number, (source, due_s) in enumerate(added) if due_s <= now_s]
    assert sorted(taken(turns, now_s)) == sorted(due)
    assert len(turns) == len(added) - len(due)
