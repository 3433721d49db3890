"""Checks of the clocks of writers, and of the stamps of samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from zstate.cli.doctor.check import Check, broken, first_broken, ok, skipped, warning
from zstate.cli.doctor.robot_probe import RobotProbe
from zstate.clock import SYSTEM, format_stamp
from zstate.errors import NoClock, format_duration
from zstate.ingest.stamp_checks import FAR_NS, likely_cause
from zstate.net.clock_offset import MeasuredOffset
from zstate.net.topic_statistics import IntervalStatistics, Window
from zstate.stream_registry import measured_streams

_DISTURBS_NS = 20_000_000
_BREAKS_NS = 1_000_000_000

_SET_CLOCKS = "timedatectl  # on both machines: is each synchronized?"
_STAMPS = "date +%s.%N  # on the writer's machine: is it this time? Stamp with time.time_ns()"


def clocks_check(probe: RobotProbe) -> Check:
    """The largest offset between the clock of a writer and the local one."""
    if not probe.offsets:
        return skipped("clocks", "no writer reports its clock")
    worst = max(probe.offsets, key=lambda one: abs(one.offset_ns))
    text = _offset_text(worst)
    known = max(abs(worst.offset_ns) - worst.uncertainty_ns, 0)
    if known > _BREAKS_NS:
        return broken("clocks", text, _SET_CLOCKS)
    return warning("clocks", text, _SET_CLOCKS) if known > _DISTURBS_NS else ok("clocks", text)


def _offset_text(one: MeasuredOffset) -> str:
    side = "ahead of" if one.offset_ns > 0 else "behind"
    size, bound = format_duration(abs(one.offset_ns)), format_duration(one.uncertainty_ns)
    return f"that of {one.writer} is {size} {side} this one (± {bound})"


def domains_check(clocks: Mapping[str, str]) -> Iterator[Check]:
    """A warning if ``clocks``, the clock domains by robot, differ; "" is an unknown one."""
    domains: dict[str, list[str]] = {}
    for robot, clock in clocks.items():
        domains.setdefault(clock, []).append(repr(robot))
    domains.pop("", None)
    if len(domains) > 1:
        parts = (f"{', '.join(names)} in {domain!r} time" for domain, names in domains.items())
        text = f"robots are stamped by different clocks: {'; '.join(parts)}; there are no poses between them"
        yield warning("clocks", text, "zstate publish --help  # --clock: start all of them with the same")


def stamps_check(probe: RobotProbe) -> Check:
    """Whether the stamps of all writers' samples are plausible sampling times."""
    named = [(probe.writer_name(one.session), one) for one in probe.statistics()]
    named += _sensors(probe)
    sampled = [(writer, one.session, window) for writer, one in named if (window := one.window()) is not None]
    if not sampled:
        return skipped("stamps", "there is no sample")
    if probe.description is not None and (domain := probe.description.clock) not in ("", SYSTEM):
        now = probe.collector.simulated_now
        if isinstance(now, NoClock):
            return broken("stamps", f"simulated time {domain!r}: {now}", "zstate replay FILE --clock")
        return ok("stamps", f"simulated time {domain!r}, which is now {format_stamp(now)}")
    problems = [problem for one in sampled if (problem := _stamps_problem(probe, *one)) is not None]
    if problems:
        return first_broken(problems) or problems[0]
    least, greatest = zip(*(window.delays for _, _, window in sampled), strict=True)
    low, high = (format_duration(max(delay, 0)) for delay in (min(least), max(greatest)))
    return ok("stamps", f"{low} to {high} old on arrival")


def _sensors(probe: RobotProbe) -> Iterator[tuple[str, IntervalStatistics]]:
    """The samples of each sensor, with the name of the sensor and its writer."""
    for stream in measured_streams():
        names = {writer.session: f"{stream} {name!r}" for name, writer in probe.info.named(stream)}
        for session, one in probe.measured[stream].writers.items():
            yield f"{names.get(session, stream)} of {probe.writer_name(session)}", one.statistics


def _stamps_problem(probe: RobotProbe, writer: str, session: int, window: Window) -> Check | None:
    """What is wrong with the stamps of one writer; None if they are plausible."""
    least = window.delays[0]
    stamp, stamps = window.received[-1].stamp, {one.stamp for one in window.received}
    if abs(least) > FAR_NS:
        size = f"{format_duration(abs(least))} {'before' if least > 0 else 'after'}"
        cause = likely_cause(stamp, stamp + least)
        text = f"{writer} stamps samples {size} the time here ({format_stamp(stamp)}): {cause}"
        return broken("stamps", text, _STAMPS)
    if len(window.received) > 2 and len(stamps) == 1:
        text = f"{writer} gives every sample the same stamp, {format_stamp(stamp)}: its source stands still"
        return broken("stamps", text, f"zstate echo {probe.info.name}")
    return _delay_problem(probe, writer, session, least)


def _delay_problem(probe: RobotProbe, writer: str, session: int, least: int) -> Check | None:
    """A writer whose samples do not arrive soon after their stamps; ``least`` is the least delay [ns]."""
    cause, then = "", _SET_CLOCKS
    for measured in probe.offsets:
        if measured.writer.session == session and abs(measured.offset_ns) > _DISTURBS_NS:
            cause = f": {_offset_text(measured)}"
        elif measured.writer.session == session:
            cause, then = (
                "; its clock is right, so it stamps another instant than that of the sample",
                _STAMPS,
            )
    if least < -_DISTURBS_NS:
        text = f"{writer} stamps samples up to {format_duration(-least)} in the future{cause}"
        return (broken if least < -_BREAKS_NS else warning)("stamps", text, then)
    if least > _BREAKS_NS:
        text = f"samples of {writer} arrive {format_duration(least)} after their stamps{cause}"
        return warning("stamps", text, then)
    return None
