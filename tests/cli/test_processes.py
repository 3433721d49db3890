from __future__ import annotations

import threading

import pytest

from zstate.cli.processes import BackgroundCall
from zstate.errors import InvalidInput


def test_the_result_is_that_of_the_work():
    assert BackgroundCall("work", lambda: 6 * 7).result() == 42


def test_exception_of_the_work_is_raised_by_result():
    def work() -> None:
        raise InvalidInput("not so")

    with pytest.raises(InvalidInput, match="not so"):
        BackgroundCall("work", work).result()


def test_result_raises_after_its_timeout():
    forever = threading.Event()
    worker = BackgroundCall("work", forever.wait)
    with pytest.raises(TimeoutError):
        worker.result(0.01)
    forever.set()
    assert worker.result() is True
