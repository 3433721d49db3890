"""Errors: one tree, facts as attributes, texts with advice."""

from __future__ import annotations

import pickle

import pytest

from zstate import errors
from zstate.errors import (
    AmbiguousFrame,
    Disconnected,
    InFuture,
    InPast,
    InsertRefused,
    LookupFailed,
    NoData,
    Stale,
    UnknownFrame,
    WaitTimeout,
    ZStateError,
    as_timeout,
    format_duration,
)

S = 1_000_000_000


def test_every_exception_is_a_zstate_error() -> None:
    classes = [thing for thing in vars(errors).values() if isinstance(thing, type)]
    exceptions = [thing for thing in classes if issubclass(thing, BaseException)]
    assert len(exceptions) > 15
    assert all(issubclass(thing, ZStateError) for thing in exceptions)


def test_invalid_input_is_a_value_error_and_a_failed_lookup_is_not() -> None:
    assert issubclass(InsertRefused, ValueError)
    assert not issubclass(LookupFailed, ValueError)


@pytest.mark.parametrize(
    ("nanoseconds", "text"),
    [
        (85, "85 ns"),
        (1_500, "1.5 us"),
        (12_000_000, "12.0 ms"),
        (4_200_000_000, "4.2 s"),
        (172_799 * S, "172799.0 s"),
        (216_000 * S, "2.5 days"),
        (-3_000_000, "-3.0 ms"),
    ],
)
def test_durations_have_a_readable_unit(nanoseconds: int, text: str) -> None:
    assert format_duration(nanoseconds) == text


def in_future() -> InFuture:
    return InFuture(
        "map",
        "hand",
        edge=("map", "base"),
        requested=5 * S,
        oldest=S,
        newest=4 * S,
        rate_hz=50.0,
        writer="odom",
    )


def test_in_future_names_distance_edge_and_advice() -> None:
    text = str(in_future())
    assert text.startswith("pose of 'hand' in 'map': asked 1.0 s after the newest sample of 'map' -> 'base'")
    for part in ("writer odom", "50 Hz", "timeout_s", "at=None", "predict_s"):
        assert part in text


def test_in_past_names_distance_and_length_of_the_history() -> None:
    error = InPast("map", "hand", edge=("map", "base"), requested=S, oldest=3 * S, newest=7 * S)
    assert "asked 2.0 s before the oldest sample of 'map' -> 'base'" in str(error)
    assert "the history there spans 4.0 s" in str(error)


def test_a_single_sample_is_called_the_only_one() -> None:
    before = InPast("map", "hand", edge=("map", "base"), requested=S, oldest=3 * S, newest=3 * S)
    assert "asked 2.0 s before the only sample of 'map' -> 'base' so far; " in str(before)
    assert "spans" not in str(before)
    assert "zstate static" in str(before)
    after = InFuture("map", "hand", edge=("map", "base"), requested=5 * S, oldest=3 * S, newest=3 * S)
    assert "asked 2.0 s after the only sample of 'map' -> 'base'; " in str(after)


# 2024-01-05 10:17:57.278 UTC
WALL = 1_704_449_877_278_544_000
SIMULATED = 250_655_000_000


def test_wall_clock_lookup_among_simulated_stamps_is_explained() -> None:
    error = InFuture("a", "b", edge=("a", "b"), requested=WALL, oldest=S, newest=SIMULATED)
    assert (
        "the requested stamp, 2024-01-05 10:17:57 UTC, is wall-clock time, but the samples have simulated "
        "stamps, or those of a machine whose clock was never set (newest 250.655 s); use stamps of "
        "their clock" in str(error)
    )
    assert error.is_of_another_time
    assert "wait for it" not in str(error)
    again = pickle.loads(pickle.dumps(as_timeout(error, 1.0)))
    assert str(again).endswith(str(error))


def test_simulated_lookup_among_wall_clock_stamps_is_explained() -> None:
    error = InPast("a", "b", edge=("a", "b"), requested=SIMULATED, oldest=WALL, newest=WALL + S)
    assert (
        "the requested stamp, 250.655 s, is simulated time or time since a machine was switched on, but the "
        "samples have wall-clock stamps (newest 2024-01-05 10:17:58 UTC)" in str(error)
    )


