"""The age of commands without clocks in common, and how many of them may be under way."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from zstate.driving.messages import DriverState
from zstate.driving.transit import CommandAdmission, CommandAges, CommandWindow, DriverClock
from zstate.errors import MessageError

MS = 1_000_000
S = 1000 * MS
TTL = 250 * MS
HOST = 5
START = 1000 * S
"""Of the driver's clock."""


def state(instant: int, session: int = HOST) -> DriverState:
    return DriverState(0, session, "host", "ready", "", ("elbow",), TTL, instant=instant)


class Link:
    """A commander whose monotonic clock is ``ahead`` [ns] and runs at ``rate``, and its driver."""

    def __init__(self, ahead: int = 77 * S, rate: float = 1.0) -> None:
        self.ages, self.clock = CommandAges(HOST, TTL), DriverClock()
        self._ahead, self._rate = ahead, rate

    def there(self, now: int) -> int:
        """The commander's monotonic clock."""
        return round((now - START) * self._rate) + START + self._ahead

    def report(self, published: int, took: int) -> None:
        self.clock.update(state(published), self.there(published + took))

    def command(self, sent: int, took: int, session: int = 1) -> int:
        """The excess of a command."""
        return self.ages.excess(session, 0, sent + took, self.clock.at(self.there(sent)))


