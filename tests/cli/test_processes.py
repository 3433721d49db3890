from __future__ import annotations

import threading

import pytest

from zstate.cli.processes import BackgroundCall
from zstate.errors import InvalidInput


def test_the_result_is_that_of_the_work():
    assert BackgroundCall("work", lambda: 6 * 7).result() == 42


def test_an_error_of_the_work_is_raised_where_it_is_waited_for():
    def work() -> None:
        raise InvalidInput("not so")

    with pytest.raises(InvalidInput, match="not so"):
        BackgroundCall("work", work).result()


def test_work_that_goes_on_is_not_waited_for_longer_than_asked():
    forever = threading.Event()
    worker = BackgroundCall("work", forever.wait)
    with pytest.raises(TimeoutError):
        worker.result(0.01)
    forever.set()
    assert worker.result() is True