@pytest.mark.parametrize(
    ("unit", "scale"), [("seconds", S), ("milliseconds", 1_000_000), ("microseconds", 1_000)]
)
def test_a_mistaken_unit_is_named_on_either_side(unit: str, scale: int) -> None:
    asked = InPast("a", "b", edge=("a", "b"), requested=WALL // scale, oldest=WALL, newest=WALL + S)
    assert f"the requested stamp {WALL // scale} looks like {unit}, but stamps are nanoseconds" in str(asked)
    stamped = InFuture("a", "b", edge=("a", "b"), requested=WALL, oldest=1, newest=WALL // scale)
    assert f"the writer's stamps look like {unit}, but stamps are nanoseconds" in str(stamped)


@pytest.mark.parametrize(
    ("asked", "newest"), [(100_000 * S, 100 * S), (WALL, WALL - 90_000 * S), (S, 40_000 * S)]
)
def test_distant_stamps_of_one_clock_are_a_plain_extrapolation(asked: int, newest: int) -> None:
    error = InFuture("a", "b", edge=("a", "b"), requested=asked, oldest=newest - S, newest=newest)
    assert not error.is_of_another_time
    assert "wait for it" in str(error)


def test_unknown_frame_names_near_misses_or_the_command_that_lists_frames() -> None:
    assert "did you mean 'hand'?" in str(
        UnknownFrame("a", "hnd", name="hnd", near_misses=["hand"], frame_count=3)
    )
    assert "unknown among 3 frames" in str(UnknownFrame("a", "q", name="q", frame_count=3))
    assert "is a publisher running" in str(UnknownFrame("a", "q", name="q"))


def test_other_lookup_errors_name_the_edge_or_frame_at_fault() -> None:
    assert "'r1/hand' or 'r2/hand'" in str(
        AmbiguousFrame("a", "hand", name="hand", candidates=["r1/hand", "r2/hand"])
    )
    disconnected = str(Disconnected("a", "b", roots=("map", "base")))
    assert "'a' is under root 'map', 'b' under root 'base'" in disconnected
    assert "zstate static map base" in disconnected
    gone = Disconnected("a", "b", roots=("map", "base"))
    gone.edge, gone.writer, gone.gone_s = ("map", "base"), "odom", 40.9
    assert str(gone).endswith("'map' -> 'base' (writer odom) was withdrawn 40 s ago")
    assert "no sample of 'a' -> 'b'" in str(NoData("a", "b", edge=("a", "b")))
    assert "every edge of the path is static" in str(NoData("a", "b"))
    stale = Stale("a", "b", age_s=2.0, max_age_s=0.5, edge=("a", "b"))
    assert "2.0 s old, 0.5 s are allowed" in str(stale)


def test_a_note_follows_the_message() -> None:
    error = in_future()
    error.note = "one thing more"
    assert str(error).endswith("(one thing more)")


def test_a_wait_timeout_has_class_and_facts_of_its_reason() -> None:
    error = as_timeout(in_future(), 0.25)
    assert isinstance(error, InFuture)
    assert isinstance(error, TimeoutError)
    assert isinstance(error, WaitTimeout)
    assert (error.edge, error.requested, error.newest) == (("map", "base"), 5 * S, 4 * S)
    assert error.waited_s == 0.25
    assert str(error).startswith("after waiting 0.25 s, pose of 'hand'")


def test_each_reason_has_one_timeout_class() -> None:
    assert type(as_timeout(in_future(), 1.0)) is type(as_timeout(in_future(), 2.0))


def one_of_each() -> list[errors.ZStateError]:
    late = errors.InFuture(
        "a", "b", edge=("a", "b"), requested=5, oldest=1, newest=3, rate_hz=2.0, writer="w"
    )
    return [
        errors.InvalidInput("text"),
        errors.InsertRefused("text", reason="loop", edge=("a", "b")),
        errors.ConfigError("text", path="robots[0]"),
        errors.ModelError("arm.urdf", (), "text"),
        errors.UnknownModel("pand", ("panda",), "text"),
        errors.MessageError("text", reason="foreign"),
        errors.Unreachable("text", endpoints=("tcp/127.0.0.1:1",)),
        errors.AccessDenied("text", reason="wrong CA", endpoint="tls/127.0.0.1:1"),
        errors.PortBusy("text", endpoint="tcp/127.0.0.1:1"),
        errors.UnknownFrame("a", "b", name="b", near_misses=("bb",)),
        errors.Stale("a", "b", age_s=2.0, max_age_s=1.0, edge=("a", "b")),
        late,
        errors.as_timeout(late, 0.5),
    ]


@pytest.mark.parametrize("error", one_of_each(), ids=lambda error: type(error).__name__)
def test_every_error_crosses_processes_whole(error: errors.ZStateError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


@pytest.mark.parametrize(
    ("offset_ns", "uncertainty_ns", "text"),
    [
        (1_200_000_000, 300_000, "; the clock of 'driver@jetson' is 1.2 s ahead of this one (± 300.0 us)"),
        (-2_000_000, 1_000_000, "; the clock of 'driver@jetson' is 2.0 ms behind this one (± 1.0 ms)"),
        (999_999, 100, ""),
        (2_000_000, 2_000_001, ""),
    ],
)
def test_the_writers_clock_is_named_if_it_may_be_the_cause(
    offset_ns: int, uncertainty_ns: int, text: str
) -> None:
    error = InFuture(
        "map", "hand", edge=("map", "base"), requested=5 * S, newest=4 * S, writer="driver@jetson"
    )
    without = error.message()
    error.clock_offset_ns, error.clock_uncertainty_ns = offset_ns, uncertainty_ns
    assert error.message() == without + text
    again = pickle.loads(pickle.dumps(as_timeout(error, 1.0)))
    assert (again.clock_offset_ns, again.clock_uncertainty_ns) == (offset_ns, uncertainty_ns)


def one_of_each() -> list[ZStateError]:
    where = {"edge": ("map", "hand"), "requested": 5 * S, "oldest": S, "newest": 2 * S, "rate_hz": 10.0}
    return [
        errors.InvalidInput("no"),
        InsertRefused("no", reason="loop", edge=("a", "b")),
        errors.ConfigError("no", path="a.b"),
        errors.ModelError("arm.urdf"),
        errors.UnknownModel("arn", ["arm"], "no robot is called 'arn'"),
        errors.LibraryMissing("install it"),
        errors.MessageError("no", reason="foreign"),
        errors.ClockMismatch(
            "a", "b", edges=(("a", "m"), ("m", "b")), robots=("r1", "r2"), domains=("sim", "system")
        ),
        errors.Unreachable("no", endpoints=["tcp/a:1"]),
        errors.AccessDenied("no", reason="wrong CA", endpoint="tcp/a:1"),
        errors.NoClock("no", waited_s=1.0),
        errors.PortBusy("no", endpoint="tcp/a:1"),
        errors.Closed("no"),
        UnknownFrame("a", "hnd", name="hnd", near_misses=lambda: ["hand"], frame_count=3),
        AmbiguousFrame("a", "hand", name="hand", candidates=["r1/hand", "r2/hand"]),
        Disconnected("a", "b", roots=("map", "base")),
        NoData("a", "b", **where),
        InFuture("a", "b", **where),
        InPast("a", "b", **where | {"requested": 0}),
        Stale("a", "b", age_s=2.0, max_age_s=1.0, **where),
        Stale("a", "b", age_s=9.0, other=("hand", "tip"), other_newest=11 * S, **where),
        errors.NotFinite("a", "b", **where),
        as_timeout(InFuture("a", "b", **where), 0.5),
    ]


@pytest.mark.parametrize("error", one_of_each(), ids=lambda error: type(error).__name__)
def test_the_repr_of_an_error_has_its_text_and_both_survive_pickling(error: ZStateError) -> None:
    assert repr(error) == f"{type(error).__name__}({str(error)!r})"
    assert str(error)
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again), repr(again)) == (type(error), str(error), repr(error))


def test_in_past_of_a_recording_does_not_advise_on_listeners() -> None:
    error = InPast("a", "b", edge=("a", "b"), requested=0, oldest=S, newest=3 * S)
    error.is_recorded = True
    assert "the recording has nothing older of it, and 2.0 s in all" in str(error)
    assert "listener" not in str(error)
    assert "history_s" not in str(error)
