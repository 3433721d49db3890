"""Time: the clocks of the writers, and what they stamp."""

from __future__ import annotations

from collections.abc import Mapping

from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.ear import Ear
from zstate.clock import SYSTEM, format_stamp
from zstate.errors import NoClock, format_duration
from zstate.ingest.stamp_checks import FAR_NS, likely_cause
from zstate.net.clock_offset import MeasuredOffset
from zstate.net.session import Session
from zstate.net.topic_statistics import Window

_DISTURBS_NS = 20_000_000
_BREAKS_NS = 1_000_000_000

_SET_CLOCKS = "timedatectl  # on both machines: is each synchronized?"
_STAMPS = "date +%s.%N  # is it this time where the writer runs? It is to stamp with time.time_ns()"


def clocks_check(ear: Ear) -> Check:
    """How far the clocks of the writers are from the one here."""
    if not ear.offsets:
        return skipped("clocks", "no writer tells the time by its clock")
    worst = max(ear.offsets, key=lambda one: abs(one.offset_ns))
    text = _offset_text(worst)
    known = max(abs(worst.offset_ns) - worst.uncertainty_ns, 0)
    if known > _BREAKS_NS:
        return broken("clocks", text, _SET_CLOCKS)
    if known > _DISTURBS_NS:
        return warning("clocks", text, _SET_CLOCKS)
    return ok("clocks", text)


def _offset_text(one: MeasuredOffset) -> str:
    side = "ahead of" if one.offset_ns > 0 else "behind"
    size, bound = format_duration(abs(one.offset_ns)), format_duration(one.uncertainty_ns)
    return f"that of {one.writer} is {size} {side} this one (± {bound})"


def domains_check(clocks: Mapping[str, str]) -> Check | None:
    """Whether all robots are stamped by one clock, of those by robot; None if they are, or if not known."""
    domains: dict[str, list[str]] = {}
    for robot, clock in clocks.items():
        if clock:
            domains.setdefault(clock, []).append(robot)
    if len(domains) < 2:
        return None
    told = "; ".join(f"{', '.join(map(repr, names))} in {domain!r} time" for domain, names in domains.items())
    return warning(
        "clocks",
        f"robots are stamped by different clocks: {told}; there are no poses between them",
        "zstate publish --help  # --clock: start all of them with the same",
    )


def stamps_check(ear: Ear, session: Session) -> Check:
    """Whether samples are stamped with the time at which they were taken."""
    window = ear.samples.window
    if window is None:
        return skipped("stamps", "there is no sample")
    if ear.description is not None and ear.description.clock not in ("", SYSTEM):
        return _simulated_check(ear.description.clock, session)
    return _far_check(ear, window) or _frozen_stamp_check(ear, window) or _near_check(ear, window)


def _far_check(ear: Ear, window: Window) -> Check | None:
    least, stamp = window.delays[0], window.received[-1].stamp
    if abs(least) <= FAR_NS:
        return None
    size = f"{format_duration(abs(least))} {'before' if least > 0 else 'after'}"
    text = (
        f"{ear.samples_writer} stamps samples {size} the time here ({format_stamp(stamp)}): "
        f"{likely_cause(stamp, stamp + least)}"
    )
    return broken("stamps", text, _STAMPS)


def _frozen_stamp_check(ear: Ear, window: Window) -> Check | None:
    stamps = {one.stamp for one in window.received}
    if len(window.received) < 3 or len(stamps) > 1:
        return None
    stamp = format_stamp(stamps.pop())
    text = f"{ear.samples_writer} gives every sample the same stamp, {stamp}: what it reads stands still"
    return broken("stamps", text, f"zstate echo {ear.info.name}")


def _near_check(ear: Ear, window: Window) -> Check:
    least, greatest = window.delays
    if least < -_DISTURBS_NS:
        text, then = _cause(ear)
        text = f"{ear.samples_writer} stamps samples up to {format_duration(-least)} in the future{text}"
        return (broken if least < -_BREAKS_NS else warning)("stamps", text, then)
    if least > _BREAKS_NS:
        text, then = _cause(ear)
        text = f"samples of {ear.samples_writer} come {format_duration(least)} after their stamps{text}"
        return warning("stamps", text, then)
    return ok("stamps", f"{_delay_text(least)} to {_delay_text(greatest)} old as they come")


def _cause(ear: Ear) -> tuple[str, str]:
    """Whether the clock of the writer explains it, and what to do."""
    measured = [one for one in ear.offsets if one.writer.session == ear.samples.statistics.session]
    if not measured:
        return "", _SET_CLOCKS
    if abs(measured[0].offset_ns) > _DISTURBS_NS:
        return f": {_offset_text(measured[0])}", _SET_CLOCKS
    return ", though its clock is right: it stamps another instant than that of the sample", _STAMPS


def _simulated_check(domain: str, session: Session) -> Check:
    from zstate.nodes.clock import SimulatedClock

    with SimulatedClock(session) as clock:
        try:
            now = clock.wait(0.5)
        except NoClock as error:
            return broken(
                "stamps", f"of the simulated time {domain!r}: {error}", "zstate replay FILE --clock"
            )
    return ok("stamps", f"of the simulated time {domain!r}, where it is {format_stamp(now)}")


def _delay_text(nanoseconds: int) -> str:
    return format_duration(max(nanoseconds, 0))
