"""Joining samples with transforms, in place of a message filter."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass

import pytest

from zstate import Transform, TransformBuffer

MS = 1_000_000


@dataclass(frozen=True)
class Scan:
    frame: str
    stamp: int


def a_buffer() -> TransformBuffer:
    """A base that moves 1 m in a second along x, from 0 to 100 ms."""
    buffer = TransformBuffer()
    for stamp in range(0, 101 * MS, 10 * MS):
        buffer.insert(Transform("map", "base", (stamp * 1e-9, 0, 0), (0, 0, 0, 1), stamp=stamp))
    buffer.insert_static(Transform("base", "laser", (0, 0, 1), (0, 0, 0, 1)))
    return buffer


async def stream(*scans: Scan) -> AsyncIterator[Scan]:
    for scan in scans:
        yield scan


def test_each_sample_is_joined_with_the_transform_at_its_own_stamp() -> None:
    async def run() -> list[tuple[int, float]]:
        scans = stream(*(Scan("laser", stamp) for stamp in (5 * MS, 25 * MS, 95 * MS)))
        return [(scan.stamp, tf.translation[0]) async for scan, tf in a_buffer().join(scans, "map")]

    joined = asyncio.run(run())
    assert [stamp for stamp, _ in joined] == [5 * MS, 25 * MS, 95 * MS]
    assert [x for _, x in joined] == pytest.approx([0.005, 0.025, 0.095], abs=1e-15)


def test_sample_waits_for_a_transform_that_arrives_later() -> None:
    async def run() -> float:
        buffer = a_buffer()
        join = buffer.join(stream(Scan("laser", 105 * MS)), "map", timeout_s=10.0)
        next_pair = asyncio.ensure_future(anext(aiter(join)))
        await asyncio.sleep(0)  # lets the join begin to wait
        buffer.insert(Transform("map", "base", (0.11, 0, 0), (0, 0, 0, 1), stamp=110 * MS))
        _, transform = await next_pair
        return float(transform.translation[0])

    assert asyncio.run(run()) == pytest.approx(0.105, abs=1e-15)


def test_dropped_samples_are_counted_by_reason_and_the_rest_continues() -> None:
    async def run() -> None:
        scans = (Scan("laser", -1), Scan("lidar", 5), Scan("laser", 200 * MS), Scan("laser", 50 * MS))
        join = a_buffer().join(stream(*scans), "map", timeout_s=0.01)
        assert [scan.stamp async for scan, _ in join] == [50 * MS]
        assert join.dropped == {"InPast": 1, "UnknownFrame": 1, "InFuture": 1}
        assert join.joined == 1
        assert "after the newest sample of 'map' -> 'base'" in str(join.last_reason)

    asyncio.run(run())


def test_frame_and_stamp_functions_read_samples_of_any_type() -> None:
    async def pairs() -> AsyncIterator[tuple[str, int]]:
        yield ("laser", 20 * MS)

    async def run() -> list[float]:
        join = a_buffer().join(pairs(), "map", frame=lambda pair: pair[0], stamp=lambda pair: pair[1])
        return [transform.translation[0] async for _, transform in join]

    assert asyncio.run(run()) == pytest.approx([0.02], abs=1e-15)


def test_loop_over_a_join_can_be_left_and_resumed() -> None:
    async def run() -> list[int]:
        join = a_buffer().join(stream(*(Scan("laser", k * MS) for k in range(4))), "map")
        seen: list[int] = []
        async for scan, _ in join:
            seen.append(scan.stamp)
            break
        seen += [scan.stamp async for scan, _ in join]
        return seen

    assert asyncio.run(run()) == [0, MS, 2 * MS, 3 * MS]
