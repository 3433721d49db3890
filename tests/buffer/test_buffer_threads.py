"""Readers and writers at full speed: each answer is right for some instant, or the right error.

Everything written is a straight line in time, so an answer
at a stamp can be checked by that stamp alone, whatever else was going on.
"""

from __future__ import annotations

import itertools
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from helpers.buffers import NOW, S, every_joint, moving, pose_of_every, static
from helpers.processes import DEADLINE_S, until

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.errors import Disconnected, InFuture, InPast, LookupFailed, NoData, Stale
from zstate.transform import Transform

STEP = 1_000_000
TURN = (0.0, 0.0, 0.0, 1.0)
TIME = (InFuture, InPast, NoData, Stale)


def line(stamp: int) -> float:
    """Where everything is at a stamp [m]: one metre for each second since NOW."""
    return (stamp - NOW) * 1e-9


def write_pairs(buffer: TransformBuffer, tick: int) -> None:
    """hall -> left and left -> right run apart at one speed, mostly inserted together."""
    stamp = NOW + tick * STEP
    x = line(stamp)
    if tick % 50 == 10:
        # Fed alone, the edges get tracks of their own; there is one row less on the other.
        buffer.insert(moving("hall", "left", stamp, x=x))
    elif tick % 50 == 20:
        late = stamp - 25 * STEP // 2
        buffer.insert_many(
            [("left", "right"), ("hall", "left")],
            late,
            [(-line(late), 0, 0, *TURN), (line(late), 0, 0, *TURN)],
        )
    else:
        buffer.insert_many(
            [("hall", "left"), ("left", "right")], stamp, [(x, 0, 0, *TURN), (-x, 0, 0, *TURN)]
        )


def write_churn(buffer: TransformBuffer, track, tick: int) -> None:
    """A cart that comes and goes, a lamp that is fixed at times, a robot whose arm turns, an odd clear."""
    stamp = NOW + tick * STEP
    x = line(stamp)
    if tick % 40 == 39:
        buffer.withdraw("cart")
    buffer.insert(moving("hall", "cart", stamp, x=2.0 * x))
    if tick % 30 == 15:
        buffer.insert_static(static("cart", "lamp", x=1000.0))
    elif tick % 30 >= 20:
        buffer.insert(moving("cart", "lamp", stamp, x=x))
    rates = np.zeros(track.model.velocity_count) if tick > 500 else None
    buffer.insert_joints(track, stamp, pose_of_every(track, lift=x), rates)
    if tick % 500 == 499:
        buffer.clear()
    if tick % 700 == 699:
        feed_of(buffer).restart(track)


def check(answer: Transform, expected: float) -> None:
    assert answer.translation[0] == pytest.approx(expected, abs=1e-9), answer


def read_pairs(buffer: TransformBuffer, at: int | None) -> None:
    answer = buffer.lookup("hall", "left", at)
    check(answer, line(answer.stamp))
    # Both edges of one instant, from one or two tracks: the sum is nought at any stamp.
    check(buffer.lookup("right", "hall", at), 0.0)


def read_cart(buffer: TransformBuffer, at: int | None) -> None:
    answer = buffer.lookup("hall", "cart", at)
    check(answer, 2.0 * line(answer.stamp))
    lamp = buffer.lookup("cart", "lamp", at)
    check(lamp, 1000.0 if lamp.kind == "static" else line(lamp.stamp))


def read_robot(buffer: TransformBuffer, at: int | None) -> None:
    answer = buffer.lookup("body", "lift", at)
    assert answer.translation[2] == pytest.approx(line(answer.stamp), abs=1e-9)


