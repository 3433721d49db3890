from zstate.following.bounded import MOST, remember


def test_what_was_put_first_is_forgotten_first():
    known: dict[int, str] = {}
    for number in range(MOST):
        remember(known, number, "old")
    remember(known, 0, "new")
    remember(known, MOST, "new")
    assert len(known) == MOST
    assert 1 not in known
    assert list(known.items())[-2:] == [(0, "new"), (MOST, "new")]
