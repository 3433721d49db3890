"""Samples and descriptions in any order, handed over directly: no network, no waiting."""

from __future__ import annotations

from itertools import permutations

import msgspec
import pytest
from helpers.robots import RRBOT, assert_pose, kinematic_pose

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import MONOTONIC, ManualClock
from zstate.errors import LookupFailed
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.transforms import TransformIngest
from zstate.model.kinematics import Kinematics
from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.wire.messages import JointState, RobotDescription, Sample, TransformSample, order_digest, to_block
from zstate.wire.native import decode, encode, encoding_of

LONGER = load_model(RRBOT.urdf.replace('xyz="0 0 0.6"', 'xyz="0 0 0.9"'))
SWAPPED = load_model(RRBOT.urdf.replace('name="shoulder"', 'name="aa"'))
ELBOW = Kinematics(RRBOT).edges.index(("upper", "lower"))
EVERY = [JointStateIngest, TransformIngest]


def edge_names(model: RobotModel) -> tuple[tuple[str, str], ...]:
    return tuple((joint.parent, joint.child) for joint in model.joints if joint.type != "fixed")


def description(model: RobotModel = RRBOT, urdf: str | None = None, digest: str = "") -> RobotDescription:
    return RobotDescription(
        1, urdf or model.urdf, digest or model.digest, model.joint_names, edge_names(model)
    )


class IngestCase:
    """An ingest with its buffer and its counters."""

    def __init__(
        self,
        make: type[StreamIngest],
        buffer: TransformBuffer | None = None,
        sharing: IngestCase | None = None,
        *,
        is_shared: bool = False,
    ) -> None:
        self.clock = sharing.clock if sharing else ManualClock(domain=MONOTONIC)
        self.ownership = (
            sharing.ownership
            if sharing
            else FrameOwnership(
                buffer or TransformBuffer(), Counters(), is_shared=is_shared, clock=self.clock
            )
        )
        self.buffer, self.counters, self.live = (
            self.ownership.buffer,
            self.ownership.counters,
            self.ownership.live,
        )
        self.ingest: StreamIngest = make("r1", self.ownership)

    def receive(self, *samples: Sample) -> None:
        for sample in samples:
            self.ingest.insert_sample(sample, overflowed=False)

    def sample(
        self, seq: int, positions: list[float], session: int = 7, stamp: int | None = None, **more
    ) -> Sample:
        head = (seq if stamp is None else stamp, seq, session)
        if isinstance(self.ingest, JointStateIngest):
            return JointState(*head, order_digest(RRBOT.joint_names), to_block(positions))
        table = Kinematics(RRBOT)
        edges = edge_names(RRBOT)
        rows = [table.edges.index(edge) for edge in edges]
        poses = to_block(table.edge_poses(positions)[rows])
        return TransformSample(*head, order_digest(edges), poses, **more)

    def elbow_is(self, positions: list[float], at: int | None = None) -> bool:
        pose = self.buffer.lookup("r1/upper", "r1/lower", at)
        assert_pose(pose, kinematic_pose(RRBOT, positions, "upper", "lower"))
        return True


@pytest.fixture(params=EVERY)
def case(request: pytest.FixtureRequest) -> IngestCase:
    return IngestCase(request.param)


def test_samples_before_the_description_are_not_lost(case: IngestCase):
    case.receive(*[case.sample(n, [0.1 * n, 0.2 * n]) for n in range(4)])
    assert case.counters.stats().received == 0
    case.ingest.describe(description())
    assert case.counters.stats().received == 4
    assert all(case.elbow_is([0.1 * n, 0.2 * n], at=n) for n in range(4))


def test_samples_that_no_description_fits_are_counted(case: IngestCase):
    case.receive(*[case.sample(n, [0.0, 0.0]) for n in range(1030)])
    assert case.counters.stats().refused == {"no description": 6}
    case.ingest.describe(description())
    assert case.counters.stats().received == 1024


def test_seq_gaps_count_as_missed_or_as_dropped_by_the_own_ring(case: IngestCase):
    case.ingest.describe(description())
    case.receive(case.sample(10, [0, 0]), case.sample(13, [0, 0]))
    case.ingest.insert_sample(case.sample(15, [0, 0]), overflowed=True)
    case.receive(case.sample(14, [0, 0]), case.sample(16, [0, 0]))
    stats = case.counters.stats()
    assert (stats.received, stats.missed, stats.dropped) == (5, 2, 1)


