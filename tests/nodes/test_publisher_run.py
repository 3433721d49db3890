"""Publishing at a rate, from a source."""

import threading

import numpy as np
import pytest
from helpers.processes import SteppingClock
from helpers.robots import RRBOT, STAMP, SampleCollector, wait_for_reader

from zstate.clock import SystemClock
from zstate.errors import Closed, InvalidInput
from zstate.net.session import connect
from zstate.nodes.publisher import StatePublisher
from zstate.sources import JointReading, SineSource

NAN, INF = float("nan"), float("inf")
JOINTS = "zstate/r1/joint_states"


class ScriptedSource:
    """Positions that stay, or nothing on every second tick."""

    def __init__(self, every: int = 1, stamp: int | None = None) -> None:
        self._every, self._stamp = every, stamp
        self.reads = 0

    def read(self, stamp: int) -> JointReading | None:
        self.reads += 1
        return None if self.reads % self._every else JointReading(np.zeros(2), stamp=self._stamp)


@pytest.mark.parametrize("rate_hz", [0.0, -5.0, NAN, INF, 20_000.0])
def test_invalid_rate_is_refused(sessions, rate_hz: float):
    with (
        StatePublisher(sessions[0], RRBOT) as publisher,
        pytest.raises(InvalidInput, match="a rate is above 0"),
    ):
        publisher.run(ScriptedSource(), rate_hz)


def test_run_publishes_one_sample_per_tick_with_its_stamp(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1", clock=SteppingClock(STAMP)) as publisher:
        wait_for_reader(writer, JOINTS)
        report = publisher.run(ScriptedSource(), 30.0, seconds=2.0)
    assert (report.ticks, report.skipped, report.commanded_hz) == (60, 0, 30.0)
    assert report.rate_hz == pytest.approx(30.0, rel=1e-8)
    states = tap.joint_states(60)
    assert [state.stamp for state in states] == [STAMP + round(k * 1e9 / 30.0) for k in range(60)]
    assert [state.seq for state in states] == list(range(60))


def test_tick_without_a_reading_publishes_nothing_and_a_reading_keeps_its_stamp(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1", clock=SteppingClock(STAMP)) as publisher:
        wait_for_reader(writer, JOINTS)
        assert publisher.run(ScriptedSource(every=2, stamp=77), 10.0, seconds=1.0).ticks == 10
        publisher.publish([0.0, 0.0], stamp=78)
    assert [state.stamp for state in tap.joint_states(6)] == [77] * 5 + [78]


def test_close_from_another_thread_ends_run(sessions):
    publisher = StatePublisher(sessions[0], RRBOT, clock=SystemClock())
    reports = []
    runner = threading.Thread(target=lambda: reports.append(publisher.run(SineSource(RRBOT), 0.01)))
    runner.start()
    publisher.close()
    runner.join(1.0)
    assert not runner.is_alive()
    assert reports[0].ticks <= 1


def test_run_raises_closed_when_its_session_is_closed():
    with connect() as session, StatePublisher(session, RRBOT) as publisher:
        source = ScriptedSource()
        source.read = lambda stamp: session.close() or JointReading(np.zeros(2))
        with pytest.raises(Closed, match="session is closed"):
            publisher.run(source, 100.0, seconds=1.0)
