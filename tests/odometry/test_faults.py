"""Faults of sensors: no estimate is wrong by more than it claims unless a sentence names the fault.

Each row is a drive on a level floor, whose truth is known, with one fault of a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from helpers.base_motion import stamp_at
from helpers.drives import (
    Call,
    Drive,
    Errors,
    Run,
    compass_calls,
    imu_calls,
    joint_calls,
    legs_of,
    merged,
    new_estimator,
    run,
    tilted_mount,
    velocity_calls,
)

from zstate.odometry import DiffDrive
from zstate.odometry.invariant_filter import Floats

WHEELS = DiffDrive("left", "right", radius=0.1, track=0.4)
MOUNT = tilted_mount()
THREE_SIGMA = 3.5
"""What the larger of two Mahalanobis distances, of x and y and of the yaw, exceeds once in 370 cases."""
SENTENCE_S = 5.0
"""A fault is named at most so late."""

ROUND = legs_of([(5.0, 0.0), (20.0, 0.5), (25.0, 0.3), (40.0, 0.5), (44.0, 0.0), (57.0, 0.4)])
ROUND_TURNS = legs_of(
    [(8.0, 0.0), (14.0, 0.4), (20.0, 0.0), (25.0, -0.5), (40.0, 0.2), (44.0, 0.0), (57.0, -0.3)]
)
STRAIGHT = legs_of([(5.0, 0.0), (57.0, 0.5)])
NO_TURNS = legs_of([])
AT_REST = legs_of([])


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A drive of ``along`` and ``turning`` whose calls are changed by ``change``.

    One sample in ``imu_step`` of an IMU at 100 Hz is used. ``bound`` [m] is the largest error at the end that
    still is of use. ``named``: a sentence of health() is due, even if the estimate is inside its claim, and
    after ``within_s`` if it is outside.
    """

    bound: float
    along: Callable[[Floats], Floats] = ROUND
    turning: Callable[[Floats], Floats] = ROUND_TURNS
    seconds: float = 26.0
    imu_step: int = 2
    change: Callable[[list[Call]], list[Call]] = list
    distort: Callable[[float, Floats, Floats], None] | None = None
    wheels: DiffDrive = WHEELS
    velocity: tuple[float, float] | None = None
    compass: float | None = None
    gyro_bias: float | None = None
    stamp_of: Callable[[Call], int] | None = None
    named: bool = False
    within_s: float = SENTENCE_S


def imu_where(at: Callable[[float], bool], change: Callable[[Floats, Floats], tuple[Floats, Floats]]) -> Any:
    """Samples of the IMU at instants changed: ``change`` gets rate and force in the axes of the base."""
    turn = MOUNT.matrix[:3, :3]

    def changed(calls: list[Call]) -> list[Call]:
        out: list[Call] = []
        for call in calls:
            if call.kind == "imu" and at(call.t):
                rate, force = (np.array(part) for part in change(*(turn @ part for part in call.values)))
                call = call._replace(values=(turn.T @ rate, turn.T @ force))  # noqa: PLW2901
            out.append(call)
        return out

    return changed


def once(t: float) -> Callable[[float], bool]:
    return lambda at: abs(at - t) < 0.004


def between(begin: float, end: float) -> Callable[[float], bool]:
    return lambda at: begin <= at < end


def add(rate: Sequence[float] = (0, 0, 0), force: Sequence[float] = (0, 0, 0)) -> Any:
    return lambda w, f: (w + rate, f + force)


def set_to(rate: float | None = None, force: float | None = None) -> Any:
    """All numbers of the samples in the axes of the IMU, one by one."""

    def changed(w: Floats, f: Floats) -> tuple[Floats, Floats]:
        turn = MOUNT.matrix[:3, :3]
        return (
            w if rate is None else turn @ np.full(3, rate),
            f if force is None else turn @ np.full(3, force),
        )

    return changed


def without(kinds: Sequence[str], begin: float, end: float) -> Callable[[list[Call]], list[Call]]:
    """No calls of ``kinds`` in between."""
    return lambda calls: [call for call in calls if not (call.kind in kinds and begin <= call.t < end)]


