"""One answer, one state: all numbers of an answer are of one epoch of each track, whatever writers do.

Two writers restart their tracks as fast as they can. Every number of an epoch is the number of that epoch,
also the variances, so that an answer of two epochs shows: by numbers that differ, or by fractions, which come
of an interpolation between two of them. 0.2 s for each call.
"""

from __future__ import annotations

import asyncio
import itertools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.buffers import MS, NOW, moving
from helpers.processes import DEADLINE_S
from numpy.typing import ArrayLike

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.tracks import JointTrack
from zstate.errors import LookupFailed, Stale
from zstate.model.load import load_model
from zstate.transform import Transform

SECONDS = 0.2

CRANE = """<robot name="crane"><link name="base"/><link name="trolley"/><link name="hook"/>
  <joint name="reach" type="prismatic"><parent link="base"/><child link="trolley"/>
    <limit lower="-1e9" upper="1e9" effort="1" velocity="1"/><axis xyz="0 1 0"/></joint>
  <joint name="lift" type="prismatic"><parent link="trolley"/><child link="hook"/>
    <limit lower="-1e9" upper="1e9" effort="1" velocity="1"/><axis xyz="0 0 1"/></joint>
</robot>"""
"""x of the hook in odom is the epoch of the base's poses, y and z those of the two drivers of the joints."""