def test_sample_older_than_the_history_counts_as_late(case: IngestCase):
    case = IngestCase(type(case.ingest), TransformBuffer(history_s=1e-6))
    case.ingest.describe(description())
    case.receive(case.sample(0, [0, 0], stamp=5000), case.sample(1, [0, 0], stamp=3999))
    stats = case.counters.stats()
    assert (stats.received, stats.late, stats.refused) == (1, 1, {})


def test_live_samples_that_the_history_overtook_are_no_clock_set_back(case: IngestCase):
    case.ingest.describe(description())
    second = 1_000_000_000
    samples = [case.sample(seq, [0, 0.1 * seq], stamp=(10 + seq) * second) for seq in range(6)]
    case.receive(samples[0])
    case.ingest.insert_history(samples)  # while samples 1 to 5 wait in the queue of a busy reader
    case.receive(*samples[1:])
    assert case.counters.stats().recalled == 5
    assert all(case.elbow_is([0, 0.1 * seq], at=(10 + seq) * second) for seq in range(6))


def test_second_sample_of_a_clock_set_back_starts_a_new_epoch(case: IngestCase):
    case = IngestCase(type(case.ingest), TransformBuffer(history_s=1e-6))
    case.ingest.describe(description())
    stamps = (5000, 1000, 1100, 1200)
    case.receive(*(case.sample(seq, [0, 0.1 * seq], stamp=at) for seq, at in enumerate(stamps)))
    stats = case.counters.stats()
    assert (stats.received, stats.late, stats.refused) == (3, 1, {})
    assert case.buffer.latest("r1/upper", "r1/lower") == 1200
    assert case.elbow_is([0, 0.2], 1100)


@pytest.mark.parametrize(("behind_ns", "is_set_back"), [(100_000_000, False), (100_000_001, True)])
def test_clock_more_than_a_tenth_of_a_second_behind_was_set_back(
    case: IngestCase, behind_ns: int, is_set_back: bool
):
    case.ingest.describe(description())
    newest = 10_000_000_000
    stamps = (newest, newest - behind_ns - 1, newest - behind_ns)
    case.receive(*(case.sample(seq, [0, 0.1 * seq], stamp=at) for seq, at in enumerate(stamps)))
    assert case.buffer.latest("r1/upper", "r1/lower") == (newest - behind_ns if is_set_back else newest)


def test_delayed_sample_does_not_end_the_epoch(case: IngestCase):
    case = IngestCase(type(case.ingest), TransformBuffer(history_s=1e-6))
    case.ingest.describe(description())
    stamps = (5000, 1000, 6000, 1100, 7000)
    case.receive(*(case.sample(seq, [0, 0], stamp=at) for seq, at in enumerate(stamps)))
    assert (case.counters.stats().received, case.counters.stats().late) == (3, 2)


def test_writer_with_a_slow_clock_does_not_take_over_edges_of_a_live_writer():
    ahead = IngestCase(TransformIngest, TransformBuffer(history_s=1e-6), is_shared=True)
    behind = IngestCase(TransformIngest, sharing=ahead)
    ahead.live |= {("r1", 7): "ahead", ("r1", 8): "behind"}
    for case, session in ((ahead, 7), (behind, 8)):
        case.ingest.describe(description())
        case.ingest.name_writer(session, behind.live["r1", session])
    ahead.receive(ahead.sample(0, [0, 0.5], stamp=9000))
    late = [behind.sample(seq, [0, 0], session=8, stamp=1000 + seq) for seq in range(3)]
    behind.receive(*late)
    assert behind.counters.stats().late == 3
    assert ahead.elbow_is([0, 0.5])
    del behind.live["r1", 7]
    behind.receive(behind.sample(3, [0, 0], session=8, stamp=1003))
    assert behind.elbow_is([0, 0], 1003)