def held(kind: str, begin: float, end: float) -> Callable[[list[Call]], list[Call]]:
    """Calls of ``kind`` that repeat the values of the last one before ``begin``, with new stamps."""

    def changed(calls: list[Call]) -> list[Call]:
        out, last = list[Call](), None
        for call in calls:
            if call.kind == kind:
                if last is not None and begin <= call.t < end:
                    call = call._replace(values=last)  # noqa: PLW2901
                else:
                    last = call.values
            out.append(call)
        return out

    return changed


def shifted(chosen: Callable[[Call], bool], by_s: float) -> Callable[[Call], int]:
    return lambda call: stamp_at(call.t) + (round(by_s * 1e9) if chosen(call) else 0)


def first_of(kind: str, t: float) -> Callable[[Call], bool]:
    """The first call of ``kind`` from ``t`` on, once."""
    found: list[float] = []

    def is_it(call: Call) -> bool:
        if call.kind == kind and call.t >= t and (not found or found[0] == call.t):
            found[:] = [call.t]
            return True
        return False

    return is_it


def spinning(begin: float, end: float, speed: float) -> Callable[[float, Floats, Floats], None]:
    """Both wheels turn by ``speed`` [m/s] more than the base moves."""

    def distort(t: float, linear: Floats, _: Floats) -> None:
        if begin <= t < end:
            linear[0] += speed

    return distort


def blocked(begin: float, end: float) -> Callable[[float, Floats, Floats], None]:
    """The wheels stand while the base moves on."""

    def distort(t: float, linear: Floats, angular: Floats) -> None:
        if begin <= t < end:
            linear[:] = angular[:] = 0.0

    return distort


# At rest for 5 s, 0.04 rad/s while the wheels stand, then a drive.
SLOW_TURN = legs_of([(1.0, 0.0), (6.0, 0.04), (10.0, 0.0), (16.0, 0.3)])
CREEP_FROM_START = legs_of([(6.0, 0.043), (10.0, 0.0), (16.0, 0.3)])
LATE_START = legs_of([(10.0, 0.0), (57.0, 0.5)])


def wheels_stand(until: float) -> Callable[[float, Floats, Floats], None]:
    return blocked(0.0, until)


ALL = ("imu", "joints", "velocity", "heading")
LONG = 130.0
PAUSE_AT_REST = legs_of([(5.0, 0.0), (15.0, 0.5), (125.0, 0.0), (145.0, 0.5)])
PAUSE_TURNS = legs_of([(8.0, 0.0), (12.0, 0.3), (126.0, 0.0), (132.0, 0.4)])
SHORT_PAUSE = legs_of([(5.0, 0.0), (15.0, 0.5), (38.0, 0.0), (58.0, 0.5)])
SHORT_TURNS = legs_of([(8.0, 0.0), (12.0, 0.3), (40.0, 0.0), (46.0, 0.4)])
MOVED_LONG = legs_of([(5.0, 0.0), (15.0, 0.5), (60.0, 0.0), (66.0, 0.5), (125.0, 0.0), (145.0, 0.5)])
MOVED_SHORT = legs_of([(5.0, 0.0), (15.0, 0.5), (24.0, 0.0), (29.0, 0.5), (38.0, 0.0), (58.0, 0.5)])