def read_many(buffer: TransformBuffer, at: int | None) -> None:
    newest = at or buffer.latest("left", "cart")
    stamps = newest + np.arange(-30, 10) * (STEP // 2)
    poses, valid = buffer.lookup_many("left", "cart", stamps)
    # A stretch of time is covered as a whole or cut at its ends, never in between.
    assert np.count_nonzero(np.diff(valid.astype(int))) <= 2
    np.testing.assert_allclose(poses[valid, 0], [line(int(stamp)) for stamp in stamps[valid]], atol=1e-9)
    assert np.isnan(poses[~valid]).all()
    assert np.isfinite(buffer.plan("left", "cart").poses(stamps[valid])).all()


READERS = [read_pairs, read_cart, read_robot, read_many]
# The errors that each reader may get instead of a transform.
RIGHT_ERRORS: dict[Callable[..., None], tuple[type[LookupFailed], ...]] = {
    read_pairs: TIME,
    read_cart: (*TIME, Disconnected),
    read_robot: TIME,
    read_many: (*TIME, Disconnected),
}


def is_consistent(reason: LookupFailed) -> bool:
    """Whether an error's own numbers bear it out."""
    if isinstance(reason, InFuture):
        return reason.requested > reason.newest
    if isinstance(reason, InPast):
        return reason.requested < reason.oldest
    if isinstance(reason, Stale):
        return reason.newest < reason.other_newest
    return not isinstance(reason, NoData) or reason.newest is None


@pytest.fixture(autouse=True)
def many_switches() -> Iterator[None]:
    """Threads take turns a hundred times more often than usual, in the middle of everything."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(usual / 100)
    yield
    sys.setswitchinterval(usual)


class Crowd:
    """Threads that run until they are stopped, and the first failure in any of them."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.wrong: list[BaseException] = []
        self._threads: list[threading.Thread] = []

    def start(self, step: Callable[[int], None]) -> None:
        thread = threading.Thread(target=self._run, args=(step,), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _run(self, step: Callable[[int], None]) -> None:
        try:
            for tick in itertools.count(1):
                if self.stop.is_set():
                    return
                step(tick)
        except BaseException as error:
            self.wrong.append(error)
            self.stop.set()

    def finish(self, seconds: float) -> None:
        self.stop.wait(seconds)
        self.stop.set()
        for thread in self._threads:
            thread.join(10.0)
            assert not thread.is_alive(), "a thread hangs"
        if self.wrong:
            raise self.wrong[0]


@pytest.mark.parametrize("seconds", [2.0, pytest.param(20.0, marks=pytest.mark.soak)])
@pytest.mark.long
def test_readers_and_writers_at_full_speed_get_correct_transforms_or_errors(seconds: float) -> None:
    buffer, track = every_joint()
    write_pairs(buffer, 0)
    buffer.insert(moving("hall", "cart", NOW))
    buffer.insert_static(static("cart", "lamp", x=1000.0))
    crowd, answers = Crowd(), Counter()

    def reader(read: Callable[..., None]) -> Callable[[int], None]:
        def step(tick: int) -> None:
            # In turn the newest instant, a recent one, and one that is not there yet.
            newest = NOW + answers["ticks"] * STEP
            at = (None, newest - 7 * STEP - 333_333, newest + 3 * STEP)[tick % 3]
            try:
                read(buffer, at)
                answers[read.__name__] += 1
            except LookupFailed as reason:
                assert isinstance(reason, RIGHT_ERRORS[read]), repr(reason)
                assert is_consistent(reason), str(reason)
                answers[type(reason).__name__] += 1

        return step

    def first_writer(tick: int) -> None:
        write_pairs(buffer, tick)
        answers["ticks"] = tick

    crowd.start(first_writer)
    crowd.start(lambda tick: write_churn(buffer, track, tick))
    for read in READERS:
        crowd.start(reader(read))
    crowd.finish(seconds)
    print(dict(answers))
    for read in READERS:
        assert answers[read.__name__] > 10, f"{read.__name__} hardly ever got an answer: {answers}"


def test_instant_of_two_tracks_is_read_entirely_or_not_at_all() -> None:
    buffer = TransformBuffer()
    edges = [("hall", "left"), ("left", "right")]
    for edge in edges:
        buffer.insert(Transform.from_pose7(*edge, (0, 0, 0, *TURN), NOW))
    crowd = Crowd()

    def write(tick: int) -> None:
        # The same stamp again and again: rows are replaced, and both always sum up to nought.
        buffer.insert_many(edges, NOW, [(tick, 0, 0, *TURN), (-tick, 0, 0, *TURN)])

    def read(_: int) -> None:
        check(buffer.lookup("hall", "right", NOW), 0.0)
        assert buffer.lookup_many("hall", "right", [NOW])[0][0, 0] == 0.0

    crowd.start(write)
    crowd.start(read)
    crowd.start(read)
    crowd.finish(0.5)


def test_lookup_does_not_wait_for_the_lock_of_a_writer() -> None:
    buffer = TransformBuffer()
    buffer.insert(moving("a", "b", NOW))
    buffer.lookup("a", "b")
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with buffer._lock:
            held.set()
            done.wait(10.0)

    holder = threading.Thread(target=hold)
    holder.start()
    assert held.wait(10.0)
    answers: list[Transform] = []
    reader = threading.Thread(target=lambda: answers.append(buffer.lookup("a", "b", NOW)))
    reader.start()
    reader.join(5.0)
    done.set()
    holder.join()
    assert len(answers) == 1


def test_every_wait_of_many_threads_is_woken() -> None:
    buffer = TransformBuffer()
    buffer.insert(moving("a", "b", NOW))
    stamps = [NOW + n * S // 100 for n in range(1, 101)]
    answers: list[Transform] = []

    def wait(at: int) -> None:
        answers.append(buffer.wait("a", "b", at, timeout_s=100 * DEADLINE_S))  # woken, or never

    waiters = [threading.Thread(target=wait, args=(at,), daemon=True) for at in stamps]
    for waiter in waiters:
        waiter.start()
    for at in stamps:
        buffer.insert(moving("a", "b", at))
    until(lambda: len(answers) == len(stamps))
    assert sorted(answer.stamp for answer in answers) == stamps


def test_sample_during_unregistration_of_a_waiter_wakes_the_others() -> None:
    buffer = TransformBuffer()
    buffer.insert(moving("a", "b", NOW))
    reported_stamps: list[int | None] = []
    threads: list[threading.Thread] = []

    def comes() -> None:
        stamp = NOW + 1 + len(threads)
        threads.append(threading.Thread(target=lambda: buffer.insert(moving("a", "b", stamp))))
        threads[-1].start()
        until(lambda: reported_stamps[-1] == stamp, 5.0)

    class Interrupted(dict[Any, Any]):
        """Whenever it is changed, a sample comes before the next step."""

        def pop(self, *arguments: Any) -> Any:
            found = super().pop(*arguments)
            comes()
            return found

        def __setitem__(self, key: Any, value: Any) -> None:
            comes()
            super().__setitem__(key, value)

    with buffer.watch("a", "b", lambda news: reported_stamps.append(news.stamp)):
        leaving = buffer.watch("a", "b", lambda _: None)
        buffer._waiters._by_track = Interrupted(buffer._waiters._by_track)
        leaving.close()
        assert threads
    for thread in threads:
        thread.join()
