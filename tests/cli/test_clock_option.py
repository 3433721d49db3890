"""``--clock``: which time a command keeps."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest
from helpers.cli_runner import (
    RRBOT,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import repeated, until

from zstate import StatePublisher, TransformListener, connect, load_model
from zstate.buffer.buffer import feed_of
from zstate.buffer.frame_tree import FrameInfo
from zstate.clock import ManualClock
from zstate.nodes.clock import ClockPublisher

MS = 1_000_000
SECOND = 1_000_000_000


@contextmanager
def simulation(
    start: int = 5 * SECOND, speed: float = 10.0, limit: Callable[[], int] | None = None
) -> Iterator[None]:
    """Publishes a time that runs ``speed`` times as fast as the system's, but never beyond ``limit``."""
    with connect() as session, ClockPublisher(session) as publisher:
        began = time.monotonic_ns()

        def publish() -> None:
            stamp = start + round(speed * (time.monotonic_ns() - began))
            publisher.publish(stamp if limit is None else min(stamp, limit()))

        with repeated(publish):
            yield


def test_publish_uses_the_simulated_time_for_stamps_and_rate():
    start = 5 * SECOND
    with connect() as session, TransformListener(session, "rrbot") as listener:

        def joint_frames() -> list[FrameInfo]:
            return [frame for frame in listener.buffer.frames() if frame.kind == "joint"]

        def limit() -> int:
            # A rate skips what is more than 1 s late, so the time waits for a process that is slow.
            return max((frame.newest or start for frame in joint_frames()), default=start) + SECOND // 2

        with simulation(start, limit=limit):
            done = run_cli(
                "publish", RRBOT, "--source", "sine", "--clock", "sim", "--rate", "50", "--seconds", "5"
            )
        # Five simulated seconds: 250 ticks of 20 ms, exact by that time at any speed.
        assert "commanded 50 Hz, achieved 50.00 Hz" in done.stdout
        # Samples published before the two have connected arrive with the history.
        until(lambda: [frame.count for frame in joint_frames()] == [250, 250])
        frame = joint_frames()[0]
        assert frame.newest - frame.oldest == 249 * 20 * MS
        assert feed_of(listener.buffer).domain.domain_of("rrbot") == "sim"
        assert listener.stats.off_clock == 0


def test_missing_simulated_time_is_waited_for_with_a_note():
    def watch(command: Command) -> None:
        until(lambda: "waiting for the simulated time on zstate/clock" in command.stderr)
        time_of_all.enter_context(simulation())
        assert command.line().startswith("rrbot: a sine on 2 joints")
        until(lambda: "received zstate/clock: it is " in command.stderr)

    with ExitStack() as time_of_all:
        run_watched(watch, "joints", RRBOT, "--clock", "sim")


@pytest.mark.processes
def test_a_wait_for_the_time_ends_with_ctrl_c(spawn: Spawn):
    child = started(spawn, "publish", RRBOT, "--clock", "sim")
    until(lambda: "waiting for the simulated time" in child.stderr)
    interrupted(child)


def test_tf_gives_up_without_a_publisher_of_the_time():
    message = failure("tf", "world", "tool", "--once", "--timeout", "0.7", "--clock", "sim")
    assert "no time was received on 'zstate/clock' for 0.7 s" in message


def test_tf_measures_ages_with_the_clock_of_the_robot():
    with (
        simulation(5 * SECOND, speed=0.0),
        connect() as session,
        StatePublisher(session, load_model(RRBOT), "rrbot", clock=ManualClock(3 * SECOND, "sim")) as robot,
    ):
        stop = threading.Event()

        def publish() -> None:
            while not stop.wait(0.01):
                robot.publish([0.5, 0.5])

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            asked = ("tf", "world", "tool", "--once", "--json")
            unknown = json.loads(run_cli(*asked).stdout)
            known = json.loads(run_cli(*asked, "--clock", "sim").stdout)
        finally:
            stop.set()
            thread.join()
    assert (unknown["stamp"], unknown["age_s"]) == (3 * SECOND, None)
    assert known["age_s"] == pytest.approx(2.0)


def test_robots_on_another_clock_are_received_without_ages():
    def watch(command: Command) -> None:
        def is_followed() -> bool:
            report = json.loads(command.line())
            assert (report["age_s"], report["refused"]) == (None, {})
            return report["received"] > 0

        until(is_followed)

    with simulation(), published_robot():
        run_watched(watch, "monitor", "--robots", "--clock", "sim", "--json")


def test_first_robot_on_another_clock_does_not_exclude_others():
    with published_robot("a1", clock=ManualClock(5 * SECOND, "sim")), published_robot("b1"):
        for _ in range(3):
            assert json.loads(run_cli("tf", "b1/world", "b1/tool", "--once", "--json").stdout)["age_s"] < 60.0


def test_listen_counts_stamps_that_are_off_the_clock():
    def watch(command: Command) -> None:
        until(lambda: "  off the clock " in command.line())
        until(lambda: "the writer gives seconds where nanoseconds are meant" in command.stderr)

    with (
        connect() as session,
        StatePublisher(session, load_model(RRBOT), "rrbot") as robot,
        repeated(lambda: robot.publish([0.5, 0.5], stamp=time.time_ns() // SECOND)),
    ):
        run_watched(watch, "monitor", "--robots")


def test_unknown_clock_is_wrong_usage():
    assert "'noon' is not one of 'system', 'sim'" in failure("joints", RRBOT, "--clock", "noon", code=2)