FAULTS: dict[str, Fault] = {
    "none": Fault(bound=1.0),
    # shocks and absurd samples
    "one sample of 16 g ahead": Fault(bound=1.0, change=imu_where(once(12.0), add(force=(160.0, 0, 0)))),
    "one sample of 16 g up": Fault(bound=1.0, change=imu_where(once(12.0), add(force=(0, 0, 160.0)))),
    "one sample of 8 g aside": Fault(bound=1.0, change=imu_where(once(12.0), add(force=(0, 80.0, 0)))),
    "three samples of 16 g, which swing back": Fault(
        bound=1.0, change=imu_where(between(12.0, 12.025), add(force=(0, 0, 160.0)))
    ),
    "one gyro sample of 35 rad/s about x": Fault(
        bound=1.0, change=imu_where(once(12.0), add(rate=(35.0, 0, 0)))
    ),
    "one gyro z sample of 100 rad/s, straight": Fault(
        bound=5.0, along=STRAIGHT, turning=NO_TURNS, change=imu_where(once(12.0), add(rate=(0, 0, 100.0)))
    ),
    "one gyro sample of 1e154": Fault(bound=1.0, change=imu_where(once(12.0), set_to(rate=1e154))),
    "one gyro sample of 1e200": Fault(bound=1.0, change=imu_where(once(12.0), set_to(rate=1e200))),
    "one accel sample of 1e308": Fault(bound=1.0, change=imu_where(once(12.0), set_to(force=1e308))),
    "accelerometer reads zeros for the first 3 s": Fault(
        bound=1.5, change=imu_where(between(-1.0, 3.0), set_to(force=0.0))
    ),
    "accelerometer reads zeros": Fault(
        bound=math.inf, change=imu_where(between(-1.0, 1e3), set_to(force=0.0)), named=True
    ),
    # stamps
    "one IMU stamp an hour ahead": Fault(bound=1.0, stamp_of=shifted(first_of("imu", 12.0), 3600.0)),
    "one joints stamp an hour ahead": Fault(bound=1.0, stamp_of=shifted(first_of("joints", 12.0), 3600.0)),
    "one joints stamp 3 s ahead": Fault(bound=1.0, stamp_of=shifted(first_of("joints", 12.0), 3.0)),
    "clock of the wheels 1.1 s ahead": Fault(
        bound=math.inf, stamp_of=shifted(lambda call: call.kind == "joints", 1.1), named=True
    ),
    # gyro
    "mirrored gyro": Fault(
        bound=math.inf,
        seconds=36.0,
        change=imu_where(between(-1, 1e3), lambda w, f: (w * (1, 1, -1), f)),
        named=True,
    ),
    "frozen IMU from 12 s on": Fault(bound=10.0, change=held("imu", 12.0, 1e3), named=True),
    "frozen IMU for 5 s": Fault(bound=3.0, change=held("imu", 12.0, 17.0), named=True),
    "gyro jumps by 0.02 rad/s": Fault(
        # Wheels show it in the mean of some ten seconds.
        bound=5.0,
        seconds=40.0,
        change=imu_where(between(12.0, 1e3), add(rate=(0, 0, 0.02))),
        within_s=15.0,
    ),
    "IMU at 10 Hz": Fault(bound=1.5, imu_step=10),
    "IMU at 20 Hz": Fault(bound=1.5, imu_step=5),
    "IMU silent for 5 s": Fault(bound=3.0, change=without(["imu"], 12.0, 17.0), named=True),
    "mount wrong by 5 degrees": Fault(
        bound=2.0,
        change=imu_where(
            between(-1, 1e3), lambda w, f: (_tilted(math.radians(5.0)) @ w, _tilted(math.radians(5.0)) @ f)
        ),
    ),
    # wheels
    "wheels spin for 5 s while driving": Fault(bound=4.0, distort=spinning(14.0, 19.0, 0.7), named=True),
    "wheels spin for 5 s at rest": Fault(
        bound=4.0,
        distort=spinning(22.0, 27.0, 0.7),
        along=legs_of([(5.0, 0.0), (17.0, 0.5)]),
        turning=legs_of([(8.0, 0.0), (15.0, 0.2)]),
        seconds=34.0,
        named=True,
    ),
    "wheels blocked for 5 s": Fault(bound=4.0, distort=blocked(14.0, 19.0), named=True),
    "encoders frozen from 15 s on": Fault(bound=math.inf, change=held("joints", 15.0, 1e3), named=True),
    "wheels silent for 5 s": Fault(bound=3.0, change=without(["joints"], 12.0, 17.0)),
    # sigmas that are wider than the speed
    "0.3 m/s with sigma 0.5": Fault(
        bound=2.5, along=legs_of([(5.0, 0.0), (20.0, 0.3)]), velocity=(0.002, 0.5)
    ),
    "0.15 m/s with sigma 0.2": Fault(
        bound=1.5, along=legs_of([(5.0, 0.0), (20.0, 0.15)]), velocity=(0.002, 0.2)
    ),
    "0.03 m/s with sigma 0.032": Fault(
        bound=0.5, along=legs_of([(5.0, 0.0), (55.0, 0.03)]), turning=NO_TURNS, velocity=(0.001, 0.032)
    ),
    # bias and turns
    "a turn of 0.04 rad/s while the wheels stand": Fault(
        bound=4.0, along=LATE_START, turning=SLOW_TURN, distort=wheels_stand(8.0), gyro_bias=0.003
    ),
    "a turn of 0.04 rad/s from the start while the wheels stand": Fault(
        bound=8.0, along=LATE_START, turning=CREEP_FROM_START, distort=wheels_stand(8.0), gyro_bias=0.0
    ),
    "the same with a compass": Fault(
        bound=4.0,
        along=LATE_START,
        turning=CREEP_FROM_START,
        distort=wheels_stand(8.0),
        gyro_bias=0.0,
        compass=0.0,
    ),
    # compass
    "compass with a hard iron of 42 degrees, straight, then turns": Fault(
        bound=1.5,
        along=legs_of([(5.0, 0.0), (67.0, 0.5)]),
        turning=legs_of([(30.0, 0.0), (50.0, 0.3), (65.0, -0.3)]),
        seconds=70.0,
        compass=math.radians(42.0),
        named=True,
    ),
    "compass with a hard iron of 42 degrees": Fault(bound=1.5, compass=math.radians(42.0), named=True),
    # pauses of all sources
    "pause of 13 s at rest": Fault(
        bound=1.0, along=SHORT_PAUSE, turning=SHORT_TURNS, seconds=48.0, change=without(ALL, 20.0, 33.0)
    ),
    "pause of 100 s at rest": Fault(
        bound=1.0, along=PAUSE_AT_REST, turning=PAUSE_TURNS, seconds=150.0, change=without(ALL, 20.0, 120.0)
    ),
    "pause of 5 s while driving": Fault(
        bound=4.0, along=STRAIGHT, turning=ROUND_TURNS, change=without(ALL, 26.0, 31.0)
    ),
    "pause of 5 s while driving straight": Fault(
        bound=4.0, along=STRAIGHT, turning=NO_TURNS, change=without(ALL, 26.0, 31.0)
    ),
    "pause of 13 s in which the base was moved": Fault(
        bound=4.0, along=MOVED_SHORT, turning=SHORT_TURNS, seconds=48.0, change=without(ALL, 20.0, 33.0)
    ),
    "pause of 100 s in which the base was moved": Fault(
        bound=4.0, along=MOVED_LONG, turning=PAUSE_TURNS, seconds=150.0, change=without(ALL, 20.0, 120.0)
    ),
}

