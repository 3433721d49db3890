"""Frames are compared again only where something has changed, with the result of a comparison of all."""

from __future__ import annotations

import random
from contextlib import suppress

import pytest
from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InsertRefused
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import EdgeSource, FrameOwnership
from zstate.transform import Transform

ROBOTS = ("r1", "r2", "r3")
FRAMES = (
    *(f"{robot}/{name}" for robot in ROBOTS for name in ("world", "base", "tool", "camera")),
    *("fleet/map", "fleet/dock", "site/map"),
)


def pose(parent: str, child: str) -> Transform:
    return Transform(parent, child, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class Writers:
    """Writers that publish, join and leave at random."""

    def __init__(self, seed: int, *, is_shared: bool) -> None:
        self.choose = random.Random(seed)
        self.is_shared = is_shared
        placers = self.choose.choice([None, ["r1"]])
        self.ownership = FrameOwnership(TransformBuffer(), Counters(), is_shared=is_shared, placers=placers)
        self.buffer = self.ownership.buffer
        self.statics = [self.source(robot, number) for robot in ROBOTS for number in range(2)]
        self.moving = [self.source(robot, 10 + number) for robot in ROBOTS for number in range(2)]
        self.tracks: dict[str, object] = {}
        self.stamp = 0

    def source(self, robot: str, number: int) -> EdgeSource:
        return EdgeSource(robot, f"{robot} {number}", number, is_model=self.choose.random() < 0.2)

    def edges(self, number: int) -> list[tuple[str, str]]:
        return [(self.choose.choice(FRAMES), self.choose.choice(FRAMES)) for _ in range(number)]

    def step(self) -> None:
        actions = [self.set_statics] * 3 + [self.move] * 3 + [self.join, self.leave, self.release, self.model]
        if not self.is_shared:  # in ROS nothing is withdrawn, and no frame belongs to a robot
            actions += [self.withdraw, self.describe]
        action = self.choose.choice(actions)
        action()

    def set_statics(self) -> None:
        adds = self.choose.random() < 0.2
        edges = {edge: pose(*edge) for edge in self.edges(self.choose.randrange(4)) if edge[0] != edge[1]}
        self.ownership.set_statics(self.choose.choice(self.statics), edges, adds=adds)

    def move(self) -> None:
        source = self.choose.choice(self.moving)
        edges = list(dict.fromkeys(source.claims)) if self.choose.random() < 0.5 else []
        edges = edges or [edge for edge in self.edges(2) if edge[0] != edge[1]]
        self.stamp += 1
        try:
            self.insert(source, edges)
        except InsertRefused:  # as an ingest does
            self.ownership.resolve_edges(edges)
            with suppress(InsertRefused):
                self.insert(source, edges)

    def insert(self, source: EdgeSource, edges: list[tuple[str, str]]) -> None:
        admitted = self.ownership.admit(source, edges)
        inserted = [edges[row] for row in (range(len(edges)) if admitted.rows is None else admitted.rows)]
        if inserted:
            poses = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)] * len(inserted)
            self.buffer.insert_many(inserted, self.stamp, poses, writer=source.name)

    def join(self) -> None:
        source = self.choose.choice(self.statics + self.moving)
        self.ownership.live[source.robot, source.session] = source.name
        self.ownership.add_robot(source.robot)
        self.ownership.add_writer(source.robot, source.session)

    def leave(self) -> None:
        source = self.choose.choice(self.statics + self.moving)
        self.ownership.live.pop((source.robot, source.session), None)
        self.ownership.remove_writer(source.robot, source.session)

    def release(self) -> None:
        self.ownership.release(self.choose.choice(self.statics + self.moving))

    def withdraw(self) -> None:
        self.ownership.withdraw_statics(self.choose.choice(self.statics))

    def describe(self) -> None:
        self.ownership.add_description(self.choose.choice(ROBOTS))

    def model(self) -> None:
        robot = self.choose.choice(ROBOTS)
        self.ownership.add_robot(robot)
        before = self.tracks.pop(robot, None)
        self.tracks[robot] = self.ownership.place_model(robot, RRBOT, before)

    def state(self) -> dict[str, object]:
        """What is accepted, and which edges the buffer holds."""
        claims = [claim for claims in self.ownership._claims.values() for claim in claims]
        names = {claim: (claim.source.name, *claim.names) for claim in claims}
        frames = self.buffer.frames()
        return {
            "accepted": {names[claim]: claim.is_accepted for claim in claims},
            "frames": {(frame.name, frame.parent) for frame in frames if frame.parent},
        }


@pytest.mark.parametrize("seeds", [20, pytest.param(60, marks=pytest.mark.soak)])
@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.long
def test_result_is_that_of_a_comparison_of_all_edges(is_shared: bool, seeds: int):
    refused = 0
    for seed in range(seeds):
        writers = Writers(seed, is_shared=is_shared)
        for _ in range(40):
            writers.step()
            before = writers.state()
            if writers.ownership._unresolved:
                continue
            writers.ownership._unresolved.update(writers.ownership._claims)
            writers.ownership.resolve()
            assert writers.state() == before, seed
            refused += writers.ownership._refused.total()
    assert refused > 1000 * seeds // 60


def compared_when_a_writer_joins(edges: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many edges are compared for a robot that joins a network of ``edges``, one of which is refused."""
    ownership = FrameOwnership(TransformBuffer(), Counters())
    placed = {("r1/map", f"r1/f{number}"): pose("r1/map", f"r1/f{number}") for number in range(edges)}
    ownership.set_statics(EdgeSource("r1", "map", 1), placed)
    ownership.set_statics(EdgeSource("r1", "wrong", 2), {("r1/dock", "r1/f0"): pose("r1/dock", "r1/f0")})
    assert ownership._refused.total() == 1
    compared = 0
    compare = FrameOwnership._refusal

    def counted(*arguments):
        nonlocal compared
        compared += 1
        return compare(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(FrameOwnership, "_refusal", counted)
        moving = EdgeSource("r2", "base", 3)
        ownership.live["r2", 3] = "base"
        ownership.add_robot("r2")
        ownership.add_writer("r2", 3)
        ownership.admit(moving, [("r2/odom", "r2/base")])
        ownership.set_statics(
            EdgeSource("r2", "mount", 4), {("r2/base", "r2/arm"): pose("r2/base", "r2/arm")}
        )
        ownership.remove_writer("r2", 3)
        ownership.release(moving)
    return compared


def test_one_refused_edge_does_not_make_a_join_cost_more_on_a_larger_network(monkeypatch: pytest.MonkeyPatch):
    few, many = (compared_when_a_writer_joins(number, monkeypatch) for number in (10, 1000))
    assert many == few
