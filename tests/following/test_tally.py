import logging
import threading

import pytest

from zstate.following.tally import Stats, Tally


def test_counts_begin_at_nothing_and_add_up():
    tally = Tally()
    assert tally.stats() == Stats(0, 0, 0, 0, {})
    tally.count("received", 3)
    tally.count("missed")
    tally.count("received")
    assert tally.stats() == Stats(received=4, dropped=0, missed=1, late=0, refused={})


def test_the_first_refusal_of_each_reason_is_logged_and_all_are_counted(caplog: pytest.LogCaptureFixture):
    tally = Tally()
    with caplog.at_level(logging.WARNING, "zstate"):
        for number in range(3):
            tally.refuse("foreign", f"text {number}")
        tally.refuse("loop", "a loop")
    assert tally.stats().refused == {"foreign": 3, "loop": 1}
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "refused (foreign): text 0",
        "refused (loop): a loop",
    ]


def test_stats_are_of_their_moment():
    tally = Tally()
    tally.refuse("loop", "")
    before = tally.stats()
    tally.refuse("loop", "")
    assert before.refused == {"loop": 1}


def test_threads_lose_no_count():
    tally = Tally()

    def work() -> None:
        for _ in range(1000):
            tally.count("received")
            tally.refuse("loop", "")

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (tally.stats().received, tally.stats().refused["loop"]) == (4000, 4000)


def test_the_first_refusal_of_each_reason_is_kept_in_words():
    tally = Tally()
    tally.refuse("malformed", "one")
    tally.refuse("malformed", "two")
    tally.refuse("foreign", "three")
    assert tally.refusals() == {"malformed": "one", "foreign": "three"}