SIMILAR = {
    "none",
    "one sample of 16 g up",
    "one sample of 8 g aside",
    "one gyro sample of 1e200",
    "one accel sample of 1e308",
    "one IMU stamp an hour ahead",
    "frozen IMU for 5 s",
    "IMU at 20 Hz",
    "0.3 m/s with sigma 0.5",
    "0.15 m/s with sigma 0.2",
    "a turn of 0.04 rad/s from the start while the wheels stand",
    "pause of 100 s at rest",
    "pause of 5 s while driving straight",
    "pause of 13 s in which the base was moved",
}
"""Faults of a kind that another row or test has as well."""

UNSEEN = {
    "radius 20 % wrong": Fault(bound=math.inf, wheels=DiffDrive("left", "right", radius=0.12, track=0.4))
}
"""What no other sensor contradicts: for the table of a benchmark, not for a claim."""


def _tilted(angle: float) -> Floats:
    cosine, sine = math.cos(angle), math.sin(angle)
    about_x = np.array(((1.0, 0.0, 0.0), (0.0, cosine, -sine), (0.0, sine, cosine)))
    about_y = np.array(((cosine, 0.0, sine), (0.0, 1.0, 0.0), (-sine, 0.0, cosine)))
    return about_y @ about_x


def played(fault: Fault, seed: int = 0) -> Run:
    """The fault through an estimator."""
    random = np.random.default_rng(seed)
    drive = Drive(fault.seconds, fault.along, fault.turning)
    gyro_bias = 0.005 if fault.gyro_bias is None else fault.gyro_bias
    calls = imu_calls(drive, MOUNT, random, biases=(gyro_bias, 0.05))[:: fault.imu_step]
    if fault.velocity is None:
        calls = merged(calls, joint_calls(drive, WHEELS, random, distort=fault.distort))
    else:
        sigma, stated = fault.velocity
        calls = merged(calls, velocity_calls(drive, random, sigma=sigma, stated=stated))
    if fault.compass is not None:
        calls = merged(calls, compass_calls(drive, random, hard_iron=fault.compass))
    wheels = {} if fault.velocity else {"wheels": fault.wheels}
    return run(new_estimator(MOUNT, **wheels), drive, fault.change(calls), stamp_of=fault.stamp_of)


def is_named(found: Run, at: float, within_s: float) -> bool:
    """Whether a sentence of any source stands between ``at`` and so many seconds later."""
    return any(first <= at + within_s and at <= last for first, last, _ in found.sentences.values())


