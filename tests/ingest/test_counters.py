import logging
import threading

import pytest

from zstate.ingest.counters import Counters, ListenerStats


def test_counts_start_at_zero_and_add_up():
    counters = Counters()
    assert counters.stats() == ListenerStats(0, 0, 0, 0, {})
    counters.count("received", 3)
    counters.count("missed")
    counters.count("received")
    assert counters.stats() == ListenerStats(received=4, dropped=0, missed=1, late=0, refused={})


def test_first_refusal_of_each_reason_is_logged_and_all_are_counted(caplog: pytest.LogCaptureFixture):
    counters = Counters()
    with caplog.at_level(logging.WARNING, "zstate"):
        for number in range(3):
            counters.count_refusal("foreign", f"text {number}")
        counters.count_refusal("loop", "a loop")
    assert counters.stats().refused == {"foreign": 3, "loop": 1}
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "refused (foreign): text 0",
        "refused (loop): a loop",
    ]


def test_stats_do_not_change_after_they_are_read():
    counters = Counters()
    counters.count_refusal("loop", "")
    before = counters.stats()
    counters.count_refusal("loop", "")
    assert before.refused == {"loop": 1}


def test_concurrent_counts_lose_nothing():
    counters = Counters()

    def work() -> None:
        for _ in range(1000):
            counters.count("received")
            counters.count_refusal("loop", "")

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (counters.stats().received, counters.stats().refused["loop"]) == (4000, 4000)


def test_text_of_the_first_refusal_of_each_reason_is_kept():
    counters = Counters()
    counters.count_refusal("malformed", "one")
    counters.count_refusal("malformed", "two")
    counters.count_refusal("foreign", "three")
    assert counters.refusals() == {"malformed": "one", "foreign": "three"}
