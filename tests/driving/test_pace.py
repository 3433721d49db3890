"""The pace of control loops: that of a device, and real-time scheduling."""

import gc
import os
import re
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S

from zstate.clock import ManualClock, MonotonicClock
from zstate.driving.pace import DevicePace, Realtime, check_pace, control_loop_pace
from zstate.errors import InvalidInput
from zstate.rate import RateReport

SECOND = 1_000_000_000


def paced(pauses_ns: list[int]) -> list[float]:
    """The steps [s] at the ends of ``pauses_ns``, each after the motion at the end of the one before."""
    clock = ManualClock()
    pace = DevicePace(clock, threading.Event())
    steps, moved_at = [], 0
    for pause_ns, _ in zip(pauses_ns, pace, strict=False):
        clock.set(clock.now() + pause_ns)
        steps.append(pace.step_s(moved_at, clock.now()))
        moved_at = clock.now()
    return steps


def test_a_step_at_a_devices_pace_lasts_as_long_as_the_time_that_has_passed():
    # All pauses are within two periods of 10 ms, which the loop knows after 200 ticks.
    pauses = [8_000_000, 15_000_000, 40_000, 10_000_000]
    assert paced([10_000_000] * 200 + pauses)[200:] == [pause * 1e-9 for pause in pauses]


def test_a_step_after_a_pause_of_the_device_lasts_for_two_of_its_periods():
    steps = paced([10_000_000] * 200 + [200_000_000, 200_000_000])
    # The pause counted as two periods of 10 ms, among the last 16.
    assert steps[-2:] == pytest.approx([0.02, 2 * (0.01 + (0.02 - 0.01) / 16)], rel=1e-3)


def test_no_step_at_a_devices_pace_is_longer_than_the_device_has_been_seen_to_take():
    # The first reading takes a second. At first a period is 0.1 ms; it grows by a 16th at a tick.
    first, second, *others = paced([SECOND] + [1_000_000] * 60)
    assert (first, second) == pytest.approx((0.0002, 0.0002 * (1 + 1 / 16)))
    assert others[-1] == max(others) == 0.001
    # The motion of a device that takes 0.2 s for each reading is slower than its limits.
    assert paced([200_000_000] * 500)[-1] == 0.05


def test_a_devices_pace_ends_after_its_seconds_and_reports_its_rate():
    clock = ManualClock()
    pace = DevicePace(clock, threading.Event(), 0.1)
    for _ in pace:
        clock.advance(0.01)
    assert pace.report() == RateReport(0.0, pytest.approx(100.0), ticks=10, skipped=0, late=0)


def test_a_devices_pace_ends_when_it_is_stopped():
    stop = threading.Event()
    pace = DevicePace(ManualClock(), stop)
    for number, _ in enumerate(pace, 1):
        if number == 4:
            stop.set()
    assert pace.report().ticks == 4


@pytest.mark.skipif(sys.platform != "linux", reason="waits are counted by Linux")
def test_a_device_that_returns_at_once_is_refused_and_one_that_blocks_is_not():
    nothing = threading.Event()
    for ticks, _ in enumerate(DevicePace(MonotonicClock(), threading.Event())):
        if ticks == 2000:
            break
        nothing.wait(1e-6)
    with pytest.raises(InvalidInput, match=r"has waited \d+ times in 1000 ticks.*returns at once"):
        for _ in DevicePace(MonotonicClock(), threading.Event()):
            pass


@pytest.mark.skipif(sys.platform != "linux", reason="waits are counted by Linux")
def test_a_loop_that_becomes_slower_than_its_device_goes_on_with_a_warning_and_sleeps(
    caplog: pytest.LogCaptureFixture,
):
    pace = DevicePace(MonotonicClock(), threading.Event())
    for ticks, now in enumerate(pace):
        if ticks == 0:
            pace.step_s(now - 1, now)  # the robot moves, so the loop must not end by itself
        elif ticks == 2000:
            before = count_waits()
        elif ticks == 4000:
            break
    assert count_waits() - before >= 1500  # a sleep whose time is over before the switch does not count
    (record,) = caplog.records
    assert re.search(r"has waited \d+ times in 1000 ticks.*sleeps for 50 us at each tick", record.message)


# Real-time scheduling


def count_waits() -> int:
    """How often this thread has waited until now."""
    import resource  # not on every system

    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw


def in_thread(function: Callable[[], None]) -> None:
    failures: list[BaseException] = []

    def run() -> None:
        try:
            function()
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    for failure in failures:
        raise failure


def test_other_threads_give_up_the_interpreter_sooner_while_a_control_loop_runs():
    before = sys.getswitchinterval()
    with control_loop_pace(100.0, None, threading.Event(), 1.0):
        assert sys.getswitchinterval() == pytest.approx(5e-4)
    assert sys.getswitchinterval() == before


@pytest.mark.realtime
@pytest.mark.parametrize("realtime", ["fifo", "spin"])
def test_a_real_time_loop_has_its_scheduling_inside_the_block_only(realtime: Realtime):
    def loop() -> None:
        assert os.sched_getscheduler(0) == os.SCHED_OTHER
        frozen, interval = gc.get_freeze_count(), sys.getswitchinterval()
        with control_loop_pace(1000.0, realtime, threading.Event(), 0.02) as pace:
            assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
            assert gc.get_freeze_count() > 0
            assert "VmLck:\t       0 kB" not in Path("/proc/self/status").read_text()
            ticks = len(list(pace))
            assert ticks + pace.report().skipped == 20
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
        assert (gc.get_freeze_count(), sys.getswitchinterval()) == (frozen, interval)
        assert "VmLck:\t       0 kB" in Path("/proc/self/status").read_text()

    in_thread(loop)


@pytest.mark.realtime
@pytest.mark.parametrize("realtime", ["fifo", "spin"])
def test_a_real_time_loop_sleeps_at_each_tick_even_if_its_work_takes_too_long(realtime: Realtime):
    def loop() -> None:
        with control_loop_pace(1000.0, realtime, threading.Event(), 0.1) as pace:
            before = count_waits()
            for now in pace:
                while time.monotonic_ns() < now + 1_500_000:
                    pass
            assert count_waits() - before >= 3 * pace.report().ticks // 4 > 1

    in_thread(loop)


@pytest.mark.realtime
def test_a_loop_that_would_starve_other_programs_leaves_real_time_scheduling(caplog):
    def loop() -> None:
        with control_loop_pace(1000.0, "fifo", threading.Event(), DEADLINE_S) as pace:
            for now in pace:
                while time.monotonic_ns() < now + 3_000_000:
                    pass
                if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER:
                    return
        pytest.fail("still SCHED_FIFO")

    in_thread(loop)
    assert "more than 90 % of a processor for a second" in caplog.text
    assert "lower rate_hz" in caplog.text


@pytest.mark.realtime
def test_a_stop_ends_a_real_time_loop_that_waits_for_its_next_tick():
    stop = threading.Event()

    def loop() -> None:
        with control_loop_pace(0.001, "spin", stop, None) as pace:
            threading.Timer(0.05, stop.set).start()
            assert len(list(pace)) == 1

    in_thread(loop)


@pytest.mark.realtime
@pytest.mark.parametrize(("capability", "limit"), [("sys_nice", "ulimit -r 50"), ("ipc_lock", "ulimit -l")])
def test_real_time_scheduling_that_the_system_refuses_is_an_error_with_what_to_do(
    capability: str, limit: str
):
    code = """
        import resource, threading
        from zstate.driving.pace import control_loop_pace
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
        try:
            with control_loop_pace(100.0, "fifo", threading.Event(), None): print("permitted")
        except ValueError as error:
            print(error, resource.getrlimit(resource.RLIMIT_MEMLOCK))
    """
    command = ["setpriv", "--bounding-set", f"-{capability}", sys.executable, "-c", textwrap.dedent(code)]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert limit in text
    assert f"CAP_{capability.upper()}" in text
    assert "(65536, 65536)" in text
    # A limit of any size is refused, since a later allocation could reach it: the reason is not its size.
    assert "Cannot allocate memory" not in text


@pytest.mark.parametrize(
    ("rate_hz", "realtime", "text"),
    [
        (100.0, "hard", "realtime is None, 'fifo' or 'spin', not 'hard'"),
        (None, "spin", "realtime='spin' waits for deadlines"),
        (2500.0, "spin", "leaves too little of a processor above 2000 Hz; got rate_hz=2500.0"),
        (0.0, None, "a rate is above 0"),
    ],
)
def test_a_pace_that_no_control_loop_has_is_refused(rate_hz: float | None, realtime: str, text: str):
    with pytest.raises(InvalidInput, match=text):
        check_pace(rate_hz, realtime)