def findings(fault: Fault, found: Run) -> list[str]:
    """What is not as it must be; empty if nothing."""
    wrong: list[str] = []
    if not found.errors:
        if not fault.named or not found.last:
            wrong.append("there is no state, and no sentence says why")
        return wrong
    silent: list[Errors] = [
        one
        for one in found.errors
        if not one.sigmas <= THREE_SIGMA and not is_named(found, one.t, fault.within_s)
    ]
    if silent:
        worst = max(silent, key=lambda one: one.sigmas)
        wrong.append(
            f"{worst.sigmas:.1f} sigmas off at {worst.t:.0f} s without a sentence ({worst.plane:.2f} m)"
        )
    if not found.end.plane <= fault.bound:
        wrong.append(f"{found.end.plane:.2f} m off at the end; of use are {fault.bound:g} m")
    if not math.isinf(fault.bound) and found.errors[-1].t < fault.seconds - 2.0:
        wrong.append(f"no state after {found.errors[-1].t:.0f} s")
    if fault.named and not found.sentences:
        wrong.append("no sentence names the fault")
    return wrong


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.soak if name in SIMILAR else ()) for name in FAULTS]
)
@pytest.mark.parametrize("is_longer", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_a_fault_leaves_the_estimate_inside_its_claim_or_is_named(name: str, is_longer: bool):
    """The longer drives are 30 s longer, with an IMU at 100 Hz unless it is slow."""
    fault = FAULTS[name]
    if is_longer:
        step = 1 if fault.imu_step == Fault.imu_step else fault.imu_step
        fault = replace(fault, seconds=fault.seconds + 30.0, imu_step=step)
    assert findings(fault, played(fault)) == []


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 2))])
def test_a_base_without_faults_has_no_sentence_and_is_inside_its_claim(seed: int):
    found = played(FAULTS["none"], seed)
    assert found.sentences == {}
    assert findings(FAULTS["none"], found) == []


@pytest.mark.long
def test_stamps_that_go_back_begin_anew():
    """A recording that is played in a loop: each source goes back by 20 s, all the same."""
    drive = Drive(20.0, ROUND, ROUND_TURNS)
    base = new_estimator(MOUNT, wheels=WHEELS)
    for seed in range(2):
        random = np.random.default_rng(seed)
        calls = merged(imu_calls(drive, MOUNT, random), joint_calls(drive, WHEELS, random))
        for call in calls:
            getattr(base, call.kind)(stamp_at(call.t), *call.values, **call.options)
            if seed and call.t == calls[len(calls) // 2].t:
                assert abs(base.state().stamp - stamp_at(call.t)) < 1e9
    assert all(source.too_late < 200 for source in base.health())  # those of 1 s, until the loop is certain
    state = base.state()
    assert np.isfinite(state.odom_from_base.pose7).all()
    assert abs(state.stamp - stamp_at(20.0)) < 1e9


def test_headings_of_an_axis_that_passes_the_vertical_leave_the_estimator_alive():
    """At rest for 3 s; then its x axis goes up to the vertical and comes back, with a compass all along."""
    base = new_estimator(
        MOUNT,
    )
    turn = MOUNT.matrix[:3, :3]
    for step in range(1500):
        t = 0.01 * step
        part = min(max((t - 3.0) / 10.0, 0.0), 1.0)
        pitch, rate = -1.55 * math.sin(math.pi * part), 0.0
        if 0.0 < part < 1.0:
            rate = -1.55 * math.pi / 10.0 * math.cos(math.pi * part)
        gyro = np.array((0.0, rate, 0.0))
        force = np.array((-math.sin(pitch), 0.0, math.cos(pitch))) * 9.80665
        base.imu(stamp_at(t), turn.T @ gyro, turn.T @ force)
        if step % 5 == 0:
            base.velocity(stamp_at(t), (0.0, 0.0, 0.0), sigma=[0.02] * 3)
            base.heading(stamp_at(t), 0.7, 0.035, source="compass")
        if step > 300 and step % 10 == 0:
            base.state()
            base.health()
    state = base.state()
    assert abs(state.odom_from_base.rpy[1]) < 0.05
    assert abs(state.odom_from_base.rpy[2]) < 3.5 * math.sqrt(state.covariance.pose[5, 5]) + 0.02
