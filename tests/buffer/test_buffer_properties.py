"""What holds in every world: algebra, agreement of all ways to ask, and no trace of what failed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from helpers.buffers import NOW, S, filled
from hypothesis import given
from hypothesis import strategies as st

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InvalidInput, LookupFailed, ZStateError
from zstate.transform import Transform

World = list[Transform]

small = st.floats(-5.0, 5.0)
angles = st.floats(-3.0, 3.0)
instants = st.integers(-2, 12).map(lambda n: NOW + n * S // 2)
names = st.sampled_from(["f0", "f1", "f2", "f3", "f4", "unknown"])


@st.composite
def worlds(draw: st.DrawFn) -> World:
    """Samples of a tree of up to five frames, no stamp twice on one edge."""
    world: World = []
    for n in range(1, draw(st.integers(2, 5))):
        parent, child = f"f{draw(st.integers(0, n - 1))}", f"f{n}"
        stamps: list[int | None] = [None]
        if draw(st.booleans()):
            stamps = draw(st.lists(instants, min_size=1, max_size=4, unique=True))  # type: ignore[assignment]
        for stamp in stamps:
            xyz, rpy = draw(st.tuples(small, small, small)), draw(st.tuples(angles, angles, angles))
            world.append(Transform.from_rpy(parent, child, xyz, rpy, stamp))
    return world


def answer(ask: Callable[[], Transform]) -> Transform | LookupFailed:
    try:
        return ask()
    except LookupFailed as reason:
        return reason


def assert_same(
    ours: Transform | LookupFailed, theirs: Transform | LookupFailed, atol: float = 1e-11
) -> None:
    if isinstance(ours, LookupFailed) or isinstance(theirs, LookupFailed):
        assert (type(ours), str(ours)) == (type(theirs), str(theirs))
        return
    assert (ours.target, ours.source, ours.stamp, ours.kind) == (
        theirs.target,
        theirs.source,
        theirs.stamp,
        theirs.kind,
    )
    np.testing.assert_allclose(ours.matrix, theirs.matrix, atol=atol)


@given(worlds(), names, names, instants | st.none())
def test_lookup_in_the_other_direction_is_the_inverse(world: World, a: str, b: str, at: int | None) -> None:
    buffer = filled(*world)
    there, back = answer(lambda: buffer.lookup(a, b, at)), answer(lambda: buffer.lookup(b, a, at))
    if isinstance(there, Transform) and isinstance(back, Transform):
        assert_same(there.inverse(), back)
    else:
        assert type(there) is type(back)


@given(worlds(), names, names, names, instants)
def test_two_lookups_at_one_stamp_compose_to_the_third(world: World, a: str, b: str, c: str, at: int) -> None:
    buffer = filled(*world)
    first, second = answer(lambda: buffer.lookup(a, b, at)), answer(lambda: buffer.lookup(b, c, at))
    if isinstance(first, Transform) and isinstance(second, Transform):
        # What both halves know, the whole knows: its path is no longer than theirs together.
        np.testing.assert_allclose(buffer.lookup(a, c, at).matrix, (first @ second).matrix, atol=1e-11)


@given(worlds(), names, names, st.lists(instants, max_size=6))
def test_lookup_plan_and_lookup_many_agree(world: World, a: str, b: str, stamps: list[int]) -> None:
    buffer = filled(*world)
    try:
        plan = buffer.plan(a, b)
    except LookupFailed as reason:
        assert type(buffer.explain(a, b)) is type(reason)
        return
    poses, valid = buffer.lookup_many(a, b, stamps)
    for stamp, pose, is_valid in zip(stamps, poses, valid, strict=True):
        single = answer(lambda stamp=stamp: buffer.lookup(a, b, stamp))
        assert_same(answer(lambda stamp=stamp: plan.at(stamp)), single, atol=0.0)
        assert buffer.can_lookup(a, b, stamp) == is_valid == isinstance(single, Transform)
        if isinstance(single, Transform):
            np.testing.assert_allclose(Transform.from_pose7(a, b, pose).matrix, single.matrix, atol=1e-12)
            np.testing.assert_allclose(plan.poses([stamp])[0], pose, atol=1e-12)
    if valid.all():
        np.testing.assert_array_equal(plan.poses(stamps), poses)
    else:
        with pytest.raises(LookupFailed) as caught:
            plan.poses(stamps)
        assert caught.value.requested == stamps[int(valid.argmin())]


@given(worlds(), st.randoms(use_true_random=False), names, names, instants | st.none())
def test_order_of_inserts_does_not_matter(world: World, rng, a: str, b: str, at: int | None) -> None:
    shuffled = list(world)
    rng.shuffle(shuffled)
    one, other = filled(*world), filled(*shuffled)
    first, second = answer(lambda: one.lookup(a, b, at)), answer(lambda: other.lookup(a, b, at))
    if isinstance(first, Transform):
        assert_same(first, second, atol=0.0)
    else:
        assert type(first) is type(second)


@given(worlds(), names, names, instants | st.none())
def test_lookups_between_inserts_change_no_result(world: World, a: str, b: str, at: int | None) -> None:
    live = TransformBuffer()
    for transform in world:
        with suppress(LookupFailed):
            live.lookup(a, b, at)
        (live.insert_static if transform.stamp is None else live.insert)(transform)
    replayed = filled(*world)
    assert_same(answer(lambda: live.lookup(a, b, at)), answer(lambda: replayed.lookup(a, b, at)), atol=0.0)
    assert live.frames() == replayed.frames()


def failing_calls(buffer: TransformBuffer, parent: str, child: str, at: int) -> list[Callable[[], object]]:
    """Calls of which each is refused, or not, by what the world happens to be."""
    turn, nan = (0, 0, 0, 1), float("nan")
    good = Transform(parent, child, (0, 0, 0), turn, at)
    return [
        lambda: buffer.insert_many([(parent, child), ("new", "new")], at, [(0, 0, 0, *turn)] * 2),
        lambda: buffer.insert_many([("new", "newer"), (parent, child)], at, [(nan, 0, 0, *turn)] * 2),
        lambda: buffer.insert_many([("new", "f1"), ("newer", "f1")], at, [(0, 0, 0, *turn)] * 2),
        lambda: buffer.insert(Transform("/new", child, (0, 0, 0), turn, at)),
        lambda: buffer.insert(Transform(parent, "", (0, 0, 0), turn, at)),
        lambda: buffer.insert_static(Transform("second parent", "f1", (0, 0, 0), turn)),
        lambda: buffer.insert_static(Transform("f1", "f0", (0, 0, 0), turn)),
        lambda: buffer.insert(good.inverse() @ good),
        lambda: buffer.withdraw("newest"),
        lambda: buffer.lookup(parent, "newest", at),
        lambda: buffer.lookup(parent, child, NOW - 50 * S, timeout_s=-1.0),
        lambda: buffer.twist("newest", child),
    ]


@given(worlds(), names, names, instants, st.integers(0, 11))
def test_failed_call_changes_nothing(world: World, a: str, b: str, at: int, which: int) -> None:
    buffer, untouched = filled(*world), filled(*world)
    with pytest.raises(ZStateError):
        failing_calls(buffer, a, b, at)[which]()
    assert buffer.frames() == untouched.frames()
    for target in ("f0", "f1", "f2", "f3", "f4", "new"):
        assert_same(
            answer(lambda target=target: buffer.lookup(target, "f1", at)),
            answer(lambda target=target: untouched.lookup(target, "f1", at)),
            atol=0.0,
        )


@given(worlds(), st.floats(), names)
def test_non_integer_stamp_is_never_accepted(world: World, at: float, a: str) -> None:
    buffer = filled(*world)
    with pytest.raises(InvalidInput):
        buffer.lookup("f0", a, at)  # type: ignore[arg-type]