def test_writer_that_returns_moves_no_edge_that_another_took_over():
    frozen = IngestCase(TransformIngest)
    rival = IngestCase(TransformIngest, sharing=frozen)
    edges, live = edge_names(RRBOT), frozen.live

    def join(case: IngestCase, session: int, name: str) -> None:
        live["r1", session] = name
        frozen.ownership.add_writer("r1", session)
        case.ingest.name_writer(session, name)

    def leave(case: IngestCase, session: int) -> None:
        del live["r1", session]
        frozen.ownership.remove_writer("r1", session)
        case.ingest.writer_left(session)

    join(frozen, 7, "frozen")
    frozen.receive(*(frozen.sample(seq, [1.0, 1.0], stamp=seq, edges=edges) for seq in range(3)))
    leave(frozen, 7)
    join(rival, 8, "rival")
    rival.receive(*(rival.sample(seq, [2.0, 2.0], 8, 10 + seq, edges=edges) for seq in range(3)))
    join(frozen, 7, "frozen")
    frozen.receive(*(frozen.sample(seq, [1.0, 1.0], stamp=20 + seq, edges=edges) for seq in range(3, 6)))
    assert rival.buffer.latest("r1/upper", "r1/lower") == 12
    assert rival.elbow_is([2.0, 2.0])
    assert rival.counters.stats().refused == {"second writer": 3}
    refusal = rival.counters.refusals()["second writer"]
    assert "is written by rival already; refused: frozen" in refusal
    leave(rival, 8)
    frozen.receive(frozen.sample(6, [1.0, 1.0], stamp=30, edges=edges))
    assert frozen.buffer.latest("r1/upper", "r1/lower") == 30
    assert frozen.buffer.explain("r1/upper", "r1/lower", 25) is not None  # between two writers is no pose


def test_frames_and_memory_of_a_writer_of_many_edges_are_bounded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.ingest.frame_ownership.MAX_MOVING_FRAMES", 50)
    monkeypatch.setattr("zstate.ingest.transforms._MAX_CACHED_EDGES", 100)
    monkeypatch.setattr("zstate.buffer.pose_tracks._MAX_CACHED_EDGES", 100)
    case = IngestCase(TransformIngest)

    def sample(seq: int, edges: tuple[tuple[str, str], ...]) -> TransformSample:
        poses = to_block([[0.0, 0.0, float(seq), 0.0, 0.0, 0.0, 1.0]] * len(edges))
        return TransformSample(seq, seq, 7, order_digest(edges), poses, edges)

    frames = [("odom", f"frame{number}") for number in range(50)]
    shuffled = list(permutations(frames[:5]))
    case.receive(sample(0, tuple(frames)))
    case.receive(*(sample(seq, tuple(edges)) for seq, edges in enumerate(shuffled, 1)))
    case.receive(sample(200, (("odom", "another"),)))
    assert case.counters.stats().refused == {"too many frames": 1}
    assert "moves 50 frames, and 1 more would exceed the limit" in case.counters.refusals()["too many frames"]
    assert len(case.ingest._full_names) <= 20
    assert len(case.buffer._pose_tracks._cache) <= 20
    case.receive(sample(201, tuple(frames[:5])))
    assert case.buffer.lookup("r1/odom", "r1/frame4").translation[2] == 201.0


def test_new_session_starts_a_new_epoch_even_if_its_clock_is_behind(case: IngestCase):
    case.ingest.describe(description())
    case.receive(case.sample(5, [1.0, 1.0], session=1, stamp=10**12))
    case.receive(case.sample(0, [0.5, 0.5], session=2, stamp=7))
    assert case.buffer.latest("r1/upper", "r1/lower") == 7
    assert case.elbow_is([0.5, 0.5])
    assert case.buffer.explain("r1/upper", "r1/lower", 10**12) is not None
    stats = case.counters.stats()
    assert (stats.received, stats.missed, stats.late, stats.refused) == (2, 0, 0, {})


def test_older_of_two_writers_is_counted_and_stays_refused(case: IngestCase):
    case.ingest.describe(description())
    for seq in range(10):
        case.receive(case.sample(seq, [1.0, 1.0], session=1, stamp=2 * seq))
        case.receive(case.sample(seq, [2.0, 2.0], session=2, stamp=2 * seq + 1))
    assert case.counters.stats().refused == {"second writer": 9}
    assert case.elbow_is([2.0, 2.0])
    assert case.buffer.explain("r1/upper", "r1/lower", 0) is not None


@pytest.mark.parametrize(("silent_ns", "is_accepted"), [(2_000_000_000 - 1, False), (2_000_000_000, True)])
def test_announced_writer_is_accepted_again_two_seconds_after_a_stray_sample(
    case: IngestCase, silent_ns: int, is_accepted: bool
):
    case.ingest.describe(description())
    case.ingest.name_writer(1, "driver")
    stray = msgspec.structs.replace(case.sample(0, [9.0, 9.0], session=9, stamp=0), order=bytes(8))
    case.receive(case.sample(0, [1.0, 1.0], session=1, stamp=1), stray)
    case.receive(case.sample(1, [1.0, 1.0], session=1, stamp=2))
    case.clock.set(silent_ns)
    case.receive(case.sample(2, [2.0, 2.0], session=1, stamp=3))
    assert case.counters.stats().refused["second writer"] == (1 if is_accepted else 2)
    if is_accepted:
        assert case.elbow_is([2.0, 2.0], at=3)


