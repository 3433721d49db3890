from __future__ import annotations

import threading

import pytest
from helpers.processes import DEADLINE_S

from zstate.cli.processes import BackgroundCall
from zstate.errors import InvalidInput


def test_the_result_is_that_of_the_work():
    assert BackgroundCall("work", lambda: 6 * 7).result() == 42


def test_exception_of_the_work_is_raised_by_result():
    def work() -> None:
        raise InvalidInput("not so")

    with pytest.raises(InvalidInput, match="not so"):
        BackgroundCall("work", work).result()


@pytest.mark.parametrize("end", [SystemExit(3), KeyboardInterrupt()], ids=repr)
def test_what_would_end_the_thread_alone_is_raised_by_result(end: BaseException):
    """A library may call sys.exit(); the thread that waits would wait for ever."""

    def work() -> None:
        raise end

    call = BackgroundCall("work", work)
    with pytest.raises(type(end)) as caught:
        call.result(DEADLINE_S)
    assert caught.value is end


def test_result_raises_after_its_timeout():
    forever = threading.Event()
    worker = BackgroundCall("work", forever.wait)
    with pytest.raises(TimeoutError):
        worker.result(0.01)
    forever.set()
    assert worker.result() is True