STAMPS = NOW + np.arange(40) * (MS // 2)
AHEAD = NOW + 40 * MS


class World:
    """A crane whose base and two joints have a track each."""

    def __init__(self) -> None:
        self.buffer = TransformBuffer()
        self.robot = self.buffer.add_robot(load_model(CRANE))
        self.lift = feed_of(self.buffer).add_part(self.robot, ["lift"])
        feed_of(self.buffer).assign_joints(self.robot, {"lift": self.lift})
        for writer in (self.write_base, self.write_joints):
            writer(0)

    def write_base(self, epoch: int) -> None:
        edge = feed_of(self.buffer).tree_snapshot().edges.get("base")
        if edge is not None and edge.track is not None:
            feed_of(self.buffer).restart(edge.track)
        pose, triangle = [[epoch, 0, 0, 0, 0, 0, 1]], np.zeros((1, 21))
        triangle[0, 0] = epoch
        for stamp in stamps_of(epoch):
            self.buffer.insert_many([("odom", "base")], stamp, pose, covariances=triangle)

    def write_joints(self, epoch: int) -> None:
        self.write_driver(self.robot, [epoch, 0.0], epoch)
        self.write_driver(self.lift, [epoch], epoch)

    def write_driver(self, track: JointTrack, positions: list[float], epoch: int) -> None:
        feed_of(self.buffer).restart(track)
        for stamp in stamps_of(epoch):
            self.buffer.insert_joints(track, stamp, positions)


def stamps_of(epoch: int) -> list[int]:
    """The stamps of the samples of an epoch: those of the next one begin and end elsewhere."""
    first = NOW + epoch * 3 % 5 * MS
    # The first two at once cover the instants between them.
    return [first, first + 7 * MS, *range(first + MS, first + 7 * MS, MS)]


@contextmanager
def restarting(*writers: Callable[[int], None]) -> Iterator[None]:
    """Threads that write one epoch after the other, and take turns as often as the interpreter permits."""
    done, usual = threading.Event(), sys.getswitchinterval()

    def run(write: Callable[[int], None]) -> None:
        for epoch in itertools.count(1):
            if done.is_set():
                return
            write(epoch)

    threads = [threading.Thread(target=run, args=(write,), daemon=True) for write in writers]
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        yield
    finally:
        done.set()
        sys.setswitchinterval(usual)
        for thread in threads:
            thread.join(10.0)


Numbers = dict[str, ArrayLike]
"""Numbers that are of one epoch each."""


def of_transform(transform: Transform) -> Numbers:
    x, y, z = transform.translation
    covariance = transform.covariance
    variance = [] if covariance is None else [covariance[0, 0]]
    return {"base": [x, *variance], "reach": [y], "lift": [z]}


def of_points(rows: np.ndarray) -> Numbers:
    return dict(zip(("base", "reach", "lift"), rows[~np.isnan(rows[:, 0]), :3].T, strict=True))


def read_latest(world: World) -> Numbers:
    """An instant that all three tracks had reached in one epoch each."""
    stamp = world.buffer.latest("odom", "hook")
    assert (stamp - NOW) % MS == 0
    return {}


def read_between(world: World) -> Numbers:
    """The hook at one instant in the hook at another does not move in one epoch."""
    early, late = (int(STAMPS[n]) for n in (8, 14))
    moved = world.buffer.lookup_between("hook", early, "hook", late, "odom")
    assert moved.translation.tolist() == [0.0, 0.0, 0.0]
    return {}


def read_twist(world: World) -> Numbers:
    assert world.buffer.twist("hook", "odom", int(STAMPS[12])).linear.tolist() == [0.0, 0.0, 0.0]
    return {}


def read_joints(world: World) -> Numbers:
    positions, _ = world.buffer.joint_positions("crane", int(STAMPS[13]))
    return {"reach": positions[:1], "lift": positions[1:]}


def read_joints_many(world: World) -> Numbers:
    positions, valid = world.buffer.joint_positions_many("crane", STAMPS)
    return {"reach": positions[valid, 0], "lift": positions[valid, 1]}


def read_joint_states(world: World) -> Numbers:
    samples = world.buffer.joint_states("crane")
    return {"reach": samples.positions[:, 0], "lift": samples.positions[:, 1]}


def read_newest_joints(world: World) -> Numbers:
    """The newest instant is one of the epochs of both drivers."""
    positions, stamp = world.buffer.joint_positions("crane")
    assert all(stamp in stamps_of(int(epoch)) for epoch in positions)
    return {"lift": positions[1:]}


def read_link_poses(world: World) -> Numbers:
    poses, _ = world.buffer.link_poses("crane", int(STAMPS[13]))
    return {"reach": poses[1:, 1], "lift": poses[2:, 2]}


def read_snapshot(world: World, at: int | None) -> Numbers:
    poses = world.buffer.snapshot(at)
    x, y, z = (
        poses.poses[poses.tree.row(name), axis] for axis, name in enumerate(("base", "trolley", "hook"))
    )
    return {"base": [x], "reach": [y], "lift": [z]}


def read_watched(world: World) -> Numbers:
    seen: list[Transform] = []
    with world.buffer.watch("odom", "hook", seen.append):
        pass
    return of_transform(seen[-1]) if seen else {}


DOORS: dict[str, Callable[[World], Numbers]] = {
    "lookup": lambda world: of_transform(world.buffer.lookup("odom", "hook")),
    "lookup at a stamp": lambda world: of_transform(world.buffer.lookup("odom", "hook", int(STAMPS[13]))),
    "lookup with max_age_s": lambda world: of_transform(world.buffer.lookup("odom", "hook", max_age_s=1e9)),
    "lookup with a prediction": lambda world: of_transform(
        world.buffer.lookup("odom", "base", AHEAD, predict_s=1.0)
    ),
    "lookup_many": lambda world: of_points(world.buffer.lookup_many("odom", "hook", STAMPS)[0]),
    "lookup_between": read_between,
    "plan.at": lambda world: of_transform(world.buffer.plan("odom", "hook").at(int(STAMPS[13]))),
    "plan.poses": lambda world: of_points(world.buffer.plan("odom", "hook").poses(STAMPS[9:14])),
    "place": lambda world: of_points(
        world.buffer.place(np.zeros((len(STAMPS), 3)), STAMPS, source="hook", target="odom")[0]
    ),
    "wait": lambda world: of_transform(world.buffer.wait("odom", "hook", timeout_s=0.01)),
    "wait_async": lambda world: of_transform(asyncio.run(world.buffer.wait_async("odom", "hook"))),
    "watch": read_watched,
    "latest": read_latest,
    "twist": read_twist,
    "joint_positions": read_joints,
    "joint_positions at the newest sample": read_newest_joints,
    "joint_positions_many": read_joints_many,
    "joint_states": read_joint_states,
    "link_poses": read_link_poses,
    "snapshot": lambda world: read_snapshot(world, None),
    "snapshot at a stamp": lambda world: read_snapshot(world, int(STAMPS[13])),
}


@pytest.mark.parametrize("door", DOORS)
def test_answer_beside_writers_that_restart_is_of_one_epoch_of_each_track(door: str) -> None:
    world, answers, begin = World(), 0, time.monotonic()
    with restarting(world.write_base, world.write_joints):
        while time.monotonic() < begin + SECONDS or not answers:
            assert time.monotonic() < begin + DEADLINE_S, "no lookup succeeds"
            try:
                numbers = DOORS[door](world)
            except LookupFailed:
                continue
            answers += 1
            for track, found in numbers.items():
                epochs = np.unique(np.round(found, 6))
                assert len(epochs) <= 1, f"{door}: {track} of the epochs {epochs}"
                assert (epochs == np.round(epochs)).all(), f"{door}: {track} between epochs, {epochs}"


def test_batch_beside_the_eviction_of_its_samples_has_the_numbers_of_its_stamps() -> None:
    """The writer moves and reuses the memory of samples that are too old, but none that a batch reads."""
    buffer, edges = TransformBuffer(history_s=0.02), tuple((f"p{n}", f"c{n}") for n in range(50))
    stamps, answers, begin = itertools.count(NOW, MS), 0, time.monotonic()

    def write(_: int) -> None:
        stamp = next(stamps)
        x = (stamp - NOW) / MS
        buffer.insert_many(edges, stamp, np.array([(x, 0, 0, 0, 0, 0, 1)] * 50).tobytes())

    write(0)
    with restarting(write):
        while time.monotonic() < begin + SECONDS or not answers:
            assert time.monotonic() < begin + DEADLINE_S, "no batch has a transform"
            newest = buffer.latest("p49", "c49")
            asked = newest + np.arange(-50, 10) * (MS // 2)
            poses, valid = buffer.lookup_many("p49", "c49", asked)
            np.testing.assert_allclose(poses[valid, 0], (asked[valid] - NOW) / MS, atol=1e-6)
            placed, known = buffer.place(np.zeros((len(asked), 3)), asked, source="c49", target="p49")
            np.testing.assert_allclose(placed[known, 0], (asked[known] - NOW) / MS, atol=1e-6)
            snapshot = buffer.snapshot(newest - MS // 2)
            moved = snapshot.poses[snapshot.known & (snapshot.tree.parents >= 0), 0]
            np.testing.assert_allclose(moved, (newest - MS // 2 - NOW) / MS, atol=1e-6)
            answers += int(valid.any())


def test_latest_raises_stale_where_a_lookup_of_the_newest_instant_does() -> None:
    """One edge was last heard of before the history of the other begins."""
    buffer = TransformBuffer(history_s=0.01)
    buffer.insert(moving("odom", "base", NOW))
    buffer.insert(moving("base", "arm", NOW))
    for stamp in range(NOW + 20 * MS, NOW + 40 * MS, MS):
        buffer.insert(moving("base", "arm", stamp))
    with pytest.raises(Stale) as of_latest:
        buffer.latest("odom", "arm")
    with pytest.raises(Stale) as of_lookup:
        buffer.lookup("odom", "arm")
    assert str(of_latest.value) == str(of_lookup.value)
    assert of_latest.value.edge == ("odom", "base")
