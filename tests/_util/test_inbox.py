"""Inbox: items that wait for a reader, a thread or a task."""

from __future__ import annotations

import asyncio

import pytest

from zstate._util.inbox import Inbox
from zstate.errors import Closed


class Reception:
    """Reception that a test ends, and that counts how often it is checked."""

    def __init__(self) -> None:
        self.checks = 0
        self.is_ended = False

    def check(self) -> None:
        self.checks += 1
        if self.is_ended:
            raise Closed("the session is closed")


def test_asynchronous_wait_ends_as_reception_ends():
    reception = Reception()
    inbox: Inbox[int] = Inbox(3, reception.check)

    async def wait() -> None:
        task = asyncio.ensure_future(anext(aiter(inbox)))
        while not reception.checks:
            await asyncio.sleep(0)
        reception.is_ended = True
        with pytest.raises(Closed):
            await asyncio.wait_for(task, 10.0)

    asyncio.run(wait())


def test_cancelled_wait_leaves_nothing_behind():
    reception = Reception()
    inbox: Inbox[int] = Inbox(3, reception.check)

    async def cancel() -> None:
        task = asyncio.ensure_future(anext(aiter(inbox)))
        while not reception.checks:
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancel())
    assert not inbox._waiting_tasks


def test_items_beyond_the_limit_of_bytes_are_lost_and_counted():
    inbox: Inbox[bytes] = Inbox(9, lambda: None, max_bytes=10, size_of=len)
    assert inbox.add([b"1234", b"5678"]) == 0
    assert inbox.add([b"9"]) == 0
    assert inbox.add([b"abc", b"d"]) == 1  # 4 + 4 + 1 + 3 bytes are 2 too many
    assert inbox.add([b"more than 10 bytes"]) == 5
    assert inbox.add([b"e"]) == 0
    assert inbox.take_newest() == b"e"


def test_items_lost_for_newer_ones_are_counted():
    inbox: Inbox[int] = Inbox(3, lambda: None)
    assert inbox.add([1, 2]) == 0
    assert inbox.add([3, 4, 5]) == 2
    assert inbox.add([6]) == 1
    inbox.close()
    assert list(inbox) == [4, 5, 6]


def test_item_added_after_close_is_lost():
    inbox: Inbox[int] = Inbox(3, lambda: None)
    inbox.add([1])
    inbox.close()
    inbox.add([2])
    assert list(inbox) == [1]
