"""Orders of samples: live ones ascend, a writer's past arrives newest first, late ones come in between."""

from __future__ import annotations

import random

import numpy as np
import pytest

from zstate.buffer.history import History
from zstate.buffer.reference_history import ReferenceHistory

HISTORIES = pytest.mark.parametrize("make", list(dict.fromkeys([History, ReferenceHistory])))


@HISTORIES
@pytest.mark.parametrize("stamps", [range(1, 10_001), range(10_000, 0, -1)], ids=["live", "past"])
def test_live_samples_and_the_past_are_not_copied_for_each_sample(make: type[History], stamps: range):
    history, blocks = make(1, 10**12), []
    for stamp in stamps:
        history.insert(stamp, np.array([float(stamp)]))
        start = history.view.stamps.ctypes.data
        if not blocks or blocks[-1] != start:
            blocks.append(start)
    assert len(blocks) < 60  # each an eighth larger than the last
    view = history.view
    assert view.kept_stamps().tolist() == list(range(1, 10_001))
    assert view.kept_rows()[:, 0].tolist() == list(range(1, 10_001))


@HISTORIES
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(1, 5))])
@pytest.mark.long
def test_samples_in_any_order_are_sorted_and_leave_earlier_views_unchanged(make: type[History], seed: int):
    choose, span = random.Random(seed), 400
    history = make(2, span)
    kept: dict[int, float] = {}
    views: list[tuple[object, list[int], list[list[float]]]] = []
    front = back = 1000
    for step in range(3000):
        way = choose.random()
        if way < 0.5:
            stamp = front = front - choose.randrange(1, 3)
        elif way < 0.9:
            stamp = back = back + choose.randrange(1, 3)
        else:
            stamp = choose.randrange(front, back + 1)
        inserted = history.insert(stamp, np.array([float(step), -1.0]))
        newest = max(kept, default=stamp)
        assert inserted == (stamp >= newest - span)
        if inserted:
            kept[stamp] = float(step)
            kept = {at: number for at, number in kept.items() if at >= max(kept) - span}
        front, back = min(kept), max(kept)
        view = history.view
        assert view.kept_stamps().tolist() == sorted(kept)
        assert view.kept_rows()[:, 0].tolist() == [kept[at] for at in sorted(kept)]
        if step % 50 == 0:
            views.append((view, view.kept_stamps().tolist(), view.kept_rows().tolist()))
        if choose.random() < 0.002:
            history.clear()
            kept.clear()
            front = back = 1000
    for view, stamps, rows in views:
        assert (view.kept_stamps().tolist(), view.kept_rows().tolist()) == (stamps, rows)