def test_the_excess_is_what_a_command_took_longer_than_the_fastest_of_its_session():
    link = Link()
    link.report(START, 5 * MS)
    assert link.command(START + 10 * MS, took=20 * MS) == 0
    assert link.command(START + 20 * MS, took=90 * MS) == pytest.approx(70 * MS, abs=MS // 10)
    assert link.command(START + 30 * MS, took=3 * MS) == 0
    assert link.command(START + 40 * MS, took=20 * MS) == pytest.approx(17 * MS, abs=MS // 10)
    assert link.command(START + 50 * MS, took=20 * MS, session=2) == 0


def test_a_first_command_that_has_waited_is_not_the_measure_of_the_others():
    link = Link()
    link.report(START, 5 * MS)
    for number in range(100):
        excess = link.command(START + number * 10 * MS, took=3 * S)
        assert excess == pytest.approx(3005 * MS, abs=5 * MS)
    assert link.command(START + S, took=10 * MS) == 0


def test_old_commands_stay_old_at_rest_after_silence_and_with_a_steady_delay():
    """What a bounded queue delivers after the death of its sender: all of it equally old."""
    link = Link()
    link.report(START, 5 * MS)
    assert link.command(START, took=5 * MS) == 0
    for number in range(1, 2000):
        assert link.command(START + number * 10 * MS, took=16 * S) > 15 * S
    assert link.command(START + 30 * S, took=3600 * S) > 3500 * S


@pytest.mark.parametrize("rate", [1.0 - 5e-4, 1.0, 1.0 + 5e-4], ids=["slow", "equal", "fast"])
def test_no_age_is_underestimated_by_more_than_the_shortest_way_there_and_back(rate: float):
    """For ten minutes of random delays; clocks that differ by what NTP may slew."""
    generator = np.random.default_rng(3)
    link, shortest, worst_over = Link(rate=rate), 10**18, 0
    for number in range(12_000):
        now = START + number * 50 * MS
        link.report(now, int(generator.uniform(2, 40)) * MS)
        way = int(generator.choice([3, 3, 3, 50, 2000]) * MS)
        shortest = min(shortest, way)
        excess = link.command(now + 45 * MS, way)
        assert excess + shortest + 2 * MS < TTL or way > TTL / 2
        assert way <= excess + shortest + 45 * MS
        worst_over = max(worst_over, excess - way)
    assert worst_over < 45 * MS


def test_a_command_that_answers_another_host_or_a_later_instant_is_refused():
    link = Link()
    with pytest.raises(MessageError, match="another host of this driver") as caught:
        link.ages.excess(1, 0, START, (HOST + 1, START))
    assert caught.value.reason == "late"
    with pytest.raises(MessageError, match=r"its echo is 1\.0 ms ahead"):
        link.ages.excess(1, 0, START, (HOST, START + MS))


def test_an_echo_is_less_by_a_thousandth_of_the_time_since_the_state_has_arrived():
    clock = DriverClock()
    clock.update(state(START), 0)
    assert clock.at(0) == (HOST, START)
    assert clock.at(10 * S) == (HOST, START + 10 * S - 10 * MS)


@pytest.mark.parametrize(("later", "way"), [(10 * S, 0), (10 * S + 1, 20 * MS)])
def test_the_state_that_was_fastest_is_used_for_ten_seconds(later: int, way: int):
    clock = DriverClock()
    clock.update(state(START), 0)
    clock.update(state(START + later - 20 * MS), later)  # it was under way for 20 ms, the first one for 0
    drift = 0 if way else later // 1000
    assert clock.at(later) == (HOST, START + later - way - drift)


def deadline(admission: CommandAdmission, arrived: int, seq: int = 0) -> int:
    return admission.deadline((arrived, seq, 1), TTL, arrived)


def test_commands_of_a_session_without_a_token_count_for_half_a_second_after_the_first():
    admission = CommandAdmission(CommandAges(HOST, TTL))
    for arrived in (START, START + 500 * MS):
        assert deadline(admission, arrived) == arrived + TTL
    with pytest.raises(MessageError, match="not announced as a commander") as caught:
        deadline(admission, START + 500 * MS + 1)
    assert caught.value.reason == "no claim"
    admission.set_announced(1, alive=True, now=START + 600 * MS)
    assert deadline(admission, START + 600 * MS) == START + 600 * MS + TTL


def test_commands_of_a_session_count_for_half_a_second_after_the_loss_of_its_token():
    admission = CommandAdmission(CommandAges(HOST, TTL))
    admission.set_announced(1, alive=True, now=START)
    deadline(admission, START + 60 * S)
    admission.set_announced(1, alive=False, now=START + 61 * S)
    deadline(admission, START + 61 * S + 500 * MS)
    with pytest.raises(MessageError, match="not announced as a commander"):
        deadline(admission, START + 61 * S + 500 * MS + 1)


def test_steps_of_the_system_clock_of_a_commander_do_not_matter():
    link = Link()
    link.report(START, MS)
    for stamp in (-(2**63), 2**63 - 1, 0):
        assert link.ages.excess(1, stamp, START + 10 * MS, link.clock.at(link.there(START + 9 * MS))) < MS


def test_without_an_echo_the_excess_is_counted_by_stamps():
    ages = CommandAges(HOST, TTL)
    assert ages.excess(1, 1_700_000_000 * S, START) == 0
    assert ages.excess(1, 1_700_000_000 * S + 10 * MS, START + 310 * MS) == pytest.approx(300 * MS, abs=MS)
    assert ages.excess(1, 1_700_000_001 * S, START + 990 * MS) == 0
    for session, stamp in enumerate((-(2**63), 2**63 - 1, 0), start=2):
        assert ages.excess(session, stamp, START) == 0


def test_without_an_echo_a_slow_clock_is_followed_and_one_that_is_set_back_is_not():
    ages = CommandAges(HOST, TTL)
    for second in range(3600):
        assert ages.excess(1, round(second * S * (1 - 5e-4)), START + second * S) < 2 * MS
    set_back = 3600 * S - 5 * S
    assert ages.excess(1, set_back, START + 3600 * S) > 3 * S


@pytest.mark.parametrize("idle_s", [250, 3600, 86_400])
def test_without_an_echo_a_command_after_a_pause_counts_for_at_most_one_ttl_longer(idle_s: int):
    for late in (0, TTL // 2, 2 * TTL, 3600 * MS):
        ages = CommandAges(HOST, TTL)
        assert ages.excess(1, 0, START) == 0
        sent = idle_s * S
        # A burst that has waited for equally long is equally old.
        for number in range(10):
            arrived = START + sent + late + number * MS
            assert ages.excess(1, sent + number * MS, arrived) > late - TTL - MS


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_without_an_echo_a_clock_without_ntp_is_followed_over_an_hour_without_commands(drift: float):
    ages = CommandAges(HOST, TTL)
    assert ages.excess(1, 0, START) == 0
    assert ages.excess(1, round(3600 * S * (1 - drift)), START + 3600 * S) == 0


class Admission:
    """The commands of a host, with clocks in common."""

    def __init__(self) -> None:
        self.admission = CommandAdmission(CommandAges(HOST, TTL))

    def is_valid(self, session: int, arrived: int) -> bool:
        """Whether a command of ``session`` counts that takes no time to arrive."""
        try:
            deadline = self.admission.deadline((arrived, 0, session), TTL, arrived, (HOST, arrived))
        except MessageError as error:
            assert error.reason == "no claim"
            return False
        assert deadline == arrived + TTL
        return True


@pytest.mark.parametrize("changes_after", [1, 40, 50, 10**6], ids=lambda every: f"{every} commands")
def test_sessions_without_a_token_command_for_half_a_second_however_often_they_change(changes_after: int):
    host = Admission()
    times = [START + number * 10 * MS for number in range(6000)]
    valid = [now for number, now in enumerate(times) if host.is_valid(100 + number // changes_after, now)]
    assert valid == [now for now in times if now <= START + 500 * MS]


def test_a_commander_whose_token_arrives_after_its_first_commands_is_not_interrupted():
    host = Admission()
    for session, start in ((1, START), (2, START + S), (3, START + 2 * S)):
        for number in range(80):
            now = start + number * 10 * MS
            if number == 40:
                host.admission.set_announced(session, True, now)
            assert host.is_valid(session, now)
        host.admission.set_announced(session, False, start + S)


def test_a_commander_is_valid_from_its_token_while_others_without_one_send():
    host = Admission()
    for number in range(200):
        host.is_valid(100 + number, START + number * 10 * MS)
    now = START + 2 * S
    assert not host.is_valid(1, now)
    host.admission.set_announced(1, True, now + MS)
    assert host.is_valid(1, now + 2 * MS)


def test_sessions_without_a_token_command_again_after_ten_seconds_without_any_of_them():
    host = Admission()
    for now in range(START, START + 5 * S, 10 * MS):
        host.is_valid(100, now)
    refused_at = START + 5 * S
    assert not host.is_valid(101, refused_at)
    assert not host.is_valid(101, refused_at + 9 * S)
    assert host.is_valid(101, refused_at + 20 * S)


def test_a_session_that_has_lost_its_token_goes_on_for_half_a_second_while_others_send_without_one():
    host = Admission()
    host.admission.set_announced(1, True, START)
    for now in range(START, START + 5 * S, 10 * MS):
        host.is_valid(100, now)
        assert host.is_valid(1, now)
    lost_at = START + 5 * S
    host.admission.set_announced(1, False, lost_at)
    assert host.is_valid(1, lost_at + 500 * MS)
    assert not host.is_valid(1, lost_at + 501 * MS)


class Queue:
    """A link that carries ``per_s`` commands, one after the other, in simulated time."""

    def __init__(self, per_s: float) -> None:
        self.window = CommandWindow()
        self._takes = round(S / per_s)
        self._under_way: deque[tuple[int, int, int]] = deque()
        self._free_at = self._seq = 0
        self.newest, self.excess = -1, 0
        self.longest = 0
        self.arrived = 0

    def run(self, start: int, seconds: float, rate_hz: float) -> None:
        """Sends at ``rate_hz`` what the window permits; the driver reports ten times a second."""
        self.longest = self.arrived = 0
        for number in range(round(seconds * rate_hz)):
            now = start + round(number * S / rate_hz)
            if self.window.has_room(now):
                self._free_at = max(self._free_at, now) + self._takes
                self._seq += 1
                self._under_way.append((now, self._free_at, self._seq))
                self.window.sent(self._seq, now)
            while self._under_way and self._under_way[0][1] <= now:
                sent, arrives, seq = self._under_way.popleft()
                self.newest, self.excess = seq, arrives - sent - self._takes
                self.longest = max(self.longest, self.excess)
                self.arrived += 1
            if number % round(rate_hz / 10) == 0:
                self.window.update(self.newest, self.excess, TTL, now)


def test_a_fast_link_carries_every_command_at_1_khz():
    queue = Queue(per_s=100_000.0)
    queue.run(0, 5.0, 1000.0)
    assert queue.arrived >= 4999


@pytest.mark.parametrize("per_s", [8.0, 15.0, 40.0])
def test_on_a_slow_link_commands_wait_for_less_than_the_ttl_once_the_first_have_drained(per_s: float):
    queue = Queue(per_s)
    queue.run(0, 20.0, 200.0)
    assert queue.longest > TTL
    queue.run(20 * S, 20.0, 200.0)
    assert queue.longest < TTL
    assert queue.arrived >= 20


def test_a_link_that_becomes_fast_again_carries_every_command():
    queue = Queue(per_s=10.0)
    queue.run(0, 20.0, 200.0)
    queue._takes = S // 100_000
    queue.run(20 * S, 5.0, 200.0)
    queue.run(25 * S, 5.0, 200.0)
    assert queue.arrived >= 999


def test_commands_that_are_lost_do_not_close_the_window():
    window = CommandWindow()
    for now in range(0, 3 * S, 100 * MS):  # halved, as none is confirmed
        if window.has_room(now):
            window.sent(now, now)
        window.update(-1, 0, TTL, now)
    sent = 0
    for now in range(3 * S, 13 * S, 10 * MS):
        if window.has_room(now):
            window.sent(now, now)
            sent += 1
    assert 9 <= sent <= 12


@pytest.mark.parametrize(("excess", "is_halved"), [(TTL // 4, False), (TTL // 4 + 1, True)])
def test_the_window_is_halved_if_the_newest_command_waited_for_more_than_a_quarter_of_the_ttl(
    excess: int, is_halved: bool
):
    window = CommandWindow()
    window.sent(0, 0)
    window.update(0, excess, TTL, MS)
    window.sent(1, MS)  # half of the one that was under way is one
    assert window.has_room(MS) != is_halved


class ConfirmedMeanwhile(deque[tuple[int, int]]):
    """Commands whose last one another thread takes out once this one has seen it."""

    def __bool__(self) -> bool:
        self.clear()
        return True


def test_a_command_that_is_confirmed_while_another_thread_asks_how_long_it_waits_raises_nothing():
    window = CommandWindow()
    assert window.waiting_ns(5 * MS) == 0
    window._unconfirmed = ConfirmedMeanwhile([(0, 2 * MS)])
    assert window.waiting_ns(5 * MS) in (0, 3 * MS)