def test_announced_writer_stays_refused_while_an_unannounced_one_sends(case: IngestCase):
    case.ingest.describe(description())
    case.ingest.name_writer(1, "driver")
    case.receive(case.sample(0, [1.0, 1.0], session=1, stamp=0))
    for seq in range(5):
        case.clock.advance(1.9)
        case.receive(case.sample(seq, [2.0, 2.0], session=2, stamp=2 * seq + 1))
        case.receive(case.sample(seq + 1, [1.0, 1.0], session=1, stamp=2 * seq + 2))
    assert case.counters.stats().refused == {"second writer": 5}


def test_replaced_writer_is_accepted_again_with_its_own_description(case: IngestCase):
    case.ingest.describe(description())
    case.receive(case.sample(0, [1.0, 1.0], session=1))
    case.ingest.describe(msgspec.structs.replace(description(SWAPPED), session=2))
    case.receive(case.sample(1, [0.0, 0.0], session=2))
    case.ingest.writer_left(2)
    received = case.counters.stats().received
    case.receive(case.sample(3, [2.0, 2.0], session=1))
    assert case.counters.stats().received == received + 1
    assert case.elbow_is([2.0, 2.0], at=3)


def test_replaced_writer_is_accepted_again_after_the_newer_one_left(case: IngestCase):
    case.ingest.describe(description())
    case.receive(case.sample(0, [1.0, 1.0], session=1), case.sample(1, [2.0, 2.0], session=2))
    case.ingest.writer_left(1)
    case.receive(case.sample(2, [1.0, 1.0], session=1))
    assert case.counters.stats().refused == {"second writer": 1}
    case.ingest.writer_left(2)
    case.receive(case.sample(3, [1.0, 1.0], session=1))
    assert case.counters.stats().refused == {"second writer": 1}
    assert case.elbow_is([1.0, 1.0])
    case.receive(case.sample(4, [2.0, 2.0], session=2))
    assert case.counters.stats().refused == {"second writer": 2}


def test_writer_name_is_known_whether_announced_before_or_after_its_samples(case: IngestCase):
    case.ingest.describe(description())
    case.ingest.name_writer(1, "driver@arm pid 4")
    case.receive(case.sample(0, [0, 0], session=1))
    names = {frame.name: frame.writer for frame in case.buffer.frames()}
    assert names["r1/lower"] == "driver@arm pid 4"
    case.receive(case.sample(0, [0, 0], session=2))
    case.ingest.name_writer(2, "driver@arm pid 5")
    case.receive(case.sample(1, [0, 0], session=2))
    names = {frame.name: frame.writer for frame in case.buffer.frames()}
    assert names["r1/lower"] == "driver@arm pid 5"


def test_changed_model_replaces_the_robot_and_its_history():
    case = IngestCase(JointStateIngest)
    case.ingest.describe(description())
    case.receive(case.sample(0, [0.0, 0.0]))
    assert case.buffer.lookup("r1/lower", "r1/tool").translation[2] == 0.6
    case.ingest.describe(description(LONGER))
    assert case.buffer.lookup("r1/lower", "r1/tool").translation[2] == 0.9
    with pytest.raises(LookupFailed):
        case.buffer.lookup("r1/upper", "r1/lower")
    case.receive(case.sample(1, [0.3, 0.4]))
    assert case.elbow_is([0.3, 0.4])
    assert case.counters.stats().refused == {}


def test_repeated_description_leaves_the_history(case: IngestCase):
    payload = encode(description())
    case.ingest.describe(decode(payload, encoding_of(RobotDescription), RobotDescription))
    case.receive(case.sample(0, [0.1, 0.2]), case.sample(1, [0.3, 0.4]))
    case.ingest.describe(decode(payload, encoding_of(RobotDescription), RobotDescription))
    assert case.elbow_is([0.1, 0.2], at=0)
    assert case.elbow_is([0.3, 0.4], at=1)


def test_another_joint_order_than_the_models_is_refused():
    case = IngestCase(JointStateIngest)
    case.ingest.describe(description(SWAPPED))
    case.receive(case.sample(0, [0.0, 0.0]))
    assert case.counters.stats().refused == {"other joint order": 1}


