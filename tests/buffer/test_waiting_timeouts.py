"""Waiting: woken by what arrives, ended at once by what can never come."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest
from helpers.buffers import MS, S, every_joint, filled, moving, pose_of_every, static, x_of
from helpers.processes import until

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.errors import (
    Disconnected,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    NoData,
    Stale,
    UnknownFrame,
    WaitTimeout,
)
from zstate.transform import Transform

LONG_S = 20.0
"""Longer than any test may take: a wait that needs it has failed."""


class Waiting:
    """A call in a thread of its own, and what became of it."""

    def __init__(self, buffer: TransformBuffer, call: Callable[[], Transform]) -> None:
        self._buffer = buffer
        self.outcome: Transform | LookupFailed | None = None
        seats = len(buffer._waiters)
        self._thread = threading.Thread(target=self._run, args=(call,), daemon=True)
        self._thread.start()
        until(lambda: len(buffer._waiters) != seats or not self._thread.is_alive(), LONG_S)

    def _run(self, call: Callable[[], Transform]) -> None:
        try:
            self.outcome = call()
        except LookupFailed as reason:
            self.outcome = reason

    def result(self) -> Transform | LookupFailed:
        self._thread.join(LONG_S / 2)
        assert self.outcome is not None, "still waiting"
        return self.outcome


def by_thread(buffer: TransformBuffer, *question) -> Waiting:
    return Waiting(buffer, lambda: buffer.wait(*question, timeout_s=LONG_S))


def by_lookup(buffer: TransformBuffer, *question) -> Waiting:
    return Waiting(buffer, lambda: buffer.lookup(*question, timeout_s=LONG_S))


def by_asyncio(buffer: TransformBuffer, *question) -> Waiting:
    return Waiting(buffer, lambda: asyncio.run(buffer.wait_async(*question, timeout_s=LONG_S)))


@pytest.fixture(params=[by_thread, by_lookup, by_asyncio])
def waiting(request: pytest.FixtureRequest) -> Callable[..., Waiting]:
    return request.param


def test_available_transform_is_returned_at_once(waiting) -> None:
    buffer = filled(moving("a", "b", 5, x=2.0))
    assert x_of(waiting(buffer, "a", "b", 5).result()) == 2.0


def test_wait_ends_with_the_sample_that_completes_the_transform(waiting) -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 0))
    wait = waiting(buffer, "a", "c", S)
    buffer.insert(moving("a", "b", 2 * S, x=2.0))
    buffer.insert(moving("b", "c", S - 1))
    buffer.insert(moving("b", "c", S, x=10.0))
    assert x_of(wait.result()) == 11.0


def test_wait_for_unknown_unconnected_and_empty_frames_ends_with_the_last_missing_sample(waiting) -> None:
    buffer = TransformBuffer()
    wait = waiting(buffer, "a", "c")
    buffer.insert_static(static("a", "b", x=1.0))
    buffer.insert_static(static("x", "c"))
    buffer.withdraw("c")
    buffer.insert(moving("b", "c", S, x=2.0))
    assert x_of(wait.result()) == 3.0


def test_wait_for_a_robot_ends_with_its_first_sample(waiting) -> None:
    buffer, track = every_joint()
    wait = waiting(buffer, "body", "arm")
    buffer.insert_joints(track, S, pose_of_every(track, bend=0.5))
    assert wait.result().rpy[2] == pytest.approx(0.5)


def test_wait_before_the_kept_history_fails_at_once(waiting) -> None:
    outcome = waiting(filled(moving("a", "b", 10 * S + 1)), "a", "b", 0).result()
    assert type(outcome) is InPast


def test_wait_before_the_only_sample_ends_when_older_history_arrives(waiting) -> None:
    """The order in which a joining listener receives: a live sample, then history, newest first."""
    buffer = filled(moving("a", "b", 10 * S, x=10.0))
    wait = waiting(buffer, "a", "b", 9 * S + S // 2)
    buffer.insert(moving("a", "b", 9 * S, x=9.0))
    buffer.insert(moving("a", "b", 8 * S, x=8.0))
    assert x_of(wait.result()) == 9.5


def test_wait_for_a_past_instant_ends_when_the_last_edge_covers_it(waiting) -> None:
    buffer, track = every_joint()
    buffer.insert(moving("map", "root", 10 * S, x=1.0))
    buffer.insert_joints(track, 10 * S, pose_of_every(track))
    wait = waiting(buffer, "map", "lift", 9 * S)
    buffer.insert(moving("map", "root", 8 * S, x=1.0))
    assert wait.outcome is None
    buffer.insert_joints(track, 9 * S, pose_of_every(track, lift=0.5))
    assert wait.result().translation.tolist() == [1.0, 0.0, 1.5]


def test_wait_for_a_past_instant_wakes_once_for_any_number_of_samples(waiting) -> None:
    buffer = filled(moving("a", "b", 10 * S))
    wait = waiting(buffer, "a", "b", 5 * S)
    (waiter,) = buffer._waiters._waiters
    wakes, wake = [], waiter.wake
    waiter.wake = lambda: wakes.append(None) or wake()
    for n in range(95, 49, -1):
        buffer.insert(moving("a", "b", n * S // 10, x=n))
        buffer.insert(moving("a", "b", 10 * S + n, x=n))
    assert x_of(wait.result()) == 50.0
    assert len(wakes) <= 2  # the late sample that makes the answer, and the one behind it


def test_wait_for_a_past_instant_without_new_samples_times_out_with_its_reason() -> None:
    buffer = filled(moving("a", "b", 10 * S))
    with pytest.raises(InPast) as caught:
        buffer.lookup("a", "b", 5 * S, timeout_s=0.01)
    assert isinstance(caught.value, TimeoutError)


def test_wait_for_a_past_instant_fails_when_the_history_moves_past_it(waiting) -> None:
    buffer = filled(moving("a", "b", 10 * S))
    wait = waiting(buffer, "a", "b", 9 * S)
    buffer.insert(moving("a", "b", 19 * S))
    assert wait.outcome is None
    buffer.insert(moving("a", "b", 19 * S + 1))
    outcome = wait.result()
    assert type(outcome) is InPast
    assert not isinstance(outcome, TimeoutError)


def test_wait_fails_at_once_when_a_jump_makes_it_hopeless(waiting) -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 0))
    wait = waiting(buffer, "a", "c", S)
    buffer.insert(moving("b", "c", 100 * S))
    outcome = wait.result()
    assert (type(outcome), outcome.edge) == (InPast, ("b", "c"))


def test_wait_for_the_newest_instant_survives_an_edge_that_lags_behind_the_history_of_others(waiting) -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 100 * S, x=1.0))
    wait = waiting(buffer, "a", "c")
    buffer.insert(moving("a", "b", 100 * S, x=5.0))
    assert x_of(wait.result()) == 6.0


@pytest.mark.parametrize("name", ["", "/a", None, 5, b"a", ["a"]])
def test_wait_for_an_impossible_name_fails_at_once(name) -> None:
    buffer = TransformBuffer()
    for call in (
        lambda: buffer.wait(name, "b", timeout_s=LONG_S),
        lambda: buffer.lookup("b", name, timeout_s=LONG_S),
        lambda: asyncio.run(buffer.wait_async(name, "b", timeout_s=LONG_S)),
    ):
        with pytest.raises(InvalidInput, match="frame name"):
            call()


def cases() -> list:
    one = filled(moving("a", "b", 0), static("x", "y"))
    empty, _ = every_joint()
    return [
        (TransformBuffer(), ("a", "b"), UnknownFrame),
        (one, ("a", "y"), Disconnected),
        (one, ("a", "b", 1), InFuture),
        (empty, ("root", "body"), NoData),
    ]


@pytest.mark.parametrize(("buffer", "question", "reason"), cases())
def test_wait_that_times_out_raises_its_reason_as_a_timeout_error(buffer, question, reason) -> None:
    def check(call: Callable[[], object]) -> None:
        with pytest.raises(reason) as caught:
            call()
        assert isinstance(caught.value, TimeoutError)
        assert isinstance(caught.value, WaitTimeout)
        assert caught.value.waited_s == 0.01
        assert str(caught.value).startswith("after waiting 0.01 s")

    check(lambda: buffer.wait(*question, timeout_s=0.01))
    check(lambda: buffer.lookup(*question, timeout_s=0.01))
    check(lambda: asyncio.run(buffer.wait_async(*question, timeout_s=0.01)))


def test_wait_with_prediction_ends_when_prediction_reaches_the_stamp() -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", 10 * MS, x=1.0))
    wait = Waiting(buffer, lambda: buffer.lookup("a", "b", 40 * MS, predict_s=0.02, timeout_s=LONG_S))
    buffer.insert(moving("a", "b", 20 * MS, x=2.0))
    outcome = wait.result()
    assert (outcome.kind, x_of(outcome)) == ("predicted", pytest.approx(4.0))


def test_wait_for_an_unpredictable_transform_times_out_or_ends_with_the_sample() -> None:
    buffer, track = every_joint()
    buffer.insert_joints(track, 0, pose_of_every(track))
    with pytest.raises(InFuture) as caught:
        buffer.lookup("body", "arm", MS, predict_s=1.0, timeout_s=0.01)
    assert isinstance(caught.value, TimeoutError)
    wait = Waiting(buffer, lambda: buffer.lookup("body", "arm", MS, predict_s=1.0, timeout_s=LONG_S))
    buffer.insert_joints(track, 2 * MS, pose_of_every(track, bend=0.5))
    assert wait.result().rpy[2] == pytest.approx(0.25)


def test_wait_for_a_fresher_transform_ends_with_its_sample() -> None:
    clock = ManualClock(10 * S)
    buffer = TransformBuffer(clock=clock)
    buffer.insert(moving("a", "b", 8 * S))
    wait = Waiting(buffer, lambda: buffer.lookup("a", "b", max_age_s=1.0, timeout_s=LONG_S))
    buffer.insert(moving("a", "b", 8 * S + MS))
    buffer.insert(moving("a", "b", 9 * S, x=3.0))
    assert x_of(wait.result()) == 3.0


def test_wait_does_not_make_a_stale_instant_valid() -> None:
    buffer = TransformBuffer(clock=ManualClock(10 * S))
    buffer.insert(moving("a", "b", 8 * S))
    with pytest.raises(Stale) as caught:
        buffer.lookup("a", "b", 8 * S, max_age_s=1.0, timeout_s=LONG_S)
    assert not isinstance(caught.value, TimeoutError)


def test_wait_times_out_although_samples_keep_arriving() -> None:
    buffer = TransformBuffer(clock=ManualClock(2**62))
    buffer.insert(moving("a", "b", 0))
    stop = threading.Event()

    def pour() -> None:
        stamp = 0
        while not stop.is_set():
            stamp += 1
            buffer.insert(moving("a", "b", stamp))

    writer = threading.Thread(target=pour)
    writer.start()
    try:
        with pytest.raises(Stale) as caught:
            buffer.lookup("a", "b", max_age_s=1.0, timeout_s=0.05)
        assert isinstance(caught.value, TimeoutError)
    finally:
        stop.set()
        writer.join()


def test_asyncio_wait_can_be_cancelled_and_leaves_no_waiter() -> None:
    buffer = TransformBuffer()

    async def cancel() -> None:
        task = asyncio.create_task(buffer.wait_async("a", "b", timeout_s=LONG_S))
        await asyncio.sleep(0)
        assert len(buffer._waiters) == 1
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancel())
    assert len(buffer._waiters) == 0


def test_asyncio_waits_share_one_loop() -> None:
    buffer = TransformBuffer()

    async def both() -> list[Transform]:
        waits = [asyncio.create_task(buffer.wait_async("a", "b", n * S, timeout_s=LONG_S)) for n in range(3)]
        await asyncio.sleep(0)
        for n in range(3):
            buffer.insert(moving("a", "b", n * S, x=n))
        return await asyncio.gather(*waits)

    assert [x_of(answer) for answer in asyncio.run(both())] == [0.0, 1.0, 2.0]


def test_insert_survives_a_waiter_whose_loop_is_closed() -> None:
    buffer = TransformBuffer()
    loop = asyncio.new_event_loop()
    task = loop.create_task(buffer.wait_async("a", "b", timeout_s=LONG_S))
    loop.run_until_complete(asyncio.sleep(0))
    (waiter,) = buffer._waiters._waiters
    task.cancel()
    loop.run_until_complete(asyncio.gather(task, return_exceptions=True))
    loop.close()
    waiter.wake()
