"""Slow, frozen and many processes, and their effect on others."""

from __future__ import annotations

import signal
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.fault_processes import RECOVERED_WITHIN_S, Start, client
from helpers.processes import mounted_disk, until

from zstate.recording.reader import RecordingReader

pytestmark = pytest.mark.processes

FROZEN_S = 3.0


def pass_time(seconds: float) -> None:
    deadline = time.monotonic() + seconds
    until(lambda: time.monotonic() >= deadline, timeout_s=seconds + 5.0)


def test_writer_frozen_for_3_s_is_stale_and_recovers(start: Start, endpoint: str):
    start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint))
    reader = start("reader", session=client(endpoint))
    assert reader.query("after", "r1", 0)
    reader.query("watch", "r1")
    publisher.freeze()
    pass_time(FROZEN_S)
    publisher.signal(signal.SIGCONT)
    thawed_at = time.time_ns()
    received_at = reader.query("after", "r1", thawed_at)
    assert reader.query("after", "r1", received_at)
    watched = reader.query("watched", "r1")
    publisher.query("mark", 3.0)
    assert reader.query("mark", "r1", 3.0)
    recovery_s = (received_at - thawed_at) * 1e-9
    print(f"writer frozen for 3 s: received again {recovery_s:.3f} s after it continues")
    assert watched["stale"] > 0
    assert (watched["old_as_fresh"], watched["went_back"]) == (0, 0)
    assert recovery_s < RECOVERED_WITHIN_S


@pytest.mark.parametrize("way", ["through a router", "from peer to peer"])
def test_frozen_reader_blocks_neither_the_writer_nor_other_readers(start: Start, endpoint: str, way: str):
    session = client(endpoint) if way == "through a router" else {}
    if session:
        start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=session, rate_hz=200.0)
    frozen, other = (start("reader", session=session) for _ in range(2))
    for reader in (frozen, other):
        assert reader.query("after", "r1", 0)
    other.query("watch", "r1")
    frozen.freeze()
    pass_time(FROZEN_S)
    watched, stats = other.query("watched", "r1"), other.query("stats")
    closing_s = publisher.query("leave")
    print(f"a reader frozen, {way}: the other's longest gap {watched['gap_ns'] * 1e-9:.3f} s, the writer's ")
    print(f"session closes in {closing_s:.3f} s")
    assert stats["missed"] == 0
    assert watched["gap_ns"] < FROZEN_S * 1e9 / 2, (
        "the other reader waits for no frozen one; a busy machine pauses"
    )
    assert closing_s < RECOVERED_WITHIN_S
    frozen.signal(signal.SIGCONT)
    assert frozen.query("census")


def test_slow_reader_loses_samples_and_a_fast_reader_loses_neither_samples_nor_time(
    start: Start, endpoint: str
):
    start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint), rate_hz=500.0)
    fast = start("reader", session=client(endpoint))
    assert fast.query("after", "r1", 0)
    alone = statistics.median(fast.query("latencies", "r1", 250))
    slow = start("reader", session=client(endpoint), robot="r1", busy_ms=50.0)
    with_slow = statistics.median(fast.query("latencies", "r1", 250))
    until(lambda: slow.query("stats")["dropped"] > 0, 60.0)  # buffers of the system are full
    publisher.query("pause")
    slow_stats, fast_stats = slow.query("stats"), fast.query("stats")
    print(f"a slow reader: median latency of the fast one {alone / 1e3:.0f} us, now {with_slow / 1e3:.0f} us")
    print(f"with it; dropped: the slow one {slow_stats['dropped']}, the fast one {fast_stats['dropped']}")
    assert (fast_stats["dropped"], fast_stats["missed"], slow_stats["missed"]) == (0, 0, 0)
    assert with_slow / alone < 4.5  # 1.5, and a factor of 3 for a busy machine


@pytest.mark.parametrize(
    ("count", "seconds"),
    [pytest.param(3, 1, id="three"), pytest.param(20, 3, id="twenty", marks=pytest.mark.soak)],
)
def test_many_readers_of_one_robot_receive_all_samples_and_latched_values(
    start: Start, endpoint: str, count: int, seconds: int
):
    start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint), mark=20.0)
    readers = [start("reader", session=client(endpoint), wait=False) for _ in range(count)]
    for reader in readers:
        reader.wait_ready()
    for reader in readers:
        assert reader.query("after", "r1", 0)
    all_ready_at = time.time_ns()
    for reader in readers:
        assert reader.query("after", "r1", all_ready_at + seconds * 1_000_000_000)
        assert reader.query("mark", "r1", 20.0)
    last = publisher.query("pause")
    for reader in readers:
        assert reader.query("after", "r1", last - 1)
        stats = reader.query("stats")
        assert stats["received"] > 100 * seconds - 10  # at 100 Hz, less a rounding
        assert (stats["missed"], stats["dropped"], stats["late"], stats["refused"]) == (0, 0, 0, {})


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with mounted_disk(tmp_path / "disk", "256k") as place:
        yield place


@pytest.mark.disk
def test_recorder_with_a_full_disk_reports_it_and_others_are_unaffected(
    start: Start, endpoint: str, small_disk: Path
):
    start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint), rate_hz=1000.0)
    reader = start("reader", session=client(endpoint))
    recorder = start("recorder", session=client(endpoint), path=str(small_disk / "run.mcap"))
    assert reader.query("after", "r1", 0)
    reader.query("watch", "r1")
    until(lambda: recorder.query("ended"), timeout_s=30.0)
    reason, written = recorder.query("ended"), recorder.query("written")
    publisher.query("pause")
    watched, stats = reader.query("watched", "r1"), reader.query("stats")
    print(f"a full disk: {reason}; the reader's longest gap {watched['gap_ns'] * 1e-9:.3f} s")
    assert reason.startswith("RecordingError")
    assert "No space left" in reason
    assert (stats["missed"], stats["dropped"], stats["refused"]) == (0, 0, {})
    assert recorder.query("census")
    with RecordingReader(small_disk / "run.mcap") as recording:
        assert not recording.complete
        assert 0 < sum(1 for _ in recording.records()) <= written