@pytest.mark.parametrize(
    "urdf",
    [
        "rrbot",
        "/etc/hostname",
        "not XML",
        "<robot name='x'/>",
        "<robot name='x'><xacro:if value='1'/></robot>",
    ],
)
def test_description_without_urdf_text_is_refused_and_opens_no_file(urdf: str):
    case = IngestCase(JointStateIngest)
    case.ingest.describe(description(urdf=urdf, digest="ff"))
    assert case.counters.stats().refused == {"robot description": 1}
    assert case.buffer.frames() == ()
    case.ingest.describe(description())
    case.receive(case.sample(0, [0.5, 0.5]))
    assert case.elbow_is([0.5, 0.5])


@pytest.mark.parametrize("positions", [[0.0], [0.0, 0.0, 0.0], [0.0, float("nan")], [float("inf"), 0.0]])
def test_invalid_positions_are_refused(positions: list[float]):
    case = IngestCase(JointStateIngest)
    case.ingest.describe(description())
    case.receive(case.sample(0, positions), case.sample(1, [0.5, 0.5]))
    assert case.counters.stats().refused == {"bad numbers": 1}
    assert case.elbow_is([0.5, 0.5])


def test_transforms_that_name_their_edges_need_no_description():
    case = IngestCase(TransformIngest)
    case.receive(case.sample(0, [0.5, 0.5], edges=edge_names(RRBOT)))
    assert case.elbow_is([0.5, 0.5])
    case.receive(case.sample(0, [0.7, 0.7], session=8, stamp=-5, edges=edge_names(RRBOT)))
    assert case.buffer.latest("r1/upper", "r1/lower") == -5


def test_transforms_that_name_their_edges_stay_when_a_description_arrives():
    case = IngestCase(TransformIngest)
    case.receive(case.sample(0, [0.5, 0.5], stamp=5, edges=edge_names(RRBOT)))
    case.ingest.describe(RobotDescription(1, "", "", (), (("base", "left"),)))
    assert case.elbow_is([0.5, 0.5], at=5)


def test_transforms_in_the_order_of_another_robot_are_never_inserted():
    case = IngestCase(TransformIngest)
    case.receive(case.sample(0, [0.5, 0.5]))
    other = (("base", "left"), ("base", "right"))
    case.ingest.describe(RobotDescription(1, "", "", (), other))
    assert case.counters.stats().refused == {"no description": 1}
    assert case.buffer.frames() == ()


def test_changed_description_before_any_sample_is_used():
    case = IngestCase(TransformIngest)
    case.ingest.describe(RobotDescription(1, "", "", (), (("base", "left"),)))
    case.ingest.describe(description())
    case.receive(case.sample(0, [0.5, 0.5]))
    assert case.elbow_is([0.5, 0.5])


def test_description_with_impossible_frame_names_is_refused():
    case = IngestCase(TransformIngest)
    case.ingest.describe(RobotDescription(1, "", "", (), (("base", ""),)))
    assert case.counters.stats().refused == {"robot description": 1}
    case.ingest.describe(description())
    case.receive(case.sample(0, [0.5, 0.5]))
    assert case.elbow_is([0.5, 0.5])


def test_samples_of_a_robot_without_moving_edges_are_valid():
    case = IngestCase(TransformIngest)
    case.ingest.describe(RobotDescription(1, "", "", (), ()))
    case.receive(TransformSample(1, 0, 7, order_digest(()), b""))
    assert (case.counters.stats().received, case.counters.stats().refused) == (1, {})


def test_restart_keeps_edges_that_a_static_writer_took_over():
    from zstate.transform import Transform

    case = IngestCase(TransformIngest)
    case.ingest.describe(description())
    case.receive(case.sample(0, [0.5, 0.5]))
    case.buffer.insert_static(
        Transform("r1/upper", "r1/lower", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), writer="fixture"
    )
    case.ingest.describe(RobotDescription(1, "", "", (), (("base", "left"),)))
    assert case.buffer.lookup("r1/upper", "r1/lower").translation[0] == 1.0


def test_fixed_edges_name_the_model_writer_and_moving_edges_the_driver():
    case = IngestCase(JointStateIngest)
    case.ingest.describe(description())
    case.receive(case.sample(0, [0, 0]))
    case.ingest.name_writer(7, "driver")
    assert {frame.writer for frame in case.buffer.frames() if frame.kind == "static"} == {
        "the model of 'rrbot'"
    }
    case.ingest.name_writer(1, "publisher")
    writers = {(frame.kind, frame.writer) for frame in case.buffer.frames() if frame.parent}
    assert writers == {("static", "publisher"), ("joint", "driver")}
