from __future__ import annotations

from zstate._util.bounded_dict import MAX_ENTRIES, BoundedDict


def test_oldest_entry_is_dropped_first():
    known: BoundedDict[int, str] = BoundedDict()
    for number in range(MAX_ENTRIES):
        known[number] = "old"
    known[0] = "new"
    known[MAX_ENTRIES] = "new"
    assert len(known) == MAX_ENTRIES
    assert 1 not in known
    assert list(known.items())[-2:] == [(0, "new"), (MAX_ENTRIES, "new")]
