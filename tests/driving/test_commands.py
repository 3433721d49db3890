"""Targets of joints in all modes, and the limiter that follows them: what a driver writes in any sequence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import put

from zstate._util.refusals import Refusals
from zstate.driving.commands import NO_COLUMNS, NO_POSITIONS, Command, CommandReceiver, Targets
from zstate.driving.driver import Mode
from zstate.driving.limits import Limits
from zstate.driving.messages import JointCommand
from zstate.driving.setpoint_limiter import JointRate, Limited, SetpointLimiter
from zstate.driving.transit import CommandAdmission, CommandAges
from zstate.errors import InvalidInput, MessageError
from zstate.net.session import Session
from zstate.wire.joint_order import order_digest
from zstate.wire.messages import to_block
from zstate.wire.native import encode, encoding_of

DT = 0.004
TICK = 4_000_000
MS = 1_000_000
TTL = 6 * TICK
EXACT = 1e-9
COUNT = 6
MODES: tuple[Mode, ...] = ("position", "velocity", "effort")


class Robot:
    """Joints that are where, or as fast as, they are commanded to be; efforts accelerate them."""

    def __init__(self, positions: np.ndarray) -> None:
        self.positions = positions.copy()
        self.velocities = np.zeros(len(positions))

    def advance(self, setpoint: Limited, disturbance: np.ndarray) -> None:
        modes = np.array(setpoint.modes)
        efforts = np.zeros(len(modes)) if setpoint.efforts is None else setpoint.efforts
        pushed = self.velocities + (3.0 * efforts + disturbance) * DT
        self.velocities = np.where(modes == "effort", pushed, setpoint.velocities)
        moved = self.positions + self.velocities * DT
        self.positions = np.where(modes == "position", setpoint.positions, moved)


class Core:
    """What a host does with commands and readings at each tick, without network and driver."""

    def __init__(self, limits: Limits, modes: tuple[Mode, ...], robot: Robot) -> None:
        self.limits, self.robot, self.now = limits, robot, 0
        self.targets, self.limiter = Targets(COUNT), SetpointLimiter(limits, modes)
        self.last = self.start()
        self.seq = 0

    def start(self) -> Limited:
        """After a stop: the first setpoint is what is measured."""
        self.robot.velocities[:] = 0.0
        self.targets.clear()
        self.targets.start(self.now, self.robot.positions)
        self.last = self.limiter.start(self.robot.positions)
        return self.last

    def send(self, rates: dict[int, JointRate], ttl: int = TTL) -> None:
        columns = [column for column, rate in rates.items() if rate.mode == "position"]
        positions = np.array([rates[column].value for column in columns])
        others = {column: rate for column, rate in rates.items() if rate.mode != "position"}
        self.seq += 1
        at = np.array(columns, dtype=np.intp) if columns else NO_COLUMNS
        place = positions if columns else NO_POSITIONS
        command = Command(7, self.seq, at, place, self.now, self.now + ttl, rates=others)
        inside = np.clip(np.zeros(COUNT), self.limits.lower, self.limits.upper)
        try:
            self.limiter.check(self.targets.merged(command, inside))
        except InvalidInput:
            return
        self.targets.accept(command)

    def tick(self, *, is_read: bool = True) -> Limited:
        self.now += TICK
        if is_read:
            self.limiter.observe(self.robot.positions, self.robot.velocities, self.now)
        if not self.targets.is_live(self.now):
            return self.limiter.brake(DT)
        target = self.targets.current(self.now, lambda: self.last.positions)
        return self.limiter.step(target, DT, rates=self.targets.rates)


def random_limits(generator: np.random.Generator) -> Limits:
    has_range, has_acceleration = np.arange(COUNT) % 4 > 0, np.arange(COUNT) % 3 > 0
    return Limits(
        tuple(f"j{number}" for number in range(COUNT)),
        np.where(has_range, -generator.uniform(0.05, 2.0, COUNT), -np.inf),
        np.where(has_range, generator.uniform(0.05, 2.0, COUNT), np.inf),
        generator.uniform(0.2, 8.0, COUNT),
        np.where(has_acceleration, generator.uniform(1.0, 80.0, COUNT), np.inf),
        effort=generator.uniform(0.5, 5.0, COUNT),
    )


def random_command(
    generator: np.random.Generator, limits: Limits, modes: tuple[Mode, ...]
) -> dict[int, JointRate]:
    columns = generator.choice(COUNT, generator.integers(1, COUNT), replace=False).tolist()
    low, high = np.maximum(limits.lower, -3.0), np.minimum(limits.upper, 3.0)
    values: dict[Mode, np.ndarray] = {
        "position": generator.uniform(low, high),
        "velocity": generator.uniform(-1.5, 1.5, COUNT) * limits.velocity,
        "effort": generator.uniform(-1.5, 1.5, COUNT) * limits.effort,
    }
    picked = {column: modes[generator.integers(len(modes))] for column in columns}
    return {column: JointRate(mode, float(values[mode][column])) for column, mode in picked.items()}


@pytest.mark.parametrize("count", [800, pytest.param(2_500, marks=pytest.mark.soak)])
@pytest.mark.parametrize("modes", [MODES, MODES[:2], MODES[1:], MODES[1:2]], ids="-".join)
@pytest.mark.long
def test_no_sequence_of_modes_commands_silences_and_stops_exceeds_a_limit(
    modes: tuple[Mode, ...], count: int
):
    generator = np.random.default_rng(19)
    limits = random_limits(generator)
    robot = Robot(np.zeros(COUNT))
    core = Core(limits, modes, robot)
    worst_step = worst_change = 0.0
    seen: set[tuple[Mode, Mode]] = set()
    braked = 0
    for _ in range(count):  # of each of four kinds of drivers
        match generator.choice(["command", "command", "command", "silence", "stop", "push"]):
            case "command":
                core.send(random_command(generator, limits, modes), int(generator.integers(1, 12)) * TICK)
            case "silence":
                core.now += 20 * TICK
            case "stop":
                core.start()
            case "push" if set(core.last.modes) == {"position"}:  # a stopped joint is moved by hand
                robot.positions = robot.positions + generator.normal(0.0, 0.05, COUNT)
                core.start()
        for _ in range(generator.integers(1, 12)):
            before, measured = core.last, robot.positions.copy()
            is_read = generator.random() > 0.05
            setpoint = core.tick(is_read=is_read)
            seen.update(zip(before.modes, setpoint.modes, strict=True))
            braked += len(setpoint.braked)
            was_pushed = np.array(before.modes) == "effort"
            is_pushed = np.array(setpoint.modes) == "effort"
            at = np.array(setpoint.modes) == "position"
            steps = np.abs(setpoint.positions - measured)[at] / (limits.velocity * DT)[at]
            if is_read or not was_pushed[at].any():
                worst_step = max(worst_step, steps.max(initial=0.0))
            assert (
                np.abs(setpoint.velocities[~is_pushed]) <= limits.velocity[~is_pushed] * (1 + EXACT)
            ).all()
            compared = ~is_pushed & ~was_pushed & np.isfinite(limits.acceleration)
            changes = np.abs(setpoint.velocities - before.velocities)[compared]
            worst_change = max(
                worst_change, (changes / (limits.acceleration[compared] * DT)).max(initial=0.0)
            )
            if setpoint.efforts is not None:
                assert (np.abs(setpoint.efforts) <= limits.effort).all()
                assert (setpoint.efforts[~is_pushed] == 0.0).all()
            if generator.random() < 0.03:  # the write has failed; the joints go on as they were commanded
                core.limiter.resume(before, DT)
                setpoint = before
            core.last = setpoint
            robot.advance(setpoint, generator.normal(0.0, 5.0, COUNT))
            # Efforts and hands move joints out of their range; nothing else does, nor further out.
            allowed = limits.containing(measured)
            outside = (robot.positions > allowed.upper + EXACT) | (robot.positions < allowed.lower - EXACT)
            assert not (outside & ~is_pushed & ~was_pushed).any()
    assert 1.0 - EXACT < worst_change <= 1.0 + EXACT
    assert worst_step <= 1.0 + EXACT
    assert seen >= {(one, other) for one in modes for other in modes} - {("effort", "effort")}
    assert bool(braked) == ("effort" in modes)


def _send(targets: Targets, session: int, arrived: int, ttl_ns: int = TTL) -> None:
    targets.check_session(session, arrived, str)
    at = np.array([0], dtype=np.intp)
    targets.accept(Command(session, arrived, at, np.zeros(1), arrived, arrived + ttl_ns))


def test_a_velocity_whose_command_has_expired_ends_while_another_joint_is_commanded():
    targets, turning = Targets(2), JointRate("velocity", 0.5)
    targets.accept(Command(1, 0, NO_COLUMNS, NO_POSITIONS, 0, TTL, rates={1: turning}))
    targets.accept(Command(1, 1, np.array([0]), np.zeros(1), 0, 2 * TTL))
    targets.current(TTL - 1, lambda: np.zeros(2))
    assert targets.rates == {1: turning}
    targets.current(TTL, lambda: np.zeros(2))
    assert targets.rates == {1: None}
    assert targets.is_live(TTL)


def test_a_commander_whose_token_vanishes_for_a_moment_stays_the_only_one_while_it_sends():
    targets = Targets(1)
    _send(targets, 1, TICK)
    targets.set_announced(1, alive=False, now=2 * TICK)
    _send(targets, 1, 3 * TICK)
    with pytest.raises(MessageError, match="while commands of 1 are valid"):
        _send(targets, 2, 4 * TICK)
    targets.set_announced(1, alive=False, now=4 * TICK)  # it has closed: the next one need not wait
    _send(targets, 2, 4 * TICK)


def test_the_end_of_a_commander_may_overtake_its_last_command():
    """The token and the commands of a commander take different ways; 0.2 s of silence decide."""
    targets, ttl_ns = Targets(1), 10_000 * MS
    _send(targets, 1, 100 * MS, ttl_ns)
    targets.set_announced(1, alive=False, now=101 * MS)
    _send(targets, 1, 150 * MS, ttl_ns)
    with pytest.raises(MessageError, match="while commands of 1 are valid"):
        _send(targets, 2, 350 * MS)
    _send(targets, 2, 351 * MS)


def test_a_commander_without_a_token_that_still_sends_after_a_while_stays_the_only_one():
    targets, ttl_ns = Targets(1), 10_000 * MS
    targets.set_announced(1, alive=False, now=101 * MS)
    _send(targets, 1, 302 * MS, ttl_ns)
    with pytest.raises(MessageError, match="while commands of 1 are valid"):
        _send(targets, 2, 600 * MS)


class Receiver:
    """The receiver of a driver that grants 250 ms, and a program of session 7 that sends it commands."""

    def __init__(self, session: Session, receiver: CommandReceiver, refusals: Refusals) -> None:
        self._session, self._receiver, self._refusals = session, receiver, refusals

    def receive(self, payload: bytes) -> Command | str:
        """A command as it is received, or the reason of its refusal."""
        put(self._session, "zstate/arm/joint_commands", payload, encoding_of(JointCommand))
        found: list[Command] = []
        until(lambda: found.extend(self._receiver.drain()) or found or self._refusals.counts)
        return found[0] if found else next(iter(self._refusals.counts))


@contextmanager
def receiving(session: Session, joint_names: Sequence[str]) -> Iterator[Receiver]:
    refusals, admission = Refusals(), CommandAdmission(CommandAges(5, 250 * MS))
    admission.set_announced(7, alive=True, now=0)
    options = {"admission": admission, "modes": ("position",)}
    with CommandReceiver(session, "arm", joint_names, 250 * MS, refusals, **options) as receiver:
        yield Receiver(session, receiver, refusals)


def command_of(joint_names: Sequence[str], ttl: int = 0) -> bytes:
    names = tuple(joint_names)
    block = to_block([0.1] * len(names))
    return encode(JointCommand(0, 0, 7, order_digest(names), block, names=names, ttl=ttl))


@pytest.mark.parametrize(("ttl", "valid"), [(0, 250 * MS), (60 * MS, 60 * MS), (250 * MS, 250 * MS)])
def test_a_command_moves_its_joints_until_its_own_ttl_has_passed_or_without_one_that_of_the_driver(
    sessions: tuple[Session, Session], ttl: int, valid: int
):
    with receiving(sessions[0], ("elbow",)) as receiver:
        command = receiver.receive(command_of(("elbow",), ttl))
    assert isinstance(command, Command)
    targets = Targets(1)
    targets.accept(command)
    assert targets.is_live(command.arrived + valid - 1)
    assert not targets.is_live(command.arrived + valid)


def test_a_ttl_that_is_longer_than_the_driver_grants_is_refused(sessions: tuple[Session, Session]):
    with receiving(sessions[0], ("elbow",)) as receiver:
        assert receiver.receive(command_of(("elbow",), 250 * MS + 1)) == "ttl"


@pytest.mark.parametrize("joint_names", [("elbow",), ("shoulder", "größe", "wrist")])
def test_a_command_has_1024_bytes_100_for_each_joint_and_two_for_each_of_their_names(
    sessions: tuple[Session, Session], joint_names: tuple[str, ...]
):
    most = 1024 + 100 * len(joint_names) + 2 * len(", ".join(joint_names).encode())
    payload = command_of(joint_names)
    # One further element of the array, which readers ignore: a bin with its length in two bytes.
    filler = most - len(payload) - 3
    largest = bytes([payload[0] + 1]) + payload[1:] + b"\xc5" + filler.to_bytes(2) + bytes(filler)
    with receiving(sessions[0], joint_names) as receiver:
        assert isinstance(receiver.receive(largest), Command)
        assert receiver.receive(largest + b"\0") == "too large"
